"""Sharing of one physical motor by many logical motors.

A hardware object registers the physical motor that it represents; a second one for the same motor
is refused while the first exists. All logical motors on that hardware object share the resulting
record. The record separates four things:

- A *transaction*: one operation at a time (interleaved SDOs would mix settings of two owners).
  Transactions are short, first come, first served, and leave no ownership behind.
- A *run*: one motion, from its command to its end. While it is active, the logical motor that began
  it holds the motor: others read, and may stop it, but not command it.
- The *token*: it grows when the motor changes hands. The settings written by a hardware object are
  known only while the token of the write is the current one.
- *Low-level access*: a transaction of any length. Requests for an ordinary transaction are refused
  at once meanwhile. Access without a transaction (readings, stops, polling waits) is refused as
  well: it goes through a *passage*, and low-level access is granted only without active passages.

Commands by the hardware object itself, outside of an operation and of low-level access, are refused
while a logical motor of this process has the motor (`PhysicalMotor.require_free`).

They build on *ownership* (`motorhil.motorapi.ownership.ownership`): by one logical motor, for an
operation, a reservation or low-level access. On a bus that other processes can open it excludes
them as well, also while a motion is active. The token grows when one of them had the motor in
between.
"""

import itertools
import threading
import weakref
from collections.abc import Callable, Hashable
from contextlib import AbstractContextManager
from enum import Enum
from math import isfinite
from typing import Final, Protocol, final

from motorhil.motorapi.bus_context import context_of
from motorhil.motorapi.commands import ControlVariable
from motorhil.motorapi.errors import LinkError, MotorBusyError, MotorError, UsageError
from motorhil.motorapi.locking.process_lock import ProcessLock
from motorhil.motorapi.motion import Motion
from motorhil.motorapi.ownership.ownership import Ownership
from motorhil.motorapi.ownership.queue import LOW_LEVEL, FifoQueue, Ticket
from motorhil.motorapi.runtime.api import ChangeCounter, Runtime, wait_until
from motorhil.motorapi.state import Measurement, MotorState

_NO_STOP: Final = (
    "a stop is refused as well, so that its holder is alone with the hardware; the holder can stop"
    " it through the hardware object, and the drive's own dead-man still holds"
)

_DIRECTLY: Final = (
    "command it by the hardware object inside `with motor.low_level() as hardware:` of its holder"
)


@final
class RunStatus(Enum):
    """The status of a motion, as reported by the hardware."""

    GOING = "going"
    DONE = "done"
    FAILED = "failed"


class MotionOwner(Protocol):
    """A party that begins motions (a logical motor)."""

    @property
    def name(self) -> str:
        """Its name in messages."""

    def goes_on(self, run: "ActiveMotion") -> bool:
        """Return True if `run` is the active motion and has not ended."""


@final
class ActiveMotion:
    """One motion of a physical motor: its owner, its command, and its end."""

    __slots__ = (
        "error",
        "finished",
        "interrupted_at_ns",
        "interrupted_by",
        "motion",
        "name",
        "owner",
        "since_ns",
    )

    def __init__(self, name: str, owner: MotionOwner, since_ns: int, motion: Motion | None) -> None:
        self.name: Final = name
        self.owner: Final = owner
        self.since_ns: Final = since_ns
        self.motion: Final = motion
        self.finished: bool = False
        self.error: MotorError | None = None
        self.interrupted_by: str | None = None
        self.interrupted_at_ns: int = 0

    def __repr__(self) -> str:
        how = "done" if self.finished else self.interrupted_by or "not known to have ended"
        return f"<Run {self.name} since {self.since_ns / 1e9:.6f} s: {how}>"

    @property
    def ends(self) -> bool:
        """True if it ends by itself, at rest.

        A command of velocity, torque or current continues, as does a trajectory with a final
        velocity.
        """
        motion = self.motion
        if motion is None:
            return True
        return motion.variable is ControlVariable.POSITION and not motion.final_velocity

    @property
    def is_over(self) -> bool:
        """True if its end is known."""
        return self.finished or self.interrupted_by is not None

    def interrupt(self, by: str, now_ns: int) -> None:
        """Record that `by` ended it short of its target; the first call counts."""
        if self.interrupted_by is None and not self.finished:
            self.interrupted_at_ns = now_ns
            self.interrupted_by = by  # last: a waiter examines this attribute first

    def fail(self, error: MotorError, now_ns: int) -> None:
        """Record that `error` ended it, unless it has ended before."""
        if not self.is_over:
            self.error = error
            self.interrupt(str(error), now_ns)


