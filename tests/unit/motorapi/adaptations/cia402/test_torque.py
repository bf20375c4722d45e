"""Output torque of a CiA 402 drive in profile torque mode."""

from collections.abc import Callable
from math import inf
from pathlib import Path

import pytest

from motorhil.emulators.cia402.settings import OWN_EDS
from motorhil.emulators.plant.presets import WHEEL_60W
from motorhil.harness.rig.rig import Rig
from motorhil.motorapi import MotorGroup, MotorModel, TrapezoidalTrajectory
from motorhil.motorapi.adaptations.cia402.motor import Cia402Motor
from motorhil.motorapi.commands import ControlMode, ControlVariable, DerivativeLimits
from motorhil.motorapi.errors import LimitError, MotionInterrupted, StateError, UnsupportedError
from motorhil.motorapi.model import MotionKind
from motorhil.motorapi.synchronization.quality import Synchronization, SyncLevel
from tests.support.motors.drive_rigs import drive
from tests.unit.motorapi.adaptations.cia402.test_controlword import written_to_left

OpenRig = Callable[..., Rig]
GEAR = 66.0  # of the drive's default motor, from its 6091h
RATED_N_M = 0.207  # 6076h, at the motor: 8 A times its torque constant, in mN m
HEAVY = "plant.preset = 'wheel_60w'\nplant.load_inertia_kg_m2 = 0.5"


@pytest.fixture
def rig(open_rig: OpenRig) -> Rig:
    return open_rig(drive("left", 1, HEAVY), drive("right", 2, HEAVY))


def motor_of(rig: Rig, name: str = "left") -> Cia402Motor:
    motor = rig.motors[name]
    assert isinstance(motor, Cia402Motor)
    return motor


def push(motor: Cia402Motor, torque_n_m: float, slope: float | None = None) -> None:
    motor.set_control_mode(ControlMode.SETPOINT, ControlVariable.TORQUE)
    limits = None if slope is None else DerivativeLimits(first=slope)
    motor.set_setpoint(torque_n_m, limits=limits)
    motor.start()


def asked(rig: Rig, name: str = "left") -> float:
    """Return the drive's torque demand, 6074h, behind the gear [N·m]."""
    permille = motor_of(rig, name).hardware.read("torque_demand")
    assert isinstance(permille, int)
    return permille * 1e-3 * RATED_N_M * GEAR


def test_torque_set_point_acts_behind_the_gear(rig: Rig):
    motor = motor_of(rig)
    push(motor, 6.0)
    motor.wait_until_done(timeout_s=1)
    step = RATED_N_M * 1e-3 * GEAR
    assert asked(rig) == pytest.approx(6.0, abs=step)
    assert asked(rig) <= 6.0  # rounded towards 0
    truth = rig.controllers["left"].snapshot()["torque_n_m"]
    assert motor.torque() == pytest.approx(truth, abs=2 * step)  # read a moment later
    before = rig.controllers["left"].snapshot()["velocity_rad_s"]
    rig.runtime.run_for(0.1)
    gained = rig.controllers["left"].snapshot()["velocity_rad_s"] - before
    friction = WHEEL_60W.coulomb_friction_n_m * GEAR
    inertia = 0.5 + WHEEL_60W.rotor_inertia_kg_m2 * GEAR**2
    # viscous friction and the current loop's lag behind the back-EMF: a few per cent
    assert gained / 0.1 == pytest.approx((6.0 - friction) / inertia, rel=0.06)
    motor.stop()
    motor.wait_until_done(timeout_s=3)
    velocity = rig.controllers["left"].snapshot()["velocity_rad_s"]
    assert velocity == pytest.approx(0.0, abs=0.01)  # resolution: about 2 increments in 20 ms


def test_torque_continues_until_the_next_torque_command(rig: Rig):
    motor = motor_of(rig)
    push(motor, 3.0)
    motor.wait_until_done(timeout_s=1)
    push(motor, -3.0, slope=30.0)  # in mid-motion; 6 N·m in 0.2 s
    rig.runtime.run_for(0.1)
    assert asked(rig) == pytest.approx(0.0, abs=0.2)
    assert not motor.is_done()
    motor.wait_until_done(timeout_s=1)
    assert asked(rig) == pytest.approx(-3.0, abs=0.02)
    motor.set_control_mode(ControlMode.SETPOINT)
    motor.set_setpoint(1.0)
    with pytest.raises(StateError, match="stop"):
        motor.start()
    motor.stop()
    motor.wait_until_done(timeout_s=3)
    motor.start()
    motor.wait_until_done(timeout_s=5)
    assert motor.position() == pytest.approx(1.0, abs=1e-3)


