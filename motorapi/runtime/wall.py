"""Wall-clock runtime: the only reader of clocks and owner of threads here.

Callbacks (received frames, `every`) and the `done` conditions of waits run one at a time under one
lock, which is released only during waits. So their shared data need no other lock, and no callback
may wait. Any ordinary thread may use the runtime. There is one thread per bus with listeners, one
for timers if there are any, and one per `spawn`; `close` ends them all. A forked child is refused
the buses and motors of its parent.

Time is int ns since the runtime was created, by the monotonic clock.
"""

import atexit
import os
import threading
import time
from collections import deque
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from heapq import heappop, heappush
from typing import TYPE_CHECKING, Final, ParamSpec, final

from motorhil.motorapi.bus_context import BusContext
from motorhil.motorapi.errors import DeadlineExceeded, LinkError, UsageError
from motorhil.motorapi.runtime.api import FrameListener, Runtime
from motorhil.motorapi.runtime.can_sources import (
    CAN_FRAME_BYTES,
    FrameSource,
    require_fd,
    source_of,
)

if TYPE_CHECKING:
    import can

P = ParamSpec("P")

_LOOK_AGAIN_S: Final = 0.01
"""The delay after which a wait notices changes made by other threads outside of callbacks [s]."""
_RECEIVE_S: Final = 0.1
"""The delay after which a receiving thread notices that it has no listeners [s]."""
_CLOSE_S: Final = 5.0
_TIMERS_LOOK_S: Final = 0.1
"""The delay after which the thread notices that its last timer was cancelled [s]."""


@final
class Timer:
    """An action that repeats until it is cancelled."""

    def __init__(self, period_ns: int, action: Callable[[], None]) -> None:
        self.period_ns = period_ns
        self.action = action
        self.cancelled: bool = False

    def cancel(self) -> None:
        """Cancel the timer; cancelling again does nothing."""
        self.cancelled = True

    def run(self) -> None:
        """Run the action, unless the timer was cancelled at the last moment."""
        if not self.cancelled:
            self.action()


@final
class Timers:
    """All timers of one runtime, in a heap with key (due time, order of creation).

    Args:
        now_ns: the clock.
        run: runs an action as a callback.
    """

    def __init__(
        self, now_ns: Callable[[], int], run: Callable[[Callable[[], None]], None]
    ) -> None:
        self._now_ns = now_ns
        self._run = run
        self._changed = threading.Condition()
        self._heap: list[tuple[int, int, Timer]] = []
        self._asked = 0
        self._thread: threading.Thread | None = None
        self._closed = False

    def add(self, period_ns: int, action: Callable[[], None]) -> Timer:
        """Run `action` every `period_ns` [ns] from now, first after one period."""
        timer = Timer(period_ns, action)
        with self._changed:
            self._push(self._now_ns() + period_ns, timer)
            if self._thread is None:
                self._thread = threading.Thread(
                    target=self._work, name="motorapi timers", daemon=True
                )
                self._thread.start()
            self._changed.notify()
        return timer

    def close(self) -> list[threading.Thread]:
        """Stop all timers. Return the thread that is still to end, if any."""
        with self._changed:
            self._closed = True
            self._changed.notify()
            return [] if self._thread is None else [self._thread]

    def _push(self, due_ns: int, timer: Timer) -> None:
        self._asked += 1
        heappush(self._heap, (due_ns, self._asked, timer))

    def _work(self) -> None:
        timer = self._next()
        while timer is not None:
            self._run(timer.run)
            timer = self._next()

    def _next(self) -> Timer | None:
        """Wait for the next timer that is due and return it; None without timers."""
        with self._changed:
            while True:
                while self._heap and self._heap[0][2].cancelled:
                    heappop(self._heap)
                if self._closed or not self._heap:
                    self._thread = None
                    return None
                due_ns, _, timer = self._heap[0]
                now_ns = self._now_ns()
                if due_ns > now_ns:
                    self._changed.wait(min((due_ns - now_ns) / 1e9, _TIMERS_LOOK_S))
                    continue
                heappop(self._heap)
                missed = (now_ns - due_ns) // timer.period_ns
                self._push(due_ns + (missed + 1) * timer.period_ns, timer)
                return timer


