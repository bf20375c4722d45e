"""Runtime of an application: the only source of time and threads.

Efficient waiting for events of several motors.

Conditions are evaluated after every event of a rig, so they must be fast. A motor whose changes are
counted is examined only after a change.
"""

from collections.abc import Callable
from typing import TYPE_CHECKING, Final, Protocol, final

from motorhil.motorapi.errors import MotorError, PluginError

if TYPE_CHECKING:
    import can

FrameListener = Callable[[bytes, int, bool], None]
"""(frame, time_ns, transmitted): a Linux can_frame of 16 bytes or a canfd_frame of 72 bytes, the
time when it was complete on the bus, and True if this bus object sent it, so that it is known to
have been on the wire. Error messages of the CAN controller of the bus arrive here too, as frames
with ERR_FLAG in their identifier; `motorhil.motorapi.runtime.can_sources` decodes them. They are
not bus traffic.
"""


class Registration(Protocol):
    """An activity that continues until it is cancelled."""

    def cancel(self) -> None:
        """End the activity; cancelling again does nothing."""


class Party(Protocol):
    """A further thread of execution of the application."""

    name: str
    error: BaseException | None

    def join(self, timeout_s: float | None = None) -> bool:
        """Wait for its end. Return True if it ended within `timeout_s` [s] (None: no timeout)."""


class Runtime(Protocol):
    """Time, waiting and bus access for ordinary blocking code. Times are int ns, timeouts s."""

    def now_ns(self) -> int:
        """Return the time [ns]."""

    def wait_until(self, done: Callable[[], bool], timeout_s: float | None = None) -> bool:
        """Wait until `done()` is true; only waits let time pass. Return False on timeout.

        Raises:
            UsageError: called inside a callback, or in a thread unknown to the runtime.
        """

    def is_in_callback(self) -> bool:
        """Return True inside a callback or a condition of a wait, where waiting is refused."""

    def every(self, period_s: float, action: Callable[[], None]) -> Registration:
        """Run `action` every `period_s` [s], first after one period; it must not wait."""

    def spawn(self, name: str, function: Callable[[], None]) -> Party:
        """Run `function` as a further party of the application, which may wait."""

    def listen(
        self, bus: "can.BusABC", on_frame: FrameListener, *, fd: bool = False
    ) -> Registration:
        """Call `on_frame` for every frame on `bus`, for own frames after their transmission.

        CAN FD frames arrive with fd=True only.

        Raises:
            UsageError: fd=True, and the bus object was opened for classical CAN.
        """

    def send(self, bus: "can.BusABC", frame: bytes) -> None:
        """Queue a can_frame or canfd_frame on `bus`; `listen` reports its transmission.

        Raises:
            LinkError: the bus does not accept the frame.
            UsageError: a canfd_frame, and the bus object was opened for classical CAN.
        """


def wait_until(runtime: Runtime, done: Callable[[], bool], timeout_s: float | None = None) -> bool:
    """Wait as `runtime.wait_until`; convert exceptions of callbacks to PluginError.

    Raises:
        MotorError: `done`, or the runtime, raised it.
        PluginError: a callback raised another exception; names its place.
    """
    try:
        return runtime.wait_until(done, timeout_s)
    except MotorError:
        raise
    except Exception as error:
        plugin, where = "a callback", "during a wait"
        place = error.__traceback__
        while place is not None and place.tb_next is not None:
            place = place.tb_next
        if place is not None:
            code = place.tb_frame.f_code
            plugin, where = code.co_qualname, f"{code.co_filename}:{place.tb_lineno}"
        failed = PluginError(plugin=plugin, where=where, problem=repr(error))
        failed.__cause__ = error  # mypyc ignores "from"
        raise failed from error


LOOK_PERIOD_S: Final = 0.01
"""The check period [s] where no event reports a change: motors without a change counter, for
callbacks; the end of low-level access.
"""


@final
class ChangeCounter:
    """A counter of changes in the knowledge of a physical motor. The source of a change counts it.

    Attributes:
        count: compared by waiters. An increment is sufficient if no motion can have ended.
        listeners: called by `grow`; they check for the end of a motion.
    """

    def __init__(self) -> None:
        self.count: int = 0
        self.listeners: list[Callable[[], None]] = []

    def grow(self) -> None:
        """Count a complete change that may have ended a motion, and call the listeners."""
        self.count += 1
        if self.listeners:
            for listener in self.listeners.copy():
                listener()


@final
class Awaited:
    """An awaited event; `is_over` checks for it, and may raise."""

    def __init__(self, news: ChangeCounter | None, is_over: Callable[[], bool]) -> None:
        self.counts: bool = news is not None
        self.news: ChangeCounter = ChangeCounter() if news is None else news
        self.seen: int = -1  # last count seen; unchanged without a counter
        self.is_over = is_over

    def looks_over(self) -> bool:
        """Return True if the event has happened, as of the latest change."""
        if self.counts:
            if self.news.count == self.seen:
                return False
            self.seen = self.news.count
        return self.is_over()


@final
class Waiting:
    """Several awaited events; `going` contains those still to come."""

    def __init__(self, awaited: list[Awaited]) -> None:
        self.going: list[Awaited] = awaited

    def all_over(self) -> bool:
        """Return True if all events have happened; past ones are not checked again."""
        for one in self.going:
            if one.news.count != one.seen:
                self.going = [other for other in self.going if not other.looks_over()]
                return not self.going
        return not self.going
