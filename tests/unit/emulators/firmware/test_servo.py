"""Ten steps as one map equal ten steps, and the axis follows its equations."""

import math
from dataclasses import replace

import pytest
from hypothesis import event, given
from hypothesis import strategies as st

from motorhil.emulators.firmware import profile, servo
from motorhil.emulators.firmware import servo as current_loop
from motorhil.emulators.firmware.axis import Axis
from motorhil.emulators.firmware.servo_tables import ServoGains, ServoTables
from motorhil.emulators.plant.presets import PLAUSIBLE, WHEEL_60W
from tests.support.motion.reference import ReferenceAxis

MS = 1_000_000
WINDOWS = (10.0, 1e300, 0.5, 2.0, 1, 1, 11, 11, -1e300, 1e300)
TABLES = {
    name: ServoTables(p, ServoGains.tuned(p, MS, 10), MS, 10) for name, p in PLAUSIBLE.items()
}


def one_tick(tables, load_table, state):
    """Return the state one tick later, at hold; step by step if the load table forbids the map."""
    orders = (servo.POSITION, 0, -1.0, profile.hold(0.0), True, 0.0, 0.0, 8.0, 8.0)
    after, made, _ = servo.run(
        *(tables.tick, tables.step, tables.current_steps, load_table),
        *(WINDOWS, orders, state, 0, 1, False),
    )
    assert made == 1
    return after


def state_with(i, u, w, wanted):
    quiet = servo.standing(0.0)
    return (True, i, u, w, 0.5, 0.0, wanted, *quiet[7:])


@given(
    st.floats(allow_infinity=False, allow_nan=False)
    | st.floats(-1e7, 1e7)
    | st.integers(-(2**53), 2**53).map(lambda halves: halves / 2)
    | st.integers(-(2**51), 2**51).map(lambda number: math.nextafter(float(number), -math.inf))
)
def test_whole_equals_floor_division(x):
    assert servo.whole(x) == x // 1.0


def check_one_tick(name, current, error, speed, mismatch, load):
    plant, tables = PLAUSIBLE[name], TABLES[name]
    wanted = max(-8.0, min(8.0, current + error))
    u = plant.resistance_ohm * wanted + plant.torque_constant_n_m_a * speed + mismatch
    u = max(-24.0, min(24.0, u))
    state = state_with(current, u, speed, wanted)
    mapped = one_tick(tables, tables.load(load * plant.gear_ratio), state)
    singly = current_loop.steps(tables.step, 10, load, wanted, current, u, speed, 0.5)
    got = mapped[1:5]
    # Ten products of matrices against ten steps: rounding relative to the quantities.
    assert got[0] == pytest.approx(singly[0], rel=1e-9, abs=1e-10)
    assert got[1] == pytest.approx(singly[1], rel=1e-9, abs=1e-9)
    assert got[2] == pytest.approx(singly[2], rel=1e-9, abs=1e-8)
    assert got[3] == pytest.approx(singly[3], rel=1e-9, abs=1e-7)
    return "step by step" if got == singly else "mapped"


NAMES = st.sampled_from(sorted(PLAUSIBLE))
LOADS_N_M = st.floats(-0.01, 0.01)


@given(
    NAMES,
    st.floats(-4.0, 4.0),
    st.floats(-8.0, 8.0) | st.floats(-0.3, 0.3),
    st.floats(-500.0, 500.0) | st.floats(-5.0, 5.0) | st.floats(-0.3, 0.3),
    st.floats(-30.0, 30.0) | st.floats(-0.3, 0.3),
    LOADS_N_M,
)
def test_one_map_equals_ten_steps(name, current, error, speed, mismatch, load):
    event(check_one_tick(name, current, error, speed, mismatch, load))


@given(
    NAMES,
    st.floats(-0.03, 0.03),
    st.floats(-0.03, 0.03),
    st.floats(-0.03, 0.03) | st.floats(-0.2, 0.2),
    st.floats(-0.0005, 0.0005),
)
def test_one_map_equals_ten_steps_of_stuck_rotor(name, current, error, mismatch, load):
    event(check_one_tick(name, current, error, 0.0, mismatch, load))


@pytest.mark.parametrize("sign", [1.0, -1.0])
def test_rotor_dipping_through_standstill_is_stepped(sign):
    """Both ends of such a tick turn the same way; friction changes its sign in between."""
    plant, tables = PLAUSIBLE["wheel_60w"], TABLES["wheel_60w"]
    dips = 0
    for hundredths in range(2, 150, 2):
        speed = 0.01 * hundredths
        mismatch = -sign * plant.torque_constant_n_m_a * speed  # u = R * wanted
        check_one_tick("wheel_60w", -sign * 4.0, sign * 8.0, sign * speed, mismatch, 0.0)
        i, u, w, x = -4.0 * sign, plant.resistance_ohm * 4.0 * sign, speed * sign, 0.5
        lowest = speed
        for _ in range(10):
            i, u, w, x = current_loop.steps(tables.step, 1, 0.0, 4.0 * sign, i, u, w, x)
            lowest = min(lowest, w * sign)
        dips += lowest <= 0.0 < w * sign
    assert dips > 3