def refuse_fork(is_the_parents: bool) -> None:
    """Raise UsageError if an object to be used belongs to the parent process.

    Both processes would write to its connection, and only the parent reads. Locks of the parent's
    threads may stay locked for ever.
    """
    if is_the_parents:
        raise UsageError(
            "these buses and motors were created in the parent process, which still uses them: "
            "create new ones in this process, or start it with 'spawn'"
        )


class _Closed(BaseException):
    """The end of a party that still waits when the runtime is closed."""


@final
class _Listener:
    def __init__(self, link: "_BusLink", on_frame: FrameListener, fd: bool) -> None:
        self._link = link
        self.takes_any_length: Final = fd or not hasattr(link.bus, "protocol")  # a line of bytes
        self.on_frame = on_frame

    def cancel(self) -> None:
        """Stop the calls of this listener; cancelling again does nothing."""
        self._link.remove(self)


@final
class WallParty:
    """A further thread of the application.

    Attributes:
        name: as given to `spawn`.
        error: the exception of the function, after its end; else None.
    """

    def __init__(self, name: str, runtime: "WallRuntime") -> None:
        self.name = name
        self.error: BaseException | None = None
        self.joined: bool = False
        self.thread: threading.Thread | None = None
        self.finished = False
        self._runtime = runtime

    def join(self, timeout_s: float | None = None) -> bool:
        """Wait for its end. Return False after `timeout_s` [s]. See `error` for its exception."""
        self.joined = True
        return self._runtime.wait_until(lambda: self.finished, timeout_s)


@final
class _BusLink:
    """One bus with listeners: its source of frames, its listeners, its thread."""

    def __init__(self, bus: "can.BusABC", runtime: "WallRuntime") -> None:
        self.bus = bus
        self.listeners: list[_Listener] = []
        self.sending: threading.Lock = threading.Lock()
        self.source: FrameSource = source_of(bus)
        self._runtime = runtime
        self.thread: threading.Thread = threading.Thread(
            target=runtime.run_link,
            args=(self,),
            name=f"listens to {bus.channel_info}",
            daemon=True,
        )

    def remove(self, listener: _Listener) -> None:
        if listener in self.listeners:
            self.listeners.remove(listener)


