"""Lines that speak Modbus, on the wall: a TCP connection, a serial line.

    line = TcpLine("192.168.1.20")                    # port 502
    line = SerialLine("/dev/ttyUSB0", baud_bit_s=115_200, parity="N")
    motor = LeadshineMotor(LeadshineHwMotor(line, unit=1, runtime=line.wall), model)

What comes is read by a thread of the wall's runtime, as it reads CAN buses. A serial line needs
pyserial (`pip install motorhil[serial]`).

Source: of the silences MODBUS over Serial Line V1.02, section 2.5.1.1.
"""

import select
import socket
import struct
from collections.abc import Callable
from contextlib import suppress
from typing import TYPE_CHECKING, Any, Final, final

from motorapi.errors import LinkError, UsageError
from motorapi.wall_runtime import WallRuntime, process_runtime

if TYPE_CHECKING:
    from motorapi.runtime import Registration

DataListener = Callable[[bytes, int], None]
"""(bytes, time [ns] when they came); b"": the other end has closed."""

_FAST_BIT_S: Final = 19_200
_T35_NS: Final = 1_750_000
_NS: Final = 1_000_000_000
_READ_MAX: Final = 4096
_LOOK_S: Final = 0.001
_SEND_S: Final = 1
"""Nobody waits longer for an end that takes nothing: all that share the runtime would wait."""
_SEND_TIMEOUT: Final = struct.pack("@ll", _SEND_S, 0)  # struct timeval


@final
class TcpLine:
    """A connection to a Modbus/TCP server or gateway.

    Args:
        host: name or address.
        port: 502 is Modbus's own.
        runtime: where applications on it wait; None: the process's own.
        timeout_s: how long to wait for the connection [s].

    Attributes: name, framing ("tcp"), silence_ns (0), is_closed, address.

    Raises:
        LinkError: nobody answers there.
    """

    def __init__(
        self,
        host: str,
        port: int = 502,
        *,
        runtime: WallRuntime | None = None,
        timeout_s: float = 3.0,
    ) -> None:
        self.name: Final = f"{host}:{port}"
        self.framing: Final = "tcp"
        self.silence_ns: Final = 0
        self.address: Final = (host, port)
        self.channel_info: Final = self.name  # what the runtime calls it
        self._wall: Final = process_runtime() if runtime is None else runtime
        self.is_closed = False
        try:
            self._socket = socket.create_connection((host, port), timeout_s)
        except OSError as error:
            reason = f"no connection ({error.strerror or error})"
            raise LinkError(link=self.name, reason=reason) from error
        self._socket.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        self._socket.setblocking(True)
        self._socket.setsockopt(socket.SOL_SOCKET, socket.SO_SNDTIMEO, _SEND_TIMEOUT)

    @property
    def wall(self) -> WallRuntime:
        """Where applications on it wait."""
        return self._wall

    def duration_ns(self, characters: int) -> int:
        """It means nothing here: 0."""
        return 0

    def send(self, data: bytes) -> None:
        """These bytes go out now.

        Raises:
            LinkError: the connection is gone.
        """
        if self.is_closed:
            raise LinkError(link=self.name, reason="the connection is closed")
        self._wall.send(self, data)  # type: ignore[arg-type]  # a bus, as far as it is used there

    def listen(self, on_data: DataListener) -> "Registration":
        """`on_data` hears what comes."""
        return _listen(self._wall, self, on_data)

    def close(self) -> None:
        """Nothing is sent or heard any more; closing again does nothing."""
        self.is_closed = True
        self._socket.close()

    # --- the runtime's side: a source of frames ---------------------------------------------------

    def receive_frame(self, timeout_s: float) -> tuple[bytes, int, bool] | None:
        """(bytes, 0, False) that have come, b"" at the end; None after `timeout_s` [s]."""
        data = b""
        with suppress(OSError, ValueError):  # it was closed here, or is broken
            if not select.select([self._socket], [], [], timeout_s)[0]:
                return None
            data = self._socket.recv(_READ_MAX)
        if not data:
            self.is_closed = True
        return data, 0, False

    def transmit(self, data: bytes) -> None:
        """These bytes are with the system."""
        self._socket.sendall(data)