def test_nothing_moves_between_arming_and_start(rig: Rig):
    """With a hanging load and 6071h = 0, the halt bit holds the drive while its mode changes."""
    motor = motor_of(rig)
    motor.enable()
    rig.controllers["left"].stimulate("load_torque_n_m", 5.0)
    rig.runtime.run_for(0.5)
    motor.set_control_mode(ControlMode.SETPOINT, ControlVariable.TORQUE)
    motor.set_setpoint(5.0)
    lowest = [0.0]

    def look() -> None:
        lowest[0] = min(lowest[0], rig.controllers["left"].snapshot()["velocity_rad_s"])

    looking = rig.runtime.every(1e-3, look)
    motor.start()
    looking.cancel()
    assert lowest[0] > -0.002
    motor.stop()


def test_simple_torque_trajectory_uses_the_drives_slope(rig: Rig):
    motor = motor_of(rig)
    motor.set_control_mode(ControlMode.TRAJECTORY, ControlVariable.TORQUE)
    motor.set_trajectory(TrapezoidalTrajectory(8.0, initial=0.0, duration_s=0.4))
    written = written_to_left(rig)
    motor.start()
    permille_s = 8.0 / 0.4 / (RATED_N_M * 1e-3 * GEAR)
    assert ("6087", int(permille_s)) in written
    began_s = rig.runtime.now_ns() / 1e9
    for at_s in (0.1, 0.2, 0.3):
        rig.runtime.run_for(began_s + at_s - rig.runtime.now_ns() / 1e9)
        assert asked(rig) == pytest.approx(20.0 * at_s, abs=0.15)
    motor.wait_until_done(timeout_s=1)
    # over when the current is within the drive's window; a TPDO every 20 ms reports it
    assert rig.runtime.now_ns() / 1e9 - began_s == pytest.approx(0.4, abs=0.05)
    motor.stop()


def torque_group(rig: Rig, *durations_s: float) -> MotorGroup:
    """Return two motors that ramp to 2 and 4 N·m in these times."""
    group = MotorGroup(motor_of(rig), motor_of(rig, "right"))
    group.for_each(Cia402Motor.set_control_mode, ControlMode.TRAJECTORY, ControlVariable.TORQUE)
    ramps = zip((2.0, 4.0), durations_s, strict=True)
    group.set_trajectory(
        *(TrapezoidalTrajectory(end, initial=0.0, duration_s=time_s) for end, time_s in ramps)
    )
    return group


def test_two_torque_motors_start_sequentially_and_report_it(rig: Rig):
    group = torque_group(rig, 0.2, 0.2)
    capability = group.sync_capability()
    assert capability.level is SyncLevel.SEQUENTIAL
    assert "6071h" in capability.reason
    group.start()
    group.wait_until_done(timeout_s=1)
    assert asked(rig) == pytest.approx(2.0, abs=0.02)
    assert asked(rig, "right") == pytest.approx(4.0, abs=0.02)
    group.stop()


def test_end_skew_of_torque_ramps_is_that_of_their_durations(rig: Rig):
    group = torque_group(rig, 0.2, 0.5)
    group.synchronization = Synchronization.NONE
    group.start()
    group.wait_until_done(timeout_s=1)
    assert group.sync_quality().predicted_end_skew_s == pytest.approx(0.3, abs=0.002)
    group.stop()


def test_torque_limits_are_those_of_model_and_drive(open_rig: OpenRig):
    rig = open_rig(
        drive("left", 1, 'objects = { "6072h" = 300 }', model="torque_max_n_m = 10.0"),
        drive("right", 2),
    )
    motor = motor_of(rig)
    with pytest.raises(LimitError, match="model wheel"):
        push(motor, 10.1)
    with pytest.raises(LimitError, match="6072h is 300"):
        push(motor, 4.2)  # 300/1000 of 0.207 N·m times 66 are 4.0986
    push(motor, 4.0)
    motor.stop()
    right = motor_of(rig, "right")
    with pytest.raises(LimitError, match=r"6072h is 1001"):
        push(right, 20.0)
    assert rig.controllers["right"].snapshot()["velocity_rad_s"] == 0.0


