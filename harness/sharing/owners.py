"""Logical owners of shared motors, each a party of one virtual time that does what it is told.

What an owner is told to do next is an *errand*; it may take long, and others do theirs meanwhile.
Whatever he does is noted in a history, whose clock never stands still: of two notes the later one
was made later. What must hold of an owner alone he sees to himself: a motion that nobody cut short
took as long as he asked for, and, where he had the motor for himself all along, went as far.
"""

# ruff: noqa: SLF001 -- the harness looks at who has a motor, and lets arming fail

from contextlib import ExitStack
from typing import TYPE_CHECKING, Final, final

from harness.sharing.history import Action, Answer, Note
from harness.sharing.stage import Party, Stage
from motorapi import (
    ControlMode,
    Motor,
    MotorBusyError,
    MotorError,
    TrapezoidalTrajectory,
    UsageError,
)
from motorapi.ownership_events import LockAction, OwnershipEvent

if TYPE_CHECKING:
    from motorapi.reservation import Reservation

_LONG_S: Final = 60.0
_RENEWED: Final = 7 / 8
"""So much of a lease is left at least when a use of the motor does not renew it."""
_STOPS: Final = ("stop() of ", "halt() of ")


@final
class Owner(Party):
    """One logical motor of a physical one, and who works it.

    Args:
        name: told apart from whoever had the motor before, and died.
        motor: his logical motor.
        label: what the history calls the physical one.
        number: among all owners.
    """

    def __init__(self, name: str, motor: Motor, label: str, number: int, stage: Stage) -> None:
        self.motor: Final = motor
        self.number: Final = number
        self.reservation: Reservation | None = None
        self.lease_s: float | None = None
        self.is_lost = False
        """Whether somebody is known to have taken it over."""
        self.used_ns = 0
        """When the last use of his began that went well: his lease began anew then or later."""
        self._called_ns = 0
        self._label: Final = label
        self._stack: Final = ExitStack()
        self._moves = False
        self._give: Note | None = None
        self._death: Note | None = None
        self._taken: OwnershipEvent | None = None
        self._listeners: Final = motor._physical.ownership.listeners
        self._listeners.append(self._hear)
        super().__init__(name, stage)

    # ---- errands ----

    def reserve(self, timeout_s: float | None, lease_s: float | None, take_over: bool) -> None:
        """He has reserved it, or was refused."""
        if self.reservation is not None:
            return
        self._await_rest()
        kind = "take over" if take_over else "reserve"
        note = self._call(Action.TAKE, forced=take_over)
        if timeout_s is not None and not take_over:
            note.queued()
        try:
            self.reservation = self._stack.enter_context(
                self.motor.reserve(kind, timeout_s=timeout_s, lease_s=lease_s, take_over=take_over)
            )
        except MotorBusyError as error:
            self._refused(note, self._refusal(error, kind))
        except MotorError as error:
            self._failed(kind, error)
            self._refused(note, Answer.UNKNOWN)
        else:
            self.lease_s = lease_s
            self.used_ns = self._called_ns
            self.is_lost = False
            self._note_taken(note, kind)

    def start(self, timeout_s: float | None, wait: bool) -> None:
        """A motion of his has begun, or he was refused; it is over, if he waits."""
        self._await_rest()
        motor, reserved = self.motor, self.reservation
        before = motor.position() if reserved is not None else 0.0
        distance, duration_s = self.stage.course.of(self.number)
        if motor.position() > 0.0:
            distance = -distance
        motor.set_control_mode(ControlMode.TRAJECTORY)
        motor.set_trajectory(TrapezoidalTrajectory(distance, duration_s=duration_s))
        take = None if reserved is not None else self._call(Action.TAKE)
        if take is not None and timeout_s is not None:
            take.queued()
        command = self._call(Action.COMMAND, value=self.number + 1)
        try:
            motor.start(timeout_s)
        except MotorBusyError as error:
            answer = self._refusal(error, "start")
            command.returned(answer)
            if take is not None:
                self._refused(take, answer)
            return
        except MotorError as error:
            self._failed("start", error)
            command.returned(Answer.UNKNOWN)
            if take is not None:
                self._refused(take, Answer.UNKNOWN)
            return
        if take is not None:
            self._note_taken(take, "start")
        command.returned(value=self.number + 1)
        self.used_ns = self._called_ns
        self._begun(gives=take is not None)
        if wait and self._await_rest():
            self._check_motion(before, distance, duration_s, reserved)

    def trip(self, timeout_s: float | None, lease_s: float | None) -> None:
        """He had it for a motion of his, if he was given it."""
        self.reserve(timeout_s, lease_s, False)
        if self.reservation is not None:
            self.start(None, True)
            self.give()

    def give(self) -> None:
        """The reservation is over."""
        reservation = self.reservation
        if reservation is None:
            return
        self.reservation = None
        note = self._call(Action.GIVE)
        self._stack.close()
        if reservation.lost_to is not None:
            note.returned(Answer.LOST)
            self.stage.counts["give: lost before"] += 1
        elif self._moves:
            self._give = note
        else:
            note.returned()

    def renew(self) -> None:
        """The lease begins anew; who lost it is told so."""
        if self.reservation is None:
            return
        self._called_ns = self.stage.runtime.now_ns()
        try:
            self.reservation.renew()
        except MotorBusyError:
            self._expect_lost("renew")
        else:
            self.used_ns = self._called_ns

    def stop(self) -> None:
        """It slows down, whosever it is."""
        try:
            self.motor.stop()
            self.stage.counts["stop"] += 1
        except MotorError as error:
            self._failed("stop", error)

    def wait(self) -> None:
        """His motion is over."""
        self._await_rest()

    # ---- inside ----

    def _call(self, action: Action, *, value: int = 0, forced: bool = False) -> Note:
        self._called_ns = self.stage.runtime.now_ns()
        self._taken = None
        return self.stage.history.call(self.name, self._label, action, value=value, forced=forced)

    def _hear(self, event: OwnershipEvent) -> None:
        if event.owner.endswith(f" of {self.motor.name}") and event.action in (
            LockAction.TAKEN,
            LockAction.BROKEN,
            LockAction.TAKEN_OVER,
        ):
            self._taken = event

    def _note_taken(self, note: Note, kind: str) -> None:
        taken = self._taken
        forced = taken is not None and taken.action is LockAction.TAKEN_OVER
        note.returned(token=0 if taken is None else taken.token, forced=forced)
        self.stage.counts[f"{kind}: {'from a living owner' if forced else 'done'}"] += 1
        if taken is not None and forced:
            self._note_losers(taken, by_lease=kind != "take over")

    def _note_losers(self, taken: OwnershipEvent, *, by_lease: bool) -> None:
        """Who had it until now had let his lease end, unless it was taken all the same."""
        for other in self.stage.owners:
            reservation = other.reservation
            if other.is_lost or reservation is None or reservation.lost_to is None:
                continue
            if other.motor._physical is self.motor._physical:
                other.is_lost = True
                lease_s = (other.lease_s or _LONG_S) * _RENEWED
                end_ns = other.used_ns + round(lease_s * 1e9)
                self.stage.require(
                    taken.time_ns >= end_ns or not by_lease,
                    f"{self.name} took the motor over from {other.name},"
                    f" whose lease went on until {end_ns / 1e9:.6f} s",
                )

    def _refusal(self, error: MotorBusyError, kind: str) -> Answer:
        if any(word in error.holder for word in _STOPS):
            self.stage.counts[f"{kind}: refused while somebody stops it"] += 1
            return Answer.UNKNOWN
        if self.reservation is not None:
            self._expect_lost(kind)
            return Answer.LOST
        if self._taken is not None:  # he had it, and lost it before he could say so
            self.stage.counts[f"{kind}: refused after it was taken"] += 1
            return Answer.UNKNOWN
        self.stage.counts[f"{kind}: refused"] += 1
        return Answer.REFUSED

    def _refused(self, take: Note, answer: Answer) -> None:
        """He does not have it; if it is not known why, he may have had it for a moment."""
        take.returned(answer)
        if answer is Answer.UNKNOWN:
            self._call(Action.GIVE).returned(Answer.UNKNOWN)

    def _expect_lost(self, kind: str) -> None:
        reservation = self.reservation
        is_lost = reservation is not None and reservation.lost_to is not None
        self.stage.counts[f"{kind}: lost before"] += 1
        self.stage.require(is_lost, f"{self.name}: {kind} was refused, and yet it has the motor")

    def _failed(self, kind: str, error: MotorError) -> None:
        self.stage.counts[f"{kind}: {type(error).__name__}"] += 1
        self.stage.require(type(error) is not UsageError, f"{self.name}: {kind} failed: {error}")

    def _begun(self, *, gives: bool) -> None:
        self._moves = True
        if gives:
            self._give = self._call(Action.GIVE)
        self.motor.on_done(lambda _: self._over())

    def _over(self) -> None:
        """His motion is over: whoever waits may have the motor, unless it is reserved."""
        self._moves = False
        give, self._give = self._give, None
        if give is not None:
            give.returned()
        death, self._death = self._death, None
        if death is not None:
            death.returned()

    def _await_rest(self) -> bool:
        """Whether what he commanded last is over, by itself."""
        try:
            self.motor.wait_until_done(_LONG_S)
        except MotorError as error:
            self._failed("wait", error)
            return False
        return True

    def _check_motion(
        self, before: float, distance: float, duration_s: float, reserved: "Reservation | None"
    ) -> None:
        stage = self.stage
        run = self.motor._run
        assert run is not None
        took_s = (stage.runtime.now_ns() - run.since_ns) / 1e9
        stage.counts["motion: as long as asked for"] += 1
        stage.require(
            abs(took_s - duration_s) <= stage.course.tolerance_s,
            f"{self.name} asked for a motion of {duration_s:g} s, and it took {took_s:g} s: it was"
            " made with settings that are not his",
        )
        if reserved is None or reserved.lost_to is not None:
            return
        went = self.motor.position() - before
        stage.counts["motion: as far as asked for"] += 1
        stage.require(
            abs(went - distance) <= stage.course.window,
            f"{self.name} had the motor to itself and moved it by {distance:g}; it went {went:g}",
        )

    def leave(self) -> None:
        """His blocks are left, as by an exception."""
        self._death = self.stage.history.call(self.name, "", Action.DIE)
        self._stack.close()
        self.reservation = None
        self._listeners.remove(self._hear)
        if not self._moves:
            self._death.returned()
            self._death = None
