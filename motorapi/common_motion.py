"""One start of a group, watched to its end: what becomes of the others when one motor fails.

Whether or not anybody waits: it looks at every news of its motors, as `on_done` does, and what it
does in answer is sent from there and waited for by nobody. Of a motor that must be asked it hears
while somebody waits for that motor.

A motor fails when its motion ends short of its target though its owner did not want that: by a
fault, a lost link, another program, by being taken over. A stop of one motor is obeyed by that one;
but who waits for the group finds it short of its target, and that is answered like a fault. Those
that were stopped in answer are told as interrupted to whoever waits for one of them; who waits for
the group is told the cause.
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
    FaultReaction.NONE: "the others of its group go on",
}


@final
class _Watched:
    """A motor and the run it has in this start."""

    __slots__ = ("_common", "is_over", "motor", "run")

    def __init__(self, common: "CommonMotion", motor: "Motor", run: Run) -> None:
        self._common = common
        self.motor: Final = motor
        self.run: Final = run
        self.is_over = False

    def look(self) -> None:
        """News of the motor."""
        self._common.look_at(self)

    def ended(self) -> bool:
        """Whether it is known how its run ended."""
        return self.is_over

    def failure(self) -> MotorError | None:
        """How the run failed; None: it goes on, is done, or a logical motor ended it."""
        run = self.run
        try:
            self.is_over = self.motor._look(run) and run.ends
        except MotorError as error:
            self.is_over = True
            # Who takes a motor over ends its run and has not begun one of his own yet.
            taken_over = self.motor._physical.run is run
            wanted = run.interrupted_by is not None and run.error is None and not taken_over
            return None if wanted else error
        return None


@final
class CommonMotion:
    """The motions of one start. `begin` once they have begun, `end` when the group does else.

    Args:
        started: of `start_together`.
        common: what they have in common.

    Attributes:
        cause: the first failure, and whose it is; None: none so far.
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
        self._claim: Final[list[None]] = [None]  # goes to who finds the first failure
        self._ended = False
        self._answers: list[tuple[Motor, Run]] = []
        self._path: PathWatch | None = None
        if common.synchronization is Synchronization.PHASE:
            self._path = PathWatch(started, self._after_look)

    def begin(self) -> None:
        """Every news is looked at from now on; now, too: one may have failed already."""
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
        """Nothing is looked at any more; ending again does nothing."""
        self._fall_silent()
        if self._path is not None:
            self._path.end()

    @property
    def stops_together(self) -> bool:
        """Whether its motors slow down along their path."""
        return self._common.reaction is FaultReaction.TOGETHER

    def path(self) -> tuple[PathDeviation, ...]:
        """How far each motor was from the common path; empty: there is none."""
        return () if self._path is None else self._path.told()

    def look_at(self, one: _Watched) -> None:
        """Its failure is answered, if it has failed and is the first."""
        if one.is_over or self._ended:
            return
        error = one.failure()
        physical = one.motor._physical
        if one.ended() and physical.news is None:
            physical.bell.grow()  # nobody else tells those who want to know of its end
        if error is not None:
            self._fail(one.motor, error)
        elif all(other.is_over for other in self._watched):
            if self._path is not None:
                self._path.look()
            self.end()

    def watches(self, run: Run | None) -> bool:
        """Whether the run is one of this start's."""
        return any(one.run is run for one in self._watched)

    def failed(self, motor: "Motor", error: Exception) -> Exception:
        """Who waits found that a motor's run failed: what to raise, once it is answered."""
        if not isinstance(error, MotorError):
            return error
        self._fail(motor, error)
        cause = self.cause
        if cause is None:  # another thread is at it
            return error
        told = copy(cause[1])
        told.__cause__ = cause[1].__cause__
        return told

    def _fail(self, motor: "Motor", error: MotorError) -> None:
        try:
            self._claim.pop()  # two threads may come to that at once
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
        """The others do what the group was told."""
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
        """It slows down, or will by a trigger; its run is over, ended by the group."""
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
        """Along the path they are watched until all of them are at rest."""
        if self._answers and not any(motor._goes_on(run) for motor, run in self._answers):
            self.end()


def add_trigger(triggers: "list[tuple[Motor, Trigger]]", motor: "Motor") -> None:
    """The motor slows down, or will by one of the triggers, each of which is in the list once."""
    trigger = motor._call(motor._stop_with_others)
    if trigger is not None and all(trigger != known for _, known in triggers):
        triggers.append((motor, trigger))
