"""Supervision of one group start to its end, with the reaction to a failure.

Supervision does not depend on a waiting caller: it examines every change of its motors, as
`on_done` does, and sends its reaction from there without waiting. A motor that must be polled
reports only while a caller waits for it.

A motor fails when its motion ends short of its target although its owner did not request that: by a
fault, a lost link, another program, or a takeover. A stop of one motor affects that motor only. A
caller that waits for the group finds it short of its target, and then the group reacts as to a
fault. Motors stopped in reaction raise an interruption for callers that wait for one of them; a
caller that waits for the group gets the cause.
"""

# ruff: noqa: SLF001 -- it works the hooks of motors, as motorapi.execution does

import logging
from collections.abc import Sequence
from copy import copy
from typing import TYPE_CHECKING, Final, final

from motorapi.errors import MotorError
from motorapi.group_planning import Common
from motorapi.path import PathWatch
from motorapi.sharing import Run
from motorapi.synchronization import FaultReaction, PathDeviation, Synchronization, Trigger
from motorapi.waiting import LOOK_PERIOD_S

if TYPE_CHECKING:
    from motorapi.execution import Started
    from motorapi.motor import Motor
    from motorapi.runtime import Registration

_LOG: Final = logging.getLogger("motorapi")
_TOLD: Final = {
    FaultReaction.TOGETHER: "the others of its group were stopped along the path",
    FaultReaction.EACH: "the others of its group were stopped",
    FaultReaction.NONE: "the others of its group continue",
}


@final
class _Watched:
    """A motor with its active motion of this start."""

    __slots__ = ("_common", "is_over", "motor", "run")

    def __init__(self, common: "CommonMotion", motor: "Motor", run: Run) -> None:
        self._common = common
        self.motor: Final = motor
        self.run: Final = run
        self.is_over = False

    def look(self) -> None:
        """Examine the motor after a change."""
        self._common.look_at(self)

    def ended(self) -> bool:
        """Return True if the end of the motion is known."""
        return self.is_over

    def failure(self) -> MotorError | None:
        """Return the failure of the motion; None if it runs, is done, or its owner ended it."""
        run = self.run
        try:
            self.is_over = self.motor._look(run) and run.ends
        except MotorError as error:
            self.is_over = True
            # A takeover ends the motion before the new owner has begun its own.
            taken_over = self.motor._physical.run is run
            wanted = run.interrupted_by is not None and run.error is None and not taken_over
            return None if wanted else error
        return None


