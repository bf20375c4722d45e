"""One physical motor, many logical ones: who has it, and what it is doing for whom.

A hardware object registers the physical motor it speaks for; a second one for the same motor is
refused while the first lives. The record this yields is shared by all logical motors on that
hardware object. It keeps three things apart:

- a *transaction*: one operation at a time (an SDO here, an SDO there would mix settings of two
  owners). Short, first come, first served. Nobody owns anything afterwards.
- a *run*: one motion, from the command that began it to its end. While a run goes on, the motor is
  held by the logical motor that began it: others read, and may stop it, but not command it.
- the *token*: it grows when the motor changes hands. What a hardware object believes it wrote is
  true only while the token it wrote under is the current one.

Ownership across processes is to take its place behind the same three.
"""

import threading
import weakref
from collections import deque
from collections.abc import Hashable, Iterator, Sequence
from contextlib import AbstractContextManager, contextmanager
from enum import Enum
from typing import TYPE_CHECKING, Final, final

from motorapi.commands import ControlVariable, Motion
from motorapi.errors import MotorBusyError, UsageError
from motorapi.runtime import Runtime
from motorapi.waiting import News

if TYPE_CHECKING:
    import can

TRANSACTION_TIMEOUT_S: Final = 10.0
"""How long an operation waits for the one before it; far longer than any drive takes."""


@final
class _Ticket:
    __slots__ = ("since_ns", "thread", "who")

    def __init__(self, who: str, thread: int, since_ns: int) -> None:
        self.who: Final = who
        self.thread: Final = thread
        self.since_ns: Final = since_ns


@final
class Turns:
    """Who may use something that one party at a time may use: first come, first served."""

    def __init__(self, label: str) -> None:
        self.label: Final = label
        self._queue: deque[_Ticket] = deque()

    @contextmanager
    def turn(self, runtime: Runtime, who: str) -> Iterator[None]:
        """Nobody else has it inside the block; in order of asking.

        Raises:
            UsageError: this thread has it already.
            MotorBusyError: the one before took longer than `TRANSACTION_TIMEOUT_S`.
        """
        thread = threading.get_ident()
        for other in tuple(self._queue):
            if other.thread == thread:
                raise UsageError(f"{who}: {other.who} is still at work in this very thread")
        ticket = _Ticket(who, thread, runtime.now_ns())
        self._queue.append(ticket)
        try:
            if self._queue[0] is not ticket and not runtime.wait_until(
                lambda: self._queue[0] is ticket, TRANSACTION_TIMEOUT_S
            ):
                first = self._queue[0]
                raise MotorBusyError(motor=self.label, holder=first.who, since_ns=first.since_ns)
            yield
        finally:
            self._queue.remove(ticket)


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
        self.interrupted_by: str | None = None
        self.interrupted_at_ns = 0

    @property
    def ends(self) -> bool:
        """Whether it ends by itself. What is said of velocity, torque or current goes on."""
        return self.motion is None or self.motion.variable is ControlVariable.POSITION

    def interrupt(self, by: str, now_ns: int) -> None:
        """It was ended by `by`, short of its target; the first one counts."""
        if self.interrupted_by is None and not self.finished:
            self.interrupted_at_ns = now_ns
            self.interrupted_by = by  # last: a waiter looks at this one first


@final
class PhysicalMotor:
    """The record of one physical motor in this process. `label` is its name for people."""

    def __init__(self, label: str, serial: int) -> None:
        self.label: Final = label
        self.order: Final = (label, serial)
        """Transactions of several motors are taken in this order, so that none can deadlock."""
        self.token = 0
        self.run: Run | None = None
        self.interruptions = 0
        """Grows with every stop, quick stop and halt, so that a start in progress notices."""
        self.news: News | None = None
        """Set by a hardware object that counts in it every change of what `_is_done` looks at; the
        hook is then asked only when it has grown. None: it is asked after every event."""
        self._owner: object = None
        self._turns = Turns(label)

    def transaction(self, runtime: Runtime, who: str) -> AbstractContextManager[None]:
        """No other operation on this motor runs inside the block; see `Turns.turn`."""
        return self._turns.turn(runtime, who)

    def take(self, owner: object, motor: str, status: RunStatus) -> None:
        """`owner` may command the motor; `status` is that of the run there is, if any.

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
                raise MotorBusyError(motor=motor, holder=run.name, since_ns=run.since_ns)
        if self._owner is not owner:
            self._owner = owner
            self.token += 1

    def begin(self, run: Run, status: RunStatus) -> None:
        """`run` is what the motor does now; what it did before was interrupted, if not over."""
        self.end(run.name, run.since_ns, status)
        self.run = run

    def end(self, by: str, now_ns: int, status: RunStatus) -> None:
        """Nothing goes on; what went on was interrupted by `by`, if it was not over."""
        run = self.run
        if run is not None:
            if status is RunStatus.DONE and run.ends and run.interrupted_by is None:
                run.finished = True
            run.interrupt(by, now_ns)
            self._count_news()
        self.run = None

    def _count_news(self) -> None:
        if self.news is not None:
            self.news.count += 1


_triggers: Final["weakref.WeakValueDictionary[tuple[Runtime, Hashable], Turns]"] = (
    weakref.WeakValueDictionary()  # each as long as somebody has it or waits for it
)
_registry_lock: Final = threading.Lock()
_registry: Final[dict[Hashable, "weakref.ref[object]"]] = {}
_serial = 0


def trigger_turns(runtime: Runtime, groups: Sequence[Hashable]) -> list[Turns]:
    """Turns for arming and firing by the triggers `groups`, in the order to take them.

    A signal that starts whatever is armed would start another group's motors too early.
    """
    wanted: list[Turns] = []
    with _registry_lock:
        for group in dict.fromkeys(groups):
            turns = _triggers.get((runtime, group))
            if turns is None:
                turns = _triggers[runtime, group] = Turns(f"the trigger {group}")
            wanted.append(turns)
    return sorted(wanted, key=lambda turns: turns.label)


def register_physical_motor(key: Hashable, label: str, hardware: object) -> PhysicalMotor:
    """The record of the physical motor `key`, for the one hardware object that speaks for it.

    Args:
        key: says which physical motor: for a drive on CAN `(*bus_key(bus), node_id)`.
        label: its name for people ("can0 node 3").
        hardware: the hardware object. It is held weakly: dropping it lets go of the motor.

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
        return PhysicalMotor(label, _serial)


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
