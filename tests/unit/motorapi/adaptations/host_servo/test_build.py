"""Central servo built from a rig's table and by hand: invalid settings."""

from collections.abc import Callable

import pytest

from motorhil.harness.rig.config.toml import RigError
from motorhil.harness.rig.rig import Rig
from motorhil.motorapi.adaptations.host_servo.hardware import AmplifierHwMotor
from motorhil.motorapi.adaptations.host_servo.motor import ServoParameters, SoftwareMotor
from motorhil.motorapi.adaptations.host_servo.settings import IoOptions, PidGains
from motorhil.motorapi.errors import UsageError
from motorhil.motorapi.model import MotorModel
from tests.support.motors.software_rigs import motor, one

OpenRig = Callable[..., Rig]


@pytest.mark.parametrize(
    ("old", "new", "told"),
    [
        ("current_per_volt_a_v = 0.8", "", r"motor\.left\.current_per_volt_a_v: is missing"),
        (
            "current_per_volt_a_v = 0.8",
            "current_per_volt_a_v = 0",
            r"motor\.left\.current_per_volt_a_v: 0 A/V is out of range",
        ),
        ("current_per_volt_a_v = 0.8", 'current_per_volt_a_v = "x"', "must be a number"),
        ("channel = 1", "channel = 5", r"motor\.left\.channel: 5 is out of range; allowed: 1 to 4"),
        (
            "channel = 1",
            "channel = 1.0",
            r"motor\.left\.channel: must be an integer, but is a float \(1\.0\)",
        ),
        ("channel = 1", "chanel = 1", r"motor\.left\.chanel: unknown key"),
        ("bandwidth_rad_s = 60.0", "", r"motor\.left\.gains\.kp_a_rad: is missing"),
        ("bandwidth_rad_s = 60.0", "kp_a_m = 3.0", r"motor\.left\.gains\.kp_a_m: unknown key"),
        (
            "bandwidth_rad_s = 60.0",
            "bandwidth_rad_s = 0.0",
            r"motor\.left\.gains\.bandwidth_rad_s: 0\.0 rad/s is out of range",
        ),
        (
            "acceleration_feed",
            "# ",
            r"motor\.left\.gains\.acceleration_feedforward_a_s2_rad: is missing: bandwidth_rad_s",
        ),
        (
            "friction_feedforward_a = 0.",
            "friction_feedforward_a = -0.",
            r"motor\.left\.gains\.friction_feedforward_a: -0\.15444015444015444 A is out of range",
        ),
        ("increments_per_rad", "#", "does not define increments_per_rad"),
        (
            "channel = 1",
            "cycle_ms = 0.01",
            r"motor\.left\.cycle_ms: 0\.01 ms is out of range; allowed: 0\.1 to 1000 ms",
        ),
        (
            "channel = 1",
            "misses_max = 0",
            r"motor\.left\.misses_max: 0 is out of range; allowed: 1 to 1000000",
        ),
        (
            "channel = 1",
            "counter = 1",
            r"motor\.left\.counter: 1 is out of range; allowed: 8192 to 40959",
        ),
        (
            "channel = 1",
            "heartbeat_timeout_ms = 50",
            r"motor\.left\.heartbeat_timeout_ms: 50 ms is not longer than heartbeat_ms = 100 ms",
        ),
        (
            "channel = 1",
            "settle_s = 0",
            r"motor\.left\.settle_s: 0 s is out of range; allowed: more than 0 s",
        ),
        (
            "channel = 1",
            "position_window_rad = nan",
            r"motor\.left\.position_window_rad: must be finite \(nan\)",
        ),
    ],
)
def test_invalid_rig_setting_is_reported_with_its_place(
    open_rig: OpenRig, old: str, new: str, told: str
):
    text = one()
    assert old in text
    rig = open_rig(text.replace(old, new, 1))
    with pytest.raises(RigError, match=told):
        rig.build_motors()


