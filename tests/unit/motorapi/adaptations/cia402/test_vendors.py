"""Object dictionaries of real vendors: bring-up and motion in every mode."""

from collections.abc import Callable
from math import pi
from pathlib import Path

import pytest

from motorhil.harness.rig.rig import Rig
from motorhil.motorapi.adaptations.cia402.motor import Cia402Motor
from motorhil.motorapi.adaptations.cia402.objects import Mode
from motorhil.motorapi.commands import ControlMode, ControlVariable
from motorhil.motorapi.group import MotorGroup
from motorhil.motorapi.motor import Motor
from motorhil.motorapi.trajectory import TrapezoidalTrajectory
from tests.support.motors.drive_rigs import drive

pytestmark = pytest.mark.data

# 2000 increments per turn of the motor, gear 66:1: the emulated drives' default motor.
INCREMENTS = f"increments_per_rad = {132_000 / (2 * pi)!r}\n"
IN_INCREMENTS = INCREMENTS + (
    f"velocity_unit_rad_s = {2 * pi / 132_000!r}\nacceleration_unit_rad_s2 = {2 * pi / 132_000!r}"
)
IN_MOTOR_RPM = INCREMENTS + (
    f"velocity_unit_rad_s = {2 * pi / 60 / 66!r}\nacceleration_unit_rad_s2 = {2 * pi / 60 / 66!r}"
)
# 60A8h: tenths of a degree, 60A9h: turns per minute of the output; only acceleration is unknown.
TELLS_ITS_UNITS = f"acceleration_unit_rad_s2 = {2 * pi / 60!r}"
# A setting of that drive's user: the gear between its motor and the wheel.
BUILT_IN = 'objects = { "6091h:1" = 66 }'

PP, PV, HM, CSP = (
    Mode.PROFILE_POSITION,
    Mode.PROFILE_VELOCITY,
    Mode.HOMING,
    Mode.CYCLIC_SYNC_POSITION,
)
# file, units, modes it must move in (6502h; from the rig where the file has none), homing method,
# csp period [s]
VENDORS = [
    pytest.param("maxon_epos2_50_5.eds", IN_MOTOR_RPM, (PP, PV, HM, CSP), 35, 0.001, id="maxon"),
    pytest.param("elmo_gold_cob.dcf", IN_INCREMENTS, (PP, PV, HM, CSP), 35, 0.01, id="elmo"),
    pytest.param(
        "nanotec_C5-E-2-09.eds", TELLS_ITS_UNITS, (PP, PV, HM, CSP), 37, 0.01, id="nanotec"
    ),
    pytest.param("technosoft_ipos.eds", IN_INCREMENTS, (PP, PV, HM), 37, 0.0, id="ipos"),
    pytest.param("roboteq_v80.eds", IN_INCREMENTS, (PP, PV, CSP), 0, 0.01, id="roboteq"),
    pytest.param("schunk_prl_erb_0_63.dcf", IN_INCREMENTS, (PP,), 0, 0.0, id="schunk"),
]


@pytest.mark.parametrize(("file", "units", "modes", "method", "period_s"), VENDORS)
def test_vendor_drive_moves_in_every_mode_it_names(
    file: str,
    units: str,
    modes: tuple[Mode, ...],
    method: int,
    period_s: float,
    open_rig: Callable[..., Rig],
    shared: Path,
):
    eds = f'eds = "{shared / "data" / "eds" / file}"\n'
    if units == TELLS_ITS_UNITS:
        eds += BUILT_IN
    rig = open_rig(drive("one", 3, controller=eds, model=units), drive("two", 4, eds, model=units))
    motor = rig.motors["one"]
    assert isinstance(motor, Cia402Motor)
    facts = motor.hardware.connect()
    assert facts.modes is not None
    assert set(modes) <= facts.modes

    def position_rad(name: str = "one") -> float:
        return rig.controllers[name].snapshot()["position_rad"]

    step_rad = 1.0 / (motor.units.increments_per_unit or 0.0) * 1.01  # one unit of the drive
    motor.set_control_mode(ControlMode.SETPOINT)
    motor.set_setpoint(0.8)
    motor.start()
    motor.wait_until_done(timeout_s=5)
    assert abs(position_rad() - 0.8) <= step_rad
    motor.set_control_mode(ControlMode.TRAJECTORY)
    motor.set_trajectory(TrapezoidalTrajectory(-0.3, duration_s=1.0))
    motor.start()
    motor.wait_until_done(timeout_s=5)
    assert abs(position_rad() - 0.5) <= 2 * step_rad

    group = MotorGroup(motor, rig.motors["two"])
    group.for_each(Motor.set_control_mode, ControlMode.TRAJECTORY)
    group.set_trajectory(TrapezoidalTrajectory(0.5), TrapezoidalTrajectory(0.25))
    group.start()
    group.wait_until_done(timeout_s=5)
    quality = group.sync_quality()
    assert quality.start_skew_s == 0.0  # each of them has an RPDO that SYNC latches
    assert abs(position_rad("two") - 0.25) <= step_rad

    if HM in modes:
        motor.home(method)
        assert abs(motor.position()) <= step_rad
        assert motor.is_referenced()
    if CSP in modes:
        follow_a_ramp(rig, motor, period_s)
    if PV in modes:
        motor.set_control_mode(ControlMode.SETPOINT, ControlVariable.VELOCITY)
        motor.set_setpoint(-1.0)
        motor.start()
        motor.wait_until_done(timeout_s=5)
        rig.runtime.run_for(0.3)
        assert -1.1 < rig.controllers["one"].snapshot()["velocity_rad_s"] < -0.9
        motor.stop()
        motor.wait_until_done(timeout_s=5)
        assert abs(rig.controllers["one"].snapshot()["velocity_rad_s"]) < 0.01
        rig.runtime.run_for(0.1)  # the servo's last increments
        assert rig.controllers["one"].snapshot()["velocity_rad_s"] == 0.0


def follow_a_ramp(rig: Rig, motor: Cia402Motor, period_s: float) -> None:
    """Move at 0.2 rad/s in csp for 100 cycles, one target each."""
    scale = motor.units.increments_per_unit
    assert scale is not None
    motor.enable()
    before_rad = rig.controllers["one"].snapshot()["position_rad"]
    held = motor.hardware.objects.read_int(0x6062)

    def target(cycle: int) -> int | None:
        return held + round(0.2 * period_s * cycle * scale) if cycle <= 100 else None

    stream = motor.hardware.stream_positions(period_s, target)
    assert rig.runtime.wait_until(lambda: stream.ended, 3.0)
    rig.runtime.run_for(0.2)
    moved_rad = rig.controllers["one"].snapshot()["position_rad"] - before_rad
    assert abs(moved_rad - 0.2 * period_s * 100) <= 2.0 / abs(scale)
    assert (stream.sent, stream.late, stream.error) == (100, 0, None)