@final
class _Passage:
    """A block that uses the hardware outside of transactions; a class for speed."""

    __slots__ = ("_motor", "_of_holder", "_physical")

    def __init__(self, physical: "PhysicalMotor", motor: str, of_holder: bool) -> None:
        self._physical = physical
        self._motor = motor
        self._of_holder = of_holder

    def __enter__(self) -> None:
        self._physical.enter(self._motor, self._of_holder)

    def __exit__(self, *_: object) -> None:
        self._physical.leave()


@final
class PhysicalMotor:
    """The record of one physical motor in this process. `label` is its name for users."""

    def __init__(self, label: str, serial: int, lock: ProcessLock | None = None) -> None:
        self.label: Final = label
        self.ownership: Final = Ownership(lock, self._end_run_of)
        self.order: Final = (label if lock is None else lock.name, label, serial)
        """The order of transactions of several motors, which prevents deadlocks."""
        self.token: int = 0
        self.run: ActiveMotion | None = None
        self.interruptions: int = 0
        """The number of stops, quick stops and halts, by which a start in progress notices one."""
        self.news: ChangeCounter | None = None
        """The change counter of a hardware object that counts every change evaluated by `_is_done`.
        It calls `grow` where a motion may have ended with the change; the hook is then called only
        after a change. None: the hook is called after every event, and periodically for callbacks.
        """
        self.check_heard: Callable[[], None] | None = None
        """Raises LinkError if the motor cannot be heard now; None: its hardware does not know."""
        self.is_quick_stopped: bool = False
        """True from a quick stop that only this record knows until the motor is enabled again."""
        self.access: Ticket | None = None
        """The ticket of low-level access, or None."""
        self._own_news = ChangeCounter()
        self._owner: object = None
        self._absences = 0  # of `ownership`, when the token was last updated
        self._turns = FifoQueue(label)
        self._inside = 0
        self._mutex = threading.Lock()  # of the few numbers here; never held during a wait

    def __repr__(self) -> str:
        doing = "at rest" if self.run is None or self.run.finished else self.run.name
        if self.access is not None:
            doing = f"held by {self.access.who} for {LOW_LEVEL}"
        return f"<PhysicalMotor {self.label}: {doing}>"

    def seen(self, latest: Measurement | None) -> Measurement | None:
        """Return a measurement with the state as this record knows it: OFFLINE or STOPPED."""
        if latest is None:
            return None
        if self.is_quick_stopped and latest.state is MotorState.ENABLED:
            latest = latest._replace(state=MotorState.STOPPED)
        if self.check_heard is not None:
            try:
                self.check_heard()
            except LinkError:
                return latest._replace(state=MotorState.OFFLINE)
        return latest

    def stop_deceleration(self, of_model: float) -> float:
        """Return the deceleration of a stop now [U/s²]: that of the motion, else of the model.

        A quick stop that only this record knows is at that of the model.
        """
        motion = None if self.run is None or self.is_quick_stopped else self.run.motion
        if motion is None or motion.variable not in (
            ControlVariable.POSITION,
            ControlVariable.VELOCITY,
        ):
            return of_model
        size = motion.stop_deceleration or motion.deceleration
        return size if isfinite(size) else of_model

    @property
    def bell(self) -> ChangeCounter:
        """The counter that reports every end of a motion: that of the hardware, if it has one."""
        return self._own_news if self.news is None else self.news

    # ---- transactions, passages, low-level access ----

    def transaction(
        self, runtime: Runtime, who: str, timeout_s: float | None = None
    ) -> AbstractContextManager[Ticket]:
        """Exclude other operations on this motor inside the block; see `FifoQueue.turn`."""
        return self._turns.turn(runtime, who, timeout_s)

    def passage(self, motor: str, *, of_holder: bool = False) -> "_Passage":
        """Block grants of low-level access while the block uses the hardware without a transaction.

        Args:
            motor: the name for the error.
            of_holder: permit the thread with low-level access, which uses the hardware object.

        Raises:
            MotorBusyError: low-level access is active, also for the holder itself.
        """
        return _Passage(self, motor, of_holder)

    def enter(self, motor: str, of_holder: bool) -> None:
        """Begin a passage. Raises as `passage`."""
        with self._mutex:
            access = self.access
            if access is not None and not (of_holder and access.thread == threading.get_ident()):
                raise access.busy(motor)
            self._inside += 1

    def leave(self) -> None:
        """End a passage."""
        with self._mutex:
            self._inside -= 1

    @property
    def is_held_here(self) -> bool:
        """True if the calling thread has low-level access."""
        access = self.access
        return access is not None and access.thread == threading.get_ident()

    def require_not_held_elsewhere(self) -> None:
        """Raise MotorBusyError if another thread has low-level access."""
        access = self.access
        if access is not None and access.thread != threading.get_ident():
            raise access.busy(self.label)

    def require_free(self) -> None:
        """Require that a caller of the hardware object, outside of all motors, may command it.

        Operations and low-level access of the calling thread may.

        Raises:
            MotorBusyError: a logical motor of this process has reserved it, or moves it.
        """
        if self.is_held_here or self._turns.is_mine:
            return
        self.ownership.look()
        held, run = self.ownership.held, self.run
        if held is not None and held.is_held:
            holder, since_ns, purpose = held.who, held.since_ns, held.purpose
        elif run is not None and run.owner.goes_on(run):
            holder, since_ns, purpose = run.name, run.since_ns, ""
        else:
            return
        raise MotorBusyError(
            motor=self.label, holder=holder, since_ns=since_ns, purpose=purpose, remedy=_DIRECTLY
        )

    def interrupt(self, motor: str) -> AbstractContextManager[None]:
        """Notify a start in progress of a stop inside the block.

        Raises:
            MotorBusyError: low-level access is active.
        """
        access = self.access
        if access is not None:
            error = access.busy(motor)
            error.add_note(_NO_STOP)
            raise error
        with self._mutex:
            self.interruptions += 1
        return self.passage(motor)

    def grant(self, runtime: Runtime, ticket: Ticket, timeout_s: float) -> None:
        """Grant low-level access to the holder of the ticket, once no passage is active.

        Raises:
            MotorBusyError: a passage stayed active for `timeout_s` [s].
        """

        def is_granted() -> bool:
            with self._mutex:
                if self._inside:
                    return False
                ticket.exclusive = True
                self.access = ticket
                return True

        if not wait_until(runtime, is_granted, timeout_s):
            holder = "a party that reads or stops it"
            raise MotorBusyError(motor=self.label, holder=holder, since_ns=ticket.since_ns)
        self.bell.grow()

    def revoke(self, ticket: Ticket) -> None:
        """End low-level access; all knowledge of the motor is discarded."""
        self._owner = None
        self.token += 1
        self.access = None
        ticket.exclusive = False

    # ---- runs ----

    def take(
        self, owner: object, motor: str, status: RunStatus, taken_over_ns: int | None = None
    ) -> None:
        """Permit commands of `owner`; `status` is that of the present motion, if any.

        Args:
            owner: the logical motor.
            motor: its name.
            status: see above.
            taken_over_ns: time of a takeover: active motions of others (also a stop, which needs no
                ownership) end, and leave an orphan. None: no takeover.

        Raises:
            MotorBusyError: a motion of another owner is active.
        """
        run = self.run
        if run is not None and run.interrupted_by is None:
            if status is RunStatus.DONE and run.ends:
                run.finished = True
                self.bell.grow()
            going_on = status is not RunStatus.FAILED and not run.finished
            if going_on and run.owner is not owner:
                if taken_over_ns is None:
                    raise MotorBusyError(motor=motor, holder=run.name, since_ns=run.since_ns)
                self.ownership.is_orphan = True
                run.interrupt(f"{motor}, which took the motor over", taken_over_ns)
                self.bell.grow()
        if self._owner is not owner or self._absences != self.ownership.absences:
            self._owner = owner
            self._absences = self.ownership.absences
            self.token += 1

    def begin(self, run: ActiveMotion, status: RunStatus) -> None:
        """Make `run` the active motion; an earlier one that has not ended is interrupted."""
        self._settle(run.name, run.since_ns, status)
        self.run = run
        self.bell.grow()

    def end(self, by: str, now_ns: int, status: RunStatus) -> None:
        """End the active motion; it is interrupted by `by`, if it has not ended."""
        if self._settle(by, now_ns, status):
            self.run = None
            self.bell.grow()

    def fail(self, error: MotorError, now_ns: int) -> None:
        """End the active motion with `error`."""
        run = self.run
        if run is not None:
            run.fail(error, now_ns)
            self.run = None
            self.bell.grow()

    def _end_run_of(self, by: str, now_ns: int, loser: object, taker: object) -> bool:
        """End the motion of a former owner after a takeover. Return True if there was one.

        Args:
            by: the new owner, in words.
            now_ns: time of the takeover.
            loser: the former owner; None: any except the new one.
            taker: the new owner; None: another process.
        """
        with self._mutex:
            self.interruptions += 1  # a start in progress notices this
        run = self.run
        if run is None or run.is_over or run.owner is taker:
            return False
        if loser is not None and run.owner is not loser:
            return False
        run.interrupt(by, now_ns)
        self.bell.grow()
        return True

    def stopped_elsewhere(self, by: str, now_ns: int) -> bool:
        """Record a stop by another program. Return True if a motion was active here."""
        return self._end_run_of(by, now_ns, None, None)

    def _settle(self, by: str, now_ns: int, status: RunStatus) -> bool:
        """Record the end of the present motion. Return True if there was one."""
        run = self.run
        if run is None:
            return False
        if status is RunStatus.DONE and run.ends and run.interrupted_by is None:
            run.finished = True
        run.interrupt(by, now_ns)
        return True


