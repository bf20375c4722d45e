"""Kinematics of a six-wheel rover: steering, rolling, and pointing of its mast.

Every leg of a manoeuvre is a constant twist of the body: forward, left and turn at once. An arc is
forward with a turn. A crab is forward and left without a turn. A turn on the spot is a turn alone.
Lengths are in metres, angles in radians; x is forward, y left, z up.
"""

from dataclasses import dataclass
from math import atan2, cos, hypot, pi, sin
from typing import final

WHEEL_RADIUS_M = 0.10
WHEELS = ("fl", "fr", "ml", "mr", "rl", "rr")
WHEEL_PLACES_M = {
    "fl": (0.40, 0.30),
    "fr": (0.40, -0.30),
    "ml": (0.00, 0.33),
    "mr": (0.00, -0.33),
    "rl": (-0.40, 0.30),
    "rr": (-0.40, -0.30),
}
MAST_PLACE_M = (0.25, 0.0, 1.10)


@final
@dataclass(frozen=True, slots=True)
class Pose:
    """The pose of the body in the world."""

    x_m: float = 0.0
    y_m: float = 0.0
    heading_rad: float = 0.0


@final
@dataclass(frozen=True, slots=True)
class Leg:
    """A constant twist of the body from rest to rest, in the body's own axes."""

    name: str
    forward_m: float
    left_m: float
    turn_rad: float

    @classmethod
    def arc(cls, radius_m: float, turn_rad: float) -> "Leg":
        """Return a leg along a circle; a positive turn is to the left."""
        return cls("arc", abs(radius_m * turn_rad), 0.0, turn_rad)

    @classmethod
    def crab(cls, distance_m: float, direction_rad: float) -> "Leg":
        """Return a straight leg in a direction, without turning."""
        return cls("crab", distance_m * cos(direction_rad), distance_m * sin(direction_rad), 0.0)

    @classmethod
    def turn(cls, turn_rad: float) -> "Leg":
        """Return a turn on the spot."""
        return cls("turn", 0.0, 0.0, turn_rad)

    def wheel(self, name: str) -> tuple[float, float]:
        """Return one wheel's steering angle [rad], in -pi/2..pi/2, and rolling angle [rad]."""
        x_m, y_m = WHEEL_PLACES_M[name]
        along_m = self.forward_m - self.turn_rad * y_m
        across_m = self.left_m + self.turn_rad * x_m
        steering_rad = atan2(across_m, along_m)
        rolling_rad = hypot(along_m, across_m) / WHEEL_RADIUS_M
        if steering_rad > pi / 2:  # rolls backwards rather than steer so far
            return steering_rad - pi, -rolling_rad
        if steering_rad < -pi / 2:
            return steering_rad + pi, -rolling_rad
        return steering_rad, rolling_rad

    def way_ahead_rad(self) -> float:
        """Return the pan angle [rad] of a camera that looks along this leg."""
        if self.turn_rad:
            return self.turn_rad / 2
        return atan2(self.left_m, self.forward_m)

    def pose_after(self, start: Pose, part: float) -> Pose:
        """Return the pose when `part` (0..1) of the leg has been driven."""
        turn_rad = self.turn_rad * part
        forward_m, left_m = self.forward_m * part, self.left_m * part
        if abs(turn_rad) > 1e-9:  # the chord of the circle, not its arc
            forward_m, left_m = (
                (forward_m * sin(turn_rad) - left_m * (1 - cos(turn_rad))) / turn_rad,
                (forward_m * (1 - cos(turn_rad)) + left_m * sin(turn_rad)) / turn_rad,
            )
        c, s = cos(start.heading_rad), sin(start.heading_rad)
        return Pose(
            start.x_m + c * forward_m - s * left_m,
            start.y_m + s * forward_m + c * left_m,
            start.heading_rad + turn_rad,
        )


def look_at(pose: Pose, point_m: tuple[float, float, float]) -> tuple[float, float]:
    """Return (pan, tilt) [rad] of a mast that points at a point of the world; pan in -pi..pi."""
    c, s = cos(pose.heading_rad), sin(pose.heading_rad)
    dx_m, dy_m = point_m[0] - pose.x_m, point_m[1] - pose.y_m
    ahead_m = c * dx_m + s * dy_m - MAST_PLACE_M[0]
    aside_m = -s * dx_m + c * dy_m - MAST_PLACE_M[1]
    return (
        atan2(aside_m, ahead_m),
        atan2(point_m[2] - MAST_PLACE_M[2], hypot(ahead_m, aside_m)),
    )
