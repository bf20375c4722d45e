"""Demand of a motion at each instant, as one object to be sampled.

Drives that generate their own profile do not need it. Motors with set-points from the host
(streamed, software servo, ideal) sample only this. No numpy: one value at a time, in plain floats.

A trajectory is a `Demand` over its argument; `way_of` integrates a velocity trajectory. A set-point
of velocity, torque or current that is approached at limited rates is a `Ramps` over time.
"""

from collections.abc import Callable
from math import inf
from typing import TYPE_CHECKING, Protocol, final

from motorhil.motorapi.commands import ControlVariable
from motorhil.motorapi.generation import Trapezoid, shortest
from motorhil.motorapi.motion import Motion

if TYPE_CHECKING:
    from motorhil.motorapi.functions.base import Function


class Demand(Protocol):
    """The absolute control variable over the argument; outside the interval, the nearer end.

    After the end of a trajectory with a final velocity, the demand continues at it.
    """

    initial_argument: float
    final_argument: float

    def value(self, argument: float) -> float:
        """Return the control variable [U]."""

    def first(self, argument: float) -> float:
        """Return the first derivative by the argument; 0 where the value is constant."""

    def second(self, argument: float) -> float:
        """Return the second derivative by the argument; 0 where the value is constant."""


def demand_of(motion: Motion) -> Demand:
    """Return the demand of trajectory `motion` over its argument (time since the start [s]).

    Raises:
        ValueError: the motion is a set-point, which has a single value.
    """
    if motion.trajectory is None:
        raise ValueError("a set-point has no profile")
    if motion.function is not None:
        return _FunctionDemand(motion, motion.function)
    if motion.variable is ControlVariable.POSITION:
        return _TrapezoidDemand(motion)
    return _RampDemand(motion)


def way_of(motion: Motion) -> Callable[[float], float]:
    """Return the distance that a velocity trajectory covers up to an argument, in closed form."""
    function, offset = motion.function, motion.offset
    if function is None:
        start, ramp = motion.start, _RampDemand(motion)
        rate = ramp.first(ramp.initial_argument)
        return lambda argument: (start + 0.5 * rate * argument) * argument
    begin = motion.interval[0]
    integral = function.integral()
    before = integral.value(begin)
    return lambda argument: integral.value(argument) - before + offset * (argument - begin)


@final
class Ramps:
    """A value that changes to its target at limited rates: the demand of a set-point.

    Args:
        start: initial value.
        target: final value.
        growing: maximum rate while the magnitude grows, > 0; inf: immediate.
        shrinking: maximum rate while the magnitude shrinks, first to 0 if the sign changes, > 0;
            inf: immediate.

    Attributes:
        duration_s: time until the target is reached [s].
    """

    __slots__ = ("_pieces", "_target", "duration_s")

    def __init__(self, start: float, target: float, growing: float, shrinking: float) -> None:
        steps = [(start, target, growing if abs(target) > abs(start) else shrinking)]
        if start * target < 0.0:
            steps = [(start, 0.0, shrinking), (0.0, target, growing)]
        self._pieces = [  # (duration [s], initial value, rate)
            (abs(after - before) / rate, before, rate if after > before else -rate)
            for before, after, rate in steps
            if after != before and rate != inf
        ]
        self._target = target
        self.duration_s = sum([piece[0] for piece in self._pieces])

    def at(self, elapsed_s: float) -> tuple[float, float] | None:
        """Return the value and its rate at this time; None: the target is reached."""
        for duration_s, before, rate in self._pieces:
            if elapsed_s < duration_s:
                return before + rate * elapsed_s, rate
            elapsed_s -= duration_s
        return None

    def integral(self, elapsed_s: float, start: float) -> float:
        """Return the integral of the value up to this time, from `start` on."""
        for duration_s, before, rate in self._pieces:
            spent_s = min(elapsed_s, duration_s)
            start += (before + 0.5 * rate * spent_s) * spent_s
            elapsed_s -= spent_s
        return start + self._target * elapsed_s


