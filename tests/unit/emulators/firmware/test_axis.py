"""The axis as a drive sees it: demands, flags, windows, commands and limits."""

import math
from dataclasses import replace
from itertools import pairwise

import pytest
from hypothesis import event, given
from hypothesis import strategies as st

from motorhil.emulators.firmware.axis import Axis
from motorhil.emulators.firmware.flags import (
    CURRENT_SATURATED,
    FOLLOWING_ERROR,
    IN_TARGET_WINDOW,
    IN_VELOCITY_WINDOW,
    PROFILE_ACTIVE,
    SPEED_ZERO,
)
from motorhil.emulators.plant.presets import WHEEL_60W
from tests.support.motion.axes import GAINS, MS, new_axis, powered_axis, tick_by_tick
from tests.unit.emulators.firmware.test_profile import closed_form_ticks

# --- moves --------------------------------------------------------------------------------------


@given(
    st.integers(-20_000, 20_000) | st.integers(-20, 20),
    st.floats(100.0, 250_000.0),
    st.floats(5_000.0, 2e6),
    st.floats(5_000.0, 2e6),
)
def test_move_any_parameters_matches_closed_form(distance, v, a, d):
    ticks = closed_form_ticks(distance, v * 1e-3, a * 1e-6, d * 1e-6)
    if ticks > 4000:
        distance, ticks = 5, closed_form_ticks(5, v * 1e-3, a * 1e-6, d * 1e-6)
    axis = powered_axis()
    axis.move_to(distance, v, a, d)
    demands = [0]
    k = 50
    while axis.flags & PROFILE_ACTIVE:
        k += 1
        axis.at(k * MS)
        demands.append(axis.demand_inc())
    start = 51  # the tick after the command
    assert 0 <= k - start - ticks < 1 + 1e-6
    assert demands[-1] == distance
    assert axis.demand_velocity_inc_s() == 0.0
    # Rounding to whole increments: a difference is off by at most 1, a second one by at most 2.
    speeds = [after - before for before, after in pairwise(demands)]
    assert max(abs(speed) for speed in speeds) <= v * 1e-3 + 1.0
    for before, after in pairwise(speeds[:-1]):
        assert abs(after - before) <= max(a, d) * 1e-6 + 2.0
    event("zero" if distance == 0 else "tiny" if abs(distance) < 20 else "move")
    axis.at((k + 1500) * MS)
    assert axis.demand_inc() == distance
    assert abs(axis.following_error_inc()) <= 2


def test_longest_32_bit_move_ends_on_its_increment():
    axis = powered_axis(-(2**31))
    axis.move_to(2**31 - 1, 4e9, 4e9, 4e9)  # far beyond the motor: only the demand counts
    axis.at(20_000 * MS)
    assert axis.demand_inc() == axis.target_inc() == 2**31 - 1


def test_zero_move_is_over_at_next_tick():
    axis = powered_axis()
    assert axis.flags & IN_TARGET_WINDOW
    axis.move_to(0, 1000.0, 1e5, 1e5)
    assert axis.flags & (PROFILE_ACTIVE | IN_TARGET_WINDOW) == PROFILE_ACTIVE
    assert axis.next_event_ns() == 51 * MS
    axis.at(51 * MS)
    assert axis.flags & (PROFILE_ACTIVE | IN_TARGET_WINDOW) == IN_TARGET_WINDOW


def test_new_move_during_move_continues_smoothly():
    axis = powered_axis()
    axis.move_to(50_000, 100_000.0, 500_000.0, 500_000.0)
    axis.at(300 * MS)
    before = axis.demand_inc()
    axis.move_to(-10_000, 50_000.0, 500_000.0, 1_000_000.0)  # brakes, and returns
    demands = [before]
    for k in range(301, 2000):
        axis.at(k * MS)
        demands.append(axis.demand_inc())
    assert demands[-1] == -10_000
    assert demands[1] - demands[0] == pytest.approx(100, abs=1)  # still 100,000 inc/s
    for a, b, c in zip(demands, demands[1:], demands[2:], strict=False):
        assert abs(c - 2 * b + a) <= 1.0 + 2.0
    assert min(b - a for a, b in pairwise(demands)) >= -51


def test_command_replaced_within_its_tick_has_no_effect():
    replaced, direct = powered_axis(), powered_axis()
    replaced.move_to(-9_999, 70_000.0, 3e5, 3e5)
    for axis in (replaced, direct):
        axis.move_to(700, 20_000.0, 1e6, 1e6)
        axis.at(120 * MS)
    assert repr(replaced._time.state) == repr(direct._time.state)