_serials: Final = itertools.count(1)


@final
class _PhysicalMotors:
    """The hardware objects of the motors on one bus, by their place there."""

    def __init__(self) -> None:
        self.lock: Final = threading.Lock()
        self.hardware: Final[dict[Hashable, weakref.ref[object]]] = {}

    def find(self, place: Hashable) -> object:
        """Return the hardware object at this place, or None."""
        there = self.hardware.get(place)
        return None if there is None else there()


def register_physical_motor(
    home: object, place: Hashable, label: str, hardware: object, lock: ProcessLock | None = None
) -> PhysicalMotor:
    """Return the record of a physical motor, for its only hardware object.

    Args:
        home: the bus or line of the motor; its runtime if it has no bus.
        place: identifies the motor there: the node-ID of a drive on CAN.
        label: its name for users ("can0 node 3").
        hardware: the hardware object. The reference is weak: dropping the object releases the
            motor.
        lock: between processes; None: no other process can control this motor.

    Raises:
        UsageError: another hardware object for this motor exists. It is named.
    """
    motors = context_of(home).medium.part(_PhysicalMotors)
    with motors.lock:
        first = motors.find(place)
        if first is not None:
            raise UsageError(
                f"{label} has a hardware object already: {first!r};"
                " share that one, or close() it first"
            )
        motors.hardware[place] = weakref.ref(hardware)
        return PhysicalMotor(label, next(_serials), lock)


def release_physical_motor(home: object, place: Hashable, hardware: object) -> None:
    """Unregister `hardware` for the motor at `place`; do nothing if it was not registered."""
    motors = context_of(home).medium.part(_PhysicalMotors)
    with motors.lock:
        if motors.find(place) is hardware:
            del motors.hardware[place]