def test_rotor_breaking_loose_within_tick_is_stepped():
    """Current and integrator are far from their steady state, in which the rotor would stick."""
    loose = 0
    for mismatch_mv in range(-300, 301, 20):
        check_one_tick("wheel_60w", 0.1, -0.1, 0.0, mismatch_mv * 1e-3, 0.0)
        state = (0.1, mismatch_mv * 1e-3, 0.0, 0.5)
        loose += current_loop.steps(TABLES["wheel_60w"].step, 10, 0.0, 0.0, *state)[3] != 0.5
    assert loose > 5


def test_clipped_voltage_does_not_wind_up_integrator():
    for sign in (1.0, -1.0):
        table = TABLES["wheel_60w"].step
        i, u, w, x = current_loop.steps(table, 1000, 0.0, sign * 1e6, 0.0, 0.0, 0.0, 0.0)
        assert (u, w * sign > 800.0) == (0.0, True)  # clipped from the first step to the last
        i, u, w, x = current_loop.steps(
            table, 1, 0.0, sign * (i * sign - 50.0), i, 20.0 * sign, w, x
        )
        assert u * sign < 20.0  # not enough to clip: it integrates


def test_rotor_about_to_leave_does_not_creep_backwards():
    """Its torque exceeds the friction only at the end of the step: not enough to leave in it."""
    plant, table = PLAUSIBLE["wheel_60w"], TABLES["wheel_60w"].step
    gains = ServoGains.tuned(plant, MS, 10)
    breakaway_a = plant.coulomb_friction_n_m / plant.torque_constant_n_m_a
    for sign in (1.0, -1.0):
        i, wanted = sign * breakaway_a * 0.5, sign * breakaway_a
        # a voltage that lifts the current to 1.02 of the breakaway value: 0.4 of its end in a step
        voltage = plant.resistance_ohm * sign * breakaway_a * 1.79
        u = voltage - gains.current_kp_v_a * (wanted - i)
        state = current_loop.steps(table, 1, 0.0, wanted, i, u, 0.0, 0.5)
        assert state[0] * sign > breakaway_a
        assert state[2:] == (0.0, 0.5)


@pytest.mark.parametrize("name", PLAUSIBLE)
def test_axis_in_motion_uses_the_map(name, monkeypatch):
    """Only starting, stopping and clipping need single steps."""
    plant = PLAUSIBLE[name]
    axis = Axis(plant, ServoGains.tuned(plant, MS, 10), MS, 10)
    stepped = 0
    steps = servo.steps

    def counted(*arguments):
        nonlocal stepped
        stepped += 1
        return steps(*arguments)

    monkeypatch.setattr(servo, "steps", counted)
    axis.power(True)
    axis.at(10 * MS)
    axis.move_to(200_000, 100_000.0, 400_000.0, 400_000.0)
    axis.at(2_400 * MS)
    assert axis.position_inc() == 200_000
    assert stepped < 60


def side_by_side(plant, load_n_m, ticks):
    """Yield the positions [inc] of an axis and its reference, tick by tick in one move."""
    gains = ServoGains.tuned(plant, MS, 10)
    axis = Axis(plant, gains, MS, 10)
    axis.set_load(load_n_m)
    axis.power(True)
    axis.move_to(3_000, 60_000.0, 900_000.0, 900_000.0)
    pieces = profile.move(0.0, 0.0, 3_000.0, 60.0, 0.9, 0.9)
    twin = ReferenceAxis(plant, gains, load_n_m)
    inc_rad = plant.encoder_increments_rev * plant.gear_ratio / (2 * math.pi)
    for k in range(1, ticks):
        t = k - 1.0  # the profile starts at the tick after the command
        position, _ = profile.demand_at(pieces, t)
        _, start, _, _, _, velocity, change = next(piece for piece in pieces if t < piece[0])
        a_tick_ago = velocity + max(t - 1.0 - start, 0.0) * change
        twin.tick(math.floor(position + 0.5), a_tick_ago * 1e3, change * 1e6)
        axis.at(k * MS)
        yield axis.output_position_rad() * inc_rad, twin.position


def test_axis_equals_reference_until_encoders_differ():
    """The load pushes the rotor, so it never sticks: rounding and small steps only."""
    together = 0
    for ours, theirs in side_by_side(WHEEL_60W, -1.5, 200):
        if math.floor(ours + 0.5) != math.floor(theirs + 0.5):
            break
        assert ours == pytest.approx(theirs, abs=0.01)
        together += 1
    assert together > 20


@pytest.mark.parametrize("load_n_m", [0.0, 1.5, -1.5])
@pytest.mark.parametrize("friction_n_m", [0.0, 0.004, 0.02])
def test_move_follows_the_equations(load_n_m, friction_n_m):
    """A count one tick earlier or later separates the two by less than an increment."""
    plant = replace(WHEEL_60W, coulomb_friction_n_m=friction_n_m)
    for ours, theirs in side_by_side(plant, load_n_m, 200):
        assert ours == pytest.approx(theirs, abs=1.0)