def test_every_setting_has_its_effect(open_rig: OpenRig):
    settings = """
position_window_rad = 0.01
settle_s = 0.03
following_error_window_rad = 0.2
following_error_s = 0.04
quick_stop_deceleration_rad_s2 = 5.0
cycle_ms = 2
misses_max = 7
heartbeat_ms = 50
"""
    gains = """
kp_a_rad = 1.0
ki_a_rad_s = 2.0
kd_a_s_rad = 3.0
velocity_feedforward_a_s_rad = 4.0
derivative_filter_s = 0.002
"""
    text = one(motor=settings).replace("bandwidth_rad_s = 60.0", gains)
    left = open_rig(text).motors["left"]
    assert isinstance(left, SoftwareMotor)
    assert left.parameters == ServoParameters(
        position_window=0.01,
        settle_s=0.03,
        following_error_window=0.2,
        following_error_s=0.04,
        quick_stop_deceleration=5.0,
    )
    assert (left.gains.kp, left.gains.ki, left.gains.kd) == (1.0, 2.0, 3.0)
    assert (left.gains.velocity_feedforward, left.gains.derivative_filter_s) == (4.0, 0.002)
    assert left.gains.acceleration_feedforward > 0.0
    options = left.hardware.options
    assert options == IoOptions(cycle_ms=2, misses_max=7, heartbeat_ms=50)


def test_motors_that_share_must_agree(open_rig: OpenRig):
    rig = open_rig(one(), motor("other", "io", ampere=0.5))
    assert rig.motors["left"]
    with pytest.raises(RigError, match="channel 1 is used with other settings already"):
        rig.motors["other"]
    assert rig.motors["left"].hardware.users == 1


def test_second_object_for_a_channel_is_refused_by_name(open_rig: OpenRig):
    rig = open_rig(one())
    bus = rig.bus("can0")
    first = AmplifierHwMotor(bus, 1, current_per_volt_a_v=0.8)
    with pytest.raises(UsageError, match="has a hardware object already: <AmplifierHwMotor can0"):
        AmplifierHwMotor(bus, 1, current_per_volt_a_v=0.8)
    with pytest.raises(UsageError, match="motors on one node share its settings"):
        AmplifierHwMotor(bus, 1, 2, current_per_volt_a_v=0.8, options=IoOptions(misses_max=3))
    first.close()
    first.close()
    again = AmplifierHwMotor(bus, 1, current_per_volt_a_v=0.8)
    again.connect()
    again.close()
    with pytest.raises(UsageError, match="also the host's node-ID"):
        AmplifierHwMotor(bus, 126, current_per_volt_a_v=0.8)


def test_motor_built_by_hand_equals_that_of_a_rig(open_rig: OpenRig):
    rig = open_rig(one())
    hw = AmplifierHwMotor(rig.bus("can0"), node_id=1, current_per_volt_a_v=0.8)
    model = MotorModel(
        name="wheel", velocity_max=3.0, acceleration_max=10.0, increments_per_unit=21008.45
    )
    gains = PidGains.tuned(60.0, current_per_acceleration=0.0378)
    with SoftwareMotor(hw, model, gains) as left:
        left.enable()
        assert repr(left) == (
            "<SoftwareMotor 'wheel at can0 node 1 channel 1' on can0 node 1 channel 1:"
            " enabled, 0 rad>"
        )
        with pytest.raises(UsageError, match="give PidGains"):
            left.gains = 3  # type: ignore[assignment]
        with pytest.raises(UsageError, match="give ServoParameters"):
            left.parameters = 3  # type: ignore[assignment]
    hw.close()


def test_close_switches_the_current_off(open_rig: OpenRig):
    rig = open_rig(one())
    left = rig.motors["left"]
    left.enable()
    left.close()
    rig.runtime.run_for(0.01)
    assert rig.controllers["io"].snapshot()["ready"] == 0.0
