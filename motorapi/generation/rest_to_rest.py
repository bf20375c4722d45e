"""Trapezoidal velocity profiles from rest to rest, in closed form.

The profile is the shortest, or has a given duration. With distance D >= 0, speed limit v,
acceleration a and deceleration d (all magnitudes):

    shortest   peak p = min(v, sqrt(2 D a d / (a + d))), duration T = D/p + k p
    stretched  the same a and d, and the peak p for which D/p + k p = T
               p = (T - sqrt(T² - 4 k D)) / (2 k) = 2 D / (T + sqrt(T² - 4 k D))

Here k = (1/a + 1/d) / 2 is half the time for a ramp up to speed 1 and a ramp down from it. For a =
d the peak is (a T - sqrt(a² T² - 4 a D)) / 2. The last form is used: it avoids cancellation for
long T. A profile of distance 0 has duration 0, or any requested duration. Units: one unit of length
U (rad or m) throughout, so rotary and linear motors may be mixed.

Source: Biagiotti & Melchiorri, Trajectory Planning for Automatic Machines and Robots (2008), ch. 3,
trapezoidal velocity profile; asymmetric ramps follow in the same way.
"""

from dataclasses import dataclass
from math import isfinite, sqrt
from typing import final

from motorapi.errors import UsageError


@final
@dataclass(frozen=True, slots=True)
class Trapezoid:
    """A generated profile from rest at 0 to rest at `distance`; immutable.

    Attributes:
        distance: signed [U].
        peak: highest speed [U/s], >= 0.
        acceleration: magnitude while speeding up [U/s²], > 0.
        deceleration: magnitude while slowing down [U/s²], > 0.
        ramp_up_s: beginning of the plateau [s], t_1 in the paper.
        ramp_down_s: end of the plateau [s], t_2 in the paper.
        duration_s: time of arrival at `distance` [s], t_f in the paper.
    """

    distance: float
    peak: float
    acceleration: float
    deceleration: float
    ramp_up_s: float
    ramp_down_s: float
    duration_s: float

    def position(self, time_s: float) -> float:
        """Return the position [U] at `time_s` [s]; 0 before the start, `distance` after the end."""
        if time_s <= 0.0:
            return 0.0
        if time_s >= self.duration_s:
            return self.distance
        way = abs(self.distance)
        if time_s < self.ramp_up_s:
            made = 0.5 * self.acceleration * time_s * time_s
        elif time_s <= self.ramp_down_s:
            made = self.peak * (time_s - 0.5 * self.ramp_up_s)
        else:
            left_s = self.duration_s - time_s
            made = way - 0.5 * self.deceleration * left_s * left_s
        return min(made, way) if self.distance > 0.0 else -min(made, way)

    def velocity(self, time_s: float) -> float:
        """Return the signed velocity [U/s] at `time_s` [s]; 0 outside the motion."""
        if time_s <= 0.0 or time_s >= self.duration_s:
            return 0.0
        speed = min(
            self.acceleration * time_s,
            self.peak,
            self.deceleration * (self.duration_s - time_s),
        )
        return speed if self.distance > 0.0 else -speed


def shortest(
    distance: float, velocity: float, acceleration: float, deceleration: float
) -> Trapezoid:
    """Return the shortest profile over `distance` within the limits.

    Args:
        distance: signed [U], finite.
        velocity: speed limit [U/s], finite, > 0.
        acceleration: limit while speeding up [U/s²], finite, > 0.
        deceleration: limit while slowing down [U/s²], finite, > 0.

    Raises:
        UsageError: an argument violates these conditions.
    """
    _check(distance, velocity, acceleration, deceleration)
    way = abs(distance)
    if way == 0.0:
        return Trapezoid(distance, 0.0, acceleration, deceleration, 0.0, 0.0, 0.0)
    k = _ramp_time(acceleration, deceleration)
    triangle = sqrt(way / k)
    if triangle <= velocity:
        return _trapezoid(distance, triangle, acceleration, deceleration, 0.0)
    plateau_s = max(0.0, way / velocity - k * velocity)
    return _trapezoid(distance, velocity, acceleration, deceleration, plateau_s)


def stretched(
    distance: float, duration_s: float, acceleration: float, deceleration: float
) -> Trapezoid:
    """Return the profile over `distance` of duration `duration_s`, with a lower plateau.

    Args:
        distance: signed [U], finite.
        duration_s: > 0 [s], at least the duration of `shortest` (within rounding).
        acceleration: while speeding up [U/s²], finite, > 0.
        deceleration: while slowing down [U/s²], finite, > 0.

    Raises:
        UsageError: an argument violates these conditions, or the duration is too short.
    """
    _check(distance, duration_s, acceleration, deceleration)
    way = abs(distance)
    if way == 0.0:
        return Trapezoid(distance, 0.0, acceleration, deceleration, 0.0, duration_s, duration_s)
    k = _ramp_time(acceleration, deceleration)
    rest = duration_s * duration_s - 4.0 * k * way
    if rest < -1e-9 * duration_s * duration_s:
        raise UsageError(
            f"distance {way:g} in {duration_s:g} s is impossible with ramps of "
            f"{acceleration:g} and {deceleration:g}; it takes at least {2.0 * sqrt(k * way):g} "
            "s"
        )
    peak = 2.0 * way / (duration_s + sqrt(max(rest, 0.0)))
    plateau_s = max(0.0, way / peak - k * peak)
    return _trapezoid(distance, peak, acceleration, deceleration, plateau_s)


def _ramp_time(acceleration: float, deceleration: float) -> float:
    return 0.5 / acceleration + 0.5 / deceleration


def _trapezoid(
    distance: float, peak: float, acceleration: float, deceleration: float, plateau_s: float
) -> Trapezoid:
    up_s = peak / acceleration
    end_s = up_s + plateau_s + peak / deceleration
    return Trapezoid(distance, peak, acceleration, deceleration, up_s, up_s + plateau_s, end_s)


def _check(distance: float, *positive: float) -> None:
    if not isfinite(distance):
        raise UsageError(f"distance {distance} is not a finite number")
    for value in positive:
        if not (isfinite(value) and value > 0.0):
            raise UsageError(f"{value} must be finite and > 0 (a limit or a duration)")
