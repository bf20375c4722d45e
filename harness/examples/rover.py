"""A six-wheel rover's manoeuvre, written against the motor interface alone.

Nothing here knows what drives there are, on which bus, real or emulated: that is the rig's, or the
robot's, to say. The manoeuvre is the one of the paper's Figure 7: an arc, a crab and a turn on the
spot, while the mast keeps looking at one point of the world.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import final

from harness.examples.rover_kinematics import WHEELS, Leg, Pose, look_at
from motorapi import (
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

Told = Callable[[str], None]


@final
@dataclass(frozen=True, slots=True)
class Move:
    """One coordinated motion that is over: where to, how well it could and how well it did sync."""

    group: MotorGroup
    targets_rad: tuple[float, ...]
    capability: SyncCapability
    quality: SyncQuality


@final
class Rover:
    """Three groups of motors that make a rover; members in the order of WHEELS, and (pan, tilt).

    Attributes:
        pose: of the body, by what its wheels have rolled.
        leg: what is being driven; None at rest.
        moves: every coordinated motion so far.
    """

    def __init__(self, wheels: MotorGroup, steering: MotorGroup, mast: MotorGroup) -> None:
        self.wheels = wheels
        self.steering = steering
        self.mast = mast
        self.pose = Pose()
        self.leg: Leg | None = None
        self.moves: list[Move] = []
        self._leg_start: tuple[float, ...] = ()

    def switch_on(self) -> None:
        """All motors are enabled and will follow trajectories."""
        for group in (self.wheels, self.steering, self.mast):
            group.for_each(Motor.enable)
            group.for_each(Motor.set_control_mode, ControlMode.TRAJECTORY)

    def switch_off(self) -> None:
        """No motor is powered."""
        for group in (self.wheels, self.steering, self.mast):
            group.for_each(Motor.disable)

    def drive(self, leg: Leg) -> None:
        """The leg has been driven: first all wheels are steered together, then all roll together.

        Members of a group begin and end at the same time, as fast as the slowest allows.
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
        """Where the body is, judged by how far the wheels have rolled in this leg."""
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
        """The mast points at this point of the world, from where the rover is now."""
        self.turn_to(self.mast, look_at(self.pose_now(), point_m))

    def turn_to(self, group: MotorGroup, angles_rad: Sequence[float]) -> None:
        """Every motor of the group is at its angle; they began and ended together."""
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
        """The mast has followed the point, `until()`; a party of its own while others drive."""
        while not until():
            self.look_at(point_m)
            runtime.wait_until(until, LOOK_PERIOD_S)


def manoeuvre(
    rover: Rover, runtime: Runtime, point_m: tuple[float, float, float], told: Told
) -> None:
    """The whole manoeuvre has been driven while the mast looked at the point; motors are off."""
    rover.switch_on()
    told("switched on, looking at the point")
    rover.look_at(point_m)
    arrived = False
    looking = runtime.spawn(
        "mast", lambda: rover.keep_looking(runtime, point_m, until=lambda: arrived)
    )
    for leg in MANOEUVRE:
        told(
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
