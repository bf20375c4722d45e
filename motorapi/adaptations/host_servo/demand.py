"""Demand of a servo on the host, cycle by cycle.

A position set-point is the demand from the first cycle on: there is no profile, and the servo acts
on the step. A set-point of velocity, torque or current also steps, or changes at the rate limit of
the command. Trajectories are sampled. All values are in increments of the counter, seconds and
amperes.
"""

from collections.abc import Callable
from dataclasses import dataclass
from math import inf
from typing import Final, final

from motorhil.motorapi.commands import ControlMode, ControlVariable
from motorhil.motorapi.motion import Motion
from motorhil.motorapi.planning.sampling import Demand, Ramps, demand_of
from motorhil.motorapi.trajectory import Argument, value_of

POSITION: Final = 0
VELOCITY: Final = 1
CURRENT: Final = 2


class Course:
    """The demand since the cycle of its beginning; `sample` sets it for one instant.

    Attributes:
        kind: POSITION, VELOCITY or CURRENT: the quantity of `value`.
        value: the demand [inc, inc/s or A].
        velocity, acceleration: the values for feed-forward [inc/s, inc/s²].
        is_step: whether it is a position set-point; its error is not a following error.
        is_stop: whether it is a stop: over when the motor stands still, at any position.
        final_velocity: the velocity of a position demand that continues at its end [inc/s].
        target: the final value; with an argument other than time, the present value.
        is_over: whether the demand has come to its end.
    """

    def __init__(self, kind: int, target: float, *, is_step: bool = False) -> None:
        self.kind = kind
        self.value: float = target
        self.velocity: float = 0.0
        self.acceleration: float = 0.0
        self.is_step = is_step
        self.is_stop = False
        self.final_velocity: float = 0.0
        self.target: float = target
        self.is_over: bool = True

    def sample(self, elapsed_s: float, ahead_s: float) -> None:
        """Set the demand for `elapsed_s` after the start; feed-forward for `ahead_s` later.

        Raises:
            MotorError: the argument of the trajectory is no longer known.
        """


@final
class Rated(Course):
    """A set-point of velocity or current that is approached at limited rates.

    Args:
        kind: VELOCITY or CURRENT.
        start: the initial value.
        target: the final value.
        growing: the rate limit while the magnitude grows; inf: at once.
        shrinking: the rate limit while the magnitude shrinks, first to 0 if the sign changes.
    """

    def __init__(
        self, kind: int, start: float, target: float, growing: float, shrinking: float
    ) -> None:
        super().__init__(kind, target)
        self._ramps = Ramps(start, target, growing, shrinking)
        self.is_over: bool = self._ramps.duration_s == 0.0

    def sample(self, elapsed_s: float, ahead_s: float) -> None:
        """Set the demand for `elapsed_s` after the start."""
        on_ramp = self._ramps.at(elapsed_s)
        self.is_over = on_ramp is None
        value, rate = (self.target, 0.0) if on_ramp is None else on_ramp
        self.value: float = value
        if self.kind == VELOCITY:
            self.velocity: float = value
            self.acceleration: float = rate


@final
class Braking(Course):
    """A stop at a constant deceleration, from a position and a velocity."""

    def __init__(self, place: float, velocity: float, deceleration: float) -> None:
        self._place = place
        self._velocity = velocity
        self._rate = -deceleration if velocity > 0.0 else deceleration
        self._end_s = abs(velocity) / deceleration
        super().__init__(POSITION, place + 0.5 * velocity * self._end_s)
        self.is_over: bool = False
        self.is_stop = True

    def sample(self, elapsed_s: float, ahead_s: float) -> None:
        """Set the demand for `elapsed_s` after the start."""
        end_s = self._end_s
        then_s = min(elapsed_s + ahead_s, end_s)
        self.velocity: float = self._velocity + self._rate * then_s if then_s < end_s else 0.0
        self.acceleration: float = self._rate if then_s < end_s else 0.0
        if elapsed_s < end_s:
            self.value = self._place + (self._velocity + 0.5 * self._rate * elapsed_s) * elapsed_s
        else:
            self.value: float = self.target
            self.is_over = True


@final
class Tracked(Course):
    """A trajectory over time."""

    def __init__(self, kind: int, demand: Demand, scale: float) -> None:
        super().__init__(kind, demand.value(demand.final_argument) * scale)
        self._demand = demand
        self._scale = scale
        self._start = demand.initial_argument
        self._end = demand.final_argument
        self.is_over: bool = False

    def sample(self, elapsed_s: float, ahead_s: float) -> None:
        """Set the demand for `elapsed_s` after the start."""
        demand = self._demand
        now = self._start + elapsed_s
        self.value: float = demand.value(now) * self._scale
        self.is_over = now >= self._end
        if self.kind == POSITION:
            then = now + ahead_s
            self.velocity: float = demand.first(then) * self._scale
            self.acceleration: float = demand.second(then) * self._scale
        elif self.kind == VELOCITY:
            self.velocity = self.value
            self.acceleration = demand.first(now + ahead_s) * self._scale