def test_torque_limits_may_differ_by_direction(open_rig: OpenRig):
    """300/1000 forwards and 200/1000 backwards of 0.207 N·m times 66: 4.0986 and 2.7324 N·m."""
    limits = 'objects = { "60E0h" = 300, "60E1h" = 200 }'
    rig = open_rig(
        drive("left", 1, limits), drive("right", 2, limits, model="increments_per_rad = -21008.0")
    )
    for name, forwards, backwards in (("left", 4.0, 2.7), ("right", 2.7, 4.0)):
        motor = motor_of(rig, name)
        for torque in (forwards + 0.2, -backwards - 0.2):
            with pytest.raises(LimitError, match="60E"):
                push(motor, torque)
        for torque in (forwards, -backwards):
            push(motor, torque)
            motor.wait_until_done(timeout_s=1)
        motor.stop()
        motor.wait_until_done(timeout_s=3)


@pytest.mark.parametrize(
    ("controller", "model", "reason"),
    [
        ('objects = { "6076h" = 0 }', "", "rated torque, 6076h"),
        (
            'objects = { "6091h:1" = 0, "6092h:1" = 2000 }',
            "increments_per_rad = 21008.0",
            "gear ratio, 6091h",
        ),
    ],
)
def test_unknown_torque_units_are_not_guessed(
    open_rig: OpenRig, controller: str, model: str, reason: str
):
    model += "\nvelocity_unit_rad_s = 4.76e-5\nacceleration_unit_rad_s2 = 4.76e-5"
    rig = open_rig(drive("left", 1, controller, model=model))
    motor = motor_of(rig)
    for act in (motor.torque, lambda: push(motor, 1.0)):
        with pytest.raises(UnsupportedError, match=reason):
            act()


def test_model_gear_precedes_the_drives_gear(open_rig: OpenRig):
    rig = open_rig(
        drive(
            "left",
            1,
            'objects = { "6091h:1" = 1, "6092h:1" = 2000 }',
            model="gear_ratio = 66.0\nencoder_increments_rev = 2000",
        )
    )
    motor = motor_of(rig)
    push(motor, 4.0)
    motor.wait_until_done(timeout_s=1)
    assert asked(rig) == pytest.approx(4.0, abs=0.02)
    motor.stop()


def test_torque_sign_follows_the_counting_direction(open_rig: OpenRig):
    rig = open_rig(drive("left", 1, HEAVY, model="increments_per_rad = -21008.45249"))
    motor = motor_of(rig)
    push(motor, 4.0)
    rig.runtime.run_for(0.2)
    assert asked(rig) < 0.0
    assert motor.torque() > 0.0
    assert motor.velocity() > 0.0
    motor.stop()


@pytest.mark.parametrize("scale", ["", "increments_per_rad = -21008.45249"])
def test_torque_and_position_agree_under_polarity(open_rig: OpenRig, scale: str):
    """607Eh bits 6 and 7 invert velocities and positions, but not torque (CiA 402-2)."""
    polarity = HEAVY + '\nobjects = { "607Eh" = 0xC0 }'
    rig = open_rig(drive("left", 1, polarity, model=scale))
    motor = motor_of(rig)
    push(motor, 4.0)
    rig.runtime.run_for(0.2)
    assert motor.torque() > 0.0
    assert motor.velocity() > 0.0
    assert motor.position() > 0.0
    motor.stop()


def test_linear_motor_has_a_force(open_rig: OpenRig):
    """F = 2 pi n T with n turns of the motor per metre: 200 turns make 1256.6 N of 1 N·m."""
    rig = open_rig(drive("left", 1, HEAVY))
    hardware = motor_of(rig).hardware
    model = MotorModel(
        name="slide",
        kind=MotionKind.LINEAR,
        velocity_max=0.1,
        acceleration_max=1.0,
        gear_ratio=200.0,
        encoder_increments_rev=2000,
        velocity_unit=1 / 400_000,
        acceleration_unit=1 / 400_000,
    )
    motor = Cia402Motor(hardware, model)
    push(motor, 50.0)
    motor.wait_until_done(timeout_s=1)
    shaft_n_m = 50.0 / (2 * 3.141592653589793 * 200.0)
    assert asked(rig) / GEAR == pytest.approx(shaft_n_m, abs=RATED_N_M * 1e-3)
    motor.stop()


