"""One physical motor, many logical ones: who has it, and what it is doing for whom.

A hardware object registers the physical motor it speaks for; a second one for the same motor is
refused while the first lives. The record this yields is shared by all logical motors on that
hardware object. It keeps four things apart:

- a *transaction*: one operation at a time (an SDO here, an SDO there would mix settings of two
  owners). Short, first come, first served. Nobody owns anything afterwards.
- a *run*: one motion, from the command that began it to its end. While a run goes on, the motor is
  held by the logical motor that began it: others read, and may stop it, but not command it.
- the *token*: it grows when the motor changes hands. What a hardware object believes it wrote is
  true only while the token it wrote under is the current one.
- *low-level access*: a transaction that lasts as long as its holder likes. Who asks for an ordinary
  one meanwhile is refused at once; so is what needs no transaction (readings, stops, waiters that
  poll): it goes through a *passage*, and access is granted only while nobody is in one.

Behind them is *ownership* (`motorapi.ownership`): of one logical motor, for an operation, a
reservation or low-level access. On a bus that other processes can open it keeps them out as well,
then also while a run goes on, and the token grows when one of them had the motor in between.
"""

import threading
import weakref
from collections.abc import Hashable
from contextlib import AbstractContextManager
from enum import Enum
from typing import TYPE_CHECKING, Final, final

from motorapi.commands import ControlVariable, Motion
from motorapi.errors import MotorBusyError, MotorError, UsageError
from motorapi.ownership import Ownership
from motorapi.process_lock import ProcessLock
from motorapi.runtime import Runtime, wait_until
from motorapi.turns import LOW_LEVEL, Ticket, Turns
from motorapi.waiting import News

if TYPE_CHECKING:
    import can

_NO_STOP: Final = (
    "a stop is refused as well, so that its holder is alone with the hardware; the holder can stop"
    " it through the hardware object, and the drive's own dead-man still holds"
)


@final
class RunStatus(Enum):
    """How far a run is, as the hardware tells."""

    GOING = "going"
    DONE = "done"
    FAILED = "failed"


@final
class Run:
    """One motion of a physical motor: who began it, what it is, and how it ended."""

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

    def __init__(self, name: str, owner: object, since_ns: int, motion: Motion | None) -> None:
        self.name: Final = name
        self.owner: Final = owner
        self.since_ns: Final = since_ns
        self.motion: Final = motion
        self.finished = False
        self.error: MotorError | None = None
        self.interrupted_by: str | None = None
        self.interrupted_at_ns = 0

    def __repr__(self) -> str:
        how = "done" if self.finished else self.interrupted_by or "not known to be over"
        return f"<Run {self.name} since {self.since_ns / 1e9:.6f} s: {how}>"

    @property
    def ends(self) -> bool:
        """Whether it ends by itself. What is said of velocity, torque or current goes on."""
        return self.motion is None or self.motion.variable is ControlVariable.POSITION

    @property
    def is_over(self) -> bool:
        """Whether it is known how it ended."""
        return self.finished or self.interrupted_by is not None

    def interrupt(self, by: str, now_ns: int) -> None:
        """It was ended by `by`, short of its target; the first one counts."""
        if self.interrupted_by is None and not self.finished:
            self.interrupted_at_ns = now_ns
            self.interrupted_by = by  # last: a waiter looks at this one first

    def fail(self, error: MotorError, now_ns: int) -> None:
        """It was ended by `error`, if nothing else had ended it before."""
        if not self.is_over:
            self.error = error
            self.interrupt(str(error), now_ns)


