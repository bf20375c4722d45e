"""What an ideal motor does from one moment on: position, velocity and torque as functions of time.

A course is a law, not a simulation: it answers for any instant, whoever asks and however often, and
knows to the nanosecond when it is over. The one exception is `Led`, a motion over an argument that
is not time: nobody knows what that will be, so it is followed at a fixed rate as well.
U stands for the motor's unit of position: rad, or m if linear.
"""

from collections.abc import Callable
from math import inf
from typing import Final, NamedTuple, Protocol, final

from motorapi.arguments import Argument, value_of
from motorapi.commands import ControlMode, ControlVariable, Motion
from motorapi.demand import Demand, demand_of, ramps
from motorapi.errors import MotorError, PluginError

_LONGEST_S: Final = 9.2e9
"""Three centuries: what takes longer, if for ever, is not told when it is over."""


class Reading(NamedTuple):
    """Where the motor is [U], how fast [U/s], and what it pushes with [N·m, of a linear one N]."""

    position: float
    velocity: float = 0.0
    torque: float = 0.0


class Course(Protocol):
    """What the motor does, until another course takes its place.

    Attributes:
        begun_ns: since when.
        over_ns: when its goal is reached (it may go on all the same); None: nobody knows yet.
        place: where it began, or was when it was looked at last [U].
    """

    begun_ns: int
    over_ns: int | None
    place: float

    def at(self, now_ns: int) -> Reading:
        """What it demands at `now_ns`, no earlier than `begun_ns`."""

    def look(self, now_ns: int) -> None:
        """Time has come to `now_ns`; called at a fixed rate until it is over."""


class _Law:
    """A course that follows from time alone."""

    def __init__(self, begun_ns: int, duration_s: float, place: float) -> None:
        self.begun_ns = begun_ns
        self.place = place
        self.over_ns: int | None = begun_ns + round(min(duration_s, _LONGEST_S) * 1e9)

    def look(self, now_ns: int) -> None:
        """Nothing changes by being looked at."""

    def _elapsed_s(self, now_ns: int) -> float:
        return (now_ns - self.begun_ns) / 1e9

    def _is_over(self, now_ns: int) -> bool:
        return self.over_ns is not None and now_ns >= self.over_ns


@final
class Held(_Law):
    """At rest."""

    def __init__(self, begun_ns: int, position: float) -> None:
        super().__init__(begun_ns, 0.0, position)
        self._reading = Reading(position)

    def at(self, now_ns: int) -> Reading:
        """The same at all times."""
        return self._reading


@final
class Straight(_Law):
    """Position goes to its target at a constant speed, and stays there: no ramps."""

    def __init__(self, begun_ns: int, start: float, target: float, speed: float) -> None:
        super().__init__(begun_ns, abs(target - start) / speed, start)
        self._start = start
        self._target = target
        self._velocity = speed if target > start else -speed

    def at(self, now_ns: int) -> Reading:
        """On the straight line from start to target."""
        if self._is_over(now_ns):
            return Reading(self._target)
        made = self._velocity * self._elapsed_s(now_ns)
        return Reading(self._start + made, self._velocity)


@final
class Ramped(_Law):
    """Velocity goes to its target at constant rates, and stays there.

    Args:
        begun_ns: since when.
        now: where it begins, and how fast.
        target: the velocity aimed at [U/s].
        speeding: the rate at which its size grows [U/s²], > 0.
        slowing: the rate at which its size shrinks [U/s²], > 0; first to 0 if the sign changes.
    """

    def __init__(
        self, begun_ns: int, now: Reading, target: float, speeding: float, slowing: float
    ) -> None:
        pieces = ramps(now.velocity, target, speeding, slowing)
        super().__init__(begun_ns, sum(piece[0] for piece in pieces), now.position)
        self._pieces = pieces
        self._start = now.position
        self._target = target

    def at(self, now_ns: int) -> Reading:
        """Pieces of constant acceleration, in closed form."""
        left_s = self._elapsed_s(now_ns)
        position = self._start
        for duration_s, velocity, acceleration in self._pieces:
            spent_s = min(left_s, duration_s)
            position += (velocity + 0.5 * acceleration * spent_s) * spent_s
            left_s -= spent_s
            if left_s <= 0.0 and not self._is_over(now_ns):
                return Reading(position, velocity + acceleration * spent_s)
        return Reading(position + self._target * left_s, self._target)


@final
class Pushed(_Law):
    """Torque goes to its target at a constant rate (inf: at once); the shaft is held."""

    def __init__(self, begun_ns: int, now: Reading, target: float, rate: float) -> None:
        change = target - now.torque
        super().__init__(begun_ns, 0.0 if rate == inf else abs(change) / rate, now.position)
        self._now = now
        self._target = target
        self._rate = rate if change > 0.0 else -rate

    def at(self, now_ns: int) -> Reading:
        """Torque on a straight line to its target."""
        position = self._now.position
        if self._is_over(now_ns):
            return Reading(position, 0.0, self._target)
        torque = self._now.torque + self._rate * self._elapsed_s(now_ns)
        return Reading(position, 0.0, torque)