@final
class _TrapezoidDemand:
    """Position in closed form: acceleration, plateau, deceleration."""

    __slots__ = ("_distance", "_profile", "_start", "_target", "final_argument", "initial_argument")

    def __init__(self, motion: Motion) -> None:
        profile = shortest(
            motion.distance, motion.velocity, motion.acceleration, motion.deceleration
        )
        self._profile: Trapezoid = profile
        self._start = motion.start
        self._target = motion.target
        self.initial_argument = 0.0
        self.final_argument = profile.duration_s

    def value(self, argument: float) -> float:
        if argument >= self.final_argument:
            return self._target
        return self._start + self._profile.position(argument)

    def first(self, argument: float) -> float:
        return self._profile.velocity(argument)

    def second(self, argument: float) -> float:
        profile = self._profile
        if argument < 0.0 or argument >= profile.duration_s:
            return 0.0
        if argument < profile.ramp_up_s:
            size = profile.acceleration
        elif argument < profile.ramp_down_s:
            return 0.0
        else:
            size = -profile.deceleration
        return size if profile.distance > 0.0 else -size


@final
class _RampDemand:
    """Velocity, torque or current at a constant rate from start to target."""

    __slots__ = ("_rate", "_start", "_target", "final_argument", "initial_argument")

    def __init__(self, motion: Motion) -> None:
        self._start = motion.start
        self._target = motion.target
        self.initial_argument = 0.0
        self.final_argument = 0.0 if motion.duration_s is None else motion.duration_s
        self._rate = motion.distance / self.final_argument if self.final_argument > 0.0 else 0.0

    def value(self, argument: float) -> float:
        if argument >= self.final_argument:
            return self._target
        return self._start + self._rate * max(argument, 0.0)

    def first(self, argument: float) -> float:
        return self._rate if 0.0 <= argument < self.final_argument else 0.0

    def second(self, argument: float) -> float:
        return 0.0


@final
class _Onward:
    """Position after the end of a trajectory with a final velocity.

    The motor keeps this velocity. Towards a limit of position, it decelerates to rest there.
    """

    __slots__ = ("_deceleration", "_rest_at", "_stop_s", "_target", "_velocity", "_way_s")

    def __init__(self, motion: Motion) -> None:
        velocity = motion.final_velocity
        self._target = motion.target
        self._velocity = velocity
        self._deceleration = motion.deceleration if velocity > 0.0 else -motion.deceleration
        self._stop_s = velocity / self._deceleration
        self._rest_at = motion.rest_at
        self._way_s = inf
        if motion.rest_at is not None:
            way = motion.rest_at - motion.target - 0.5 * velocity * self._stop_s
            self._way_s = max(0.0, way / velocity)

    def value(self, since_s: float) -> float:
        braked_s = since_s - self._way_s
        if braked_s <= 0.0:
            return self._target + self._velocity * since_s
        left_s = self._stop_s - braked_s
        assert self._rest_at is not None
        if left_s <= 0.0:
            return self._rest_at
        return self._rest_at - 0.5 * self._deceleration * left_s * left_s

    def first(self, since_s: float) -> float:
        braked_s = since_s - self._way_s
        if braked_s >= self._stop_s:
            return 0.0
        return self._velocity - self._deceleration * max(0.0, braked_s)

    def second(self, since_s: float) -> float:
        braked_s = since_s - self._way_s
        return -self._deceleration if 0.0 <= braked_s < self._stop_s else 0.0


@final
class _FunctionDemand:
    """Any function, constant before its beginning; beyond its end constant, or `_Onward`."""

    __slots__ = (
        "_first",
        "_function",
        "_offset",
        "_onward",
        "_second",
        "final_argument",
        "initial_argument",
    )

    def __init__(self, motion: Motion, function: "Function") -> None:
        self._function = function
        self._first = function.derivative()
        self._second = function.derivative(2)
        self._offset = motion.offset
        self._onward = _Onward(motion) if motion.final_velocity else None
        self.initial_argument, self.final_argument = motion.interval

    def value(self, argument: float) -> float:
        if self._onward is not None and argument > self.final_argument:
            return self._onward.value(argument - self.final_argument)
        inside = min(max(argument, self.initial_argument), self.final_argument)
        return self._function.value(inside) + self._offset

    def first(self, argument: float) -> float:
        if self.initial_argument <= argument < self.final_argument:
            return self._first.value(argument)
        if self._onward is not None and argument >= self.final_argument:
            return self._onward.first(argument - self.final_argument)
        return 0.0

    def second(self, argument: float) -> float:
        if self.initial_argument <= argument < self.final_argument:
            return self._second.value(argument)
        if self._onward is not None and argument >= self.final_argument:
            return self._onward.second(argument - self.final_argument)
        return 0.0
