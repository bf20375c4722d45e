"""SYNC arbitration between all groups, threads and processes on one bus.

A SYNC starts every set-point that waits in a drive, no matter who sends the SYNC. Therefore:
- the interval from arming to the SYNC that fires it is one turn (`BusSync.turns`), exclusive among
  all groups, threads and processes on the bus;
- a cyclic SYNC is begun in such a turn and has one producer per bus (`SharedBus.seat`). Another
  user of the same period follows the SYNC it hears, and takes over production when the producer
  ends, dies or is paused. A different period is refused, and the error names the producer. A
  producer whose drives were taken over by other programs sends no SYNC;
- while a cyclic SYNC runs, no single SYNC is sent. A group is armed by one burst just after a SYNC
  (class `Burst`).

*Foreign producers* (a PLC, another program) do not take part in this protocol, but they are heard.
While the seat is free, the holder of the turn knows that none of our programs sends SYNC. A SYNC
heard then comes from a foreign producer. The holder waits for one only on suspicion: if more SYNCs
were heard since its last turn than the turns of others can explain.
"""

import re
from collections import deque
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from itertools import pairwise
from typing import TYPE_CHECKING, Final, final

from motorhil.frozen import frozen
from motorhil.motorapi.bus_context import context_of
from motorhil.motorapi.errors import LinkError, MotorBusyError, UsageError
from motorhil.motorapi.locking.directory import LockDirectory, bus_name
from motorhil.motorapi.locking.lock_status import list_locks, look
from motorhil.motorapi.locking.process_lock import LockHandle, ProcessLock, can_share_time
from motorhil.motorapi.ownership.fencing import joint_fence
from motorhil.motorapi.ownership.queue import FifoQueue, share_trigger
from motorhil.motorapi.runtime.api import Registration, Runtime
from motorhil.motorapi.runtime.can_link import CanLink, Transmission, can_frame

if TYPE_CHECKING:
    from motorhil.motorapi.ownership.fencing import Fence

SYNC_ID: Final = 0x080
_OVERWRITTEN: Final = 2  # times: a frame may be lost


WaitingSetPoint = tuple[int, int, bytes]
"""A set-point that waits for SYNC: node-ID, identifier of its RPDO, and data that halt the node."""


@final
class ArmedMarks:
    """The set-points on one bus that wait for a SYNC, as other processes see them.

    A node keeps a set-point that waits for SYNC after the program that sent it has died. The next
    SYNC on the bus, sent for other nodes, would start that set-point. So each waiting set-point is
    marked by a lock between processes, which names the node, the RPDO and the data that halt the
    node. The mark of a process that died stays. The next process that gets the bus's turn learns
    that the previous one died in it. Before it arms anything else, it overwrites the marked
    set-points by their halt, and latches the halt by a SYNC of its own.

    If another process has taken the node since, that process cleared it itself when it found the
    ownership abandoned.

    Args:
        where: the name of the bus between processes, or None if no other process uses it.
        name: the name of the bus in messages.
    """

    def __init__(self, where: str | None, name: str) -> None:
        self._where: Final = where
        self._name: Final = name
        self._locks: dict[tuple[int, int, bytes], ProcessLock] = {}

    def mark(self, runtime: Runtime, waiting: WaitingSetPoint, owner: object) -> LockHandle | None:
        """Mark a set-point as waiting for SYNC, until the mark is released."""
        if self._where is None:
            return None
        lock = self._lock(runtime, waiting)
        return lock.acquire(runtime, "a set-point that waits for SYNC", 0.0, owner)

    def _lock(self, runtime: Runtime, waiting: WaitingSetPoint) -> ProcessLock:
        lock = self._locks.get(waiting)
        if lock is None:
            node_id, can_id, halt = waiting
            name = f"{self._prefix}{node_id}-{can_id:03X}-{halt.hex()}"
            label = f"set-points waiting for SYNC in {self._name} node {node_id}"
            lock = ProcessLock(name, label, runtime=runtime)
            self._locks[waiting] = lock
        return lock

    @property
    def _prefix(self) -> str:
        return f"{self._where}-armed-"

    def release(self, runtime: Runtime, left: Sequence[WaitingSetPoint]) -> None:
        """Remove the marks that dead processes have left for these set-points."""
        for one in left:
            self._lock(runtime, one).acquire(runtime, "clearing the mark", 0.0, self).release()

    def left(self, own: int | None) -> list[WaitingSetPoint]:
        """Return the set-points that dead processes have left waiting, also in our node `own`."""
        return [] if self._where is None else list(self._left(own))

    def _left(self, own: int | None) -> Iterator[WaitingSetPoint]:
        directory = LockDirectory()
        for view in list_locks(directory):
            if not view.name.startswith(self._prefix) or not view.abandoned:
                continue
            node_id, can_id, halt = view.name.removeprefix(self._prefix).split("-")
            drive = look(directory, f"{self._where}-node{node_id}")
            if int(node_id) == own or (drive.abandoned and drive.holder is None):
                yield int(node_id), int(can_id, 16), bytes.fromhex(halt)