@final
class Moving(Course):
    """A trajectory that begins with a velocity, planned when it begins.

    Args:
        planned: returns the motion, for the position where it begins [U].
        motion: the motion from the present position.
        scale: increments per U.
    """

    def __init__(self, planned: Callable[[float], Motion], motion: Motion, scale: float) -> None:
        super().__init__(POSITION, motion.target * scale)
        self._planned = planned
        self._scale = scale
        self._tracked = Tracked(POSITION, demand_of(motion), scale)
        self.final_velocity: float = motion.final_velocity * scale
        self.is_over: bool = False

    def begin(self, demand: float) -> None:
        """Plan the motion from this demand [inc].

        Raises:
            MotorError: there is no such motion from there.
        """
        motion = self._planned(demand / self._scale)
        self._tracked = Tracked(POSITION, demand_of(motion), self._scale)
        self.target: float = self._tracked.target

    def sample(self, elapsed_s: float, ahead_s: float) -> None:
        """Set the demand for `elapsed_s` after the start."""
        tracked = self._tracked
        tracked.sample(elapsed_s, ahead_s)
        self.value: float = tracked.value
        self.velocity: float = tracked.velocity
        self.acceleration: float = tracked.acceleration
        self.is_over = tracked.is_over


@final
class Led(Course):
    """A trajectory over an argument other than time, which is read once a cycle."""

    def __init__(self, kind: int, demand: Demand, scale: float, argument: Argument) -> None:
        super().__init__(kind, demand.value(value_of(argument)) * scale)
        self._demand = demand
        self._scale = scale
        self._argument = argument
        self._before = (0.0, value_of(argument))
        self.is_over: bool = False

    def sample(self, elapsed_s: float, ahead_s: float) -> None:
        """Set the demand for the present value of the argument."""
        demand = self._demand
        now = value_of(self._argument)
        then_s, before = self._before
        passed_s = elapsed_s - then_s
        rate = (now - before) / passed_s if passed_s > 0.0 else 0.0
        self._before = (elapsed_s, now)
        self.target: float = demand.value(now) * self._scale
        self.value: float = self.target
        self.is_over = now >= demand.final_argument
        if self.kind == POSITION:
            self.velocity: float = demand.first(now) * rate * self._scale
            self.acceleration: float = demand.second(now) * rate * rate * self._scale
        elif self.kind == VELOCITY:
            self.velocity = self.value
            self.acceleration = demand.first(now) * rate * self._scale


@final
@dataclass(frozen=True, slots=True)
class Scales:
    """The scales between the motor's units and its servo.

    Attributes:
        increments: increments of the counter per unit of position, signed.
        torque: the torque per current at the output [N·m/A, of a linear motor N/A]; None: not
            known.
    """

    increments: float
    torque: float | None

    @property
    def sign(self) -> float:
        """1, or -1 if the counter counts against the motor's positive direction."""
        return 1.0 if self.increments > 0.0 else -1.0

    def of(self, variable: ControlVariable) -> float:
        """Return the servo's units per unit of this variable."""
        if variable is ControlVariable.TORQUE:
            return self.sign / (1.0 if self.torque is None else self.torque)
        return self.sign if variable is ControlVariable.CURRENT else self.increments


_KINDS: Final = {ControlVariable.POSITION: POSITION, ControlVariable.VELOCITY: VELOCITY}


def course_of(
    motion: Motion,
    scales: Scales,
    velocity: float,
    current_a: float,
    planned: Callable[[float], Motion] | None = None,
) -> Course:
    """Return the course of a motion.

    Args:
        motion: a set-point or any trajectory, in the motor's units.
        scales: the scales of these units.
        velocity: the present demand [inc/s].
        current_a: the present output [A].
        planned: returns a motion with an initial velocity, for the position where it begins [U].

    Raises:
        MotorError: the argument of the trajectory is not known.
    """
    kind = _KINDS.get(motion.variable, CURRENT)
    scale = scales.of(motion.variable)
    if motion.mode is ControlMode.TRAJECTORY:
        demand = demand_of(motion)
        if motion.argument is not None:
            return Led(kind, demand, scale, motion.argument)
        if motion.initial_velocity and planned is not None:
            return Moving(planned, motion, scale)
        course = Tracked(kind, demand, scale)
        course.final_velocity = motion.final_velocity * scale
        return course
    target = motion.target * scale
    if kind == POSITION:
        return Course(POSITION, target, is_step=True)
    size = abs(scale)
    if kind == CURRENT:
        return Rated(CURRENT, current_a, target, motion.slope * size, motion.slope * size)
    if motion.slope == inf:
        return Rated(VELOCITY, velocity, target, inf, inf)
    growing, shrinking = motion.acceleration * size, motion.deceleration * size
    return Rated(VELOCITY, velocity, target, growing, shrinking)
