"""Byte lines for Modbus on the wall clock: a TCP connection or a serial line.

    line = TcpLine("192.168.1.20")                    # port 502
    line = SerialLine("/dev/ttyUSB0", baud_bit_s=115_200, parity="N")
    motor = LeadshineMotor(LeadshineHwMotor(line, unit=1, runtime=line.wall), model)

A thread of the wall runtime reads received bytes, as it reads CAN buses. A serial line needs
pyserial (`pip install motorhil[serial]`).

Source: for the silent intervals MODBUS over Serial Line V1.02, section 2.5.1.1.
"""

import select
import socket
import struct
import time
from abc import ABC, abstractmethod
from collections.abc import Callable
from typing import TYPE_CHECKING, Any, Final, final

from motorhil.motorapi.errors import LinkError, UsageError
from motorhil.motorapi.runtime.wall import WallRuntime, process_runtime

if TYPE_CHECKING:
    from motorhil.motorapi.runtime.api import Registration

DataListener = Callable[[bytes, int], None]
"""(bytes, time of arrival [ns]); b"": the other end has closed the connection."""

_FAST_BIT_S: Final = 19_200
_T35_NS: Final = 1_750_000
_NS: Final = 1_000_000_000
_READ_MAX: Final = 4096
_LOOK_S: Final = 0.001
_SEND_S: Final = 1
"""The maximum time to send [s]: a longer wait would delay all users of the runtime."""
_SEND_TIMEOUT: Final = struct.pack("@ll", _SEND_S, 0)  # struct timeval


class _Line(ABC):
    """A line whose end can be opened anew: what a TCP connection and a serial line share."""

    def __init__(self, name: str, runtime: WallRuntime | None) -> None:
        self.name: Final = name
        self.channel_info: Final = name  # its name in messages of the runtime
        self.is_closed: bool = False  # by either end
        self._wall: Final = process_runtime() if runtime is None else runtime
        self._is_over = False  # by this one
        self._failed_s: float | None = None
        self._end: Any = None  # Any: a socket, or an object of pyserial

    @abstractmethod
    def _opened(self, timeout_s: float) -> object:
        """Return a new end of the line; raises LinkError."""

    def reconnect(self) -> None:
        """Open the line anew, within 1 s; at most one attempt per second.

        Raises:
            LinkError: the host does not answer, the device cannot be opened, or the application has
                closed the line.
        """
        now_s = time.monotonic()
        if self._is_over:
            raise LinkError(link=self.name, reason="the connection is closed")
        if self._failed_s is not None and now_s < self._failed_s + _SEND_S:
            raise LinkError(link=self.name, reason="no connection; the last attempt has failed")
        before = self._end
        self._failed_s = now_s
        self._end = self._opened(_SEND_S)
        self._failed_s, self.is_closed = None, False
        before.close()

    @property
    def wall(self) -> WallRuntime:
        """The runtime in which applications wait for this line."""
        return self._wall

    def send(self, data: bytes) -> None:
        """Send the bytes now.

        Raises:
            LinkError: the line is closed, or gone.
        """
        if self.is_closed:
            raise LinkError(link=self.name, reason="the connection is closed")
        self._wall.send(self, data)  # type: ignore[arg-type]  # a bus, as far as it is used there

    def listen(self, on_data: DataListener) -> "Registration":
        """Call `on_data` with the bytes received from now on."""
        return _listen(self._wall, self, on_data)

    def close(self) -> None:
        """Close the line; closing again does nothing."""
        self.is_closed = self._is_over = True
        self._end.close()

    # --- the frame source for the runtime
    # --------------------------------------------------------------

    def receive_frame(self, timeout_s: float) -> tuple[bytes, int, bool] | None:
        """Return (received bytes, 0, False), b"" at the end; None after `timeout_s` [s]."""
        end = self._end
        try:
            data = self._received(end, timeout_s)
        except (OSError, ValueError, TypeError):  # closed here, broken or unplugged
            data = b""
        if data is None or end is not self._end:
            return None  # nothing, or of an end that was replaced
        if not data:
            self.is_closed = True
        return data, 0, False

    @abstractmethod
    def _received(self, end: Any, timeout_s: float) -> bytes | None:
        """Return received bytes, b"" at the end; None after `timeout_s` [s]."""

    @abstractmethod
    def transmit(self, data: bytes) -> None:
        """Pass the bytes to the operating system."""