@final
class WallRuntime:
    """The Runtime of real hardware, and of emulated hardware in other processes."""

    def __init__(self) -> None:
        self.context: Final = BusContext()
        self._start_ns = time.monotonic_ns()
        self._changed = threading.Condition(threading.RLock())
        self._callback_thread: int | None = None
        self._pending: deque[tuple[_BusLink, bytes, int, bool]] = deque()
        self._failures: list[BaseException] = []
        self._links: list[_BusLink] = []
        self._threads: list[threading.Thread] = []  # of links, also of those that are ending
        self._parties: list[WallParty] = []
        self._timers = Timers(self.now_ns, self._run_timer)
        self._waiting = 0
        self._closed = False
        self.is_the_parents = False  # True in a forked child

    # --- Runtime ---------------------------------------------------------------------------

    def now_ns(self) -> int:
        """Return the time [ns] since the runtime was created."""
        return time.monotonic_ns() - self._start_ns

    def wait_until(self, done: Callable[[], bool], timeout_s: float | None = None) -> bool:
        """Wait until `done()` is true; it runs under the lock. Return False after `timeout_s` [s].

        Raises:
            UsageError: inside a callback, or the runtime was closed.
            LinkError: a bus with listeners broke meanwhile.
            Exception: an exception of a callback, during this wait or since the last one.
        """
        if timeout_s is not None and not timeout_s >= 0.0:
            raise UsageError(f"timeout_s = {timeout_s}: must be a number of seconds >= 0")
        refuse_fork(self.is_the_parents)
        self._refuse_in_callback()
        deadline_ns: int | None = None
        if timeout_s is not None:
            deadline_ns = self.now_ns() + round(min(timeout_s, 1e9) * 1e9)
        with self._changed, self._counted():
            while True:
                self._check_open()
                if self._failures:
                    raise self._failures.pop(0)
                if self._run_alone(done):
                    self._changed.notify_all()
                    return True
                pause_s = _LOOK_AGAIN_S
                if deadline_ns is not None:
                    left_ns = deadline_ns - self.now_ns()
                    if left_ns <= 0:
                        return False
                    pause_s = min(pause_s, left_ns / 1e9)
                self._changed.wait(pause_s)

    def is_in_callback(self) -> bool:
        """Return True inside a callback or a condition of a wait, where waiting is refused."""
        return self._callback_thread == threading.get_ident()

    def wake(self) -> None:
        """Make all waits check their conditions, after a change outside of any callback."""
        with self._changed:
            self._changed.notify_all()

    def every(self, period_s: float, action: Callable[[], None]) -> Timer:
        """Run `action` at start + k * `period_s` [s]; a late timer skips the missed runs."""
        if not 1e-9 <= period_s <= 1e9:
            raise UsageError(f"period_s = {period_s}: must be 1e-9 to 1e9 s")
        self._check_open()
        return self._timers.add(round(period_s * 1e9), action)

    def spawn(self, name: str, function: Callable[[], None]) -> WallParty:
        """Run `function` in its own thread, where it may wait."""
        self._check_open()
        party = WallParty(name, self)
        party.thread = threading.Thread(
            target=self._run_party, args=(party, function), name=f"party {name}", daemon=True
        )
        self._parties.append(party)
        party.thread.start()
        return party

    def listen(self, bus: "can.BusABC", on_frame: FrameListener, *, fd: bool = False) -> _Listener:
        """Call `on_frame` for every frame on `bus`, for own frames after their transmission.

        CAN FD frames arrive with fd=True only. From then on the runtime reads the bus: no other
        code can `recv` from this bus object.

        Raises:
            UsageError: other code reads this bus object (a can.Notifier), or it has its own
                runtime; fd=True, and it was opened for classical CAN.
            LinkError: the bus is closed.
        """
        with self._changed:
            self._check_open()
            if getattr(bus, "runtime", None) is not None:
                raise UsageError(f"{bus.channel_info} has its own runtime; use runtime_of(bus)")
            if fd:
                require_fd(bus)
            link = self._link_of(bus)
            if link is None:
                link = _BusLink(bus, self)
                link.source.open()
                self._links.append(link)
                self._threads = [thread for thread in self._threads if thread.is_alive()]
                self._threads.append(link.thread)
                link.thread.start()
            listener = _Listener(link, on_frame, fd)
            link.listeners.append(listener)
            return listener

    def send(self, bus: "can.BusABC", frame: bytes) -> None:
        """Queue the can_frame or canfd_frame on `bus`; `listen` reports its transmission.

        Raises:
            LinkError: the bus does not accept it.
            UsageError: a canfd_frame, and the bus object was opened for classical CAN.
        """
        refuse_fork(self.is_the_parents)
        if len(frame) != CAN_FRAME_BYTES:
            require_fd(bus)
        link = self._link_of(bus)
        if link is None:
            source_of(bus).send(frame)
            return
        with link.sending:  # frames are reported in the order of sending
            link.source.send(frame)
            if not link.source.reports_own:
                self._pending.append((link, frame, self.now_ns(), True))
        if not link.source.reports_own:
            self._deliver_pending()

    def close(self) -> None:
        """End all threads and waiting parties. Closing again does nothing.

        Raises:
            DeadlineExceeded: a thread does not end (a party that neither waits nor returns).
            Exception: an exception of a callback or a party that no wait or join has raised.
        """
        self._refuse_in_callback()
        with self._changed:
            self._closed = True
            self._changed.notify_all()
        threads = list(self._threads)
        threads += [party.thread for party in self._parties if party.thread is not None]
        threads += self._timers.close()
        for thread in threads:
            if thread is threading.current_thread():
                continue
            thread.join(_CLOSE_S)
            if thread.is_alive():
                raise DeadlineExceeded(
                    awaited=f"end of thread {thread.name!r}",
                    timeout_s=_CLOSE_S,
                    last_heard="it neither waits nor returns",
                )
        unseen = self._failures + [
            party.error for party in self._parties if party.error is not None and not party.joined
        ]
        self._failures, self._parties = [], []
        if unseen:
            raise unseen[0]

    # --- callbacks, one at a time ------------------------------------------------------------

    def _refuse_in_callback(self) -> None:
        if self.is_in_callback():
            raise UsageError(
                "waiting inside a callback: no frame is received until the callback returns; "
                "set a flag there and wait for it outside, or start a party with runtime.spawn"
            )

    @contextmanager
    def _counted(self) -> Iterator[None]:
        self._waiting += 1
        try:
            yield
        finally:
            self._waiting -= 1

    def _check_open(self) -> None:
        if not self._closed:
            return
        here = threading.current_thread()
        if any(party.thread is here for party in self._parties):
            raise _Closed
        raise UsageError("this runtime was closed; create a new one")

    def _run_alone(self, action: Callable[[], bool]) -> bool:
        """Run `action` under the lock, with waits refused; then deliver the frames that it sent."""
        outer = self._callback_thread
        self._callback_thread = threading.get_ident()
        try:
            result = action()
        finally:
            self._callback_thread = outer
        if self._pending and outer is None:
            self._deliver_pending()
        return result

    def _run_callback(self, action: Callable[P, None], *args: P.args, **kwargs: P.kwargs) -> None:
        """Run a callback under the lock; the next wait raises its exception."""
        if self._closed:
            return  # no wait would raise its exception
        outer = self._callback_thread
        self._callback_thread = threading.get_ident()
        try:
            action(*args, **kwargs)
        except Exception as error:
            self._failures.append(error)
        finally:
            self._callback_thread = outer

    def _deliver_pending(self) -> None:
        """Report all frames received or transmitted so far, in order; not inside a callback."""
        if self.is_in_callback():
            return  # the caller of this callback delivers them afterwards
        with self._changed:
            while self._pending:
                link, frame, time_ns, transmitted = self._pending.popleft()
                classical = len(frame) == CAN_FRAME_BYTES
                for listener in tuple(link.listeners):
                    if classical or listener.takes_any_length:
                        self._run_callback(listener.on_frame, frame, time_ns, transmitted)
            self._changed.notify_all()

    # --- threads -----------------------------------------------------------------------------

    def _link_of(self, bus: "can.BusABC") -> _BusLink | None:
        for link in self._links:
            if link.bus is bus:
                return link
        return None

    def run_link(self, link: _BusLink) -> None:
        """Read one bus, in its own thread, until it has no listeners."""
        source = link.source
        while True:
            with self._changed:
                if self._closed or not link.listeners:
                    self._links.remove(link)
                    break
            try:
                heard = source.receive(_RECEIVE_S)
            except Exception as error:
                self._link_broke(link, error)
                break
            if heard is not None:
                frame, age_ns, transmitted = heard
                self._pending.append((link, frame, self.now_ns() - age_ns, transmitted))
                self._deliver_pending()
        with suppress(OSError, ValueError):  # the bus may already be closed
            source.close()

    def _link_broke(self, link: _BusLink, error: Exception) -> None:
        with self._changed:
            self._links.remove(link)
            deliberate = getattr(link.bus, "_is_shutdown", False) and not self._waiting
            if link.listeners and not self._closed and not deliberate:
                broken = LinkError(
                    link=str(link.bus.channel_info),
                    reason=f"cannot receive: {error}",
                    since_ns=self.now_ns(),
                )
                broken.__cause__ = error
                self._failures.append(broken)
            link.listeners.clear()
            self._changed.notify_all()

    def _run_timer(self, action: Callable[[], None]) -> None:
        with self._changed:
            self._run_callback(action)
            self._changed.notify_all()
        self._deliver_pending()

    def _run_party(self, party: WallParty, function: Callable[[], None]) -> None:
        try:
            function()
        except _Closed:
            pass
        except BaseException as error:  # raised by join() or close()
            party.error = error
        finally:
            with self._changed:
                party.finished = True
                self._changed.notify_all()


_process_lock: Final = threading.Lock()
_process: list[WallRuntime] = []


def process_runtime() -> WallRuntime:
    """Return the runtime of all real buses of this process; closed at its exit."""
    with _process_lock:
        if not _process:
            _process.append(WallRuntime())
        return _process[0]


def close_process_runtime() -> None:
    """Close the shared runtime, if any; the next use creates a new one."""
    with _process_lock:
        runtimes, _process[:] = list(_process), []
    for runtime in runtimes:
        runtime.close()


def _in_child() -> None:
    while _process:
        _process.pop().is_the_parents = True  # its threads are in the parent process


atexit.register(close_process_runtime)
os.register_at_fork(after_in_child=_in_child)


def runtime_of(bus: "can.BusABC") -> Runtime:
    """Return the runtime of the bus itself if it has one, else that of the wall clock.

    An emulated bus of a rig in this process has that of the rig. All other buses of the process
    share one `WallRuntime`.
    """
    own: Runtime | None = getattr(bus, "runtime", None)
    return process_runtime() if own is None else own