def test_move_velocity_zero_never_ends():
    axis = powered_axis()
    axis.move_to(1_000, 0.0, 1e5, 1e5)
    axis.at(5_000 * MS)
    assert axis.demand_inc() == 0
    assert axis.flags & (PROFILE_ACTIVE | IN_TARGET_WINDOW) == PROFILE_ACTIVE
    assert axis.next_event_ns() is None


def test_halt_brakes_on_ramp_and_holds():
    axis = powered_axis()
    axis.move_to(10**6, 100_000.0, 1e6, 1e6)
    axis.at(500 * MS)
    start = axis.demand_inc()
    axis.ramp_to_rest(2e6)
    end = tick_by_tick(axis, 500, PROFILE_ACTIVE, False)
    # one tick at 100,000 inc/s until the command takes effect, 50 ms of braking, 2,500 inc
    assert end - 500 == 51
    assert axis.demand_inc() - start == 100 + 2_500
    axis.at(700 * MS)
    assert axis.flags & IN_TARGET_WINDOW
    assert axis.flags & SPEED_ZERO


def test_hold_stops_demand_at_once():
    axis = powered_axis()
    axis.move_to(10_000, 20_000.0, 1e6, 1e6)
    axis.at(200 * MS)
    demand = axis.demand_inc()
    axis.hold()
    assert not axis.flags & PROFILE_ACTIVE
    axis.at(201 * MS)
    assert axis.demand_inc() == demand + 20
    axis.at(500 * MS)
    assert axis.demand_inc() == demand + 20
    assert axis.position_inc() == pytest.approx(demand + 20, abs=1)


# --- velocity ------------------------------------------------------------------------------------


@pytest.mark.parametrize("wanted", [1_000.0, 80_000.0, -80_000.0])
def test_run_at_reaches_velocity_and_sets_flag(wanted):
    axis = powered_axis()
    axis.run_at(wanted, 400_000.0, 400_000.0)
    assert axis.flags & PROFILE_ACTIVE
    end = tick_by_tick(axis, 50, PROFILE_ACTIVE, False)
    assert end == 51 + math.ceil(abs(wanted) / 400.0)
    axis.at((end + 500) * MS)
    assert axis.flags & IN_VELOCITY_WINDOW
    assert axis.following_error_inc() == 0
    before = axis.position_inc()
    axis.at((end + 2500) * MS)
    assert (axis.position_inc() - before) / 2 == pytest.approx(wanted, rel=0.002, abs=2)


def test_velocity_window_is_by_default_2000_increments_per_s():
    axis = powered_axis()
    axis.run_at(80_000.0, 400_000.0, 400_000.0)
    first = tick_by_tick(axis, 50, IN_VELOCITY_WINDOW, True)
    assert first == pytest.approx(51 + (80_000 - 2_000) / 400 + 10, abs=5)  # for 10 ms within it


def test_move_after_velocity_stop_starts_at_position():
    axis = powered_axis()
    axis.run_at(50_000.0, 1e6, 1e6)
    axis.at(500 * MS)
    axis.run_at(0.0, 1e6, 1e6)
    axis.at(1_000 * MS)
    assert axis.flags & SPEED_ZERO
    assert axis.velocity_inc_s() == 0.0
    assert axis.next_event_ns() is None
    here = axis.position_inc()
    axis.move_to(here + 100, 10_000.0, 1e6, 1e6)
    axis.at(1_001 * MS)
    assert axis.demand_inc() == here
    axis.at(1_500 * MS)
    assert axis.position_inc() == here + 100


def test_change_of_velocity_and_position_mode_is_smooth():
    axis = powered_axis()
    axis.run_at(50_000.0, 1e6, 1e6)
    axis.at(500 * MS)
    axis.move_to(axis.position_inc() + 20_000, 50_000.0, 1e6, 1e6)
    worst = 0
    for k in range(501, 600):
        axis.at(k * MS)
        worst = max(worst, abs(axis.following_error_inc()))
        assert axis.velocity_inc_s() == pytest.approx(50_000, abs=1_500)
    assert worst <= 5
    axis.run_at(50_000.0, 1e6, 1e6)
    for k in range(600, 700):
        axis.at(k * MS)
        assert axis.velocity_inc_s() == pytest.approx(50_000, abs=1_500)


