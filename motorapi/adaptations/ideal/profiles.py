"""Courses of an ideal motor: position, velocity and torque over time.

A course is a law, not a simulation: it gives a value for any instant, and knows its end to the
nanosecond. The exception is `Led`, a motion over an argument that is not time. As the argument
cannot be predicted, it is also sampled at a fixed rate.

U is the motor's unit of position: rad, or m if linear.
"""

from collections.abc import Callable
from math import inf
from typing import Final, NamedTuple, Protocol, final

from motorhil.motorapi.commands import ControlMode, ControlVariable
from motorhil.motorapi.errors import MotorError, PluginError
from motorhil.motorapi.motion import Motion
from motorhil.motorapi.planning.sampling import Ramps, demand_of, way_of
from motorhil.motorapi.trajectory import Argument, value_of

_LONGEST_S: Final = 9.2e9
"""The longest duration with a known end [s], three centuries."""


class Reading(NamedTuple):
    """Position [U], velocity [U/s] and torque [N·m] or force [N] of the motor."""

    position: float
    velocity: float = 0.0
    torque: float = 0.0


class Course(Protocol):
    """The behaviour of the motor until another course replaces it.

    Attributes:
        begun_ns: the time of its beginning.
        over_ns: the time when it reaches its goal (it may continue afterwards); None: not known
            yet.
        place: the position at its beginning, or at the last sample [U].
    """

    begun_ns: int
    over_ns: int | None
    place: float

    def at(self, now_ns: int) -> Reading:
        """Return the demand at `now_ns`, which is not before `begun_ns`."""

    def look(self, now_ns: int) -> None:
        """Sample the course at `now_ns`; called at a fixed rate until the course is over."""


class _Law:
    """A course that depends on time alone."""

    def __init__(self, begun_ns: int, duration_s: float, place: float) -> None:
        self.begun_ns = begun_ns
        self.place: float = place
        self.over_ns: int | None = begun_ns + round(min(duration_s, _LONGEST_S) * 1e9)

    def look(self, now_ns: int) -> None:
        """Do nothing, as the course does not depend on samples."""

    def _elapsed_s(self, now_ns: int) -> float:
        return (now_ns - self.begun_ns) / 1e9

    def _is_over(self, now_ns: int) -> bool:
        return self.over_ns is not None and now_ns >= self.over_ns


@final
class Held(_Law):
    """A motor at rest."""

    def __init__(self, begun_ns: int, position: float) -> None:
        super().__init__(begun_ns, 0.0, position)
        self._reading = Reading(position)

    def at(self, now_ns: int) -> Reading:
        """Return the same reading at all times."""
        return self._reading


@final
class Straight(_Law):
    """Position moves to its target at a constant speed, without ramps."""

    def __init__(self, begun_ns: int, start: float, target: float, speed: float) -> None:
        super().__init__(begun_ns, abs(target - start) / speed, start)
        self._start = start
        self._target = target
        self._velocity = speed if target > start else -speed

    def at(self, now_ns: int) -> Reading:
        """Return the point on the straight line from start to target."""
        if self._is_over(now_ns):
            return Reading(self._target)
        made = self._velocity * self._elapsed_s(now_ns)
        return Reading(self._start + made, self._velocity)


@final
class Ramped(_Law):
    """Velocity moves to its target at constant rates.

    Args:
        begun_ns: the time of its beginning.
        now: the initial position and velocity.
        target: the target velocity [U/s].
        speeding: the rate at which the speed grows [U/s²], > 0.
        slowing: the rate at which the speed shrinks [U/s²], > 0; first to 0 if the sign changes.
    """

    def __init__(
        self, begun_ns: int, now: Reading, target: float, speeding: float, slowing: float
    ) -> None:
        ramps = Ramps(now.velocity, target, speeding, slowing)
        super().__init__(begun_ns, ramps.duration_s, now.position)
        self._ramps = ramps
        self._start = now.position
        self._target = target

    def at(self, now_ns: int) -> Reading:
        """Return the reading from pieces of constant acceleration, in closed form."""
        elapsed_s = self._elapsed_s(now_ns)
        position = self._ramps.integral(elapsed_s, self._start)
        on_ramp = None if self._is_over(now_ns) else self._ramps.at(elapsed_s)
        return Reading(position, self._target if on_ramp is None else on_ramp[0])