@final
class TcpLine(_Line):
    """A connection to a Modbus/TCP server or gateway.

    Args:
        host: name or address.
        port: 502 is the Modbus port.
        runtime: the runtime in which applications wait; None: that of the process.
        timeout_s: timeout of the connection attempt [s].

    Attributes: name, framing ("tcp"), silence_ns (0), is_closed, address.

    Raises:
        LinkError: the host does not answer.
    """

    def __init__(
        self,
        host: str,
        port: int = 502,
        *,
        runtime: WallRuntime | None = None,
        timeout_s: float = 3.0,
    ) -> None:
        super().__init__(f"{host}:{port}", runtime)
        self.framing: Final = "tcp"
        self.silence_ns: Final = 0
        self.address: Final = (host, port)
        self._end = self._opened(timeout_s)

    def _opened(self, timeout_s: float) -> socket.socket:
        try:
            connection = socket.create_connection(self.address, timeout_s)
        except OSError as error:
            reason = f"no connection ({error.strerror or error})"
            raise LinkError(link=self.name, reason=reason) from error
        connection.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        connection.setblocking(True)
        connection.setsockopt(socket.SOL_SOCKET, socket.SO_SNDTIMEO, _SEND_TIMEOUT)
        return connection

    def duration_ns(self, characters: int) -> int:
        """Return 0: TCP has no character time."""
        return 0

    def _received(self, end: Any, timeout_s: float) -> bytes | None:
        if not select.select([end], [], [], timeout_s)[0]:
            return None
        data: bytes = end.recv(_READ_MAX)
        return data

    def transmit(self, data: bytes) -> None:
        """Pass the bytes to the operating system."""
        self._end.sendall(data)


@final
class SerialLine(_Line):
    """A serial line, e.g. RS-485 with an adapter that switches direction by itself.

    Args:
        path: path of the device; below /dev/serial/by-id it is the same after plugging in again.
        baud_bit_s, parity ("E", "O", "N"), stop_bits: as set in the drives.
        runtime: the runtime in which applications wait; None: that of the process.

    Attributes: name, framing ("rtu"), silence_ns (t3.5), is_closed, path.

    Raises:
        LinkError: the device does not exist, or cannot be opened.
        UsageError: a setting is invalid, or pyserial is not installed.
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
            raise UsageError(
                f"{path}: {settings}: invalid setting; expected >= 300 bit/s, "
                "parity E, O or N, 1 or 2 stop bits"
            )
        bits = 9 + (parity != "N") + stop_bits
        slow_ns = 35 * bits * _NS // (10 * baud_bit_s)
        super().__init__(path, runtime)
        self.framing: Final = "rtu"
        self.silence_ns: Final = _T35_NS if baud_bit_s > _FAST_BIT_S else slow_ns
        self.path: Final = path
        self._settings: Final = (baud_bit_s, parity, stop_bits)
        self._character_ns: Final = bits * _NS // baud_bit_s
        self._reads = True
        self._end = self._opened(_SEND_S)

    def _opened(self, timeout_s: float) -> object:
        return _serial_port(self.path, *self._settings)

    def duration_ns(self, characters: int) -> int:
        """Return the duration of `characters` characters on the line [ns]."""
        return characters * self._character_ns

    def set_reading(self, reads: bool) -> None:
        """Enable or disable reading; each byte reaches only one of several processes."""
        self._reads = reads

    def close(self) -> None:
        """Close the line; closing again does nothing."""
        self._reads = True
        super().close()

    def _received(self, end: Any, timeout_s: float) -> bytes | None:
        if not self._reads:
            select.select([], [], [], _LOOK_S)  # until reading is enabled again
            return None
        if not select.select([end], [], [], timeout_s)[0] or not self._reads:
            return None  # nothing, or the answer to another process
        return end.read(max(1, end.in_waiting)) or None

    def transmit(self, data: bytes) -> None:
        """Pass the characters to the operating system."""
        self._end.write(data)


def _listen(runtime: WallRuntime, line: _Line, on_data: DataListener) -> "Registration":
    """Report the end of a line to its listeners only, not as an error of the runtime."""
    registered: list[
        Registration
    ] = []  # still empty if the line ends at once; then the end is reported again

    def on_frame(data: bytes, time_ns: int, transmitted: bool) -> None:
        if transmitted:
            return
        if not data:
            for registration in registered:
                registration.cancel()
        on_data(data, time_ns)

    registered.append(runtime.listen(line, on_frame))  # type: ignore[arg-type]  # as in `send`
    return registered[0]


def _serial_port(path: str, baud_bit_s: int, parity: str, stop_bits: int) -> object:
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
    ) as error:  # pyserial lets these exceptions through
        settings = f"{baud_bit_s} bit/s, parity {parity}, {stop_bits} stop bits"
        remedy = "check that it is plugged in, supports these settings, and that you may open it"
        reason = f"cannot be opened with {settings} ({error}): {remedy}"
        raise LinkError(link=path, reason=reason) from error
