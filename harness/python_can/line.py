"""Application's end of an emulated line in virtual time: a `motorapi` ByteLine.

On a serial line every character takes its time, and listeners get characters as they arrive. On a
gateway's line (TCP), `send` and `listen` are the two directions of one connection.
"""

from collections.abc import Callable
from typing import TYPE_CHECKING, Final, Protocol, final

from motorhil.harness.python_can.send_limit import SendLimit
from motorhil.motorapi.errors import LinkError

if TYPE_CHECKING:
    from motorhil.emulators.media.serial_line import SerialLine
    from motorhil.emulators.simulation.endpoints import HostListener
    from motorhil.motorapi.runtime.api import Registration, Runtime

DataListener = Callable[[bytes, int], None]
"""Callback for (characters, time when the last one was complete [ns]); b"" ends the connection."""


class LinePort(Protocol):
    """A port of an application on a line."""

    def send(self, data: bytes, /) -> None:
        """Send these characters."""

    def pending(self) -> int:
        """Return the number of its characters that are not yet sent."""

    def close(self) -> None:
        """Stop deliveries to the application."""


class Lines(Protocol):
    """The lines of a rig: its World in this process, or their like in another one."""

    def serial_line(self, name: str) -> "SerialLine | None":
        """Return the wires of a line, for its times; None on TCP."""

    def add_line_host(self, line: str, name: str, on_data: "HostListener") -> LinePort:
        """Return an application's port on the line; on TCP a connection."""


@final
class _Subscription:
    """A listener on a line, until cancelled."""

    def __init__(self, listeners: list[DataListener], listener: DataListener) -> None:
        self._listeners = listeners
        self._listener = listener
        listeners.append(listener)

    def cancel(self) -> None:
        """Remove the listener."""
        if self._listener in self._listeners:
            self._listeners.remove(self._listener)


@final
class EmulatedLine:
    """One application's port on a line, or connection to a gateway.

    Args:
        world: the lines of the rig.
        name: the line's name.
        runtime: the Runtime in which the application waits.
        shared_at: the socket through which processes share the rig; "": this one has it alone.

    Attributes:
        name: the line's name in messages.
        framing: "rtu" on a Modbus line, "serial" on another serial line, "tcp" on a gateway's.
        runtime: the Runtime in which the application waits.
        silence_ns: t3.5 [ns]; 0 where silence means nothing.
        hub_line: the (socket path, line name) by which processes share it; None: they do not.
        is_closed: True once either end has closed the connection.
    """

    def __init__(self, world: Lines, name: str, runtime: "Runtime", shared_at: str = "") -> None:
        self.name: Final = name
        self.runtime: Final = runtime
        self.hub_line: Final = (shared_at, name) if shared_at else None
        serial = world.serial_line(name)
        framing = "tcp" if serial is None else "rtu" if serial.has_silences else "serial"
        self.framing: Final = framing
        self.silence_ns: Final = 0 if serial is None else serial.t35_ns
        self.is_closed: bool = False
        self._serial = serial
        self._world = world
        self._is_over = False  # closed here
        self._reads = True
        self._listeners: list[DataListener] = []
        self._port: LinePort = world.add_line_host(name, "host", self._receive)
        self._limit = SendLimit(self._port, name, "characters")

    def duration_ns(self, characters: int) -> int:
        """Return the transmission time of this many characters [ns]; 0 on a gateway's line."""
        return 0 if self._serial is None else self._serial.duration_ns(characters)

    def send(self, data: bytes) -> None:
        """Send these characters now.

        Raises:
            LinkError: the line is closed, or too many characters wait already.
        """
        if self.is_closed:
            raise LinkError(link=self.name, reason="the connection is closed")
        self._port.send(data)
        try:
            self._limit.count()
        except ValueError as error:
            raise LinkError(link=self.name, reason=str(error)) from None

    def pending(self) -> int:
        """Return 1 if a message is not yet sent completely, else 0."""
        return min(1, self._port.pending())

    def set_reading(self, reads: bool) -> None:
        """Pass on what comes, or drop it: answers to other programs that share the line."""
        self._reads = reads

    def listen(self, on_data: DataListener) -> "Registration":
        """Call `on_data` with the characters that others send."""
        return _Subscription(self._listeners, on_data)

    def close(self) -> None:
        """Close the connection; closing it again has no effect."""
        self._is_over = True
        if not self.is_closed:
            self.is_closed = True
            self._port.close()

    def reconnect(self) -> None:
        """Open a new connection in place of this one.

        Raises:
            LinkError: the application has closed it.
        """
        if self._is_over:
            raise LinkError(link=self.name, reason="the connection is closed")
        closed = self._port
        self._port = self._world.add_line_host(self.name, "host", self._receive)
        self._limit = SendLimit(self._port, self.name, "characters")
        closed.close()  # only now, so that two connections in a row have two names
        self.is_closed = False

    def _receive(self, data: bytes, now_ns: int, transmitted: bool) -> None:
        if transmitted:
            return
        if not data:
            self.is_closed = True
        elif not self._reads:
            return
        for listener in tuple(self._listeners):
            listener(data, now_ns)


if TYPE_CHECKING:  # lets mypy check that EmulatedLine is a ByteLine
    from motorhil.motorapi.api.line_exchanges import ByteLine

    _EMULATED: type[ByteLine] = EmulatedLine