@final
class Pushed(_Law):
    """Torque moves to its target at a constant rate (inf: at once); the shaft is held."""

    def __init__(self, begun_ns: int, now: Reading, target: float, rate: float) -> None:
        change = target - now.torque
        super().__init__(begun_ns, 0.0 if rate == inf else abs(change) / rate, now.position)
        self._now = now
        self._target = target
        self._rate = rate if change > 0.0 else -rate

    def at(self, now_ns: int) -> Reading:
        """Return torque on a straight line to its target."""
        position = self._now.position
        if self._is_over(now_ns):
            return Reading(position, 0.0, self._target)
        torque = self._now.torque + self._rate * self._elapsed_s(now_ns)
        return Reading(position, 0.0, torque)


@final
class Followed(_Law):
    """A trajectory over time: the control variable equals the demand at every instant."""

    def __init__(self, begun_ns: int, now: Reading, motion: Motion, constant: float) -> None:
        demand = demand_of(motion)
        duration_s = demand.final_argument - demand.initial_argument
        super().__init__(begun_ns, duration_s, now.position)
        self._now = now
        self._motion = motion
        self._demand = demand
        self._constant = constant
        self._way = way_of(motion) if motion.variable is ControlVariable.VELOCITY else None

    def at(self, now_ns: int) -> Reading:
        """Return the demand, and its derivative or integral; rest if a user's function fails."""
        try:
            return self._reading(now_ns)
        except Exception:  # the next sample reports it
            return Reading(self.place)

    def look(self, now_ns: int) -> None:
        """Sample a user's function, which may fail.

        Raises:
            MotorError: it failed.
        """
        if self._motion.function is not None:
            self.place: float = _place_of(self._reading, now_ns)

    def _reading(self, now_ns: int) -> Reading:
        demand = self._demand
        argument = demand.initial_argument + self._elapsed_s(now_ns)
        is_over = self._is_over(now_ns)
        if is_over and not self._motion.final_velocity:
            argument = demand.final_argument
        value = demand.value(argument)
        if self._motion.variable is ControlVariable.POSITION:
            goes_on = not is_over or self._motion.final_velocity
            return Reading(value, demand.first(argument) if goes_on else 0.0)
        if self._way is not None:
            beyond_s = 0.0
            if self.over_ns is not None and now_ns > self.over_ns:
                beyond_s = (now_ns - self.over_ns) / 1e9
            return Reading(self._now.position + self._way(argument) + value * beyond_s, value)
        return Reading(self._now.position, 0.0, value * self._constant)


@final
class Led:
    """A trajectory over an argument that is not time.

    Position (and torque) equal the demand for the present argument. Their rates, the distance
    covered by a velocity trajectory, and the end result from samples at a fixed rate.
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
        self.place: float = now.position
        self._motion = motion
        self._demand = demand_of(motion)
        self._argument = argument
        self._constant = constant
        self._look = (begun_ns, value_of(argument), 0.0, now.position)
        self._final: Reading | None = None

    def at(self, now_ns: int) -> Reading:
        """Return the demand for the present argument, or rest if the argument is not available."""
        if self._final is not None and self.over_ns is not None:
            position, velocity, torque = self._final
            beyond_s = (now_ns - self.over_ns) / 1e9
            return Reading(position + velocity * beyond_s, velocity, torque)
        try:
            return self._reading(now_ns, value_of(self._argument))
        except Exception:  # a user's error: the next sample reports it
            return Reading(self.place)

    def look(self, now_ns: int) -> None:
        """Sample the argument, to obtain its rate and detect its end.

        Raises:
            MotorError: the argument, or a function of it, failed.
        """
        if self._final is not None:
            return
        then_ns, before, _, _ = self._look
        argument = value_of(self._argument)
        self.place = _place_of(lambda at_ns: self._reading(at_ns, argument), now_ns)
        rate = (argument - before) / (now_ns - then_ns) * 1e9
        self._look = (now_ns, argument, rate, self.place)  # atomically: other threads read it
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


def _place_of(reading: Callable[[int], Reading], now_ns: int) -> float:
    """Return the position of this reading.

    Raises:
        MotorError: the argument, or a function of a user, failed.
    """
    try:
        return reading(now_ns).position
    except MotorError:
        raise
    except Exception as error:
        what = type(error).__name__
        raise PluginError(plugin=what, where="a trajectory", problem=str(error)) from error


def course_of(motion: Motion, now: Reading, now_ns: int, torque_constant: float) -> Course:
    """Return the course of a motion that begins now.

    Args:
        motion: a set-point or any trajectory.
        now: the present reading of the motor.
        now_ns: the present time.
        torque_constant: the torque per current [N·m/A or N/A].
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
