"""Torque control with the current loop only, ramps of its demand, and changes of gains."""

import math
from dataclasses import replace

import pytest
from hypothesis import event, given
from hypothesis import strategies as st

from motorhil.emulators.firmware.axis import Axis
from motorhil.emulators.firmware.flags import (
    CURRENT_REACHED,
    CURRENT_SATURATED,
    IN_TARGET_WINDOW,
    POWERED,
    PROFILE_ACTIVE,
    SPEED_ZERO,
)
from motorhil.emulators.firmware.servo_tables import ServoGains
from motorhil.emulators.plant.presets import PLAUSIBLE, WHEEL_60W
from tests.support.motion.reference import ReferenceAxis

MS = 1_000_000
GAINS = ServoGains.tuned(WHEEL_60W, MS, 10)
AT_ONCE = math.inf


def powered_axis(plant=WHEEL_60W) -> Axis:
    axis = Axis(plant, ServoGains.tuned(plant, MS, 10), MS, 10)
    axis.power(True)
    axis.at(50 * MS)
    return axis


def demands(axis: Axis, start: int, ticks: int) -> list[float]:
    result = []
    for k in range(start + 1, start + ticks + 1):
        axis.at(k * MS)
        result.append(axis.current_demand_a())
    return result


@given(
    st.floats(-7.9, 7.9),
    st.floats(-7.9, 7.9),
    st.floats(1.0, 1e5) | st.just(AT_ONCE),
)
def test_apply_current_follows_slope_then_stays(start, target, slope):
    axis = powered_axis()
    axis.apply_current(start, AT_ONCE)
    assert demands(axis, 50, 1) == [start]
    axis.apply_current(target, slope)
    step = min(slope * 1e-3, abs(target - start)) * math.copysign(1.0, target - start)
    ticks = min(400, 2 + math.ceil(abs(target - start) / (slope * 1e-3)))
    for k, demand in enumerate(demands(axis, 51, ticks), 1):
        wanted = start + k * step
        if abs(k * step) >= abs(target - start) * (1 + 1e-9):
            assert demand == target
        else:  # the closed form rounds once, the sum of steps k times
            assert demand == pytest.approx(wanted, rel=1e-12, abs=1e-12)
    event("at once" if slope == AT_ONCE else "long" if ticks == 400 else "ramp")


def test_current_ramp_flags_change_at_exact_ticks():
    axis = powered_axis()
    axis.apply_current(0.2, 20.0)  # 10 ticks; too little to accelerate the wheel much
    assert axis.flags & (PROFILE_ACTIVE | CURRENT_REACHED) == PROFILE_ACTIVE
    seen = []
    for k in range(51, 70):
        axis.at(k * MS)
        seen.append(axis.flags & (PROFILE_ACTIVE | CURRENT_REACHED))
    assert seen == [PROFILE_ACTIVE] * 9 + [CURRENT_REACHED] * 10
    # a drive that only wakes for its events wakes for that one
    again = powered_axis()
    again.apply_current(0.2, 20.0)
    now, wakes = 50 * MS, []
    while again.flags & PROFILE_ACTIVE:
        now = again.next_event_ns()
        again.at(now)
        wakes.append(now)
    assert now == 60 * MS


@pytest.mark.parametrize("name", PLAUSIBLE)
def test_torque_motion_matches_equations(name):
    plant = PLAUSIBLE[name]
    axis = powered_axis(plant)
    reference = ReferenceAxis(plant, ServoGains.tuned(plant, MS, 10))
    peak = plant.current_max_a
    counts = plant.increments_per_rad()
    # A rotor that passes through standstill stops for the rest of a current loop step: 0.1 ms here,
    # 12.5 us in the reference. The tolerance is the speed gained in that time.
    off_rad_s = plant.torque_constant_n_m_a * peak / plant.inertia_kg_m2() * 1e-4
    off_a = 2e-3 * peak + off_rad_s * plant.torque_constant_n_m_a / plant.resistance_ohm
    for start, target, slope in ((50, 0.5, 40.0), (130, -0.7, AT_ONCE), (210, 0.02, 100.0)):
        axis.apply_current(target * peak, slope)
        for k in range(start + 1, start + 81):
            axis.at(k * MS)
            reference.push(axis.current_demand_a())
            assert axis.current_a() == pytest.approx(reference.current, abs=off_a)
            assert axis.output_velocity_rad_s() * plant.gear_ratio == pytest.approx(
                reference.speed, abs=off_rad_s
            )
            assert axis.position_inc() == pytest.approx(
                reference.position, abs=1 + 0.2 * off_rad_s * counts
            )


def test_constant_torque_accelerates_by_inertia():
    """Without friction and far below the top speed: a = k i / J, by hand."""
    plant = replace(WHEEL_60W, coulomb_friction_n_m=0.0, viscous_friction_n_m_s_rad=0.0)
    axis = powered_axis(plant)
    axis.apply_current(2.0, AT_ONCE)
    axis.at(60 * MS)
    before = axis.output_velocity_rad_s()
    axis.at(70 * MS)
    # Within a step the voltage is constant and the back-EMF grows. The current read at its end is
    # slightly below its mean, which accelerates.
    gained = (axis.output_velocity_rad_s() - before) * plant.gear_ratio / 0.010
    assert gained == pytest.approx(
        plant.torque_constant_n_m_a * axis.current_a() / plant.inertia_kg_m2(), rel=1e-3
    )
    # The current loop's PI follows the growing back-EMF with a lag: within 5 %, the flag's window.
    assert 0.95 * 2.0 < axis.current_a() < 2.0
    assert axis.torque_n_m() == axis.current_a() * plant.torque_constant_n_m_a * plant.gear_ratio


