"""Readers change neither the motion nor the wake-up times of a drive."""

from dataclasses import replace

import pytest
from hypothesis import event, given, settings
from hypothesis import strategies as st

from motorhil.emulators.firmware import servo
from motorhil.emulators.firmware.axis import Axis
from motorhil.emulators.firmware.flags import IN_TARGET_WINDOW, PROFILE_ACTIVE
from motorhil.emulators.firmware.servo_tables import ServoGains, ServoTables
from motorhil.emulators.plant.presets import MAST_20W, WHEEL_60W

MS = 1_000_000
TICK_NS = MS
PLANTS = {
    "wheel": WHEEL_60W,
    "mast": MAST_20W,
    "sliding": replace(MAST_20W, coulomb_friction_n_m=0.0, encoder_increments_rev=400),
}


def gains_of(name: str, softer: float = 1.0) -> ServoGains:
    gains = ServoGains.tuned(PLANTS[name], MS, 10)
    return replace(
        gains,
        position_kp_1_s=gains.position_kp_1_s * softer,
        current_kp_v_a=gains.current_kp_v_a * (0.5 + 0.5 * softer),
    )


TABLES = {
    (name, softer): ServoTables(PLANTS[name], gains_of(name, softer), MS, 10)
    for name in PLANTS
    for softer in (1.0, 0.25)
}

# Commands: name and arguments. Small moves and short ramps, so that ends and rests occur.
SPEEDS = st.sampled_from([500.0, 20_000.0, 150_000.0])
RAMPS = st.sampled_from([50_000.0, 1_000_000.0])
COMMANDS = st.one_of(
    st.tuples(st.just("move_to"), st.integers(-3000, 3000), SPEEDS, RAMPS, RAMPS),
    st.tuples(st.just("move_to"), st.integers(-3, 3), SPEEDS, RAMPS, RAMPS),
    st.tuples(st.just("run_at"), st.sampled_from([0.0, -3000.0, 80_000.0]), RAMPS, RAMPS),
    st.tuples(st.just("ramp_to_rest"), RAMPS),
    st.tuples(st.just("follow"), st.integers(-500, 500), st.sampled_from([MS, 4 * MS, 2_500_000])),
    st.tuples(
        st.just("apply_current"),
        st.sampled_from([0.0, 0.3, -2.0, 50.0]),
        st.sampled_from([1.0, 40.0, float("inf")]),
    ),
    st.tuples(st.just("set_gains"), st.sampled_from([1.0, 0.25])),
    st.tuples(st.just("hold")),
    st.tuples(st.just("power"), st.booleans()),
    st.tuples(st.just("set_load"), st.sampled_from([0.0, 1.0, -2.0])),
    st.tuples(st.just("set_current_limit"), st.sampled_from([0.5, 8.0])),
    st.tuples(st.just("set_current_limit"), st.just(3.0), st.sampled_from([0.2, 8.0])),
    st.tuples(st.just("set_position"), st.integers(-100, 100)),
)
WAITS_NS = st.sampled_from([0, 1, 300_000, MS, MS + 1, 3 * MS, 10 * MS, 64 * MS, 400 * MS])
ASKS = st.tuples(st.just("next_event_ns"), st.none() | WAITS_NS)
LOOKS = st.tuples(st.just("look"))
ACTIONS = st.lists(
    st.tuples(WAITS_NS, st.one_of(LOOKS, ASKS, ASKS, COMMANDS)), min_size=10, max_size=40
)

BEGIN = [
    (0, ("power", True)),
    (MS, ("next_event_ns", None)),
    (0, ("move_to", 1500, 20_000.0, 1e6, 1e6)),
]


class Plain:
    """The same servo run one tick at a time, with the axis' own orders."""

    def __init__(self, name: str, axis: Axis) -> None:
        self.tables = TABLES[name, 1.0]
        self.axis = axis
        self.tick = 0
        self.state = servo.standing(0.0)
        self.load = self.tables.load(PLANTS[name].load_torque_n_m)

    def one_more(self, tick: int, state: servo.State) -> servo.State:
        time = self.axis._time
        after, made, _ = servo.run(
            *(self.tables.tick, self.tables.step, 10, self.load),
            *(time._windows, time._orders, state, tick, 1, False),
        )
        assert made == 1
        return after

    def reach(self, tick: int) -> None:
        while self.tick < tick:
            self.state = self.one_more(self.tick, self.state)
            self.tick += 1

    def flags_after(self, ticks: int) -> list[int]:
        """Return the flags of the next ticks without commands."""
        flags, state = [], self.state
        for tick in range(self.tick, self.tick + ticks):
            state = self.one_more(tick, state)
            flags.append(state[servo.I_FLAGS])
        return flags


