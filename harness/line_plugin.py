"""An application's end of an emulated line, in virtual time: a `motorapi` ByteLine.

On a serial line every character takes its time, and `listen` hears them as they come; on a
gateway's line (TCP) `send` and `listen` are the two directions of one connection.
"""

from collections.abc import Callable
from typing import TYPE_CHECKING, Final, final

from emulators.line_segment import SerialSegment
from motorapi.errors import LinkError

if TYPE_CHECKING:
    from emulators.line_segment import LineHost
    from emulators.world import World
    from motorapi.runtime import Registration, Runtime

DataListener = Callable[[bytes, int], None]
"""(characters, when the last of them was complete [ns]); b"": the connection has ended."""


@final
class _Subscription:
    """A listener on a line, until cancelled."""

    def __init__(self, listeners: list[DataListener], listener: DataListener) -> None:
        self._listeners = listeners
        self._listener = listener
        listeners.append(listener)

    def cancel(self) -> None:
        """It hears nothing any more."""
        if self._listener in self._listeners:
            self._listeners.remove(self._listener)


@final
class EmulatedLine:
    """One application's port on a line, or connection to a gateway.

    Attributes:
        name: what messages call it.
        framing: "rtu" on a serial line, "tcp" on a gateway's.
        runtime: where its application waits.
        silence_ns: t3.5 [ns]; 0 where silence means nothing.
        is_closed: whether the other end has closed the connection, or this one.
    """

    def __init__(self, world: "World", name: str, runtime: "Runtime") -> None:
        segment = world.line(name)
        self.name: Final = name
        self.runtime: Final = runtime
        serial = segment.line if isinstance(segment, SerialSegment) else None
        self.framing: Final = "tcp" if serial is None else "rtu"
        self.silence_ns: Final = 0 if serial is None else serial.t35_ns
        self.is_closed = False
        self._serial = serial
        self._listeners: list[DataListener] = []
        self._port: LineHost = world.add_line_host(name, "host", self._hear)

    def duration_ns(self, characters: int) -> int:
        """How long so many characters are on the line [ns]; 0 where that means nothing."""
        return 0 if self._serial is None else self._serial.duration_ns(characters)

    def send(self, data: bytes) -> None:
        """These characters go on the line now.

        Raises:
            LinkError: the line is closed.
        """
        if self.is_closed:
            raise LinkError(link=self.name, reason="the connection is closed")
        self._port.send(data)

    def listen(self, on_data: DataListener) -> "Registration":
        """`on_data` hears what others send."""
        return _Subscription(self._listeners, on_data)

    def close(self) -> None:
        """Nothing is sent or heard any more; closing again does nothing."""
        if not self.is_closed:
            self.is_closed = True
            self._port.close()

    def _hear(self, data: bytes, now_ns: int, transmitted: bool) -> None:
        if transmitted:
            return
        if not data:
            self.is_closed = True
        for listener in tuple(self._listeners):
            listener(data, now_ns)


if TYPE_CHECKING:  # it is one, or mypy says why not
    from motorapi.adaptations.modbus_line import ByteLine

    _EMULATED: type[ByteLine] = EmulatedLine