def test_current_above_limit_is_cut_and_flagged():
    axis = powered_axis()
    axis.set_current_limit(3.0)
    axis.apply_current(8.0, AT_ONCE)
    for k in range(51, 60):
        axis.at(k * MS)
        assert axis.current_demand_a() == 3.0
        assert axis.flags & (CURRENT_SATURATED | CURRENT_REACHED) == CURRENT_SATURATED


def test_current_limits_can_differ_by_direction():
    axis = powered_axis()
    axis.set_current_limit(3.0, 1.0)
    for asked, allowed in ((8.0, 3.0), (-8.0, -1.0), (2.0, 2.0), (-0.5, -0.5)):
        axis.apply_current(asked, AT_ONCE)
        axis.at((axis._time.tick + 1) * MS)
        assert axis.current_demand_a() == allowed
    axis.set_current_limit(8.0)
    axis.ramp_to_rest(1e7)
    axis.set_current_limit(8.0, 0.25)  # in position control as well
    axis.move_to(-50_000, 100_000.0, 5e6, 5e6)
    seen = demands(axis, axis._time.tick, 30)
    assert min(seen) == -0.25
    for wrong in ((-1.0, None), (1.0, -1.0), (1.0, math.nan), (math.nan, None)):
        with pytest.raises(ValueError, match="current limit"):
            axis.set_current_limit(*wrong)


def test_torque_within_friction_rests():
    axis = powered_axis()
    stuck = 0.9 * WHEEL_60W.coulomb_friction_n_m / WHEEL_60W.torque_constant_n_m_a
    axis.apply_current(stuck, 1.0)
    axis.at(5_000 * MS)
    assert axis.next_event_ns() is None
    assert axis.rest() >= 0
    assert axis.current_a() == pytest.approx(stuck, rel=1e-12)
    assert axis.flags == POWERED | SPEED_ZERO | CURRENT_REACHED
    assert axis.position_inc() == axis.demand_inc() == 0


def test_position_mode_takes_over_torque_smoothly():
    axis = powered_axis()
    axis.apply_current(1.0, AT_ONCE)
    axis.at(100 * MS)
    current, velocity = axis.current_a(), axis.velocity_inc_s()
    assert velocity > 1_000.0
    axis.ramp_to_rest(100_000.0)
    axis.at(101 * MS)
    assert abs(axis.following_error_inc()) <= 2
    axis.at(102 * MS)
    assert axis.current_a() == pytest.approx(current, abs=1.0)  # not the 8 A of a step
    axis.at(1_500 * MS)
    assert axis.flags & (PROFILE_ACTIVE | IN_TARGET_WINDOW | SPEED_ZERO) == (
        IN_TARGET_WINDOW | SPEED_ZERO
    )


def test_torque_mode_takes_over_holding_current():
    """The ramp starts at the present demand, not at zero, so the load does not drop."""
    axis = powered_axis()
    axis.set_load(1.5)
    axis.at(1_000 * MS)
    holding = axis.current_demand_a()
    assert holding > 0.5
    axis.apply_current(holding, 1.0)
    axis.at(2_000 * MS)
    assert axis.output_velocity_rad_s() == 0.0
    assert axis.current_demand_a() == holding


def test_apply_current_without_power_or_slope_is_refused():
    axis = Axis(WHEEL_60W, GAINS, MS, 10)
    with pytest.raises(RuntimeError, match="power"):
        axis.apply_current(1.0, 1.0)
    axis.power(True)
    for slope in (0.0, -1.0, math.nan):
        with pytest.raises(ValueError, match="slope"):
            axis.apply_current(1.0, slope)
    with pytest.raises(ValueError, match="nan"):
        axis.apply_current(math.nan, 1.0)


# --- gains ---------------------------------------------------------------------------------------


def test_set_gains_at_rest_moves_nothing():
    axis = powered_axis()
    axis.set_load(1.0)
    axis.at(1_000 * MS)
    before = (axis.current_a(), axis.position_inc())
    axis.set_gains(replace(GAINS, position_kp_1_s=GAINS.position_kp_1_s / 3))
    axis.at(1_500 * MS)
    assert (axis.current_a(), axis.position_inc()) == before


def test_softer_position_loop_has_larger_lag():
    """P alone (no velocity feedforward) lags by velocity / kp: 60 000 / kp increments."""
    for kp in (20.0, 40.0):
        axis = powered_axis()
        axis.set_gains(replace(GAINS, position_kp_1_s=kp, velocity_feedforward=0.0))
        axis.move_to(1_000_000, 60_000.0, 1e6, 1e6)
        axis.at(1_000 * MS)
        # demand and reading are of the same moment: lag = v / kp, in whole increments
        assert axis.following_error_inc() == pytest.approx(60_000.0 / kp, abs=2.0)


def test_set_unstable_gains_keeps_old_gains():
    axis = powered_axis()
    with pytest.raises(ValueError, match="unstable"):
        axis.set_gains(replace(GAINS, current_kp_v_a=1e4))
    axis.move_to(100, 10_000.0, 1e6, 1e6)
    axis.at(500 * MS)
    assert axis.position_inc() == 100
