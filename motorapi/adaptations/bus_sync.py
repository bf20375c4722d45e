"""SYNC, which belongs to the bus: one producer, and nobody fires what somebody else has armed.

Whatever waits in a drive for the next SYNC is started by it, whoever sends it. So

- from arming to the SYNC that fires it is one turn (`BusSync.turns`), of all groups, threads and
  processes on the bus;
- a cyclic SYNC is begun in such a turn, and has one producer on a bus (`SharedBus.seat`). Who
  wants one of the same period follows what he hears, and goes on with it when the producer ends,
  dies, or is paused; another period is refused, and the producer named. A producer that has lost
  what goes by its SYNC to others sends none;
- while one runs, nobody sends a single SYNC: a group is armed by one burst just after a SYNC
  (`motorapi.adaptations.sync_burst`).

*Producers that know nothing of this* (a PLC, another program) are heard. Who has the turn while
nobody has the seat knows that no SYNC of ours can come: one that does come is a foreign one's. That
is waited for only where there is reason to suspect it: more SYNCs were heard since our last turn
than others, by the number of their turns, can have sent.
"""

from collections import deque
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager, suppress
from typing import TYPE_CHECKING, Final, final

from motorapi.adaptations.sync_producer import CyclicSync, median_ns, regular_ns, shared_bus
from motorapi.errors import LinkError, MotorBusyError, UsageError
from motorapi.runtime import Registration
from motorapi.turns import share_trigger

if TYPE_CHECKING:
    from motorapi.adaptations.canopen_link import CanopenLink, Transmission
    from motorapi.fencing import Fence

Lost = Callable[[LinkError], None]
"""Told, once, that there is no SYNC any more to go on with; called in a callback."""
FenceNow = Callable[[], "Fence | None"]
"""The fence of what goes by SYNC, as it is now; None: nobody can take that over."""
_User = tuple[Callable[[], None], Lost | None, FenceNow | None]

_SLOWEST_NS: Final = 300_000_000  # 60C2h says 255 ms at most; a slower SYNC is not waited for
_JITTER_NS: Final = 20_000_000  # of a host that listens
_KEPT: Final = 8
_OVERDUE: Final = 1.25  # periods: then a follower goes on with it, if its producer has ended
_LATE: Final = 1.5
_GONE: Final = 2.5
_LOST_PERIODS: Final = 10
_LOST_NS: Final = 250_000_000
_STRAYS_MAX: Final = 2  # foreign SYNCs, within so many periods, beside our own
_STRAY_PERIODS: Final = 8
_REGULAR: Final = 5  # SYNCs
_STRANGER: Final = "somebody who is not of ours"
_SYNCS_A_TURN: Final = 2  # one that fires, and one that takes out what was disarmed