_EQUAL: Final = 0.1
_EQUAL_NS: Final = 300_000  # jitter of a host, for short periods
_PURPOSE: Final = re.compile(r"SYNC every ([0-9.]+) ms")


@final
@frozen
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
        self._hold: LockHandle | None = None

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

    def __init__(self, name: str, where: str | None, runtime: Runtime) -> None:
        lock: ProcessLock | None = None
        seat_lock: ProcessLock | None = None
        if where is not None:
            lock = ProcessLock(f"{where}-sync", f"SYNC of {name}", runtime=runtime)
            label = f"the SYNC producer of {name}"
            seat_lock = ProcessLock(f"{where}-sync-producer", label, runtime=runtime)
        self.turns: Final = FifoQueue(f"SYNC of {name}", lock)
        self.seat: Final = ProducerSeat(seat_lock)
        self.marks: Final = ArmedMarks(where, name)
        self.users = 0


def shared_bus(link: CanLink) -> SharedBus:
    """Return the shared state of the link's bus, independent of the path by which it was opened."""
    where = bus_name(link.bus) if can_share_time(link.runtime) else None
    return context_of(link.bus).medium.part(
        SharedBus, lambda: SharedBus(link.name, where, link.runtime)
    )


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


Lost = Callable[[LinkError], None]
"""A callback, called once when the cyclic SYNC is lost."""
FenceNow = Callable[[], "Fence | None"]
"""A callback that returns the current fence of a SYNC user, or None if it cannot be taken over."""
_User = tuple[Callable[[], None], Lost | None, FenceNow | None]

_SLOWEST_NS: Final = 300_000_000  # 60C2h allows 255 ms at most; a slower SYNC is not awaited
_JITTER_NS: Final = 20_000_000  # of a listening host
_KEPT: Final = 8
_OVERDUE: Final = 1.25  # periods; a follower then takes over, if the producer has ended
_LATE: Final = 1.5
_GONE: Final = 2.5
_LOST_PERIODS: Final = 10
_LOST_NS: Final = 250_000_000
_STRAYS_MAX: Final = 2  # foreign SYNCs beside our own, within _STRAY_PERIODS
_STRAY_PERIODS: Final = 8
_REGULAR: Final = 5  # SYNCs
_STRANGER: Final = "a foreign program"
_SYNCS_A_TURN: Final = 2  # one fires; the other clears what was disarmed


@final
class _SyncUse:
    """The use of a cyclic SYNC, until it is cancelled."""

    def __init__(self, sync: "BusSync", action: Callable[[], None]) -> None:
        self._sync = sync
        self._action = action

    def cancel(self) -> None:
        """End the use; further calls do nothing."""
        self._sync.leave(self._action)


