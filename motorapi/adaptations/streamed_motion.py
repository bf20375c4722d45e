"""Set-points of a motion for a drive in csp, in increments.

Cycle k is k set-point periods after the start. A period in which the host sends no SYNC does not
count, so that set-points are never two steps apart. A trajectory over time is sampled at these
times; another argument is read in each cycle. A velocity trajectory is followed by its integral:
exactly over time, by the trapezoidal rule over another argument.

Another argument is not predictable. So its set-points are checked against the limits one by one:
- no step of position beyond the velocity limit;
- at the start, where the motor is at rest, no step of velocity beyond the acceleration limit times
  a period;
- later, no change of the velocity over 20 ms beyond that limit, as an argument received over a bus
  may be a period late.
A set-point that exceeds them raises LimitError, and is not sent.

An absolute trajectory may begin a little beside the motor's position
(`MotorModel.start_tolerance`). A step there in one period would violate every limit, so the motor
first moves there, within the limits: `lead_in` cycles before the first one of the trajectory.
"""

from collections import deque
from math import ceil
from typing import TYPE_CHECKING, Final, final

from motorapi.adaptations.cia402_units import DriveUnits
from motorapi.arguments import value_of
from motorapi.commands import ControlVariable, Motion
from motorapi.demand import demand_of
from motorapi.errors import LimitError
from motorapi.generation import Trapezoid, shortest

if TYPE_CHECKING:
    from motorapi.functions.function import Function

_ROUNDING: Final = 1e-9
_STEP_ROUNDING_INC: Final = 1.0  # two targets, each rounded by at most half an increment
_WINDOW_S: Final = 0.02
_LATE: Final = 1.5  # periods: an argument may be one period late, and have another period than ours