@final
class Followed(_Law):
    """A trajectory over time: the control variable is what it demands, at every instant."""

    def __init__(self, begun_ns: int, now: Reading, motion: Motion, constant: float) -> None:
        demand = demand_of(motion)
        duration_s = demand.final_argument - demand.initial_argument
        super().__init__(begun_ns, duration_s, now.position)
        self._now = now
        self._motion = motion
        self._demand = demand
        self._constant = constant
        self._way = _way_of(motion, demand)

    def at(self, now_ns: int) -> Reading:
        """What the demand, and its derivative or integral, are after so much time."""
        demand = self._demand
        argument = demand.initial_argument + self._elapsed_s(now_ns)
        if self._is_over(now_ns):
            argument = demand.final_argument
        value = demand.value(argument)
        variable = self._motion.variable
        if variable is ControlVariable.POSITION:
            velocity = 0.0 if self._is_over(now_ns) else demand.first(argument)
            return Reading(value, velocity)
        if variable is ControlVariable.VELOCITY:
            beyond_s = 0.0
            if self.over_ns is not None and now_ns > self.over_ns:
                beyond_s = (now_ns - self.over_ns) / 1e9
            return Reading(self._now.position + self._way(argument) + value * beyond_s, value)
        return Reading(self._now.position, 0.0, value * self._constant)


def _way_of(motion: Motion, demand: Demand) -> Callable[[float], float]:
    """The way that a trajectory of velocity has made at an argument, in closed form."""
    start = demand.initial_argument
    if motion.function is None:
        rate = demand.first(start)
        return lambda argument: (motion.start + 0.5 * rate * argument) * argument
    integral = motion.function.integral()
    before = integral.value(start)
    return lambda argument: integral.value(argument) - before + motion.offset * (argument - start)


@final
class Led:
    """A trajectory over an argument that something else determines.

    Position (and torque) are what the demand is for the argument of this very instant. Their rates,
    the way made by a trajectory of velocity, and the end are taken from looks at a fixed rate.
    """

    def __init__(
        self,
        begun_ns: int,
        now: Reading,
        motion: Motion,
        argument: Argument,
        constant: float,
    ) -> None:
        self.begun_ns = begun_ns
        self.over_ns: int | None = None
        self.place = now.position
        self._motion = motion
        self._demand = demand_of(motion)
        self._argument = argument
        self._constant = constant
        self._look = (begun_ns, value_of(argument), 0.0, now.position)
        self._final: Reading | None = None

    def at(self, now_ns: int) -> Reading:
        """What the demand is for what the argument is now; where it cannot be told, at rest."""
        if self._final is not None and self.over_ns is not None:
            position, velocity, torque = self._final
            beyond_s = (now_ns - self.over_ns) / 1e9
            return Reading(position + velocity * beyond_s, velocity, torque)
        try:
            return self._reading(now_ns, value_of(self._argument))
        except Exception:  # somebody else's; the next look tells, but the motor can be stopped
            return Reading(self.place)

    def look(self, now_ns: int) -> None:
        """The argument's rate is known, and whether it has reached its end.

        Raises:
            MotorError: what leads it, or a function of it, failed.
        """
        if self._final is not None:
            return
        then_ns, before, _, _ = self._look
        try:
            argument = value_of(self._argument)
            self.place = self._reading(now_ns, argument).position
        except MotorError:
            raise
        except Exception as error:  # of a function that somebody else made
            what = type(error).__name__
            raise PluginError(plugin=what, where="a trajectory", problem=str(error)) from error
        rate = (argument - before) / (now_ns - then_ns) * 1e9
        self._look = (now_ns, argument, rate, self.place)  # at once: other threads read it
        if argument >= self._demand.final_argument:
            self._final = self._reading(now_ns, argument)
            self.over_ns = now_ns

    def _reading(self, now_ns: int, argument: float) -> Reading:
        demand = self._demand
        value = demand.value(argument)
        then_ns, before, rate, place = self._look
        if self._motion.variable is ControlVariable.POSITION:
            return Reading(value, demand.first(argument) * rate)
        if self._motion.variable is ControlVariable.VELOCITY:
            mean = 0.5 * (demand.value(before) + value)
            return Reading(place + mean * (now_ns - then_ns) / 1e9, value)
        return Reading(place, 0.0, value * self._constant)


def course_of(motion: Motion, now: Reading, now_ns: int, torque_constant: float) -> Course:
    """The course of a motion that begins now.

    Args:
        motion: a set-point, or a trajectory of whatever kind.
        now: what the motor does at this moment.
        now_ns: this moment.
        torque_constant: torque per current [N·m/A or N/A].
    """
    variable = motion.variable
    constant = torque_constant if variable is ControlVariable.CURRENT else 1.0
    if motion.mode is ControlMode.TRAJECTORY:
        if motion.argument is not None:
            return Led(now_ns, now, motion, motion.argument, constant)
        return Followed(now_ns, now, motion, constant)
    if variable is ControlVariable.POSITION:
        return Straight(now_ns, now.position, motion.target, motion.velocity)
    if variable is ControlVariable.VELOCITY:
        return Ramped(now_ns, now, motion.target, motion.acceleration, motion.deceleration)
    return Pushed(now_ns, now, motion.target * constant, motion.slope * abs(constant))
