"""One host on one line: one exchange after another.

Exchanges take place in the order of the requests, but a request that starts motions goes before
those that wait. The protocol's `Codec` encodes and decodes; the runtime provides time, silence and
deadlines. No request is sent twice: a request whose answer was lost may have been executed. A
caller that cannot wait (a stop from inside a callback) *posts* its request. The request is sent as
soon as the line is silent, before all others.

A line that has ended or fails to send is opened anew before the next request; no request is sent
again on it. On a serial line that is the device, unplugged and plugged in again.

On a serial line, all bytes received since a request must be its answer, complete and with its check
sum. A late answer looks like the answer to the next request. So after a request without an answer
in time the line is in *quarantine*. The next request waits until the late answer has arrived
completely (it is dropped), or a time limit has passed. Posted requests do not wait for that, and
do not end it: the late answer may still follow the answer to the posted request. The same time
limit holds after the death of another process within an exchange, whose answer may be on its way.

On TCP the transaction identifier distinguishes answers. So half of a late answer does no harm. A
connection that ends within an answer or is silent for 2 s has ended as well.

A line may never be silent, or another process may hold it. The wait for such a line is limited: a
caller gets an error, and a posted request is sent anyway.
"""

from abc import ABC, abstractmethod
from collections import deque
from collections.abc import Callable
from contextlib import ExitStack, suppress
from dataclasses import dataclass
from typing import TYPE_CHECKING, ClassVar, Final, Generic, Protocol, TypeVar, final

from motorhil.motorapi.errors import (
    DeadlineExceeded,
    LinkError,
    MotorBusyError,
    MotorError,
    PeerError,
)
from motorhil.motorapi.locking.process_lock import can_share_time
from motorhil.motorapi.runtime.api import Registration, Runtime
from motorhil.motorapi.synchronization.offer import Firing

if TYPE_CHECKING:
    from motorhil.motorapi.locking.process_lock import LockHandle, ProcessLock
    from motorhil.motorapi.ownership.fencing import Owned

RequestT = TypeVar("RequestT")
AnswerT = TypeVar("AnswerT")

_SILENT_NS: Final = 2_000_000_000  # since an unanswered request: the TCP connection is broken
_LOCKED_NS: Final = 1_000_000
_AT_ONCE_S: Final = 1e-9
_PATIENCE_NS: Final = 2_000_000_000  # for the line, of a waiting caller
_URGENT_NS: Final = 100_000_000  # for silence, of a posted request


@final
class LineProtocolViolation(PeerError):  # noqa: N818 -- what happened
    """The received bytes are not an answer to the request.

    Attributes: line, unit, problem (in words), heard (the bytes).
    """

    def __init__(self, *, line: str, unit: int, problem: str, heard: bytes) -> None:
        self.line = line
        self.unit = unit
        self.problem = problem
        self.heard = heard
        shown = heard[:24].hex(" ").upper() + (" ..." if len(heard) > 24 else "")
        super().__init__(f"{line} unit {unit}: {problem} ({shown})")


def is_silence(error: Exception) -> bool:
    """Return whether the error means that a device does not answer, directly or by a gateway."""
    return isinstance(error, DeadlineExceeded) or getattr(error, "is_silence", False)


@final
@dataclass(slots=True, eq=False)
class Exchange(Generic[RequestT, AnswerT]):
    """A request and, once it is over, its answer or its error.

    Attributes:
        owned: must be ours when the request is sent.
        has_answer: False for a request that is not answered: it is over once it is sent.
        starts: True for a request that starts motions.
        on_over: called with the exchange when it is over; None: nothing follows.
        sent_ns: the time of sending.
    """

    request: RequestT
    unit: int
    timeout_s: float
    owned: "tuple[Owned, ...]" = ()
    has_answer: bool = True
    starts: bool = False
    on_over: "Callable[[Exchange[RequestT, AnswerT]], None] | None" = None
    transaction: int = 0
    asked_ns: int = 0
    sent_ns: int = 0
    is_posted: bool = False
    answer: AnswerT | None = None
    error: MotorError | None = None
    is_over: bool = False

    def end(self, answer: AnswerT | None, error: MotorError | None) -> None:
        """End it with an answer or an error."""
        self.answer, self.error, self.is_over = answer, error, True
        if self.on_over is not None:
            self.on_over(self)


