"""One axis without power, losing power and regaining it."""

import pytest

from motorhil.emulators.firmware.flags import FOLLOWING_ERROR, IN_TARGET_WINDOW, POWERED
from motorhil.emulators.plant.presets import WHEEL_60W
from tests.support.motion.axes import MS, new_axis, powered_axis, tick_by_tick


def test_power_off_commands_refused_demand_is_actual():
    axis = new_axis(77)
    for what in (
        lambda: axis.move_to(1, 1.0, 1.0, 1.0),
        lambda: axis.run_at(1.0, 1.0, 1.0),
        lambda: axis.ramp_to_rest(1.0),
        lambda: axis.follow(1, MS),
        axis.hold,
    ):
        with pytest.raises(RuntimeError, match="power"):
            what()
    axis.set_load(20.0)  # enough to turn the wheel
    axis.at(300 * MS)
    assert axis.position_inc() < 77
    assert axis.demand_inc() == axis.position_inc() == axis.target_inc()
    assert axis.flags & (POWERED | IN_TARGET_WINDOW) == 0
    assert axis.current_a() == axis.torque_n_m() == 0.0


def test_power_on_holds_present_position():
    axis = powered_axis(1_234)
    assert axis.flags & POWERED
    assert axis.position_inc() == axis.demand_inc() == 1_234
    axis.set_load(1.0)
    axis.at(2_000 * MS)
    assert axis.position_inc() == 1_234
    # friction and current hold it together: the motor torque equals the load within the friction
    friction_n_m = WHEEL_60W.coulomb_friction_n_m * WHEEL_60W.gear_ratio
    assert axis.torque_n_m() == pytest.approx(1.0, abs=friction_n_m)


def test_power_off_in_motion_coasts_to_rest():
    axis = powered_axis()
    axis.run_at(50_000.0, 1e6, 1e6)
    axis.at(500 * MS)
    axis.power(False)
    axis.at(502 * MS)
    assert axis.current_a() == 0.0
    assert axis.velocity_inc_s() > 40_000
    assert not axis.flags & POWERED
    axis.at(5_000 * MS)
    assert axis.output_velocity_rad_s() == 0.0
    assert axis.next_event_ns() is None


def test_power_on_again_starts_from_clean_state():
    axis = powered_axis()
    axis.set_windows(following_window_inc=20, following_window_ns=30 * MS)
    axis.set_load(2.0)
    axis.at(300 * MS)
    assert axis.current_demand_a() > 0.5  # held by the integrator
    axis.set_load(0.0)
    axis.set_current_limit(0.0)
    axis.follow(1_000, 0)
    axis.at(321 * MS)  # 20 of the 30 ms
    assert axis.following_error_inc() > 900
    axis.power(False)
    axis.at(400 * MS)
    axis.set_current_limit(8.0)
    axis.power(True)
    axis.at(401 * MS)
    assert axis.current_demand_a() == 0.0
    axis.set_current_limit(0.0)
    axis.follow(axis.position_inc() + 1_000, 0)
    told = tick_by_tick(axis, 401, FOLLOWING_ERROR, True)
    # effective at 402 ms, there at 403 ms; the 31st consecutive tick
    assert told == 403 + 30


def test_power_on_while_on_has_no_effect():
    axis = powered_axis()
    axis.move_to(1_000, 20_000.0, 1e6, 1e6)
    axis.at(60 * MS)
    axis.power(True)
    axis.at(500 * MS)
    assert axis.position_inc() == 1_000


# --- homing, units, refusals ---------------------------------------------------------------------