@final
class BusSync:
    """SYNC as one link sends, hears and counts it.

    Attributes:
        turns: to arm and fire; to begin a cyclic SYNC.
        marks: of what waits for a SYNC, for other processes.
        count: SYNCs that were on the wire, while anybody waited for one or others sent them.
    """

    def __init__(self, link: "CanopenLink") -> None:
        self._link: Final = link
        self._runtime: Final = link.runtime
        self._bus: Final = shared_bus(link)
        self._frame: Final = link.sync_frame
        self.turns: Final = self._bus.turns
        self.marks: Final = self._bus.marks
        share_trigger(link.runtime, link.name, self.turns)
        self.count = 0
        self._users: list[_User] = []
        self._period_ns: int | None = None
        self._timer: Registration | None = None  # of the producer, or of who watches it
        self._is_producer = False
        self._follows_ours = False
        self._sent: Transmission | None = None
        self._at_next: list[Callable[[int], None]] = []
        self._heard: deque[int] = deque(maxlen=_KEPT)
        self._heard_ns = -_SLOWEST_NS
        self._since_turn = 0  # SYNCs of others since our last turn ...
        self._turn = -1  # ... which had this number; -1: there was none
        self._foreign_ns = 0  # the period of one that is known to be foreign; 0: none is
        self._strays: deque[int] = deque(maxlen=_STRAYS_MAX)

    # --- what runs -------------------------------------------------------------------------

    @property
    def period_ns(self) -> int | None:
        """The period of the cyclic SYNC that somebody here goes by [ns]; None: nobody does."""
        return self._period_ns

    @property
    def is_producer(self) -> bool:
        """Whether it is produced here."""
        return self._is_producer

    def cyclic(self) -> CyclicSync | None:
        """The SYNC that runs on the bus, as far as can be told without waiting; None: none does.

        Also what is only heard so regularly that it may be one.
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
        """The SYNC that is known to run on the bus; None: none is."""
        seated = self._bus.seat.look()
        if seated is not None:
            return seated
        since_ns = self._runtime.now_ns() - self._heard_ns
        if self._foreign_ns and since_ns <= _GONE * self._foreign_ns:
            return CyclicSync(self._foreign_ns, _STRANGER, False)
        self._foreign_ns = 0
        return None

    def find_cyclic(self) -> CyclicSync | None:
        """The SYNC that runs on the bus; None: none does. Whoever calls this has the turn.

        Waits for another SYNC where those that were heard may be a foreign producer's.
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
            self._heard.clear()  # they were those of others' turns
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
            pass  # one interval is not yet a period
        self._foreign_ns = median_ns(tuple(self._heard))
        self._since_turn = 0
        return self.known()

    def clear(self, own: int | None = None) -> bool:
        """Nothing that a process has armed that died begins any more; `own`: our drive, too.

        Whoever has a drive to bring to rest does not wait for a process that is paused in its turn:
        the stop itself then overwrites what waits in that drive.

        Returns:
            Whether it was nobody else's turn.
        """
        if self.turns.is_mine:
            self._clear(own)
            return True
        who = "what a process has armed that died"
        with self.turns.at_once(self._runtime, who) as is_ours:
            if is_ours:
                self._clear(own)
            return is_ours

    def take_out(self) -> bool:
        """Whether what overwrites waits in no drive any more, by a SYNC in a turn of its own."""
        with self.turns.at_once(self._runtime, "what was overwritten") as is_ours:
            if is_ours and self.known() is None:
                self._link.confirmed([self._link.sync()])
            return is_ours

    def _clear(self, own: int | None) -> None:
        self.turns.died = False
        self.marks.clear(self._link, own)

    def _hears_another(self, last_ns: int, within_ns: int) -> bool:
        return self._runtime.wait_until(lambda: self._heard_ns != last_ns, within_ns / 1e9)

    # --- going by it -----------------------------------------------------------------------

    def join(
        self,
        period_s: float,
        action: Callable[[], None],
        lost: Lost | None,
        fence: FenceNow | None = None,
    ) -> None:
        """A cyclic SYNC runs, and `action` just after each was queued, or heard; as in `on_sync`.

        Raises:
            UsageError: SYNC runs with another period on this bus; says who produces it.
            MotorBusyError: somebody arms and fires for too long.
        """
        period_ns = round(period_s * 1e9)
        if self._period_ns is None:
            with self.in_turn(f"SYNC every {period_ns / 1e6:g} ms"):
                if self._period_ns is None:  # no other thread was quicker
                    self._begin(period_ns)
                    self._users.append((action, lost, fence))
                    return
        if self._period_ns != period_ns:
            raise self._other_period(self._period_ns or 0, "", period_ns)
        self._users.append((action, lost, fence))

    def check(self, period_s: float) -> None:
        """Raises UsageError if a SYNC of another period is known to run on the bus."""
        period_ns, known = round(period_s * 1e9), self.known()
        if known is not None and not known.has_period(period_ns):
            who = known.who if self._period_ns is None else ""
            raise self._other_period(known.period_ns, who, period_ns)

    @contextmanager
    def in_turn(self, who: str) -> Iterator[None]:
        """Nobody else arms and fires, or begins a cyclic SYNC, inside the block."""
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
        else:  # this process was paused, and another one goes on with it
            self._give_way()
            return
        for action, _, _ in users:
            action()

    def _send_one(self, users: Sequence["_User"]) -> "Transmission | None":
        """A SYNC, as long as anything that goes by it is still ours; or nothing."""
        fences = [None if fence is None else fence() for _, _, fence in users] or [None]
        for fence in fences:
            with suppress(MotorBusyError):  # taken over: who goes by it finds out at once
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
        """The SYNC that is followed is late: if its producer has ended, we go on with it."""
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

    def bus_off(self, error: LinkError) -> None:
        """The bus is off, and what waited for it is lost."""
        self._sent = None
        self._at_next.clear()
        self._lose(error)
        self._bus.seat.give(self)

    def _lose(self, error: LinkError) -> None:
        """Nobody goes by it any more; all are told why."""
        users, self._users = self._users, []
        self._end()
        self._foreign_ns = 0
        for _, lost, _ in users:
            if lost is not None:
                lost(error)

    def leave(self, action: Callable[[], None]) -> None:
        """`action` runs no more; the SYNC produced here ends with its last user."""
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
            self.at_next(self._leave_seat)  # the last one still waits for the bus, and will fire
        else:
            self._leave_seat(0)

    def _leave_seat(self, time_ns: int) -> None:
        if not self._is_producer:
            self._bus.seat.give(self)

    # --- what passes -----------------------------------------------------------------------

    @property
    def is_awaited(self) -> bool:
        """Whether anybody waits for the next one."""
        return bool(self._at_next)

    def at_next(self, action: Callable[[int], None]) -> None:
        """`action` is told when the next SYNC was on the wire [ns], whoever sends it."""
        self._at_next.append(action)

    def passed(self, time_ns: int) -> None:
        """A SYNC was on the wire."""
        self.count += 1
        actions, self._at_next = self._at_next, []
        for action in actions:
            action(time_ns)

    def hear(self, frame: bytes, time_ns: int) -> None:
        """A SYNC that was not sent on this link was on the wire."""
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
        self.passed(time_ns)

    def _stray(self, time_ns: int) -> None:
        """A SYNC beside our own: some drive takes a set-point too early."""
        strays, period_ns = self._strays, self._period_ns or 0
        strays.append(time_ns)
        near = time_ns - strays[0] <= _STRAY_PERIODS * period_ns
        if len(strays) == _STRAYS_MAX and near:
            reason = f"{_STRANGER} produces SYNC as well; a bus has one SYNC producer"
            self._lose(LinkError(link=self._link.name, reason=reason))

    def close(self) -> None:
        """Nothing is sent or told any more."""
        self._users.clear()
        self._at_next.clear()
        self._end()
        self._bus.seat.give(self)