class Codec(Protocol[RequestT, AnswerT]):
    """The protocol of a line: requests to bytes, bytes to answers.

    Attributes: heard (the bytes since the request); is_inside (the end of an answer is to come).
    """

    @property
    def heard(self) -> bytes:
        """The bytes since the request, except answers to others."""

    @property
    def is_inside(self) -> bool:
        """True if the end of an answer is still to come, and silence does not end it."""

    def begin(self) -> None:
        """Forget received bytes, as a request is sent."""

    def encode(self, exchange: Exchange[RequestT, AnswerT]) -> bytes:
        """Return the bytes of a request."""

    def feed(self, data: bytes, exchange: Exchange[RequestT, AnswerT] | None) -> AnswerT | None:
        """Return the answer of the addressed unit that `data` completes, if any."""

    def answers(self, answer: AnswerT, request: RequestT) -> bool:
        """Return whether it may answer this very request."""

    def refusal(self, exchange: Exchange[RequestT, AnswerT], answer: AnswerT) -> MotorError | None:
        """Return the error that an answer reports, or None."""

    def awaited(self, request: RequestT) -> str:
        """Return the words for the answer to a request."""


class ByteLine(Protocol):
    """A serial line or a TCP connection, as bytes.

    A line may have a method `reconnect`, which opens it anew within a second. It raises LinkError
    if that fails, or if the application has closed the line.
    """

    @property
    def name(self) -> str:
        """The name in messages."""

    @property
    def framing(self) -> str:
        """The framing of requests: "rtu", "tcp" or "serial" (by the protocol)."""

    @property
    def silence_ns(self) -> int:
        """t3.5 [ns]; 0 on TCP."""

    @property
    def is_closed(self) -> bool:
        """True if either end has closed the line."""

    def duration_ns(self, characters: int) -> int:
        """Return the duration of this number of characters on the line [ns]; 0 on TCP."""

    def send(self, data: bytes) -> None:
        """Send these bytes now; raises LinkError if the line does not accept them."""

    def listen(self, on_data: Callable[[bytes, int], None]) -> Registration:
        """Call `on_data(bytes, time_ns)` for received bytes; b"": the connection has ended."""


