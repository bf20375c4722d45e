"""A plain program for two motors of each kind of drive; it is correct, so no world breaks it."""

from pathlib import Path

from motorhil.harness import conformance
from motorhil.harness.cli.demo import POINT_M
from motorhil.harness.examples.rover import Rover, manoeuvre
from motorhil.harness.rig.config.scaffold import EXAMPLES
from motorhil.harness.swarm.properties import always
from motorhil.motorapi import ControlMode, Motor, StateError, TrapezoidalTrajectory
from motorhil.motorapi.state import MotorState
from tests.system.swarm.defects import CORRECT, Defect

RIGS = Path(conformance.__file__).parent / "rigs"
KINDS = (
    *("cia402", "software", "leadshine", "oriental_az", "mit", "moteus"),
    *("vesc", "rmd", "dynamixel", "robstride", "dryve"),
)
NEAR_RAD = 0.05
WAYS = (-0.4, 0.3)  # of a group, from where it is


def two_motors(rig):
    """Move both motors, unless they stop by themselves after a loss of their host."""
    try:
        move(rig)
    except StateError:
        if all(motor.state() is MotorState.ENABLED for motor in rig.motors.values()):
            raise


def move(rig):
    """Move one motor, then both, stop them half-way, and switch off."""
    left, right = rig.motors["left"], rig.motors["right"]
    for motor, target in ((left, 0.4), (right, -0.3)):
        motor.enable()
        motor.set_control_mode(ControlMode.SETPOINT)
        motor.set_setpoint(target)
        motor.start()
        motor.wait_until_done(timeout_s=4.0)
        always(abs(motor.position() - target) < NEAR_RAD, "a motor that is done is at its target")
    both = rig.groups["both"]
    both.for_each(Motor.set_control_mode, ControlMode.TRAJECTORY)
    both.set_trajectory(*map(TrapezoidalTrajectory, WAYS))
    targets = [motor.position() + way for motor, way in zip(both, WAYS, strict=True)]
    both.start()
    both.wait_until_done(timeout_s=4.0)
    for motor, target in zip(both, targets, strict=True):
        off = abs(motor.position() - target)  # a drive that was without power counts anew
        always(off < NEAR_RAD, "a group that is done is at its target")
    both.start()
    rig.runtime.run_for(0.2)
    both.stop()
    both.wait_until_done(timeout_s=3.0)
    for motor in both:
        always(abs(motor.velocity()) < 0.1, "a motor that was stopped stands")
    both.for_each(Motor.disable)


def rover(rig):
    """Make the manoeuvre of the demo."""
    groups = [rig.groups[name] for name in ("wheels", "steering", "mast")]
    manoeuvre(Rover(*groups), rig.runtime, POINT_M, lambda text: None)


CORRECT["rover"] = Defect("rover", f"{__name__}:rover", EXAMPLES / "rover.toml", "", ())
for _kind in KINDS:
    CORRECT[_kind] = Defect(_kind, f"{__name__}:two_motors", RIGS / f"{_kind}.toml", "", ())