# --- cyclic demands ------------------------------------------------------------------------------


def test_follow_interpolates_cyclic_demands():
    axis = powered_axis()
    demands = []
    for cycle in range(1, 26):  # every 4 ms, 10 inc further; then a pause
        axis.at((46 + 4 * cycle) * MS)
        axis.follow(10 * cycle, 4 * MS)
        for k in range(47 + 4 * cycle, 51 + 4 * cycle):
            axis.at(k * MS)
            demands.append(axis.demand_inc())
    # the first arrives at 50 ms, takes effect at 51 ms and is reached at 55 ms
    assert demands[:6] == [0, 3, 5, 8, 10, 13]
    assert all(after - before in (2, 3) for before, after in pairwise(demands))
    axis.at(400 * MS)
    assert axis.demand_inc() == 250
    assert not axis.flags & (PROFILE_ACTIVE | IN_TARGET_WINDOW)


def test_follow_sine_error_is_small():
    axis = powered_axis()
    worst = 0
    for k in range(50, 1_050):
        axis.at(k * MS)
        axis.follow(round(5_000 * (1 - math.cos(2 * math.pi * (k - 50) / 1_000))), MS)
        axis.at(k * MS + 300_000)
        worst = max(worst, abs(axis.following_error_inc()))
    assert worst <= 12


# --- flags and windows -------------------------------------------------------------------------


def test_target_window_held_for_time_sets_flag():
    axis = powered_axis()
    axis.set_windows(target_window_inc=2, target_window_ns=7 * MS)
    axis.move_to(3_000, 100_000.0, 2e6, 2e6)
    done = tick_by_tick(axis, 50, PROFILE_ACTIVE, False)
    errors = []
    k = done
    while not axis.flags & IN_TARGET_WINDOW:
        errors.append(abs(axis.target_inc() - axis.position_inc()))
        k += 1
        axis.at(k * MS)
    errors.append(abs(axis.target_inc() - axis.position_inc()))
    inside = (
        len(errors) - next((i for i in range(len(errors) - 1, -1, -1) if errors[i] > 2), -1) - 1
    )
    assert inside == 8  # 8 consecutive ticks are 7 ms


def test_zero_move_restarts_window_time():
    axis = powered_axis()
    axis.set_windows(target_window_inc=2, target_window_ns=7 * MS)
    axis.at(100 * MS)
    assert axis.flags & IN_TARGET_WINDOW
    axis.move_to(0, 1_000.0, 1e5, 1e5)
    assert tick_by_tick(axis, 100, IN_TARGET_WINDOW, True) == 101 + 7


@pytest.mark.parametrize(
    ("time_ns", "ticks"), [(0, 0), (1, 1), (MS, 1), (5 * MS, 5), (5 * MS + 1, 6)]
)
def test_following_error_flag_needs_its_time(time_ns, ticks):
    axis = powered_axis()
    axis.set_windows(following_window_inc=20, following_window_ns=time_ns)
    axis.follow(500, 0)
    first = None
    k = 50
    while not axis.flags & FOLLOWING_ERROR:
        k += 1
        axis.at(k * MS)
        if first is None and abs(axis.following_error_inc()) > 20:
            first = k
    assert first is not None
    assert k == first + ticks
    tick_by_tick(axis, k, FOLLOWING_ERROR, False)
    assert abs(axis.following_error_inc()) <= 20


def test_following_error_equal_to_window_is_inside():
    for window, told in ((30, False), (29, True)):
        axis = powered_axis()
        axis.set_current_limit(0.0)  # the motor stays where it is
        axis.set_windows(following_window_inc=window, following_window_ns=0)
        axis.follow(30, 0)
        axis.at(200 * MS)
        assert axis.following_error_inc() == 30
        assert bool(axis.flags & FOLLOWING_ERROR) is told


def test_new_command_does_not_restart_the_time_of_a_following_error():
    axis = powered_axis()
    axis.set_current_limit(0.0)  # the motor stays where it is
    axis.set_windows(following_window_inc=20, following_window_ns=10 * MS)
    axis.follow(500, 0)
    first = tick_by_tick(axis, 50, FOLLOWING_ERROR, True)
    again = powered_axis()
    again.set_current_limit(0.0)
    again.set_windows(following_window_inc=20, following_window_ns=10 * MS)
    again.follow(500, 0)
    for k in range(51, first - 2):
        again.at(k * MS)
        if k % 2:
            again.move_to(500 + k, 1e6, 1e9, 1e9)
        else:
            again.follow(500 + k, 0)
    assert tick_by_tick(again, first - 3, FOLLOWING_ERROR, True) == first


