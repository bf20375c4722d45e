"""Rest is a state that maps onto itself to the last bit; the motor reaches it and stays."""

from dataclasses import replace

import pytest
from hypothesis import event, given
from hypothesis import strategies as st

from motorhil.emulators.firmware import servo
from motorhil.emulators.firmware.axis import Axis
from motorhil.emulators.firmware.flags import PROFILE_ACTIVE, SPEED_ZERO
from motorhil.emulators.firmware.servo_tables import ServoGains, ServoTables
from motorhil.emulators.plant.dc_motor import MotorPlant
from motorhil.emulators.plant.presets import PLAUSIBLE, WHEEL_60W

MS = 1_000_000


def make(plant: MotorPlant, tick_ns: int = MS, steps: int = 10) -> Axis:
    axis = Axis(plant, ServoGains.tuned(plant, tick_ns, steps), tick_ns, steps)
    axis.power(True)
    axis.at(100 * MS)
    return axis


def run_to_rest(axis: Axis, limit_ns: int) -> int | None:
    """Let the axis wake as it requests; return when it rests [ns], or None."""
    now = axis._time.tick * axis._tick_ns
    wake = axis.next_event_ns()
    while wake is not None:
        now = wake
        if now > limit_ns:
            return None
        axis.at(now)
        wake = axis.next_event_ns()
    return now


def ticks_to_rest(axis: Axis, limit: int = 60_000) -> int:
    """Return the ticks until the state no longer changes."""
    start = axis._time.tick
    while not axis._time.resting:
        axis.at((axis._time.tick + 1) * axis._tick_ns)
        assert axis._time.tick < start + limit
    return axis._time.tick - start


def assert_fixed(axis: Axis, plant: MotorPlant) -> None:
    """Check that 100 further ticks of the step function change nothing, not even a zero's sign."""
    time = axis._time
    tick_ns, steps = axis._tick_ns, axis._time._current_steps
    tables = ServoTables(plant, ServoGains.tuned(plant, tick_ns, steps), tick_ns, steps)
    load = tables.load(axis.load_torque_n_m())
    state = time.state
    for tick in range(time.tick, time.tick + 100):
        state, _, _ = servo.run(
            *(tables.tick, tables.step, steps, load, time._windows, time._orders),
            *(state, tick, 1, False),
        )
        assert repr(state) == repr(time.state)


MOVES = st.integers(-30_000, 30_000) | st.integers(-30, 30)


@given(
    st.sampled_from(sorted(PLAUSIBLE)),
    st.sampled_from([(MS, 10), (MS, 10), (MS, 1), (500_000, 4), (2 * MS, 5)]),
    st.sampled_from([400, 2000, 8192]),
    st.floats(0.3, 4.0),
    st.floats(-0.8, 0.8),
    MOVES,
    st.floats(0.02, 0.6),
    st.floats(0.02, 0.5),
)
def test_powered_axis_after_any_move_rests_exactly(
    name, clock, increments, friction_share, load_share, distance, speed_share, acceleration_share
):
    preset = PLAUSIBLE[name]
    plant = replace(
        preset,
        encoder_increments_rev=increments,
        coulomb_friction_n_m=preset.coulomb_friction_n_m * friction_share,
    )
    stall_n_m = plant.torque_constant_n_m_a * plant.current_max_a
    load_n_m = load_share * (stall_n_m * 0.5 - plant.coulomb_friction_n_m)
    acceleration = acceleration_share * stall_n_m * 0.4 / plant.inertia_kg_m2()
    inc = plant.increments_per_rad()
    axis = make(plant, *clock)
    axis.set_load(load_n_m * plant.gear_ratio)
    axis.at(400 * MS)
    axis.move_to(
        distance,
        speed_share * plant.no_load_speed_rad_s() * inc,
        acceleration * inc,
        acceleration * inc,
    )
    assert run_to_rest(axis, 120_000 * MS) is not None
    assert not axis.flags & PROFILE_ACTIVE
    axis.at((axis._time.tick + 10**9) * clock[0])  # at once
    assert axis.position_inc() == axis.demand_inc() == distance
    assert axis.output_velocity_rad_s() == axis.velocity_inc_s() == 0.0
    assert axis.flags & SPEED_ZERO
    assert_fixed(axis, plant)
    event("moved" if distance else "stayed")


@pytest.mark.parametrize("name", PLAUSIBLE)
def test_default_motors_rest_soon(name):
    """The limit covers the encoder's averages, the current, and the integrator's last increment.

    More ticks are needed if friction holds the motor an increment short until the integrator has
    pushed it over.
    """
    plant = PLAUSIBLE[name]
    for distance in (100_000, -20_000, 1_000, 7, 1):
        axis = make(plant)
        axis.move_to(distance, 100_000.0, 300_000.0, 300_000.0)
        while axis.flags & PROFILE_ACTIVE:
            axis.at((axis._time.tick + 1) * MS)
        assert ticks_to_rest(axis) < 500
        assert axis.position_inc() == distance
        axis.power(False)
        assert ticks_to_rest(axis) < 10
        assert_fixed(axis, plant)


def test_unpowered_axis_rests_from_the_start():
    axis = Axis(WHEEL_60W, ServoGains.tuned(WHEEL_60W, MS, 10), MS, 10)
    assert axis.next_event_ns() is None
    axis.at(3_600_000 * MS)
    assert axis._time.resting


def test_rest_costs_nothing(monkeypatch):
    axis = make(WHEEL_60W)
    ticks_to_rest(axis)

    def never(*_):
        raise AssertionError("a resting axis was stepped")

    monkeypatch.setattr(servo, "run", never)
    for hour in range(1, 100):
        axis.at(hour * 3_600_000 * MS)
        assert axis.next_event_ns() is None


@pytest.mark.parametrize(("tick_ns", "steps"), [(250_000, 5), (500_000, 10), (MS, 1), (2 * MS, 20)])
def test_other_servo_clocks_move_and_rest(tick_ns, steps):
    axis = make(WHEEL_60W, tick_ns, steps)
    axis.move_to(50_000, 80_000.0, 400_000.0, 400_000.0)
    worst = 0
    while axis.flags & PROFILE_ACTIVE:
        axis.at((axis._time.tick + 1) * tick_ns)
        worst = max(worst, abs(axis.following_error_inc()))
    assert worst < 60
    ticks_to_rest(axis)
    assert axis.position_inc() == 50_000


def test_frictionless_axis_keeps_its_position():
    plant = replace(WHEEL_60W, coulomb_friction_n_m=0.0)
    axis = make(plant)
    axis.move_to(20_000, 100_000.0, 1e6, 1e6)
    axis.at(1_000 * MS)
    for k in range(1_000, 3_000):
        axis.at(k * MS)
        assert abs(axis.position_inc() - 20_000) <= 2


def test_overloaded_axis_yields_and_recovers():
    axis = make(WHEEL_60W)
    axis.set_current_limit(0.3)
    axis.set_load(2.0)  # 30 mN m at the motor against 8 from the current and 4 from friction
    axis.at(400 * MS)
    assert axis.position_inc() < -100
    axis.set_load(0.0)
    axis.set_current_limit(8.0)
    axis.at(6_000 * MS)
    assert axis.position_inc() == 0
