"""Where an application waits: the only place of this package that time and threads come from."""

from collections.abc import Callable
from typing import TYPE_CHECKING, Protocol

from motorapi.errors import MotorError, PluginError

if TYPE_CHECKING:
    import can

FrameListener = Callable[[bytes, int, bool], None]
"""(frame, time_ns, transmitted): a Linux can_frame of 16 bytes, when it was complete on the bus,
and whether this bus object sent it itself, so that it is now known to have been on the wire.

Error messages of the bus's own CAN controller come here, too, as frames of nobody's: ERR_FLAG is in
their identifier, and `motorapi.bus_status` knows what they mean. They are no traffic."""


class Registration(Protocol):
    """Something that goes on until it is cancelled."""

    def cancel(self) -> None:
        """It has ended; cancelling again does nothing."""


class Party(Protocol):
    """A further line of execution of the application."""

    name: str
    error: BaseException | None

    def join(self, timeout_s: float | None = None) -> bool:
        """Whether it has ended within `timeout_s` [s] (None: as long as it takes)."""


class Runtime(Protocol):
    """Time, waiting and the wire, for ordinary blocking code. Times are int ns, timeouts s."""

    def now_ns(self) -> int:
        """The time [ns]."""

    def wait_until(self, done: Callable[[], bool], timeout_s: float | None = None) -> bool:
        """Whether `done()` became true within `timeout_s` [s]; waiting is what lets time pass.

        Raises:
            UsageError: called from inside a callback, or in a thread the runtime does not know.
        """

    def every(self, period_s: float, action: Callable[[], None]) -> Registration:
        """`action` runs every `period_s` [s], first one period from now; it must not wait."""

    def spawn(self, name: str, function: Callable[[], None]) -> Party:
        """`function` runs as a further party of the application, and may wait."""

    def listen(self, bus: "can.BusABC", on_frame: FrameListener) -> Registration:
        """`on_frame` is told every frame on `bus`, own ones when they were transmitted."""

    def send(self, bus: "can.BusABC", frame: bytes) -> None:
        """A can_frame is queued on `bus`; `listen` tells when it was transmitted."""


def wait_until(runtime: Runtime, done: Callable[[], bool], timeout_s: float | None = None) -> bool:
    """As `runtime.wait_until`; what a callback raised meanwhile is told as that, with its place.

    Raises:
        MotorError: as `done` does, or the runtime.
        PluginError: a callback raised something else.
    """
    try:
        return runtime.wait_until(done, timeout_s)
    except MotorError:
        raise
    except Exception as error:
        plugin, where = "a callback", "while something was waited for"
        place = error.__traceback__
        while place is not None and place.tb_next is not None:
            place = place.tb_next
        if place is not None:
            code = place.tb_frame.f_code
            plugin, where = code.co_qualname, f"{code.co_filename}:{place.tb_lineno}"
        raise PluginError(plugin=plugin, where=where, problem=repr(error)) from error


def runtime_of(bus: "can.BusABC") -> Runtime:
    """Where an application on this bus waits: the bus's own runtime if it has one, else the wall.

    An emulated bus of a rig in this process has the rig's; all other buses of the process share
    one `WallRuntime`.
    """
    own: Runtime | None = getattr(bus, "runtime", None)
    if own is not None:
        return own
    from motorapi.wall_runtime import process_runtime

    return process_runtime()
