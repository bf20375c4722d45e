"""A motion as set-points: where a drive in csp shall be at each cycle, in its own increments.

Cycle k is k set-point periods after the start. A trajectory over time is sampled there; over
another argument, that is asked for its value in each cycle. A trajectory of velocity is followed by
its integral: exactly over time, by the trapezoidal rule over another argument.

An absolute trajectory may begin a little beside where the motor is (`MotorModel.start_tolerance`).
To step there in one period would break every limit, so the motor first moves there, within the
limits: `lead_in` cycles before the first one of the trajectory.
"""

from math import ceil
from typing import TYPE_CHECKING, Final, final

from motorapi.adaptations.cia402_units import DriveUnits
from motorapi.commands import ControlVariable, Motion
from motorapi.demand import demand_of
from motorapi.errors import LimitError
from motorapi.generation import Trapezoid, shortest

if TYPE_CHECKING:
    from motorapi.functions.function import Function

_ROUNDING: Final = 1e-9
_STEP_ROUNDING_INC: Final = 1.0  # two targets, each off by at most half an increment


@final
class StreamedMotion:
    """The set-points of one motion.

    Args:
        motor: its name, for messages.
        motion: as planned, with a function.
        units: of the drive.
        period_s: between two set-points.
        held_inc: the position the drive holds now.

    Attributes:
        lead_in: cycles before cycle 0 that it takes to get to where the trajectory begins.
        lead: cycles to wait for others that take longer to get there; set by whoever starts them.
        over: whether the end of the trajectory has been demanded.
        velocity: what the set-points amount to at the moment [U/s].
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
        self._before: tuple[float, float] | None = None  # velocity and position of the cycle before
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
        self._approach = self._approach_of(motion)
        self.lead_in = 0
        if self._approach is not None:
            self.lead_in = ceil(self._approach.duration_s / period_s * (1.0 - _ROUNDING))
        self.lead = self.lead_in
        self.over = False
        self.velocity = 0.0

    def _approach_of(self, motion: Motion) -> Trapezoid | None:
        """From where the motor is to where the trajectory begins; None: it is there."""
        away = self._from - self._units.position(self._held_inc)
        if abs(self._units.increments(away)) <= _STEP_ROUNDING_INC:
            return None
        return shortest(away, motion.velocity, motion.acceleration, motion.deceleration)

    def target(self, cycle: int) -> int | None:
        """The set-point of a cycle, counted from 1, in increments; None: there are no more.

        Asked once for each cycle, in order.

        Raises:
            LimitError: it is further from the one before than the velocity limit allows.
            MotorError: the argument cannot be told.
        """
        if self.over and self.velocity == 0.0:
            return None
        place = cycle - self.lead
        if place <= 0:
            return self._approached(cycle - self.lead + self.lead_in)
        position = self._position(place)
        target = self._units.position_inc(position)
        if abs(target - self._last_inc) > self._step_inc_max:
            raise self._too_fast(target)
        self._last_inc = target
        return target

    def _approached(self, cycle: int) -> int:
        """Where it is on the way to the beginning."""
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
        """The position demanded `place` periods after the start [U]."""
        demand = self._demand
        if self._argument is None:
            elapsed_s = place * self._period_s
            at = demand.initial_argument + elapsed_s
        else:
            at = self._argument.value()
        end = demand.final_argument
        if self.over or at >= end - _ROUNDING * max(1.0, abs(end)):
            self.over = True
            at = max(at, end)  # an argument may turn back: what is over stays over
        if self._motion.variable is not ControlVariable.VELOCITY:
            return demand.value(at)
        return self._travelled(at)

    def _travelled(self, at: float) -> float:
        """The integral of a trajectory of velocity; after its end it goes on as it ended."""
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

    def _too_fast(self, target: int) -> LimitError:
        step = self._units.position(target) - self._units.position(self._last_inc)
        argument = self._argument
        if argument is None:
            reason = "a step of the trajectory"
        else:
            reason = f"the {argument.name} steps further than in {self._period_s * 1e3:g} ms"
        return LimitError(
            motor=self._motor,
            quantity="velocity between two set-points",
            value=step / self._period_s,
            low=-self._motion.velocity,
            high=self._motion.velocity,
            unit=f"{self._units.unit}/s",
            reason=reason,
        )