def make(name: str) -> tuple[Axis, Plain]:
    plant = PLANTS[name]
    axis = Axis(plant, gains_of(name), TICK_NS, 10)
    return axis, Plain(name, axis)


def command(plant: str, axis: Axis, name: str, *arguments) -> None:
    """Give a command if the power stage's state allows it, like a drive."""
    powered = axis._mode != servo.OFF
    if name == "set_gains":
        axis.set_gains(gains_of(plant, *arguments))
    elif powered or name in ("power", "set_load", "set_current_limit", "set_position"):
        getattr(axis, name)(*arguments)


@settings(max_examples=3 * settings().max_examples)
@given(st.sampled_from(sorted(PLANTS)), ACTIONS)
def test_any_queries_states_equal_plain_run(name, actions):
    axis, plain = make(name)
    now = 0
    for wait, (what, *arguments) in BEGIN + actions:
        now += wait
        plain.reach(now // TICK_NS)
        axis.at(now)
        assert repr(axis._time.state) == repr(plain.state)  # repr: to the bit
        assert axis.flags == plain.state[servo.I_FLAGS]
        if what == "next_event_ns":
            check_next_event(axis, plain, now, arguments[0])
        elif what != "look":
            command(name, axis, what, *arguments)
            event(what)
            plain.state = axis._time.state  # a command can change the flags
            if what == "set_gains":
                plain.tables = TABLES[name, arguments[0]]
            if what in ("set_gains", "set_load"):
                plain.load = plain.tables.load(axis.load_torque_n_m())


def check_next_event(axis: Axis, plain: Plain, now: int, within_ns: int | None) -> None:
    """Check: later than now, not later than the first change of flags or the limit."""
    limit = None if within_ns is None else now + within_ns
    answer = axis.next_event_ns(limit)
    flags = axis.flags
    if answer is None:
        event("rest")
        assert set(plain.flags_after(120)) == {flags}
        return
    event("limited" if answer == limit else "work goes on")
    assert limit is None or answer <= limit
    assert answer > now or answer == limit
    quiet = -(-answer // TICK_NS) - plain.tick - 1  # ticks strictly before the answer
    assert all(other == flags for other in plain.flags_after(quiet))


@given(
    st.sampled_from(sorted(PLANTS)),
    st.lists(st.tuples(st.integers(1, 200), COMMANDS), max_size=8),
    st.lists(st.integers(0, 40 * MS), max_size=60),
    st.sampled_from([None, 20 * MS]),
)
def test_any_readers_flags_and_wakes_are_the_same(name, commands, looks, limit_step_ns):
    seen, wakes = drive(name, commands, [], limit_step_ns)
    seen_too, wakes_too = drive(name, commands, looks, limit_step_ns)
    assert wakes == wakes_too
    assert seen == seen_too == every_change(name, commands)
    event("many wakes" if len(wakes) > 200 else "few wakes")


def schedule(commands) -> list[tuple[int, tuple]]:
    due, now = [(0, ("power", True))], 0
    for wait_ms, what in commands:
        now += wait_ms * MS + 123_456
        due.append((now, what))
    return due


def drive(name, commands, looks, limit_step_ns):
    """Return (tick, flags) of each change and the wake-ups; looks are intervals."""
    axis, _ = make(name)
    due = schedule(commands)
    end = due[-1][0] + 500 * MS
    looks = [*looks]
    now, seen, wakes, flags = 0, [], [], axis.flags
    while now < end:
        if axis.flags != flags:
            flags = axis.flags
            seen.append((now // TICK_NS, flags))
        if due and due[0][0] == now:
            command(name, axis, *due.pop(0)[1])
            if axis.flags != flags:
                flags = axis.flags
                seen.append((now // TICK_NS, flags))
            continue
        limit = None if limit_step_ns is None else (now // limit_step_ns + 1) * limit_step_ns
        wake = axis.next_event_ns(limit)
        after = due[0][0] if due else end
        if limit is not None:
            after = min(after, limit)
        after = after if wake is None else min(after, wake)
        look = now
        while looks and look + looks[0] < after:
            look += looks.pop(0)
            axis.at(look)
        now = after
        wakes.append(now)
        axis.at(now)
    return seen, wakes


def every_change(name, commands) -> list[tuple[int, int]]:
    axis, _ = make(name)
    due = schedule(commands)
    end = due[-1][0] + 500 * MS
    seen, flags = [], axis.flags
    for tick in range(-(-end // TICK_NS)):
        axis.at(tick * TICK_NS)
        if axis.flags != flags:
            flags = axis.flags
            seen.append((tick, flags))
        while due and due[0][0] // TICK_NS == tick:
            command(name, axis, *due.pop(0)[1])
            if axis.flags != flags:
                flags = axis.flags
                seen.append((tick, flags))
    axis.at(end)
    if axis.flags != flags:
        seen.append((end // TICK_NS, axis.flags))
    return seen


def test_move_begins_ends_and_is_seen():  # an axis that never changes would pass above
    seen, wakes = drive("wheel", [(10, ("move_to", 3000, 20_000.0, 1e6, 1e6))], [], None)
    assert any(flags & PROFILE_ACTIVE for _, flags in seen)
    assert seen[-1][1] & IN_TARGET_WINDOW
    assert len(wakes) < 30  # of about 500 ticks: it ran ahead, and rested


def test_states_kept_before_a_command_are_discarded():
    """The axis has run ahead to rest, past several readings; then a new command comes."""
    axis, plain = make("wheel")
    axis.set_windows(velocity_threshold_inc_s=1e9)  # no flag changes on the way to rest
    axis.power(True)
    axis.move_to(200, 20_000.0, 1e6, 1e6)
    commands = 0
    for k in range(1, 3000):
        axis.at(k * MS)
        plain.reach(k)
        assert repr(axis._time.state) == repr(plain.state)
        if axis._time._ahead_resting and axis._time._ahead_tick > k + 2:
            axis.move_to((-1) ** k * k, 20_000.0, 1e6, 1e6)
            plain.state = axis._time.state
            commands += 1
            axis.next_event_ns()
        elif k % 2:
            axis.next_event_ns()
    assert commands > 3


@pytest.fixture
def runs(monkeypatch) -> list[int]:
    """Return a list to which every call of `servo.run` appends the number of its ticks."""
    made = []
    run = servo.run

    def counted(*arguments):
        result = run(*arguments)
        made.append(result[1])
        return result

    monkeypatch.setattr(servo, "run", counted)
    return made


def test_commands_every_tick_are_not_computed_twice(runs):
    """Cyclic demands make running ahead useless; it stops, except for occasional tries."""
    axis, _ = make("wheel")
    axis.power(True)
    for k in range(2000):
        axis.at(k * MS)
        axis.next_event_ns()
        axis.at(k * MS + 200_000)
        axis.follow(10 * k, MS)
        axis.next_event_ns()
    assert sum(runs) < 2000 * 1.05


def look_at(places) -> None:
    """Move for a long time, and read at these places of every 20 ms."""
    axis, _ = make("wheel")
    axis.power(True)
    axis.move_to(10**9, 50_000.0, 1e6, 1e6)
    wake = axis.next_event_ns()
    for k in range(20, 4000, 20):
        for place in places:
            while wake is not None and wake < (k + place) * MS:
                axis.at(wake)
                wake = axis.next_event_ns()
            axis.at((k + place) * MS)
            wake = axis.next_event_ns()


def test_periodic_looks_cost_no_second_computation(runs):
    look_at([0])
    assert sum(runs) < 4000 * 1.2


def test_looks_of_two_readers_cost_one_call_each(runs):
    look_at([0, 1])
    assert sum(runs) < 4000 * 1.2
    assert len(runs) < 2 * 200 * 1.5


def test_limit_within_a_tick_is_the_next_wake():
    """Nothing can change between the last tick before the limit and the limit."""
    axis, _ = make("wheel")
    axis.power(True)
    axis.move_to(10**9, 50_000.0, 1e6, 1e6)
    wakes = []
    for limit_ns in range(20_300_000, 2000 * MS, 20 * MS):
        wakes.append(axis.next_event_ns(limit_ns))
        while wakes[-1] < limit_ns:
            axis.at(wakes[-1])
            wakes.append(axis.next_event_ns(limit_ns))
        axis.at(limit_ns)
    learnt = wakes[20:]
    assert learnt == [*range(learnt[0], 2000 * MS, 20 * MS)]
