"""Logical owners of shared motors, as parties in one virtual time.

The next action of an owner is an *errand*. An errand may take long, and other owners work
meanwhile. All uses are noted in a history with a strictly increasing clock. Each owner checks its
own motions. An uninterrupted motion must take the requested time. If the owner had the motor
throughout, the motion must also go the requested distance.
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
"""The minimum share of a lease that is left when a use does not renew it."""
_STOPS: Final = ("stop() of ", "halt() of ")


@final
class Owner(Party):
    """One logical motor of a physical one, with its owner.

    Args:
        name: unique also among earlier owners that died.
        motor: its logical motor.
        label: the name of the physical motor in the history.
        number: its number among all owners.
    """

    def __init__(self, name: str, motor: Motor, label: str, number: int, stage: Stage) -> None:
        self.motor: Final = motor
        self.number: Final = number
        self.reservation: Reservation | None = None
        self.lease_s: float | None = None
        self.is_lost = False
        """True if another owner is known to have taken the motor over."""
        self.used_ns = 0
        """The start of the last successful use [ns]; the lease was renewed then or later."""
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
        """Reserve the motor, unless it is refused."""
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
        """Start a motion, unless it is refused; `wait`: wait until it has ended."""
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
        """Reserve the motor for one motion, if it is granted."""
        self.reserve(timeout_s, lease_s, False)
        if self.reservation is not None:
            self.start(None, True)
            self.give()

    def give(self) -> None:
        """End the reservation."""
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
        """Renew the lease; note the loss if it was lost."""
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
        """Stop the motor, whichever owner has it."""
        try:
            self.motor.stop()
            self.stage.counts["stop"] += 1
        except MotorError as error:
            self._failed("stop", error)

    def wait(self) -> None:
        """Wait until the owner's motion has ended."""
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
        """Check that a motor taken from a living owner had an expired lease, unless by force."""
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
                    f"{self.name} took the motor over from {other.name}, whose lease was valid "
                    f"until {end_ns / 1e9:.6f} s",
                )

    def _refusal(self, error: MotorBusyError, kind: str) -> Answer:
        if any(word in error.holder for word in _STOPS):
            self.stage.counts[f"{kind}: refused during a stop"] += 1
            return Answer.UNKNOWN
        if self.reservation is not None:
            self._expect_lost(kind)
            return Answer.LOST
        if self._taken is not None:  # it was granted, then lost before it could be reported
            self.stage.counts[f"{kind}: refused after it was taken"] += 1
            return Answer.UNKNOWN
        self.stage.counts[f"{kind}: refused"] += 1
        return Answer.REFUSED

    def _refused(self, take: Note, answer: Answer) -> None:
        """Note a refusal; with an unknown reason the motor may have been owned for a moment."""
        take.returned(answer)
        if answer is Answer.UNKNOWN:
            self._call(Action.GIVE).returned(Answer.UNKNOWN)

    def _expect_lost(self, kind: str) -> None:
        reservation = self.reservation
        is_lost = reservation is not None and reservation.lost_to is not None
        self.stage.counts[f"{kind}: lost before"] += 1
        self.stage.require(is_lost, f"{self.name}: {kind} was refused, although it owns the motor")

    def _failed(self, kind: str, error: MotorError) -> None:
        self.stage.counts[f"{kind}: {type(error).__name__}"] += 1
        self.stage.require(type(error) is not UsageError, f"{self.name}: {kind} failed: {error}")

    def _begun(self, *, gives: bool) -> None:
        self._moves = True
        if gives:
            self._give = self._call(Action.GIVE)
        self.motor.on_done(lambda _: self._over())

    def _over(self) -> None:
        """Complete the notes after the motion; the motor is free then, unless it is reserved."""
        self._moves = False
        give, self._give = self._give, None
        if give is not None:
            give.returned()
        death, self._death = self._death, None
        if death is not None:
            death.returned()

    def _await_rest(self) -> bool:
        """Wait for the end of the last motion; return True if it ended without an error."""
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
            f"{self.name} asked for a motion of {duration_s:g} s, but it took {took_s:g} s: it "
            "was made with another owner's settings",
        )
        if reserved is None or reserved.lost_to is not None:
            return
        went = self.motor.position() - before
        stage.counts["motion: as far as asked for"] += 1
        stage.require(
            abs(went - distance) <= stage.course.window,
            f"{self.name} was the only owner and moved the motor by {distance:g}, but it went "
            f"{went:g}",
        )

    def leave(self) -> None:
        """Leave all blocks, as after an exception."""
        self._death = self.stage.history.call(self.name, "", Action.DIE)
        self._stack.close()
        self.reservation = None
        self._listeners.remove(self._hear)
        if not self._moves:
            self._death.returned()
            self._death = None
