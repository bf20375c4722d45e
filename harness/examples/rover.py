"""A six-wheel rover's manoeuvre, based on the motor interface alone.

This module does not know the drives or their buses, real or emulated; the rig or the robot defines
them. The manoeuvre is that of the paper's Figure 7: an arc, a crab and a turn on the spot, while
the mast looks at one point of the world.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import final

from motorhil.harness.examples.rover_kinematics import WHEELS, Leg, Pose, look_at
from motorhil.motorapi import (
    ControlMode,
    Motor,
    MotorGroup,
    Runtime,
    SyncCapability,
    SyncQuality,
    TrapezoidalTrajectory,
)

MANOEUVRE = (Leg.arc(1.5, 0.9), Leg.crab(0.7, -0.5), Leg.turn(-0.8))
LOOK_PERIOD_S = 0.5
LEG_TIMEOUT_S = 60.0

Report = Callable[[str], None]


@final
@dataclass(frozen=True, slots=True)
class Move:
    """A finished coordinated motion: its targets, and its predicted and actual synchronization."""

    group: MotorGroup
    targets_rad: tuple[float, ...]
    capability: SyncCapability
    quality: SyncQuality


@final
class Rover:
    """A rover of three groups of motors: wheels and steering as in WHEELS, mast (pan, tilt).

    Attributes:
        pose: the pose of the body, from the rolling of the wheels.
        leg: the leg being driven; None at rest.
        moves: all coordinated motions so far.
    """

    def __init__(self, wheels: MotorGroup, steering: MotorGroup, mast: MotorGroup) -> None:
        self.wheels = wheels
        self.steering = steering
        self.mast = mast
        self.pose: Pose = Pose()
        self.leg: Leg | None = None
        self.moves: list[Move] = []
        self._leg_start: tuple[float, ...] = ()

    def switch_on(self) -> None:
        """Enable all motors, and set them to trajectories."""
        for group in (self.wheels, self.steering, self.mast):
            group.for_each(Motor.enable)
            group.for_each(Motor.set_control_mode, ControlMode.TRAJECTORY)

    def switch_off(self) -> None:
        """Disable all motors."""
        for group in (self.wheels, self.steering, self.mast):
            group.for_each(Motor.disable)

    def drive(self, leg: Leg) -> None:
        """Drive a leg: steer all wheels together, then roll all wheels together.

        The members of a group start and end at the same time, as fast as the slowest allows.
        """
        targets = [leg.wheel(name) for name in WHEELS]
        self.turn_to(self.steering, [steering_rad for steering_rad, _ in targets])
        here_rad = tuple(motor.position() for motor in self.wheels)
        self._leg_start = here_rad
        self.leg = leg
        self.turn_to(
            self.wheels, [here + roll for here, (_, roll) in zip(here_rad, targets, strict=True)]
        )
        self.pose = leg.pose_after(self.pose, 1.0)
        self.leg = None

    def pose_now(self) -> Pose:
        """Return the pose of the body from the rolling of the wheels in this leg."""
        leg = self.leg
        if leg is None:
            return self.pose
        parts = []
        for name, motor, start_rad in zip(WHEELS, self.wheels, self._leg_start, strict=True):
            roll_rad = leg.wheel(name)[1]
            if roll_rad:
                parts.append((motor.position() - start_rad) / roll_rad)
        return leg.pose_after(self.pose, sum(parts) / len(parts))

    def look_at(self, point_m: tuple[float, float, float]) -> None:
        """Point the mast at a point of the world, from the rover's current pose."""
        self.turn_to(self.mast, look_at(self.pose_now(), point_m))

    def turn_to(self, group: MotorGroup, angles_rad: Sequence[float]) -> None:
        """Move all motors of the group to their angles, starting and ending together."""
        group.set_trajectory(
            *(
                TrapezoidalTrajectory(angle_rad, initial=motor.position())
                for motor, angle_rad in zip(group, angles_rad, strict=True)
            )
        )
        capability = group.sync_capability()
        group.start()
        group.wait_until_done(LEG_TIMEOUT_S)
        self.moves.append(Move(group, tuple(angles_rad), capability, group.sync_quality()))

    def keep_looking(
        self, runtime: Runtime, point_m: tuple[float, float, float], until: Callable[[], bool]
    ) -> None:
        """Follow the point with the mast, `until()`; runs as a party while others drive."""
        while not until():
            self.look_at(point_m)
            runtime.wait_until(until, LOOK_PERIOD_S)


def manoeuvre(
    rover: Rover, runtime: Runtime, point_m: tuple[float, float, float], report: Report
) -> None:
    """Drive the whole manoeuvre while the mast looks at the point, then switch off."""
    rover.switch_on()
    report("switched on, looking at the point")
    rover.look_at(point_m)
    arrived = False
    looking = runtime.spawn(
        "mast", lambda: rover.keep_looking(runtime, point_m, until=lambda: arrived)
    )
    for leg in MANOEUVRE:
        report(
            f"{leg.name}: {leg.forward_m:.2f} m forward, {leg.left_m:.2f} m to the left, "
            f"{leg.turn_rad:.2f} rad turned"
        )
        rover.drive(leg)
    arrived = True
    looking.join()
    if looking.error is not None:
        raise looking.error
    rover.look_at(point_m)
    rover.switch_off()
