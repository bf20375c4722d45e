"""Who produces the SYNC of a bus: one seat for all links and processes on it."""

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
_EQUAL_NS: Final = 300_000  # what a host's jitter makes of the period of a fast one
_PURPOSE: Final = re.compile(r"SYNC every ([0-9.]+) ms")


@final
@dataclass(frozen=True, slots=True)
class CyclicSync:
    """A SYNC that runs on a bus: its period [ns], who produces it, and whether that one is ours."""

    period_ns: int
    who: str
    is_ours: bool

    def has_period(self, period_ns: int) -> bool:
        """Whether this is its period, as far as one can hear."""
        if self.is_ours:
            return self.period_ns == period_ns
        return abs(self.period_ns - period_ns) <= max(_EQUAL * period_ns, _EQUAL_NS)

    def __str__(self) -> str:
        return f"SYNC runs every {self.period_ns / 1e6:g} ms, produced by {self.who}"


@final
class ProducerSeat:
    """Who produces the SYNC of one bus: one link, of one process. Costs no more than a look."""

    def __init__(self, lock: ProcessLock | None) -> None:
        self._lock = lock
        self.is_alone: Final = lock is None  # no other process is on the bus
        self._holder: object = None
        self._period_ns = 0
        self._hold: Hold | None = None

    def take(self, runtime: Runtime, who: object, period_ns: int) -> None:
        """It is the seat of `who`, who has the bus's turn; who has it may take it again.

        It is taken over from a process that is paused, and so produces nothing.

        Raises:
            MotorBusyError: another process has it.
        """
        lock = self._lock
        if lock is not None and self._hold is None:
            purpose = f"SYNC every {period_ns / 1e6:g} ms"
            holder = lock.look().holder
            paused = holder is not None and holder.is_paused
            self._hold = lock.acquire(runtime, purpose, 0.0, self, take_over=paused)
        self._holder, self._period_ns = who, period_ns

    def give(self, who: object) -> None:
        """It is nobody's, if it was that one's."""
        if self._holder is who:
            self._holder = None
            hold, self._hold = self._hold, None
            if hold is not None:
                hold.release()

    def begin(self) -> bool:
        """Whether it still is this process's, until `end`: nobody takes it over meanwhile."""
        hold = self._hold
        if hold is None:
            return True
        try:
            hold.begin_write("")
        except MotorBusyError:
            return False
        return True

    def end(self) -> None:
        """What was begun is over."""
        if self._hold is not None:
            self._hold.end_write()

    def evict_paused(self, runtime: Runtime) -> None:
        """A paused process has it no more: it would go on in the middle of what others arm."""
        lock = self._lock
        if lock is None or self._hold is not None:
            return
        holder = lock.look().holder
        if holder is not None and holder.is_paused:
            lock.acquire(runtime, "ended, for it was paused", 0.0, self, take_over=True).release()

    def is_of(self, who: object) -> bool:
        """Whether that one has it."""
        return self._holder is who

    def look(self) -> CyclicSync | None:
        """Who has it now; None: nobody, or a process that is paused."""
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
    """What all links of this process on one physical bus share."""

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
    """The one of the bus that the link is on, whatever path leads there."""
    where = bus_name(link.bus) if can_share_time(link.runtime) else None
    key: Hashable = bus_key(link.bus) if where is None else where
    bus = _buses.get(key)
    if bus is None:
        bus = _buses[key] = SharedBus(link.name, where)
    return bus


def median_ns(times_ns: tuple[int, ...]) -> int:
    """The middle one of the steps between two times [ns], of several in order."""
    return _middle(_steps(times_ns))


def regular_ns(times_ns: tuple[int, ...]) -> int:
    """As `median_ns` [ns]; 0 if they do not come regularly, but for those that waited."""
    steps = _steps(times_ns)
    middle_ns = _middle(steps)
    return middle_ns if steps[0] >= middle_ns // 2 and steps[-1] <= middle_ns * 3 // 2 else 0


def _steps(times_ns: tuple[int, ...]) -> list[int]:
    return sorted(later - earlier for earlier, later in pairwise(times_ns))


def _middle(steps: list[int]) -> int:
    return steps[len(steps) // 2]