class ExchangeLine(ABC, Generic[RequestT, AnswerT]):
    """The host's end of one line, shared by its units.

    Attributes:
        strays: the number of answers that matched no request.
        reconnections: the number of connections made in place of broken ones.
        users: the number of hardware objects that use the line.
        timeout_max_s: the longest response timeout of its units [s].
        started_ns: the end of the last request on the line that started a motion, by unit [ns].
        HAS_SILENCES: whether the protocol separates its frames by silences of the line.
        QUARANTINE_NS: maximum duration of a quarantine.
    """

    HAS_SILENCES: ClassVar[bool] = True
    QUARANTINE_NS: ClassVar[int] = 500_000_000

    def __init__(self, line: ByteLine, runtime: Runtime, lock: "ProcessLock | None") -> None:
        self.line: Final = line
        self.runtime: Final = runtime
        self.name: Final = line.name
        self.strays: int = 0
        self.reconnections: int = 0
        self.users = 0
        self.timeout_max_s: float = 0.0
        self.started_ns: Final[dict[int, int]] = {}
        self._lock = lock
        self._hold: LockHandle | None = None
        self._is_tcp: Final = line.framing == "tcp"
        self._reader = self._codec()
        self._reconnect: Final = getattr(line, "reconnect", None)
        self._is_broken = False
        self._unanswered_ns = -1  # time of a request since which nothing was heard, on TCP
        self._queue: deque[Exchange[RequestT, AnswerT]] = deque()
        self._active: Exchange[RequestT, AnswerT] | None = None
        self._transaction = 0
        self._idle_ns = 0  # end of the last exchange, with its quarantine
        self._silent_ns = 0  # end of the required silence
        self._ours_ns = 0  # end of the silence after the use by another program
        self._left_ns = 0  # end of the quarantine after the death of another program
        self._owed: list[Exchange[RequestT, AnswerT]] = []  # their late answers may still come ...
        self._owed_until_ns = 0  # ... until then
        self._timer: Registration | None = None
        self._registration = line.listen(self._hear)
        if lock is not None:
            self._set_reading(False)

    @property
    def bytes_max(self) -> int:
        """The length of the longest request or answer."""
        return 256  # of Modbus RTU

    @abstractmethod
    def _codec(self) -> Codec[RequestT, AnswerT]:
        """Return a new codec of the protocol."""

    # ---- requests ----

    def ask(
        self,
        request: RequestT,
        unit: int,
        timeout_s: float,
        *owned: "Owned",
        starts: bool = False,
    ) -> AnswerT:
        """Send a request and return its answer; with `owned`, only while all of them are owned.

        A request that `starts` a motion goes before all waiting ones, except stops.

        Raises:
            MotorBusyError: it is not owned; nothing was sent.
            PeerError: the device refused the request (by the protocol's own class).
            DeadlineExceeded: no answer came in time; the request may have been executed.
            LineProtocolViolation: the received bytes are not an answer; likewise.
            LinkError: the line is closed.
        """
        exchange: Exchange[RequestT, AnswerT] = Exchange(
            request, unit, timeout_s, owned, starts=starts
        )
        self._wait_for(exchange)
        assert exchange.answer is not None
        return exchange.answer

    def tell(self, request: RequestT, unit: int, *owned: "Owned", starts: bool = False) -> None:
        """Send a request that is not answered, and return when it was transmitted.

        Raises: as `ask`.
        """
        exchange: Exchange[RequestT, AnswerT] = Exchange(
            request, unit, 0.0, owned, has_answer=False, starts=starts
        )
        self._wait_for(exchange)

    def start_bound(self, *, has_answer: bool) -> tuple[Firing | None, str]:
        """Return the longest duration of one request that starts motions, or the reason for none.

        It waits for the exchange on the line, which may end in a quarantine, but for no other one.
        A stop goes first, and is not counted. A drive that answers may execute the request until
        its answer is complete.
        """
        if can_share_time(self.runtime):
            return None, "on the wall clock the delays of this program have no bound"
        if self._is_tcp:
            return None, "a connection that has ended is opened anew before the start"
        line_ns, silence_ns = self.line.duration_ns(self.bytes_max), self.line.silence_ns
        waits_s = (2 * line_ns + silence_ns + self.QUARANTINE_NS + 1) / 1e9 + self.timeout_max_s
        executes_s = self.timeout_max_s if has_answer else 0.0
        return Firing(idle_s=waits_s + line_ns / 1e9 + executes_s, idle_after_s=executes_s), ""

    def _wait_for(self, exchange: Exchange[RequestT, AnswerT]) -> None:
        """Queue an exchange and wait for its end; raise its error."""
        exchange.asked_ns = self.runtime.now_ns()
        is_asked = False

        def is_over() -> bool:  # one condition is evaluated at a time, outside of callbacks
            nonlocal is_asked
            if not is_asked:
                is_asked = True
                self._enqueue(exchange)
                self._go_on()
            return exchange.is_over

        try:
            self.runtime.wait_until(is_over)
        except BaseException:
            with suppress(ValueError):  # it may have been sent already
                self._queue.remove(exchange)
            raise
        if exchange.error is not None:
            raise exchange.error

    def post(
        self,
        request: RequestT,
        unit: int,
        timeout_s: float,
        on_over: "Callable[[Exchange[RequestT, AnswerT]], None] | None" = None,
        *,
        urgent: bool = True,
    ) -> Exchange[RequestT, AnswerT]:
        """Queue a request without waiting, before all waiting ones if it is urgent.

        Callbacks may call it.
        """
        exchange: Exchange[RequestT, AnswerT] = Exchange(request, unit, timeout_s, on_over=on_over)
        exchange.asked_ns, exchange.is_posted = self.runtime.now_ns(), urgent
        if urgent:
            self._queue.appendleft(exchange)
        else:
            self._queue.append(exchange)
        self._once(_AT_ONCE_S, self._go_on)
        return exchange

    def close(self) -> None:
        """Close the line; waiting callers get an error."""
        self._registration.cancel()
        self._end_timer()
        closed = LinkError(link=self.name, reason="this line was closed")
        for exchange in (self._active, *self._queue):
            if exchange is not None:
                exchange.end(None, closed)
        self._queue.clear()
        self._active = None
        self._unlock()

    # ---- queue ----

    def _enqueue(self, exchange: Exchange[RequestT, AnswerT]) -> None:
        place = len(self._queue)
        if exchange.starts:
            goes_first = (n for n, one in enumerate(self._queue) if not one.is_posted)
            place = next(goes_first, place)
        self._queue.insert(place, exchange)

    def _go_on(self) -> None:
        """Send the next request, as soon as permitted."""
        if self._active is not None or not self._queue:
            return
        if self._is_broken and self._reconnect is not None:
            try:
                self._connect_anew(self._reconnect)
            except LinkError as error:
                self._fail_all(error)
                return
        if self.line.is_closed:
            self._fail_all(LinkError(link=self.name, reason="the connection has ended"))
            return
        wait_ns = self._wait_ns(self._queue[0])
        if wait_ns > 0:
            self._set_timer(wait_ns / 1e9, self._go_on)
            return
        exchange = self._active = self._queue.popleft()
        if not exchange.is_posted or self._owed_until_ns <= self.runtime.now_ns():
            self._owed.clear()
        self._reader.begin()
        self._transaction = exchange.transaction = self._transaction % 0xFFFF + 1
        adu = self._reader.encode(exchange)
        exchange.sent_ns = self.runtime.now_ns()
        try:
            self._send(exchange, adu)
        except MotorError as error:
            self._is_broken = isinstance(error, LinkError)
            self._end(exchange, None, error)
            return
        except Exception as error:  # any other failure of the line also ends the exchange
            self._end(exchange, None, LinkError(link=self.name, reason=f"cannot send: {error}"))
            return
        on_line_ns = self.line.duration_ns(len(adu))
        on_line_s = on_line_ns / 1e9
        if exchange.starts:
            self.started_ns[exchange.unit] = exchange.sent_ns + on_line_ns
        if exchange.has_answer:
            self._set_timer(on_line_s + exchange.timeout_s, self._too_late)
        else:
            self._set_timer(on_line_s, lambda: self._end(exchange, None, None))

    def _connect_anew(self, reconnect: Callable[[], None]) -> None:
        """Replace the broken connection; raises LinkError."""
        reconnect()
        self._registration.cancel()
        self._registration = self.line.listen(self._hear)
        self._reader = self._codec()
        self._is_broken, self._unanswered_ns = False, -1
        self.reconnections += 1

    def _send(self, exchange: Exchange[RequestT, AnswerT], adu: bytes) -> None:
        with ExitStack() as written:
            for owned in exchange.owned:
                owned.begin_write(f"{self.name} unit {exchange.unit}")
                written.callback(owned.end_write)
            self.line.send(adu)

    def _wait_ns(self, exchange: Exchange[RequestT, AnswerT]) -> int:
        """Return the time to wait, at least [ns]; end the exchange if it waited too long."""
        now_ns = self.runtime.now_ns()
        since_ns = max(exchange.asked_ns, self._idle_ns)
        silent_ns = self._silent_ns
        if exchange.is_posted:
            silent_ns = min(silent_ns, since_ns + _URGENT_NS)
        elif self._owed:
            silent_ns = max(silent_ns, self._owed_until_ns)
        if silent_ns <= now_ns and self._take_lock():
            until_ns = self._ours_ns if exchange.is_posted else max(self._ours_ns, self._left_ns)
            return max(0, until_ns - now_ns)
        if now_ns - since_ns < _PATIENCE_NS:
            return silent_ns - now_ns if silent_ns > now_ns else _LOCKED_NS
        if exchange.is_posted:
            return 0
        self._queue.remove(exchange)
        why = "it is never silent" if silent_ns > now_ns else "another process holds it"
        error = DeadlineExceeded(
            awaited=f"{self.name}: its turn", timeout_s=_PATIENCE_NS / 1e9, last_heard=why
        )
        exchange.end(None, error)
        return 1

    def _take_lock(self) -> bool:
        """Take the lock between processes; return False if another process holds it."""
        if self._lock is None or self._hold is not None:
            return True
        try:
            self._hold = self._lock.acquire(self.runtime, "an exchange on the line", 0.0, self)
        except MotorBusyError:
            return False
        if self._hold.changed_hands and self.HAS_SILENCES:  # another program has used the line
            self._ours_ns = self.runtime.now_ns() + self.line.silence_ns
        if self._hold.was_abandoned and not self._is_tcp:
            self._left_ns = self.runtime.now_ns() + self.QUARANTINE_NS
        self._set_reading(True)
        return True

    def _unlock(self) -> None:
        hold, self._hold = self._hold, None
        if hold is not None:
            self._set_reading(False)
            hold.release()

    def _set_reading(self, reads: bool) -> None:
        """Enable reading only during our own exchanges, on a line shared by processes."""
        set_reading = getattr(self.line, "set_reading", None)
        if set_reading is not None:
            set_reading(reads)

    def _set_timer(self, time_s: float, action: Callable[[], None]) -> None:
        self._end_timer()

        def over() -> None:
            self._timer = None
            action()

        self._timer = self._once(time_s, over)

    def _once(self, time_s: float, action: Callable[[], None]) -> Registration:
        """Run `action` once, as a callback, while no other callback and no request runs."""
        is_over, timers = False, list[Registration]()  # still empty if the timer expires at once

        def over() -> None:
            nonlocal is_over
            for timer in timers:
                timer.cancel()
            if not is_over:
                is_over = True
                action()

        timers.append(self.runtime.every(max(time_s, _AT_ONCE_S), over))
        return timers[0]

    def _end_timer(self) -> None:
        timer, self._timer = self._timer, None
        if timer is not None:
            timer.cancel()

    # ---- answers ----

    def _hear(self, data: bytes, time_ns: int) -> None:
        if not data:
            self._is_broken = True
            self._fail_all(LinkError(link=self.name, reason="the connection has ended"))
            return
        self._silent_ns = time_ns + (self.line.silence_ns if self.HAS_SILENCES else 0)
        self._unanswered_ns = -1
        exchange = self._active
        owed = self._owed[0] if len(self._owed) == 1 else None  # of several, their order is unknown
        answer = self._reader.feed(data, exchange or owed)
        if exchange is None:
            self.strays += 1
            if answer is not None:  # the late answer: nothing else can come
                self._leave_quarantine()
        elif answer is not None and self._reader.answers(answer, exchange.request):
            self._end(exchange, answer, None)
        elif owed is not None and self._reader.feed(b"", owed) is not None:
            self.strays += 1  # the late answer, before that to the posted request
            self._owed.clear()
            self._reader.begin()

    def _too_late(self) -> None:
        exchange = self._active
        if exchange is None:
            return
        heard, unit = self._reader.heard, exchange.unit
        error: MotorError
        if heard:
            problem = "the received bytes are not an answer to the request"
            error = LineProtocolViolation(line=self.name, unit=unit, problem=problem, heard=heard)
        else:
            error = DeadlineExceeded(
                awaited=f"{self.name} unit {unit}: {self._reader.awaited(exchange.request)}",
                timeout_s=exchange.timeout_s,
                last_heard="nothing",
            )
        if self._is_tcp:
            now_ns = self.runtime.now_ns()
            if self._unanswered_ns < 0 and not heard:
                self._unanswered_ns = now_ns - round(exchange.timeout_s * 1e9)
            is_silent = 0 <= self._unanswered_ns <= now_ns - _SILENT_NS
            self._is_broken = is_silent or self._reader.is_inside
        else:
            self._owed.append(exchange)
            self._owed_until_ns = self.runtime.now_ns() + self.QUARANTINE_NS
        self._end(exchange, None, error)

    def _end(
        self,
        exchange: Exchange[RequestT, AnswerT],
        answer: AnswerT | None,
        error: MotorError | None,
    ) -> None:
        self._active = None
        now_ns = self.runtime.now_ns()
        self._idle_ns = self._owed_until_ns if self._owed else now_ns
        self._end_timer()
        if answer is not None:
            error = self._reader.refusal(exchange, answer)
        exchange.end(answer, error)
        if not self._owed:
            self._unlock()
        elif not self._queue:
            self._set_timer((self._owed_until_ns - now_ns) / 1e9, self._leave_quarantine)
        self._go_on()

    def _leave_quarantine(self) -> None:
        self._owed.clear()
        self._end_timer()
        self._unlock()
        self._go_on()

    def _fail_all(self, error: MotorError) -> None:
        waiting = [exchange for exchange in (self._active, *self._queue) if exchange is not None]
        self._queue.clear()
        self._active = None
        self._end_timer()
        self._unlock()
        for exchange in waiting:
            exchange.end(None, error)


if TYPE_CHECKING:  # mypy checks that these classes implement ByteLine
    from motorhil.motorapi.runtime.byte_streams import SerialLine, TcpLine

    _ON_THE_WALL: tuple[type[ByteLine], ...] = (SerialLine, TcpLine)