@final
class _Passage:
    """A block that uses the hardware outside of any transaction. A class: readings are many."""

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
    """The record of one physical motor in this process. `label` is its name for people."""

    def __init__(self, label: str, serial: int, lock: ProcessLock | None = None) -> None:
        self.label: Final = label
        self.ownership: Final = Ownership(lock, self._end_run_of)
        self.order: Final = (label if lock is None else lock.name, label, serial)
        """Transactions of several motors are taken in this order, so that none can deadlock."""
        self.token = 0
        self.run: Run | None = None
        self.interruptions = 0
        """Grows with every stop, quick stop and halt, so that a start in progress notices."""
        self.news: News | None = None
        """Set by a hardware object that counts in it every change of what `_is_done` looks at, by
        `grow` where a motion may have ended with it; the hook is then asked only when it has grown.
        None: it is asked after every event, and for callbacks every now and then."""
        self.access: Ticket | None = None
        """Who has low-level access; None: nobody."""
        self._own_news = News()
        self._owner: object = None
        self._absences = 0  # of `ownership`, when the token was looked at last
        self._turns = Turns(label)
        self._inside = 0
        self._mutex = threading.Lock()  # of the few numbers here; never held while waiting

    def __repr__(self) -> str:
        doing = "at rest" if self.run is None or self.run.finished else self.run.name
        if self.access is not None:
            doing = f"held by {self.access.who} for {LOW_LEVEL}"
        return f"<PhysicalMotor {self.label}: {doing}>"

    @property
    def bell(self) -> News:
        """The news that tell of every end there is to a run; of its hardware's, if it counts."""
        return self._own_news if self.news is None else self.news

    # ---- transactions, passages, low-level access ----

    def transaction(
        self, runtime: Runtime, who: str, timeout_s: float | None = None
    ) -> AbstractContextManager[Ticket]:
        """No other operation on this motor runs inside the block; see `Turns.turn`."""
        return self._turns.turn(runtime, who, timeout_s)

    def passage(self, motor: str, *, of_holder: bool = False) -> "_Passage":
        """Nobody is given low-level access while this block uses the hardware, in no transaction.

        Args:
            motor: the name for the error.
            of_holder: the thread that has low-level access may pass: it works the hardware object.

        Raises:
            MotorBusyError: somebody has low-level access; the holder itself counts too.
        """
        return _Passage(self, motor, of_holder)

    def enter(self, motor: str, of_holder: bool) -> None:
        """A passage begins. Raises as `passage`."""
        with self._mutex:
            access = self.access
            if access is not None and not (of_holder and access.thread == threading.get_ident()):
                raise access.busy(motor)
            self._inside += 1

    def leave(self) -> None:
        """A passage ends."""
        with self._mutex:
            self._inside -= 1

    @property
    def is_held_here(self) -> bool:
        """Whether this very thread has low-level access."""
        access = self.access
        return access is not None and access.thread == threading.get_ident()

    def require_not_held_elsewhere(self) -> None:
        """Raises MotorBusyError if another thread has low-level access."""
        access = self.access
        if access is not None and access.thread != threading.get_ident():
            raise access.busy(self.label)

    def interrupt(self, motor: str) -> AbstractContextManager[None]:
        """A start in progress notices that the motor is stopped, inside the block.

        Raises:
            MotorBusyError: somebody has low-level access.
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
        """Who has this ticket, and so the turn, has low-level access, once nobody is in a passage.

        Raises:
            MotorBusyError: somebody stayed in one for `timeout_s` [s].
        """

        def is_granted() -> bool:
            with self._mutex:
                if self._inside:
                    return False
                ticket.exclusive = True
                self.access = ticket
                return True

        if not wait_until(runtime, is_granted, timeout_s):
            holder = "somebody who reads or stops it"
            raise MotorBusyError(motor=self.label, holder=holder, since_ns=ticket.since_ns)
        self._count_news()

    def revoke(self, ticket: Ticket) -> None:
        """Low-level access is over; what anybody believes of the motor is doubted."""
        self._owner = None
        self.token += 1
        self.access = None
        ticket.exclusive = False

    # ---- runs ----

    def take(
        self, owner: object, motor: str, status: RunStatus, taken_over_ns: int | None = None
    ) -> None:
        """`owner` may command the motor; `status` is that of the run there is, if any.

        Args:
            owner: the logical motor.
            motor: its name.
            status: see above.
            taken_over_ns: when he took it from others: what goes on for them (a stop, that anybody
                may command, too) is over, and leaves an orphan. None: he did not.

        Raises:
            MotorBusyError: a run of another owner goes on.
        """
        run = self.run
        if run is not None and run.interrupted_by is None:
            if status is RunStatus.DONE and run.ends:
                run.finished = True
                self._count_news()
            going_on = status is not RunStatus.FAILED and not run.finished
            if going_on and run.owner is not owner:
                if taken_over_ns is None:
                    raise MotorBusyError(motor=motor, holder=run.name, since_ns=run.since_ns)
                self.ownership.is_orphan = True
                run.interrupt(f"{motor}, which took the motor over", taken_over_ns)
                self._count_news()
        if self._owner is not owner or self._absences != self.ownership.absences:
            self._owner = owner
            self._absences = self.ownership.absences
            self.token += 1

    def begin(self, run: Run, status: RunStatus) -> None:
        """`run` is what the motor does now; what it did before was interrupted, if not over."""
        self._settle(run.name, run.since_ns, status)
        self.run = run
        self._count_news()

    def end(self, by: str, now_ns: int, status: RunStatus) -> None:
        """Nothing goes on; what went on was interrupted by `by`, if it was not over."""
        if self._settle(by, now_ns, status):
            self.run = None
            self._count_news()

    def fail(self, error: MotorError, now_ns: int) -> None:
        """Nothing goes on; what went on was ended by `error`."""
        run = self.run
        if run is not None:
            run.fail(error, now_ns)
            self.run = None
            self._count_news()

    def _end_run_of(self, by: str, now_ns: int, loser: object, taker: object) -> bool:
        """Who took the motor over has ended what it did; whether it did anything.

        Args:
            by: who, in words.
            now_ns: when.
            loser: whose run; None: anybody's but the taker's.
            taker: who takes it over; None: another process.
        """
        with self._mutex:
            self.interruptions += 1  # a start in progress notices
        run = self.run
        if run is None or run.is_over or run.owner is taker:
            return False
        if loser is not None and run.owner is not loser:
            return False
        run.interrupt(by, now_ns)
        self._count_news()
        return True

    def stopped_elsewhere(self, by: str, now_ns: int) -> bool:
        """Another program has told the motor to stop; whether anything went on here."""
        return self._end_run_of(by, now_ns, None, None)

    def _settle(self, by: str, now_ns: int, status: RunStatus) -> bool:
        """How the run there is ended is known; whether there was one."""
        run = self.run
        if run is None:
            return False
        if status is RunStatus.DONE and run.ends and run.interrupted_by is None:
            run.finished = True
        run.interrupt(by, now_ns)
        return True

    def _count_news(self) -> None:
        self.bell.grow()


_registry_lock: Final = threading.Lock()
_registry: Final[dict[Hashable, "weakref.ref[object]"]] = {}
_serial = 0


def register_physical_motor(
    key: Hashable, label: str, hardware: object, lock: ProcessLock | None = None
) -> PhysicalMotor:
    """The record of the physical motor `key`, for the one hardware object that speaks for it.

    Args:
        key: says which physical motor: for a drive on CAN `(*bus_key(bus), node_id)`.
        label: its name for people ("can0 node 3").
        hardware: the hardware object. It is held weakly: dropping it lets go of the motor.
        lock: between processes; None: no other process can speak for this motor.

    Raises:
        UsageError: a hardware object for this motor lives already. It is named.
    """
    global _serial
    with _registry_lock:
        there = _registry.get(key)
        first = None if there is None else there()
        if first is not None:
            raise UsageError(
                f"{label} has a hardware object already: {first!r};"
                " share that one, or close() it first"
            )

        def forget(reference: "weakref.ref[object]") -> None:
            if _registry.get(key) is reference:
                del _registry[key]

        _registry[key] = weakref.ref(hardware, forget)
        _serial += 1
        return PhysicalMotor(label, _serial, lock)


def release_physical_motor(key: Hashable, hardware: object) -> None:
    """`hardware` no longer speaks for the motor `key`; does nothing if it never did."""
    with _registry_lock:
        there = _registry.get(key)
        if there is not None and there() is hardware:
            del _registry[key]


def bus_key(bus: "can.BusABC") -> tuple[Hashable, ...]:
    """The same for every bus object on one physical bus, however it was opened in this process."""
    channel = getattr(bus, "channel_info", "unknown")
    where: Hashable = bus if channel == "unknown" else (type(bus).__name__, channel)
    return ("can", getattr(bus, "runtime", None), where)