@final
class BusSync:
    """SYNC as one link sends, hears and counts it.

    Attributes:
        turns: the exclusive turn for arming and firing, and for beginning a cyclic SYNC.
        marks: the marks of set-points that wait for a SYNC, for other processes.
        count: the number of SYNCs on the wire that were awaited here or sent by other links.
        latching: the node-IDs of drives that may hold a set-point which a SYNC would start.
        lost: whether a drive that was armed here was taken over. A halt of its new owner then waits
            in the drive for a SYNC, and no SYNC is sent before the next arming.
        planned_s: the period [s] of the cyclic SYNC that a user here will run when it is enabled,
            or None.
    """

    def __init__(self, link: CanLink, fences: "Mapping[int, Fence]") -> None:
        self._link: Final = link
        self._runtime: Final = link.runtime
        self._bus: Final = shared_bus(link)
        self._bus.users += 1
        self._frame: Final = can_frame(SYNC_ID, b"")
        self._fences: Final = fences
        self.latching: Final[set[int]] = set()
        self.lost: bool = False
        self.planned_s: float | None = None
        self.turns: Final = self._bus.turns
        self.marks: Final = self._bus.marks
        share_trigger(link.runtime, link.name, self.turns)
        self.count: int = 0
        self._users: list[_User] = []
        self._period_ns: int | None = None
        self._timer: Registration | None = None  # of the producer, or of its follower
        self._is_producer = False
        self._follows_ours = False
        self._sent: Transmission | None = None
        self._at_next: list[Callable[[int], None]] = []
        self._heard: deque[int] = deque(maxlen=_KEPT)
        self._heard_ns = -_SLOWEST_NS
        self._since_turn = 0  # SYNCs of others since our last turn
        self._turn = -1  # number of our last turn; -1: there was none
        self._foreign_ns = 0  # period of a known foreign producer; 0: none is known
        self._strays: deque[int] = deque(maxlen=_STRAYS_MAX)
        link.handle(SYNC_ID, self._hear)  # a SYNC of another producer fires as well as ours
        link.handle_sent(SYNC_ID, self._was_sent)
        link.on_bus_off.append(self._bus_off)

    def send(self) -> Transmission:
        """Queue one SYNC; a caller that armed set-points must await their confirmation first.

        Raises:
            MotorBusyError: another program has taken over a motor that this SYNC would start.
        """
        fences = self._fences
        fence = None
        if fences and self.latching:
            fence = joint_fence([fences[node] for node in sorted(self.latching) if node in fences])
        self.lost = False
        return self._link.send_tracked(self._frame, fence)

    # --- the running SYNC ------------------------------------------------------------------

    @property
    def period_ns(self) -> int | None:
        """The period of the cyclic SYNC that this link uses [ns], or None if it uses none."""
        return self._period_ns

    @property
    def is_producer(self) -> bool:
        """True if this link produces the cyclic SYNC."""
        return self._is_producer

    def cyclic(self) -> CyclicSync | None:
        """Return the SYNC that runs on the bus, without waiting, or None.

        Includes a SYNC that is only suspected because it is heard at regular intervals.
        """
        known = self.known()
        if known is not None or len(self._heard) < _REGULAR:
            return known
        period_ns = regular_ns(tuple(self._heard))
        since_ns = self._runtime.now_ns() - self._heard_ns
        if period_ns and since_ns <= _GONE * period_ns:
            return CyclicSync(period_ns, _STRANGER, False)
        return None

    def known(self) -> CyclicSync | None:
        """Return the SYNC that is known to run on the bus, or None."""
        seated = self._bus.seat.look()
        if seated is not None:
            return seated
        since_ns = self._runtime.now_ns() - self._heard_ns
        if self._foreign_ns and since_ns <= _GONE * self._foreign_ns:
            return CyclicSync(self._foreign_ns, _STRANGER, False)
        self._foreign_ns = 0
        return None

    def find_cyclic(self) -> CyclicSync | None:
        """Return the SYNC that runs on the bus, or None; the caller must have the turn.

        Waits for another SYNC if those heard so far may come from a foreign producer.
        """
        seat = self._bus.seat
        if seat.is_of(self) and not self._is_producer:
            self._runtime.wait_until(lambda: not seat.is_of(self), _SLOWEST_NS / 1e9)
        seat.evict_paused(self._runtime)
        known = self.known()
        if self.turns.died:
            self.clear()
        heard, turn = self._since_turn, self._turn
        self._since_turn, self._turn = 0, self.turns.number
        if known is not None:
            return known
        others = self.turns.number - turn - 1
        if not heard or (turn >= 0 and heard <= others * _SYNCS_A_TURN):
            self._heard.clear()  # sent by others in their turns
            return None
        times = tuple(self._heard)
        last_ns = times[-1]
        step_ns = _SLOWEST_NS if len(times) < 2 else round(_LATE * median_ns(times))
        due_ns = last_ns + min(step_ns, _SLOWEST_NS) + _JITTER_NS
        left_ns = due_ns - self._runtime.now_ns()
        if left_ns <= 0 or not self._hears_another(last_ns, left_ns):
            self._heard.clear()
            return None
        while len(self._heard) < 4 and self._hears_another(self._heard_ns, _SLOWEST_NS):
            pass  # one interval does not make a period
        self._foreign_ns = median_ns(tuple(self._heard))
        self._since_turn = 0
        return self.known()

    def clear(self, own: int | None = None) -> bool:
        """Disarm set-points that dead processes have armed, also in our drive `own`.

        A stop does not wait for a process that is paused in its turn: the stop itself then
        overwrites the set-point that waits in the drive.

        Returns:
            True if no other process had the turn.
        """
        if self.turns.is_mine:
            self._clear(own)
            return True
        who = "clearing set-points of a process that died"
        with self.turns.at_once(self._runtime, who) as is_ours:
            if is_ours:
                self._clear(own)
            return is_ours

    def take_out(self) -> bool:
        """Latch overwritten set-points by a SYNC; return whether we got the turn."""
        with self.turns.at_once(self._runtime, "clearing overwritten set-points") as is_ours:
            if is_ours and self.known() is None:
                self._link.confirmed([self.send()])
            return is_ours

    def _clear(self, own: int | None) -> None:
        self.turns.died = False
        left = self.marks.left(own)
        if not left:
            return
        if self.known() is None:  # A running cyclic SYNC has started them long ago.
            frames = [can_frame(can_id, halt) for _, can_id, halt in left] * _OVERWRITTEN
            self._link.confirmed([self._link.send_tracked(frame) for frame in frames])
            self._link.confirmed([self.send()])
        self.marks.release(self._runtime, left)

    def _hears_another(self, last_ns: int, within_ns: int) -> bool:
        return self._runtime.wait_until(lambda: self._heard_ns != last_ns, within_ns / 1e9)

    # --- using the SYNC --------------------------------------------------------------------

    def join(
        self,
        period_s: float,
        action: Callable[[], None],
        lost: Lost | None = None,
        fence: FenceNow | None = None,
    ) -> Registration:
        """Run a cyclic SYNC, and call `action` just after each is queued or heard.

        SYNC is produced here, unless another program produces one of the same period on this bus.

        Args:
            period_s: the period of SYNC [s].
            action: called once for each SYNC; it must not wait.
            lost: called once when the SYNC is lost; the registration need not be cancelled then.
            fence: returns the current fence of this user. No SYNC is sent while every user has lost
                its motors.

        Raises:
            UsageError: SYNC runs with another period on this bus; names its producer.
            MotorBusyError: another user arms and fires for too long.
        """
        period_ns = round(period_s * 1e9)
        if self._period_ns is None:
            with self.in_turn(f"SYNC every {period_ns / 1e6:g} ms"):
                if self._period_ns is None:  # unless another thread was quicker
                    self._begin(period_ns)
                    self._users.append((action, lost, fence))
                    return _SyncUse(self, action)
        if self._period_ns != period_ns:
            raise self._other_period(self._period_ns or 0, "", period_ns)
        self._users.append((action, lost, fence))
        return _SyncUse(self, action)

    def check(self, period_s: float) -> None:
        """Raise UsageError if a SYNC of another period is known to run on the bus."""
        period_ns, known = round(period_s * 1e9), self.known()
        if known is not None and not known.has_period(period_ns):
            who = known.who if self._period_ns is None else ""
            raise self._other_period(known.period_ns, who, period_ns)

    @contextmanager
    def in_turn(self, who: str) -> Iterator[None]:
        """Hold the turn inside the block: no other user arms, fires or begins a cyclic SYNC."""
        if self.turns.is_mine:
            yield
            return
        with self.turns.turn(self._runtime, who):
            yield

    def _begin(self, period_ns: int) -> None:
        known = self.find_cyclic()
        if known is None:
            self._produce(period_ns)
        elif known.has_period(period_ns):
            self._follow(period_ns, known.is_ours)
        else:
            raise self._other_period(known.period_ns, known.who, period_ns)
        self._period_ns = period_ns

    def _other_period(self, there_ns: int, who: str, period_ns: int) -> UsageError:
        produced = f", produced by {who}" if who else ""
        return UsageError(
            f"{self._link.name}: SYNC runs every {there_ns / 1e6:g} ms already{produced}, so not"
            f" every {period_ns / 1e6:g} ms; all drives of a bus share one SYNC"
        )

    def _produce(self, period_ns: int) -> None:
        self._bus.seat.take(self._runtime, self, period_ns)
        self._is_producer = True
        self._strays.clear()
        self._timer = self._runtime.every(period_ns / 1e9, self._produce_one)

    def _produce_one(self) -> None:
        seat, users = self._bus.seat, tuple(self._users)
        if seat.is_alone:
            self._sent = self._link.send_tracked(self._frame)
        elif seat.begin():
            try:
                self._sent = self._send_one(users)
            finally:
                seat.end()
        else:  # This process was paused, and another one has taken over.
            self._give_way()
            return
        for action, _, _ in users:
            action()

    def _send_one(self, users: Sequence["_User"]) -> "Transmission | None":
        """Send a SYNC if at least one of its users still owns its drive; otherwise send nothing."""
        fences = [None if fence is None else fence() for _, _, fence in users] or [None]
        for fence in fences:
            with suppress(MotorBusyError):  # taken over: the user of this SYNC finds out itself
                return self._link.send_tracked(self._frame, fence)
        return None

    def _give_way(self) -> None:
        period_ns = self._period_ns or 0
        self._is_producer = False
        self._bus.seat.give(self)
        self._follow(period_ns, True)

    def _follow(self, period_ns: int, is_ours: bool) -> None:
        self._follows_ours = is_ours
        self._heard_ns = max(self._heard_ns, self._runtime.now_ns() - period_ns)
        self._watch(period_ns)

    def _watch(self, period_ns: int) -> None:
        if self._timer is not None:
            self._timer.cancel()
        self._timer = self._runtime.every(_OVERDUE * period_ns / 1e9, self._overdue)

    def _overdue(self) -> None:
        """Take over production of an overdue SYNC, if its producer has ended."""
        period_ns, timer = self._period_ns, self._timer
        if period_ns is None or timer is None:
            return
        if self._follows_ours and self._bus.seat.look() is None:
            with self.turns.at_once(self._runtime, f"SYNC of {self._link.name}") as is_ours:
                if is_ours and self._bus.seat.look() is None:
                    timer.cancel()
                    self._produce(period_ns)
                    self._produce_one()
                    return
        silent_ns = self._runtime.now_ns() - self._heard_ns
        if silent_ns > max(_LOST_PERIODS * period_ns, _LOST_NS):
            known = self._bus.seat.look()
            who = _STRANGER if known is None else known.who
            reason = f"no SYNC came for {silent_ns / 1e6:.0f} ms; it was produced by {who}"
            self._lose(LinkError(link=self._link.name, reason=reason))

    def _bus_off(self) -> None:
        """Drop everything that waited for SYNC, because the bus is off."""
        self._sent = None
        self._at_next.clear()
        self._lose(self._link.status.failure())
        self._bus.seat.give(self)

    def _lose(self, error: LinkError) -> None:
        """Remove all users of the cyclic SYNC, and report the error to each."""
        users, self._users = self._users, []
        self._end()
        self._foreign_ns = 0
        for _, lost, _ in users:
            if lost is not None:
                lost(error)

    def leave(self, action: Callable[[], None]) -> None:
        """Remove the user `action`; the SYNC produced here ends with its last user."""
        self._users = [one for one in self._users if one[0] != action]
        if not self._users:
            self._end()

    def _end(self) -> None:
        if self._timer is not None:
            self._timer.cancel()
            self._timer = None
        self._period_ns = None
        if not self._is_producer:
            return
        self._is_producer = False
        sent, self._sent = self._sent, None
        if sent is not None and sent.time_ns is None and self._link.confirms:
            self.at_next(self._leave_seat)  # The last SYNC still waits for the bus, and will fire.
        else:
            self._leave_seat(0)

    def _leave_seat(self, time_ns: int) -> None:
        if not self._is_producer:
            self._bus.seat.give(self)

    # --- SYNCs on the wire -----------------------------------------------------------------

    def at_next(self, action: Callable[[int], None]) -> None:
        """Call `action` with the time [ns] of the next SYNC on the wire, from any producer."""
        self._at_next.append(action)

    def _was_sent(self, frame: bytes, time_ns: int) -> None:
        if self._at_next:
            self._passed(time_ns)

    def _passed(self, time_ns: int) -> None:
        """Report a SYNC on the wire to the waiting callbacks."""
        self.count += 1
        actions, self._at_next = self._at_next, []
        for action in actions:
            action(time_ns)

    def _hear(self, frame: bytes, time_ns: int) -> None:
        """Handle a SYNC on the wire that was not sent on this link."""
        self._heard.append(time_ns)
        self._heard_ns = time_ns
        self._since_turn += 1
        period_ns = self._period_ns
        if self._is_producer:
            self._stray(time_ns)
        elif period_ns is not None:
            self._watch(period_ns)
            for action, _, _ in tuple(self._users):
                action()
        self._passed(time_ns)

    def _stray(self, time_ns: int) -> None:
        """Handle a SYNC beside our own, which makes a drive take a set-point too early."""
        strays, period_ns = self._strays, self._period_ns or 0
        strays.append(time_ns)
        near = time_ns - strays[0] <= _STRAY_PERIODS * period_ns
        if len(strays) == _STRAYS_MAX and near:
            reason = f"{_STRANGER} produces SYNC as well; a bus has one SYNC producer"
            self._lose(LinkError(link=self._link.name, reason=reason))

    def close(self) -> None:
        """Stop sending, and drop all callbacks."""
        self._users.clear()
        self._at_next.clear()
        self._end()
        self._bus.seat.give(self)
        self._bus.users -= 1
        if self._bus.users == 0:
            context_of(self._link.bus).medium.drop(self._bus)