@final
class SerialLine:
    """A serial line, RS-485 by an adapter that turns round by itself.

    Args:
        path: of the device.
        baud_bit_s, parity ("E", "O", "N"), stop_bits: as the drives are set.
        runtime: where applications on it wait; None: the process's own.

    Attributes: name, framing ("rtu"), silence_ns (t3.5), is_closed, path.

    Raises:
        LinkError: there is no such device, or it cannot be opened.
        UsageError: a setting is wrong, or pyserial is not there.
    """

    def __init__(
        self,
        path: str,
        *,
        baud_bit_s: int = 19_200,
        parity: str = "E",
        stop_bits: int = 1,
        runtime: WallRuntime | None = None,
    ) -> None:
        if parity not in ("E", "O", "N") or stop_bits not in (1, 2) or not baud_bit_s >= 300:
            settings = f"{baud_bit_s} bit/s, parity {parity!r}, {stop_bits} stop bits"
            raise UsageError(f"{path}: {settings}: no such line")
        bits = 9 + (parity != "N") + stop_bits
        slow_ns = 35 * bits * _NS // (10 * baud_bit_s)
        self.name: Final = path
        self.framing: Final = "rtu"
        self.silence_ns: Final = _T35_NS if baud_bit_s > _FAST_BIT_S else slow_ns
        self.path: Final = path
        self.channel_info: Final = path
        self._character_ns: Final = bits * _NS // baud_bit_s
        self._wall: Final = process_runtime() if runtime is None else runtime
        self.is_closed = False
        self._reads = True
        self._port: Any = _opened(path, baud_bit_s, parity, stop_bits)  # Any: pyserial's own

    @property
    def wall(self) -> WallRuntime:
        """Where applications on it wait."""
        return self._wall

    def duration_ns(self, characters: int) -> int:
        """How long so many characters are on the line [ns]."""
        return characters * self._character_ns

    def send(self, data: bytes) -> None:
        """These characters go on the line now.

        Raises:
            LinkError: the line is closed, or gone.
        """
        if self.is_closed:
            raise LinkError(link=self.name, reason="the line is closed")
        self._wall.send(self, data)  # type: ignore[arg-type]  # a bus, as far as it is used there

    def listen(self, on_data: DataListener) -> "Registration":
        """`on_data` hears what comes."""
        return _listen(self._wall, self, on_data)

    def set_reading(self, reads: bool) -> None:
        """Whether what comes is read: of those who have this device open, one gets each byte."""
        self._reads = reads

    def close(self) -> None:
        """Nothing is sent or heard any more; closing again does nothing."""
        self.is_closed = self._reads = True
        self._port.close()

    # --- the runtime's side: a source of frames ---------------------------------------------------

    def receive_frame(self, timeout_s: float) -> tuple[bytes, int, bool] | None:
        """(characters, 0, False) that have come, b"" at the end; None after `timeout_s` [s]."""
        try:
            if not self._reads:
                select.select([], [], [], _LOOK_S)  # until it reads again
                return None
            if not select.select([self._port], [], [], timeout_s)[0] or not self._reads:
                return None  # nothing, or the answer to another process
            data = self._port.read(max(1, self._port.in_waiting))
        except (OSError, ValueError, TypeError):  # it was closed here, or is gone
            self.is_closed = True
            return b"", 0, False
        return (data, 0, False) if data else None

    def transmit(self, data: bytes) -> None:
        """These characters are with the system."""
        self._port.write(data)


def _listen(
    runtime: WallRuntime, line: TcpLine | SerialLine, on_data: DataListener
) -> "Registration":
    """The end of a line is told to who listens to it, and is nobody else's error."""
    registered: list[Registration] = []  # empty yet, if it ends that soon: then it is told again

    def on_frame(data: bytes, time_ns: int, transmitted: bool) -> None:
        if transmitted:
            return
        if not data:
            for registration in registered:
                registration.cancel()
        on_data(data, time_ns)

    registered.append(runtime.listen(line, on_frame))  # type: ignore[arg-type]  # as in `send`
    return registered[0]


def _opened(path: str, baud_bit_s: int, parity: str, stop_bits: int) -> object:
    try:
        import termios

        import serial
    except ImportError:
        raise UsageError(
            f"{path}: a serial line needs pyserial; install it: pip install motorhil[serial]"
        ) from None
    try:
        return serial.Serial(
            path,
            baud_bit_s,
            parity=parity,
            stopbits=stop_bits,
            timeout=0,
            write_timeout=_SEND_S,
            exclusive=False,
        )
    except (
        OSError,
        ValueError,
        OverflowError,
        termios.error,
    ) as error:  # whatever pyserial lets by
        settings = f"{baud_bit_s} bit/s, parity {parity}, {stop_bits} stop bits"
        remedy = "is it plugged in, a serial device that can do this, and yours to open?"
        reason = f"cannot be opened with {settings} ({error}): {remedy}"
        raise LinkError(link=path, reason=reason) from error