def test_speed_zero_flag_waits_to_set_and_clears_at_once():
    axis = powered_axis()
    axis.set_windows(velocity_threshold_inc_s=1_000.0, velocity_threshold_ns=20 * MS)
    axis.at(100 * MS)
    assert axis.flags & SPEED_ZERO
    axis.move_to(2_000, 50_000.0, 1e6, 1e6)
    start = tick_by_tick(axis, 100, SPEED_ZERO, False)
    assert abs(axis.velocity_inc_s()) > 1_000.0
    assert start < 115
    end = tick_by_tick(axis, start, SPEED_ZERO, True)
    slow = 0
    again = powered_axis()
    again.at(100 * MS)
    again.move_to(2_000, 50_000.0, 1e6, 1e6)
    for k in range(start, end + 1):
        again.at(k * MS)
        slow = slow + 1 if abs(again.velocity_inc_s()) <= 1_000.0 else 0
    assert slow == 21


def test_current_demand_above_limit_is_saturated():
    axis = powered_axis()
    axis.set_current_limit(1.0)
    axis.move_to(20_000, 200_000.0, 2e7, 2e7)
    saturated = False
    for k in range(51, 400):
        axis.at(k * MS)
        assert abs(axis.current_demand_a()) <= 1.0
        assert abs(axis.current_a()) < 1.3  # the current loop can overshoot slightly
        if axis.flags & CURRENT_SATURATED:
            saturated = True
            assert abs(axis.current_demand_a()) == 1.0
    assert saturated
    axis.at(3_000 * MS)
    assert axis.position_inc() == 20_000  # no integrator wind-up keeps it from its target


def test_current_limit_never_exceeds_plant_limit():
    axis = powered_axis()
    axis.set_current_limit(1e9)
    axis.move_to(10**6, 1e6, 1e9, 1e9)
    for k in range(51, 200):
        axis.at(k * MS)
        assert abs(axis.current_demand_a()) <= WHEEL_60W.current_max_a


# --- power -------------------------------------------------------------------------------------


def test_set_position_moves_nothing_and_shifts_moves():
    axis = powered_axis(500)
    truth = axis.output_position_rad()
    axis.set_position(0)
    assert axis.position_inc() == axis.demand_inc() == axis.target_inc() == 0
    axis.at(200 * MS)
    assert axis.output_position_rad() == truth
    axis.move_to(132_000, 100_000.0, 1e6, 1e6)
    axis.at(4_000 * MS)
    assert axis.position_inc() == 132_000
    turn = axis.output_position_rad() - truth  # 2000 inc/rev * gear 66: one turn
    assert turn == pytest.approx(2 * math.pi, abs=2 * math.pi / 132_000)


def test_output_position_starts_at_initial_position():
    assert new_axis().output_position_rad() == 0.0
    assert new_axis(132_000).output_position_rad() == pytest.approx(2 * math.pi, rel=1e-15)


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ((1, -1.0, 1.0, 1.0), "velocity"),
        ((1, math.nan, 1.0, 1.0), "velocity"),
        ((1, 1.0, 0.0, 1.0), "acceleration"),
        ((1, 1.0, 1.0, -1.0), "deceleration"),
    ],
)
def test_move_invalid_argument_changes_nothing(arguments, message):
    axis = powered_axis()
    before = (repr(axis._time.state), axis.flags)
    with pytest.raises(ValueError, match=message):
        axis.move_to(*arguments)
    assert (repr(axis._time.state), axis.flags) == before


def test_at_earlier_time_is_refused():
    axis = powered_axis()
    axis.at(50 * MS)
    axis.at(51 * MS - 1)
    with pytest.raises(ValueError, match="forward"):
        axis.at(50 * MS - 1)


@pytest.mark.parametrize(("tick_ns", "steps"), [(0, 1), (MS, 0), (MS, 3), (10, 20)])
def test_tick_not_divisible_into_steps_is_refused(tick_ns, steps):
    with pytest.raises(ValueError, match="steps"):
        Axis(WHEEL_60W, GAINS, tick_ns, steps)


def test_unstable_current_gains_are_refused():
    for kp in (1e3, -10.0):
        with pytest.raises(ValueError, match="current loop: unstable"):
            Axis(WHEEL_60W, replace(GAINS, current_kp_v_a=kp), MS, 10)