def test_stop_in_mid_ramp_ends_the_wait(rig: Rig):
    motor = motor_of(rig)
    second = Cia402Motor(motor.hardware, motor.model, name="second")
    motor.set_control_mode(ControlMode.TRAJECTORY, ControlVariable.TORQUE)
    motor.set_trajectory(TrapezoidalTrajectory(5.0, initial=0.0, duration_s=1.0))
    motor.start()
    rig.runtime.run_for(0.3)
    second.stop()
    with pytest.raises(MotionInterrupted):
        motor.wait_until_done(timeout_s=1)
    second.wait_until_done(timeout_s=3)
    velocity = rig.controllers["left"].snapshot()["velocity_rad_s"]
    assert velocity == pytest.approx(0.0, abs=0.01)  # resolution: about 2 increments in 20 ms


def test_torque_set_point_without_slope_is_a_step(rig: Rig):
    motor = motor_of(rig)
    written = written_to_left(rig)
    push(motor, 3.0)
    assert ("6087", 0xFFFF_FFFF) in [(name, value & 0xFFFF_FFFF) for name, value in written]
    assert motor.logical.physical.run is not None
    assert motor.logical.physical.run.motion is not None
    assert motor.logical.physical.run.motion.slope == inf
    motor.stop()


def test_drive_with_a_slope_maximum_keeps_its_own(open_rig: OpenRig, tmp_path):
    """Elmo's 6087h has a maximum; a ramp's value does not remain for other motors."""
    text = OWN_EDS.read_text()
    at = text.index("DefaultValue=100000")
    eds = tmp_path / "own.eds"
    eds.write_text(text[:at] + "HighLimit=200000\n" + text[at:])
    rig = open_rig(drive("left", 1, f'eds = "{eds}"\n{HEAVY}'))
    motor = motor_of(rig)
    push(motor, 3.0, slope=30.0)
    motor.wait_until_done(timeout_s=1)
    assert motor.hardware.read("torque_slope") == int(30.0 / (RATED_N_M * 1e-3 * GEAR))
    push(motor, -3.0)
    motor.wait_until_done(timeout_s=1)
    assert motor.hardware.read("torque_slope") == 100_000
    assert asked(rig) == pytest.approx(-3.0, abs=0.02)
    with pytest.raises(UnsupportedError, match="6087h = "):
        push(motor, 3.0, slope=1e5)
    motor.stop()


def without(tmp_path: Path, index: str) -> str:
    """Return controller settings with an EDS that lacks an object."""
    head, _, rest = OWN_EDS.read_text().partition(f"[{index}]\n")
    eds = tmp_path / f"{index}.eds"
    kept = [line for line in head.splitlines() if not line.endswith(f"=0x{index}")]
    eds.write_text("\n".join([*kept, rest[rest.index("\n[") :]]))
    return f'eds = "{eds}"\n{HEAVY}'


def test_torque_without_rated_torque_is_refused_when_set_again(open_rig: OpenRig, tmp_path):
    rig = open_rig(drive("left", 1, without(tmp_path, "6076")))
    motor = motor_of(rig)
    with pytest.raises(UnsupportedError, match="6076h"):
        push(motor, 3.0)
    with pytest.raises(UnsupportedError, match="6076h"):
        motor.set_setpoint(2.0)


def test_velocity_without_its_target_is_refused_when_set(open_rig: OpenRig, tmp_path):
    rig = open_rig(drive("left", 1, without(tmp_path, "60FF")))
    motor = motor_of(rig)
    motor.enable()
    with pytest.raises(UnsupportedError, match="setpoint of velocity; it supports"):
        motor.set_control_mode(ControlMode.SETPOINT, ControlVariable.VELOCITY)
    motor.set_control_mode(ControlMode.SETPOINT)
    motor.set_setpoint(0.1)
    motor.start()
    motor.wait_until_done(timeout_s=5)


def test_velocity_without_its_target_is_refused_at_the_first_start(open_rig: OpenRig, tmp_path):
    rig = open_rig(drive("left", 1, without(tmp_path, "60FF")))
    motor = motor_of(rig)
    motor.set_control_mode(ControlMode.SETPOINT, ControlVariable.VELOCITY)  # not connected yet
    motor.set_setpoint(1.0)
    told = "mode PROFILE_VELOCITY; it supports PROFILE_POSITION, PROFILE_TORQUE"
    with pytest.raises(UnsupportedError, match=told):
        motor.start()
