"""The wall's time: the one reader of clocks and keeper of threads in this package.

Callbacks (frames heard, `every`) and the `done` of whoever waits run one at a time under one lock,
which is released only while waiting. So what they share needs no lock of its own, and no callback
may wait. Ordinary threads may use it as they like. Threads there are: one per bus somebody listens
to, one for timers while there are any, and one per `spawn`; `close` ends them all.

Time is int ns since the runtime was made, of the monotonic clock.
"""

import atexit
import os
import threading
import time
from collections import deque
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from typing import TYPE_CHECKING, Final, ParamSpec, final

from motorapi.bus_sources import FrameSource, source_of
from motorapi.errors import DeadlineExceeded, LinkError, UsageError
from motorapi.forks import refuse_fork
from motorapi.runtime import FrameListener
from motorapi.wall_timers import Timer, Timers

if TYPE_CHECKING:
    import can

P = ParamSpec("P")

_LOOK_AGAIN_S: Final = 0.01
"""How soon a wait notices what another thread changed outside of any callback."""
_RECEIVE_S: Final = 0.1
"""How soon a listening thread notices that nobody listens any more."""
_CLOSE_S: Final = 5.0


class _Closed(BaseException):
    """The runtime was closed; a party that still waits ends here."""


@final
class _Listener:
    def __init__(self, link: "_BusLink", on_frame: FrameListener) -> None:
        self._link = link
        self.on_frame = on_frame

    def cancel(self) -> None:
        """It hears nothing any more; cancelling again does nothing."""
        self._link.remove(self)


@final
class WallParty:
    """A further thread of the application.

    Attributes:
        name: as given to `spawn`.
        error: what the function raised, once it has ended; else None.
    """

    def __init__(self, name: str, runtime: "WallRuntime") -> None:
        self.name = name
        self.error: BaseException | None = None
        self.joined = False
        self.thread: threading.Thread | None = None
        self.finished = False
        self._runtime = runtime

    def join(self, timeout_s: float | None = None) -> bool:
        """Whether it has ended within `timeout_s` [s]; what it raised is in `error`."""
        self.joined = True
        return self._runtime.wait_until(lambda: self.finished, timeout_s)