@final
class StreamedMotion:
    """The set-points of one motion.

    Args:
        motor: the motor's name, for messages.
        motion: the planned motion, with a function.
        units: the units of the drive.
        period_s: the time between two set-points [s].
        held_inc: the position the drive holds now.

    Attributes:
        lead_in: the cycles before cycle 0 for the move to the beginning of the trajectory.
        lead: `lead_in`, or more to wait for other motors; set by the trigger.
        over: whether the end of the trajectory has been demanded.
        velocity: the present velocity of the set-points [U/s].
    """

    def __init__(
        self, motor: str, motion: Motion, units: DriveUnits, period_s: float, held_inc: int
    ) -> None:
        self._motor = motor
        self._motion = motion
        self._units = units
        self._period_s = period_s
        self._demand = demand_of(motion)
        self._argument = motion.argument
        self._integral: Function | None = None
        self._before: tuple[float, float] | None = None  # the previous velocity and position
        self._held_inc = held_inc
        self._last_inc = held_inc
        self._step_inc_max = (
            motion.velocity * period_s * abs(units.increments(1.0)) * (1.0 + _ROUNDING)
            + _STEP_ROUNDING_INC
        )
        if motion.variable is ControlVariable.VELOCITY:
            self._from = units.position(held_inc)
            if self._argument is None and motion.function is not None:
                self._integral = motion.function.integral()
        else:
            self._from = motion.start
        self._scale = abs(units.increments(1.0))
        self._window = max(1, ceil(_WINDOW_S / period_s))
        self._recent: deque[float] = deque([self._from], 2 * self._window + 1)
        self._shift = 0.0  # of a relative trajectory: change of the argument since planning
        self._approach = self._approach_of(motion)
        self.lead_in = 0
        if self._approach is not None:
            self.lead_in = ceil(self._approach.duration_s / period_s * (1.0 - _ROUNDING))
        self.lead = self.lead_in
        self.over = False
        self.velocity = 0.0

    def _approach_of(self, motion: Motion) -> Trapezoid | None:
        """Return the profile from the motor's position to the beginning; None: it is there."""
        away = self._from - self._units.position(self._held_inc)
        if abs(self._units.increments(away)) <= _STEP_ROUNDING_INC:
            return None
        return shortest(away, motion.velocity, motion.acceleration, motion.deceleration)

    def target(self, cycle: int) -> int | None:
        """Return the set-point of a cycle, counted from 1, in increments; None at the end.

        Call it once for each cycle, in order.

        Raises:
            LimitError: it is further from the previous one than the velocity limit allows.
            MotorError: the argument is not known.
        """
        if self.over and self.velocity == 0.0:
            return None
        place = cycle - self.lead
        if place <= 0:
            return self._approached(cycle - self.lead + self.lead_in)
        position = self._position(place)
        target = self._units.position_inc(position)
        if abs(target - self._last_inc) > self._step_inc_max:
            step = self._units.position(target) - self._units.position(self._last_inc)
            raise self._beyond("velocity", step / self._period_s, self._motion.velocity)
        if self._argument is not None:
            self._check_change(place, position)
        self._last_inc = target
        return target

    def _check_change(self, place: int, position: float) -> None:
        """Check the change of velocity of an argument that is not predictable."""
        recent, period_s = self._recent, self._period_s
        limit = min(self._motion.acceleration, self._motion.deceleration)
        recent.append(position)
        if place <= 2:  # a relative trajectory's first set-point is the motor's position
            velocity = (position - recent[-2]) / period_s
            allowed = limit * period_s + 2.0 * _STEP_ROUNDING_INC / (self._scale * period_s)
            if abs(velocity) > allowed:
                raise self._beyond("velocity at the start", velocity, allowed)
        window_s = self._window * period_s
        middle = recent[max(0, len(recent) - 1 - self._window)]
        now = (position - middle) / window_s
        change = now - (middle - recent[0]) / window_s
        allowed = limit * window_s + _LATE * abs(now) / self._window
        allowed += 2.0 * _STEP_ROUNDING_INC / (self._scale * window_s)
        if abs(change) > allowed:
            raise self._beyond("change of velocity", change / window_s, limit)

    def _approached(self, cycle: int) -> int:
        """Return the set-point on the way to the beginning."""
        approach = self._approach
        if approach is None or cycle <= 0:
            return self._held_inc
        start = self._units.position(self._held_inc)
        at = (
            self._from
            if cycle >= self.lead_in
            else start + approach.position(cycle * self._period_s)
        )
        self._last_inc = self._units.position_inc(at)
        return self._last_inc

    def _position(self, place: int) -> float:
        """Return the position demanded `place` periods after the start [U]."""
        demand = self._demand
        if self._argument is None:
            elapsed_s = place * self._period_s
            at = demand.initial_argument + elapsed_s
        else:
            at = value_of(self._argument)
        end = demand.final_argument
        if self.over or at >= end - _ROUNDING * max(1.0, abs(end)):
            self.over = True
            at = max(at, end)  # an argument may turn back, but the trajectory stays over
        if self._motion.variable is ControlVariable.VELOCITY:
            return self._travelled(at)
        trajectory = self._motion.trajectory
        if place == 1 and self._argument is not None and trajectory and trajectory.is_relative:
            self._shift = self._from - demand.value(at)
        return demand.value(at) + self._shift

    def _travelled(self, at: float) -> float:
        """Return the integral of a velocity trajectory, continued at its final velocity."""
        demand = self._demand
        self.velocity = demand.value(at)
        integral = self._integral
        if integral is None:
            velocity, position = self._before or (demand.value(at), self._from)
            position += 0.5 * (velocity + self.velocity) * self._period_s
            self._before = (self.velocity, position)
            return position
        begin, end = demand.initial_argument, demand.final_argument
        inside = min(at, end)
        way = (
            integral.value(inside) - integral.value(begin) + self._motion.offset * (inside - begin)
        )
        return self._from + way + (at - inside) * self.velocity

    def _beyond(self, quantity: str, value: float, limit: float) -> LimitError:
        argument = self._argument
        if argument is None:
            reason = "a step of the trajectory"
        else:
            period_ms = self._period_s * 1e3
            reason = f"the {argument.name} steps: set-points are {period_ms:g} ms apart; it must be"
            reason += " received as often (status_period_ms, of a motor's position), or be slower"
        per = "/s²" if quantity.startswith("change") else "/s"
        return LimitError(
            motor=self._motor,
            quantity=quantity,
            value=value,
            low=-limit,
            high=limit,
            unit=f"{self._units.unit}{per}",
            reason=reason,
        )