@final
class CommonMotion:
    """The motions of one start, supervised between `begin` and `end`.

    Args:
        started: the result of `start_together`.
        common: the common properties of the motions.

    Attributes:
        cause: the first failure and its motor, or None.
    """

    def __init__(self, started: "Sequence[Started]", common: Common) -> None:
        self.cause: tuple[Motor, MotorError] | None = None
        self._common: Final = common
        self._runtime: Final = started[0].motor.runtime
        self._watched: Final[list[_Watched]] = []
        for one in started:
            if one.motor._run is not None:
                self._watched.append(_Watched(self, one.motor, one.motor._run))
        self._timers: list[Registration] = []
        self._claim: Final[list[None]] = [
            None
        ]  # the finder of the first failure takes the only element
        self._ended = False
        self._answers: list[tuple[Motor, Run]] = []
        self._path: PathWatch | None = None
        if common.synchronization is Synchronization.PHASE:
            self._path = PathWatch(started, self._after_look)

    def begin(self) -> None:
        """Examine every change from now on, and all motors now: one may have failed already."""
        if self._path is not None:
            self._path.begin()
        for one in self._watched:
            physical = one.motor._physical
            if physical.news is None:
                self._timers.append(self._runtime.every(LOOK_PERIOD_S, one.look))
            physical.bell.listeners.append(one.look)
        for one in tuple(self._watched):
            one.look()

    def end(self) -> None:
        """Stop the supervision; ending again does nothing."""
        self._fall_silent()
        if self._path is not None:
            self._path.end()

    @property
    def stops_together(self) -> bool:
        """True if the motors slow down along their path."""
        return self._common.reaction is FaultReaction.TOGETHER

    def path(self) -> tuple[PathDeviation, ...]:
        """Return the deviation of each motor from the common path; empty without a path."""
        return () if self._path is None else self._path.told()

    def look_at(self, one: _Watched) -> None:
        """Examine one motor, and react if it is the first to fail."""
        if one.is_over or self._ended:
            return
        error = one.failure()
        physical = one.motor._physical
        if one.ended() and physical.news is None:
            physical.bell.grow()  # no other source reports its end to the listeners
        if error is not None:
            self._fail(one.motor, error)
        elif all(other.is_over for other in self._watched):
            if self._path is not None:
                self._path.look()
            self.end()

    def watches(self, run: Run | None) -> bool:
        """Return True if `run` belongs to this start."""
        return any(one.run is run for one in self._watched)

    def failed(self, motor: "Motor", error: Exception) -> Exception:
        """React to a failure found by a waiting caller. Return the error that it should raise."""
        if not isinstance(error, MotorError):
            return error
        self._fail(motor, error)
        cause = self.cause
        if cause is None:  # another thread is reacting
            return error
        told = copy(cause[1])
        told.__cause__ = cause[1].__cause__
        return told

    def _fail(self, motor: "Motor", error: MotorError) -> None:
        try:
            self._claim.pop()  # two threads may get here at once
        except IndexError:
            return
        self._fall_silent()
        if len(self._watched) > 1:
            error.add_note(f"from {motor.name}; {_TOLD[self._common.reaction]}")
        self.cause = (motor, error)
        if self._path is not None:
            self._path.leave(motor)
        self._answer(motor, error)
        if self._common.reaction is not FaultReaction.TOGETHER and self._path is not None:
            self._path.end()

    def _answer(self, failed: "Motor", cause: MotorError) -> None:
        """Stop the other motors according to the fault reaction."""
        reaction = self._common.reaction
        if reaction is FaultReaction.NONE:
            return
        by = f"the fault reaction of its group ({cause})"
        triggers: list[tuple[Motor, Trigger]] = []
        for one in self._watched:
            motor = one.motor
            if motor is failed or not motor._goes_on(one.run):
                continue
            try:
                self._stop(motor, by, triggers)
            except Exception as further:
                self._not_stopped(motor, cause, further)
        for motor, trigger in triggers:
            try:
                motor._call(trigger.fire)
            except Exception as further:
                self._not_stopped(motor, cause, further)

    def _stop(self, motor: "Motor", by: str, triggers: "list[tuple[Motor, Trigger]]") -> None:
        """Stop the motor, or add its trigger; its motion ends, interrupted by the group."""
        physical = motor._physical
        with physical.interrupt(motor.name):
            status = motor._status()
            if self._common.reaction is FaultReaction.TOGETHER:
                add_trigger(triggers, motor)
            else:
                motor._call(motor._stop)
            run = Run(by, motor, self._runtime.now_ns(), None)
            physical.begin(run, status)
            motor._keep()
        self._answers.append((motor, run))

    def _not_stopped(self, motor: "Motor", cause: MotorError, further: Exception) -> None:
        cause.add_note(f"but {motor.name} could not be stopped: {further}")
        _LOG.error("%s could not be stopped after %s: %s", motor.name, cause, further)

    def _fall_silent(self) -> None:
        self._ended = True
        for timer in self._timers:
            timer.cancel()
        for one in self._watched:
            listeners = one.motor._physical.bell.listeners
            if one.look in listeners:
                listeners.remove(one.look)

    def _after_look(self) -> None:
        """End the supervision of the path when all motors are at rest."""
        if self._answers and not any(motor._goes_on(run) for motor, run in self._answers):
            self.end()


def add_trigger(triggers: "list[tuple[Motor, Trigger]]", motor: "Motor") -> None:
    """Stop the motor, or add its trigger to the list, which holds each trigger once."""
    trigger = motor._call(motor._stop_with_others)
    if trigger is not None and all(trigger != known for _, known in triggers):
        triggers.append((motor, trigger))