@final
class _BusLink:
    """One bus that is listened to: its source of frames, its listeners, its thread."""

    def __init__(self, bus: "can.BusABC", runtime: "WallRuntime") -> None:
        self.bus = bus
        self.listeners: list[_Listener] = []
        self.sending = threading.Lock()
        self.source: FrameSource = source_of(bus)
        self._runtime = runtime
        self.thread = threading.Thread(
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
        self._start_ns = time.monotonic_ns()
        self._changed = threading.Condition(threading.RLock())
        self._callback_thread: int | None = None
        self._pending: deque[tuple[_BusLink, bytes, int, bool]] = deque()
        self._failures: list[BaseException] = []
        self._links: list[_BusLink] = []
        self._threads: list[threading.Thread] = []  # of links, also of those just ending
        self._parties: list[WallParty] = []
        self._timers = Timers(self.now_ns, self._run_timer)
        self._waiting = 0
        self._closed = False
        self.is_the_parents = False  # of the process that this one was forked from

    # --- Runtime ---------------------------------------------------------------------------

    def now_ns(self) -> int:
        """The time [ns] since the runtime was made."""
        return time.monotonic_ns() - self._start_ns

    def wait_until(self, done: Callable[[], bool], timeout_s: float | None = None) -> bool:
        """Whether `done()` became true within `timeout_s` [s]; it runs under the lock.

        Raises:
            UsageError: inside a callback, or the runtime was closed.
            LinkError: a bus that is listened to broke meanwhile.
            Exception: whatever a callback raised meanwhile, or since anybody waited last.
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

    def wake(self) -> None:
        """Whoever waits looks at once; for what has changed outside of any callback."""
        with self._changed:
            self._changed.notify_all()

    def every(self, period_s: float, action: Callable[[], None]) -> Timer:
        """`action` runs at start + k * `period_s` [s]; one that is late skips what it missed."""
        if not 1e-9 <= period_s <= 1e9:
            raise UsageError(f"period_s = {period_s}: must be 1e-9 to 1e9 s")
        self._check_open()
        return self._timers.add(round(period_s * 1e9), action)

    def spawn(self, name: str, function: Callable[[], None]) -> WallParty:
        """`function` runs in a thread of its own, and may wait."""
        self._check_open()
        party = WallParty(name, self)
        party.thread = threading.Thread(
            target=self._run_party, args=(party, function), name=f"party {name}", daemon=True
        )
        self._parties.append(party)
        party.thread.start()
        return party

    def listen(self, bus: "can.BusABC", on_frame: FrameListener) -> _Listener:
        """`on_frame` is told every frame on `bus`, own ones when they were transmitted.

        From then on the runtime reads the bus: nobody else can `recv` from this bus object.

        Raises:
            UsageError: somebody else reads this bus object (a can.Notifier), or it has a runtime
                of its own.
            LinkError: the bus is closed.
        """
        with self._changed:
            self._check_open()
            if getattr(bus, "runtime", None) is not None:
                raise UsageError(f"{bus.channel_info} has a runtime of its own: runtime_of(bus)")
            link = self._link_of(bus)
            if link is None:
                link = _BusLink(bus, self)
                link.source.open()
                self._links.append(link)
                self._threads = [thread for thread in self._threads if thread.is_alive()]
                self._threads.append(link.thread)
                link.thread.start()
            listener = _Listener(link, on_frame)
            link.listeners.append(listener)
            return listener

    def send(self, bus: "can.BusABC", frame: bytes) -> None:
        """The can_frame (16 bytes) is queued on `bus`; `listen` tells when it was transmitted.

        Raises:
            LinkError: the bus does not take it.
        """
        refuse_fork(self.is_the_parents)
        link = self._link_of(bus)
        if link is None:
            source_of(bus).send(frame)
            return
        with link.sending:  # frames are reported in the order in which they were sent
            link.source.send(frame)
            if not link.source.reports_own:
                self._pending.append((link, frame, self.now_ns(), True))
        if not link.source.reports_own:
            self._deliver_pending()

    def close(self) -> None:
        """No thread is left; parties that still wait have ended. Closing again does nothing.

        Raises:
            DeadlineExceeded: a thread does not end (a party that neither waits nor returns).
            Exception: what a callback or a party raised, if nobody waited or joined for it.
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
        if self._callback_thread == threading.get_ident():
            raise UsageError(
                "waiting inside a callback: nothing is heard until the callback returns; "
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
        raise UsageError("this runtime was closed; make a new one")

    def _run_alone(self, action: Callable[[], bool]) -> bool:
        """What `action` returns, with the lock held and waiting refused; then what it sent."""
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
        """`action` has run; what it raised is for whoever waits next. With the lock held."""
        if self._closed:
            return  # nobody is there any more to be told
        outer = self._callback_thread
        self._callback_thread = threading.get_ident()
        try:
            action(*args, **kwargs)
        except Exception as error:
            self._failures.append(error)
        finally:
            self._callback_thread = outer

    def _deliver_pending(self) -> None:
        """All frames heard or transmitted so far were told, in order; inside a callback: later."""
        if self._callback_thread == threading.get_ident():
            return  # whoever runs this callback does it afterwards
        with self._changed:
            while self._pending:
                link, frame, time_ns, transmitted = self._pending.popleft()
                for listener in tuple(link.listeners):
                    self._run_callback(listener.on_frame, frame, time_ns, transmitted)
            self._changed.notify_all()

    # --- threads -----------------------------------------------------------------------------

    def _link_of(self, bus: "can.BusABC") -> _BusLink | None:
        for link in self._links:
            if link.bus is bus:
                return link
        return None

    def run_link(self, link: _BusLink) -> None:
        """The thread of one bus: reads until nobody listens any more."""
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
        with suppress(OSError, ValueError):  # the bus may be closed by now
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
        except BaseException as error:  # it is the joiner's, or close()'s, to raise
            party.error = error
        finally:
            with self._changed:
                party.finished = True
                self._changed.notify_all()


_process_lock: Final = threading.Lock()
_process: list[WallRuntime] = []


def process_runtime() -> WallRuntime:
    """The one runtime that all real buses of this process share; closed when the process ends."""
    with _process_lock:
        if not _process:
            _process.append(WallRuntime())
        return _process[0]


def close_process_runtime() -> None:
    """The shared runtime, if there is one, is closed; the next use makes a new one."""
    with _process_lock:
        runtimes, _process[:] = list(_process), []
    for runtime in runtimes:
        runtime.close()


def _in_child() -> None:
    while _process:
        _process.pop().is_the_parents = True  # its threads live there


atexit.register(close_process_runtime)
os.register_at_fork(after_in_child=_in_child)
