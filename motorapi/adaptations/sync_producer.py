"""The role of SYNC producer on a bus, among links and processes."""

import re
import weakref
from collections.abc import Hashable
from dataclasses import dataclass
from itertools import pairwise
from typing import TYPE_CHECKING, Final, final

from motorapi.adaptations.armed_marks import ArmedMarks
from motorapi.errors import MotorBusyError
from motorapi.lock_names import bus_name
from motorapi.process_lock import Hold, ProcessLock, can_share_time
from motorapi.runtime import Runtime
from motorapi.sharing import bus_key
from motorapi.turns import Turns

if TYPE_CHECKING:
    from motorapi.adaptations.canopen_link import CanopenLink

_EQUAL: Final = 0.1
_EQUAL_NS: Final = 300_000  # jitter of a host, for short periods
_PURPOSE: Final = re.compile(r"SYNC every ([0-9.]+) ms")


@final
@dataclass(frozen=True, slots=True)
class CyclicSync:
    """A SYNC that runs on a bus: its period [ns], its producer, and whether it is one of ours."""

    period_ns: int
    who: str
    is_ours: bool

    def has_period(self, period_ns: int) -> bool:
        """Return whether this is its period, within the accuracy of listening."""
        if self.is_ours:
            return self.period_ns == period_ns
        return abs(self.period_ns - period_ns) <= max(_EQUAL * period_ns, _EQUAL_NS)

    def __str__(self) -> str:
        return f"SYNC runs every {self.period_ns / 1e6:g} ms, produced by {self.who}"


@final
class ProducerSeat:
    """The role of SYNC producer on one bus, held by one link of one process.

    Reading it is cheap.
    """

    def __init__(self, lock: ProcessLock | None) -> None:
        self._lock = lock
        self.is_alone: Final = lock is None  # no other process is on the bus
        self._holder: object = None
        self._period_ns = 0
        self._hold: Hold | None = None

    def take(self, runtime: Runtime, who: object, period_ns: int) -> None:
        """Take the seat for `who`, which has the bus's turn; its holder may take it again.

        The seat is taken over from a process that is paused, and so produces nothing.

        Raises:
            MotorBusyError: another process holds it.
        """
        lock = self._lock
        if lock is not None and self._hold is None:
            purpose = f"SYNC every {period_ns / 1e6:g} ms"
            holder = lock.look().holder
            paused = holder is not None and holder.is_paused
            self._hold = lock.acquire(runtime, purpose, 0.0, self, take_over=paused)
        self._holder, self._period_ns = who, period_ns

    def give(self, who: object) -> None:
        """Release the SYNC producer role if `who` holds it."""
        if self._holder is who:
            self._holder = None
            hold, self._hold = self._hold, None
            if hold is not None:
                hold.release()

    def begin(self) -> bool:
        """Return whether this process still holds the seat, and keep it until `end`."""
        hold = self._hold
        if hold is None:
            return True
        try:
            hold.begin_write("")
        except MotorBusyError:
            return False
        return True

    def end(self) -> None:
        """End the period that `begin` began."""
        if self._hold is not None:
            self._hold.end_write()

    def evict_paused(self, runtime: Runtime) -> None:
        """Evict a paused process, which could resume while others arm."""
        lock = self._lock
        if lock is None or self._hold is not None:
            return
        holder = lock.look().holder
        if holder is not None and holder.is_paused:
            lock.acquire(runtime, "eviction of paused process", 0.0, self, take_over=True).release()

    def is_of(self, who: object) -> bool:
        """Return whether `who` holds the seat."""
        return self._holder is who

    def look(self) -> CyclicSync | None:
        """Return the SYNC of the holder; None: there is none, or its process is paused."""
        if self._holder is not None:
            return CyclicSync(self._period_ns, "this program", True)
        holder = None if self._lock is None else self._lock.look().holder
        if holder is None or holder.is_paused:
            return None
        said = None if holder.record is None else _PURPOSE.match(holder.record.purpose)
        period_ns = 0 if said is None else round(float(said[1]) * 1e6)
        return CyclicSync(period_ns, holder.who, True)


@final
class SharedBus:
    """The state that all links of this process share for one physical bus."""

    def __init__(self, name: str, where: str | None) -> None:
        lock: ProcessLock | None = None
        seat_lock: ProcessLock | None = None
        if where is not None:
            lock = ProcessLock(f"{where}-sync", f"SYNC of {name}")
            seat_lock = ProcessLock(f"{where}-sync-producer", f"the SYNC producer of {name}")
        self.turns: Final = Turns(f"SYNC of {name}", lock)
        self.seat: Final = ProducerSeat(seat_lock)
        self.marks: Final = ArmedMarks(where, name)


_buses: Final["weakref.WeakValueDictionary[Hashable, SharedBus]"] = weakref.WeakValueDictionary()


def shared_bus(link: "CanopenLink") -> SharedBus:
    """Return the shared state of the link's bus, independent of the path by which it was opened."""
    where = bus_name(link.bus) if can_share_time(link.runtime) else None
    key: Hashable = bus_key(link.bus) if where is None else where
    bus = _buses.get(key)
    if bus is None:
        bus = _buses[key] = SharedBus(link.name, where)
    return bus


def median_ns(times_ns: tuple[int, ...]) -> int:
    """Return the median step between times in order [ns]."""
    return _middle(_steps(times_ns))


def regular_ns(times_ns: tuple[int, ...]) -> int:
    """Return the median step [ns], or 0 if the steps are not regular within bus delays."""
    steps = _steps(times_ns)
    middle_ns = _middle(steps)
    return middle_ns if steps[0] >= middle_ns // 2 and steps[-1] <= middle_ns * 3 // 2 else 0


def _steps(times_ns: tuple[int, ...]) -> list[int]:
    return sorted(later - earlier for earlier, later in pairwise(times_ns))


def _middle(steps: list[int]) -> int:
    return steps[len(steps) // 2]
