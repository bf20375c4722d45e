"""Trapezoidal velocity profiles in closed form, rest to rest: shortest, or of a given duration.

With distance D >= 0, speed limit v, acceleration a and deceleration d (all sizes):

    shortest   peak p = min(v, sqrt(2 D a d / (a + d))), duration T = D/p + k p
    stretched  the same a and d, and the peak p for which D/p + k p = T
               p = (T - sqrt(T² - 4 k D)) / (2 k) = 2 D / (T + sqrt(T² - 4 k D))

where k = (1/a + 1/d) / 2 is half the time that speeding up to 1 and slowing down from 1 take
together. For a = d the peak is (a T - sqrt(a² T² - 4 a D)) / 2. The last form is used: it does not
cancel when T is long. A profile of length 0 has duration 0, or whatever duration is asked for.

Units: one unit of length U (rad or m) throughout, so turning and sliding motors may be mixed.
Source: Biagiotti & Melchiorri, Trajectory Planning for Automatic Machines and Robots (2008), ch. 3,
trapezoidal velocity profile; asymmetric ramps follow the same way.
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
        acceleration: size while speeding up [U/s²], > 0.
        deceleration: size while slowing down [U/s²], > 0.
        ramp_up_s: when the plateau begins [s], the paper's t_1.
        ramp_down_s: when the plateau ends [s], the paper's t_2.
        duration_s: when it is at rest at `distance` [s], the paper's t_f.
    """

    distance: float
    peak: float
    acceleration: float
    deceleration: float
    ramp_up_s: float
    ramp_down_s: float
    duration_s: float

    def position(self, time_s: float) -> float:
        """Way made [U] at `time_s` [s]; 0 before the start, `distance` after the end."""
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
        """Signed velocity [U/s] at `time_s` [s]; 0 outside the motion."""
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
    """The profile over `distance` that the limits allow to be shortest.

    Args:
        distance: signed [U], finite.
        velocity: speed limit [U/s], finite, > 0.
        acceleration: limit while speeding up [U/s²], finite, > 0.
        deceleration: limit while slowing down [U/s²], finite, > 0.

    Raises:
        UsageError: an argument is not as stated.
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
    """The profile over `distance` that takes `duration_s` with these ramps and a lower plateau.

    Args:
        distance: signed [U], finite.
        duration_s: > 0 [s], at least what `shortest` takes (a shorter one by rounding is taken
            as that).
        acceleration: while speeding up [U/s²], finite, > 0.
        deceleration: while slowing down [U/s²], finite, > 0.

    Raises:
        UsageError: an argument is not as stated, or no plateau makes it in that time.
    """
    _check(distance, duration_s, acceleration, deceleration)
    way = abs(distance)
    if way == 0.0:
        return Trapezoid(distance, 0.0, acceleration, deceleration, 0.0, duration_s, duration_s)
    k = _ramp_time(acceleration, deceleration)
    rest = duration_s * duration_s - 4.0 * k * way
    if rest < -1e-9 * duration_s * duration_s:
        raise UsageError(
            f"{way:g} in {duration_s:g} s cannot be made with ramps of {acceleration:g} and"
            f" {deceleration:g}; it takes at least {2.0 * sqrt(k * way):g} s"
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
