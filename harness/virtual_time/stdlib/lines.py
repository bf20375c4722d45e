"""Lines of a rig, as gateways and serial ports of unmodified programs.

A program that connects to the address of a line, or opens its serial port, gets one end of a pair
of UNIX sockets under its own descriptor. Whatever it writes is sent on the line before its next
wait ends, and the characters that the line delivers are written to the other end. So the kernel
itself tells whether the program's end is readable, copied or closed.

A serial port has the bit rate of its line. A program that sets another one is told so.
"""

import errno
import fcntl
import io
import ipaddress
import os
import re
import select
import socket
import struct
import sys
import termios
from collections.abc import Callable, Iterable, Iterator, Mapping
from contextlib import contextmanager, suppress
from functools import wraps
from typing import TYPE_CHECKING, Any, Final, Protocol, final, runtime_checkable

from motorhil.harness.virtual_time.stdlib.refusals import is_meant, refuse
from motorhil.harness.virtual_time.stdlib.threads import program_here
from motorhil.motorapi.errors import LinkError

if TYPE_CHECKING:
    from motorhil.harness.virtual_time.runtime import VirtualRuntime
    from motorhil.motorapi.api.line_exchanges import ByteLine

    class OpenLine(ByteLine, Protocol):
        """A port on a line."""

        def close(self) -> None:
            """Close the port."""


_PIECE: Final = 4_096
_UNREAD_MAX: Final = 65_536
_MODBUS_PORT: Final = 502
_LOCAL: Final = "127.0.0.1"
_ALIASES: Final = ("localhost", "::1")  # of the loopback interface
_NAMED: Final = "127.77.0."  # addresses of gateways with names that no server knows
_HARDWARE: Final = re.compile(r"/dev/(tty[A-Z]\w*|serial/.*|rfcomm\d+)")
_SEND_LIMIT: Final = struct.pack("ll", 0, 1_000)  # struct timeval; nobody reads while it is full
_SIGNALS: Final = struct.pack(
    "I", termios.TIOCM_DTR | termios.TIOCM_RTS | termios.TIOCM_CTS | termios.TIOCM_DSR
)
_FIRST_SETTINGS: Final = (  # of a terminal of Linux that no program has set
    termios.ICRNL | termios.IXON,
    termios.OPOST | termios.ONLCR,
    termios.B9600 | termios.CS8 | termios.CREAD | termios.CLOCAL,
    termios.ISIG | termios.ICANON | termios.ECHO | termios.ECHOE | termios.ECHOK | termios.IEXTEN,
)
_RATES: Final = {
    value: int(name[1:]) for name, value in vars(termios).items() if re.fullmatch(r"B\d+", name)
}
_TCGETS2, _TCSETS2 = 0x802C542A, 0x402C542B  # Linux, asm-generic/ioctls.h
_TIOCGSERIAL, _SERIAL_STRUCT_BYTES = 0x541E, 72
_TERMIOS2: Final = struct.Struct("=4IB19s2I")  # flags, line, controls, rates [bit/s]
_CBAUD, _BOTHER = 0o010017, 0o010000  # Linux, asm-generic/termbits.h
_CONTROLS: Final = 19
_ACCEPTED: Final = frozenset(
    {termios.TIOCMBIS, termios.TIOCMBIC, termios.TIOCMSET, termios.TIOCEXCL, termios.TIOCNXCL}
    | {0x5427, 0x5428, 0x541F, 0x542F}  # TIOCSBRK, TIOCCBRK, TIOCSSERIAL, TIOCSRS485
)
_OWN_PORT: Final = 49_152  # the first that is free for clients
_VTIME_S: Final = 0.1
_FLUSHED: Final = (termios.TCIFLUSH, termios.TCIOFLUSH)

_open, _read, _write, _isatty = os.open, os.read, os.write, os.isatty
_open_file = io.open
_connect, _connect_ex = socket.socket.connect, socket.socket.connect_ex
_setsockopt, _getsockopt = socket.socket.setsockopt, socket.socket.getsockopt
_getpeername, _getsockname = socket.socket.getpeername, socket.socket.getsockname
_select, _poll = select.select, select.poll
_getaddrinfo, _ioctl = socket.getaddrinfo, fcntl.ioctl
_OPTION_LEVELS: Final = (socket.IPPROTO_TCP, socket.IPPROTO_IP, socket.IPPROTO_IPV6)


class Line(Protocol):
    """A line in the rig's file."""

    @property
    def name(self) -> str:
        """Its name."""

    @property
    def is_line(self) -> bool:
        """False for a CAN bus."""

    @property
    def address(self) -> str:
        """The path of a serial port, or HOST:PORT of a gateway."""

    @property
    def bitrate_bit_s(self) -> int:
        """The bit rate of a serial line [bit/s]."""

    @property
    def parity(self) -> str:
        """E, O or N."""

    @property
    def stop_bits(self) -> int:
        """The stop bits of a character."""


@runtime_checkable
class LinedRig(Protocol):
    """A rig as far as its lines are concerned."""

    @property
    def description(self) -> "_Description":
        """The contents of its file."""

    def open_line(self, name: str) -> "OpenLine":
        """Return a new port on a line."""


class _Description(Protocol):
    @property
    def buses(self) -> "Mapping[str, Line]":
        """The buses and lines by name."""


@final
class _End:
    """The line's end of a descriptor of the program.

    Args:
        silences_ns: by line, when t3.5 has passed after the last characters of others [ns].

    Attributes:
        line: the connection to the line.
        runtime: the rig's time.
        bus: its description.
        settings: as of termios.tcgetattr; None on a gateway's line.
        peer: the address that the program has connected to; None on a serial port.
        options: of the socket, by (level, option).
        free_ns: when the last character of the program has been sent [ns].
        rate: as set, if termios has no name for it; else 0 [bit/s].
    """

    def __init__(
        self,
        bus: Line,
        line: "OpenLine",
        inner: socket.socket,
        runtime: "VirtualRuntime",
        silences_ns: dict[str, int],
    ) -> None:
        self.bus: Final = bus
        self.line: Final = line
        self.runtime: Final = runtime
        self.peer: tuple[Any, ...] | None = None
        self.options: dict[tuple[int, int], Any] = {}
        self.free_ns: int = 0
        self.rate: int = 0
        self.settings: list[Any] | None = None
        if _is_port(bus):
            controls = [bytes([one == termios.VMIN]) for one in range(32)]
            self.settings = [*_FIRST_SETTINGS, termios.B9600, termios.B9600, controls]
        self._inner: Final = inner
        self._unread = bytearray()  # beyond the space of the pair
        self._is_told = False
        self._silences_ns = silences_ns
        line.listen(self._hear)

    def drain(self) -> bool:
        """Send all that the program has written; return False once it has closed its end."""
        while True:
            try:
                data = _read(self._inner.fileno(), _PIECE)
            except BlockingIOError:
                self._pass_on()
                return True
            except OSError:
                data = b""
            if not data and self._may_read():
                self._pass_on()
                return True
            if not data:
                self.close()
                return False
            self._send(data)

    def _may_read(self) -> bool:
        """Return whether the program has shut its end down only for writing."""
        poll = _poll()
        poll.register(self._inner, 0)  # POLLHUP is always told: both ways are shut
        return not poll.poll(0)

    def _send(self, data: bytes) -> None:
        now_ns = self.runtime.now_ns()
        try:
            self.line.send(data)
        except LinkError as error:
            self._tell(str(error))
            self._end_input()
            return
        self.free_ns = max(now_ns, self.free_ns) + self.line.duration_ns(len(data))

    def _hear(self, data: bytes, now_ns: int) -> None:
        if not data:
            self._pass_on()
            self._end_input()
            return
        self._silences_ns[self.bus.name] = now_ns + self.line.silence_ns
        if len(self._unread) + len(data) > _UNREAD_MAX:
            self._tell(f"more than {_UNREAD_MAX} characters are not read; the others are lost")
            return
        self._unread += data
        self._pass_on()

    def await_silence(self) -> None:
        """Wait for t3.5 after the characters of others, as slower programs do by themselves."""
        runtime = self.runtime
        left_ns = self._silences_ns.get(self.bus.name, 0) - runtime.now_ns()
        if left_ns > 0:
            runtime.run_for(left_ns / 1e9)

    def _pass_on(self) -> None:
        """Write what the program has not read to its end, as far as there is space."""
        with suppress(OSError):  # no space, or the program has closed its end
            while self._unread:
                del self._unread[: _write(self._inner.fileno(), self._unread)]

    def _end_input(self) -> None:
        with suppress(OSError):
            self._inner.shutdown(socket.SHUT_RDWR)  # writes fail as those to a closed connection

    def _tell(self, text: str) -> None:
        if not self._is_told:
            self._is_told = True
            print(f"motorhil: {self.bus.address}: {text}", file=sys.stderr)

    def set(self, settings: list[Any]) -> None:
        """Take settings of termios; tell of those that the line has not."""
        self.settings = [*settings[:6], list(settings[6])]
        restores = settings[3] == _FIRST_SETTINGS[3]
        if settings[5] in _RATES and not restores:
            self.compare(_RATES[settings[5]], settings[2])

    def compare(self, rate: int, cflag: int) -> None:
        """Tell of a bit rate [bit/s] or characters that differ from those of the line."""
        parity = "N" if not cflag & termios.PARENB else "O" if cflag & termios.PARODD else "E"
        bits = {termios.CS5: 5, termios.CS6: 6, termios.CS7: 7}.get(cflag & termios.CSIZE, 8)
        asked = f"{rate} bit/s, {bits}{parity}{2 if cflag & termios.CSTOPB else 1}"
        own = f"{self.bus.bitrate_bit_s} bit/s, 8{self.bus.parity}{self.bus.stop_bits}"
        if asked != own:
            self._tell(f"opened with {asked}; line {self.bus.name} has {own}, which is used")

    def read_limit_s(self) -> float | None:
        """Return how long a blocking read waits [s]: VTIME, if VMIN is 0; None without a limit."""
        if self.settings is None or self.settings[3] & termios.ICANON:
            return None
        least, limit = (
            one if isinstance(one, int) else one[0]
            for one in (self.settings[6][termios.VMIN], self.settings[6][termios.VTIME])
        )
        return None if least else limit * _VTIME_S

    def forget(self) -> None:
        """Drop what the program has not read and its descriptor has no space for."""
        self._unread.clear()

    def unsent(self) -> int:
        """Return the number of characters of the program that are not yet sent."""
        left_ns = max(0, self.free_ns - self.runtime.now_ns())
        return -(-1_000 * left_ns // max(1, self.line.duration_ns(1_000)))

    def close(self) -> None:
        """Close the connection to the line."""
        self.line.close()
        self._inner.close()


@final
class LinePorts:
    """The lines of a rig by address, and the descriptors of the program that are open on them.

    Args:
        rig: its lines and their descriptions.
        runtime: the rig's time.
    """

    def __init__(self, rig: LinedRig, runtime: "VirtualRuntime") -> None:
        self._rig: Final = rig
        self._runtime: Final = runtime
        self._buses: Final = {
            name: bus for name, bus in rig.description.buses.items() if bus.is_line
        }
        self._gateways: dict[tuple[str, int], Line] = {}
        self._ports: dict[str, Line] = {}
        self._names: dict[str, str] = {}  # addresses of hosts by name
        self._silences_ns: dict[str, int] = {}
        self._ends: dict[tuple[int, int], _End] = {}  # by the place of the program's end
        for bus in self._buses.values():
            if _is_port(bus):
                self._ports[bus.address] = bus
            else:
                self._add_gateway(bus)

    def _add_gateway(self, bus: Line) -> None:
        host, _, port = bus.address.rpartition(":")
        host = _usual(host.strip("[]"))
        self._gateways[host, int(port)] = bus
        if not _is_numeric(host):
            self._names.setdefault(host, f"{_NAMED}{len(self._names) + 1}")
            self._gateways[self._names[host], int(port)] = bus

    def gateway(self, address: Any) -> Line | None:
        """Return the line at the address of a socket, or None."""
        if not isinstance(address, tuple) or len(address) < 2 or not isinstance(address[0], str):
            return None
        return self._gateways.get((_usual(address[0]), address[1]))

    def port(self, path: Any) -> Line | None:
        """Return the serial line with this port, or None."""
        try:
            return self._ports.get(os.fsdecode(path))
        except TypeError:  # a descriptor
            return None

    def numeric(self, host: Any) -> Any:
        """Return the address of a host that only the rig knows by name; others as they are."""
        return self._names.get(host, host) if isinstance(host, str) else host

    def known(self) -> str:
        """Return the lines with their addresses, for messages."""
        return ", ".join(f"{one.name} at {one.address}" for one in self._buses.values()) or "none"

    def open(self, bus: Line) -> socket.socket:
        """Return the program's end of a new connection to the line."""
        self.drain()  # a port that is closed and opened again is one port
        line = self._rig.open_line(bus.name)
        own, inner = socket.socketpair()
        inner.setblocking(False)
        own.setsockopt(socket.SOL_SOCKET, socket.SO_SNDTIMEO, _SEND_LIMIT)
        self._ends[_place_of(own.fileno())] = _End(
            bus, line, inner, self._runtime, self._silences_ns
        )
        self._runtime.on_yield = self.drain
        return own

    def end_of(self, fd: int) -> _End | None:
        """Return the line's end of a descriptor, or None."""
        if not self._ends:
            return None
        try:
            return self._ends.get(_place_of(fd))
        except (OSError, OverflowError):
            return None

    def drain(self) -> None:
        """Send all that the program has written, and forget the ends that it has closed."""
        for place, end in list(self._ends.items()):
            if not end.drain():
                del self._ends[place]

    def close(self) -> None:
        """Close all connections."""
        self.drain()
        self._runtime.on_yield = None
        for end in self._ends.values():
            end.close()
        self._ends.clear()


def _place_of(fd: int) -> tuple[int, int]:
    """Return the device and the number of a file in the kernel."""
    found = os.fstat(fd)
    return found.st_dev, found.st_ino


def _is_port(bus: Line) -> bool:
    return bus.address.startswith("/")


def _usual(host: str) -> str:
    return _LOCAL if host in _ALIASES else host


def _is_numeric(host: str) -> bool:
    try:
        ipaddress.ip_address(host)
    except ValueError:
        return False
    return True


@final
class _Stage:
    """The lines of the active program."""

    ports: LinePorts | None = None


@contextmanager
def lines_of(rig: object, runtime: "VirtualRuntime") -> Iterator[None]:
    """Let the program within the block connect to the rig's lines, if the rig can have some."""
    ports = _Stage.ports = LinePorts(rig, runtime) if isinstance(rig, LinedRig) else None
    try:
        yield
    finally:
        _Stage.ports = None
        if ports is not None:
            ports.close()


def _ports() -> LinePorts | None:
    return None if program_here() is None else _Stage.ports


def _end_of(fd: int) -> _End | None:
    ports = _ports()
    return None if ports is None else ports.end_of(fd)


def are_among(descriptors: Iterable[int]) -> bool:
    """Return whether one of these descriptors is open on a line."""
    return any(_end_of(one) is not None for one in descriptors)


# ---- stand-ins -----------------------------------------------------------------------------------


def stand_ins() -> list[tuple[object, object]]:
    """Return (original, stand-in) for the functions that open and use lines."""
    return [
        (_open, _opened),
        (_open_file, _opened_file),
        (_read, _reading),
        (_write, _writing),
        (_isatty, _is_terminal),
        (_getaddrinfo, _found_address),
        (_ioctl, _controlled),
        *((getattr(termios, name), own) for name, own in _OF_TERMINALS.items()),
    ]


def methods() -> list[tuple[type, str, object]]:
    """Return (class, name, stand-in) for the methods of sockets."""
    return [
        (socket.socket, "connect", _connecting),
        (socket.socket, "connect_ex", _connecting_ex),
        *((socket.socket, name, _sending(name)) for name in ("send", "sendall", "sendmsg")),
        (socket.socket, "setsockopt", _set_option),
        (socket.socket, "getsockopt", _get_option),
        (socket.socket, "getpeername", _peer),
        (socket.socket, "getsockname", _name),
    ]


@wraps(_connect)
def _connecting(client: socket.socket, address: Any, /) -> None:
    """Stand in for socket.connect."""
    if not is_meant() or not _joins(client, address):
        _connect(client, address)


@wraps(_connect_ex)
def _connecting_ex(client: socket.socket, address: Any, /) -> int:
    """Stand in for socket.connect_ex."""
    if not is_meant() or not _joins(client, address):
        return _connect_ex(client, address)
    return 0


def _joins(client: socket.socket, address: Any) -> bool:
    """Connect the socket to the line at this address, if there is one; return whether it is.

    Raises:
        UsageError: it would command hardware.
    """
    ports = _ports()
    if ports is None or client.type != socket.SOCK_STREAM:
        return False
    bus = ports.gateway(address)
    if bus is None:
        if isinstance(address, tuple) and address[1:2] == (_MODBUS_PORT,):
            _refuse_hardware("socket.connect", f"{address[0]}:{address[1]}", ports)
        return False
    fd = client.fileno()
    with ports.open(bus) as own:
        os.dup2(own.fileno(), fd, inheritable=os.get_inheritable(fd))
        os.set_blocking(fd, client.gettimeout() is None)
    end = ports.end_of(fd)
    assert end is not None
    end.peer = address
    return True


def _refuse_hardware(name: str, what: str, ports: LinePorts) -> None:
    refuse(
        name,
        f"{what}: hardware cannot be reached, and no line of the rig is there (its lines:"
        f" {ports.known()})",
        f'write address = "{what}" in its [bus.NAME]',
    )


@wraps(_getaddrinfo)
def _found_address(host: Any, *arguments: Any, **named: Any) -> Any:
    """Stand in for socket.getaddrinfo."""
    ports = _ports() if is_meant() else None
    return _getaddrinfo(host if ports is None else ports.numeric(host), *arguments, **named)


def _sending(name: str) -> Callable[..., Any]:
    """Return a stand-in for a method of sockets that sends."""
    original = getattr(socket.socket, name)

    @wraps(original)
    def stand_in(sender: socket.socket, *arguments: Any) -> Any:
        end = _end_of(sender.fileno()) if is_meant() else None
        result = original(sender, *arguments)
        if end is not None:
            end.drain()
        return result

    return stand_in


@wraps(socket.socket.setsockopt)
def _set_option(own: socket.socket, level: int, option: int, *value: Any) -> None:
    """Stand in for socket.setsockopt: options of TCP and IP are kept, and have no effect."""
    end = _end_of(own.fileno()) if is_meant() and level in _OPTION_LEVELS else None
    if end is None:
        _setsockopt(own, level, option, *value)
    else:
        end.options[level, option] = value[0]


@wraps(socket.socket.getsockopt)
def _get_option(own: socket.socket, level: int, option: int, *size: int) -> Any:
    """Stand in for socket.getsockopt."""
    end = _end_of(own.fileno()) if is_meant() and level in _OPTION_LEVELS else None
    return (
        _getsockopt(own, level, option, *size)
        if end is None
        else end.options.get((level, option), 0)
    )


@wraps(socket.socket.getpeername)
def _peer(own: socket.socket) -> Any:
    """Stand in for socket.getpeername."""
    end = _end_of(own.fileno()) if is_meant() else None
    return _getpeername(own) if end is None else end.peer


@wraps(socket.socket.getsockname)
def _name(own: socket.socket) -> Any:
    """Stand in for socket.getsockname."""
    end = _end_of(own.fileno()) if is_meant() else None
    return _getsockname(own) if end is None else (_LOCAL, _OWN_PORT)


@wraps(_open)
def _opened(path: Any, flags: int, mode: int = 0o777, *, dir_fd: int | None = None) -> int:
    """Stand in for os.open, which opens serial ports."""
    ports = _ports() if is_meant() else None
    bus = None if ports is None else ports.port(path)
    if ports is None or bus is None:
        if ports is not None and isinstance(path, str) and _HARDWARE.fullmatch(path):
            _refuse_hardware("os.open", path, ports)
        return _open(path, flags, mode, dir_fd=dir_fd)
    fd = ports.open(bus).detach()
    os.set_blocking(fd, not flags & os.O_NONBLOCK)
    return fd


@final
class _LineFile(io.RawIOBase):
    """A file on a descriptor that is open on a line, as io.FileIO is for all others."""

    def __init__(self, fd: int, end: _End, mode: str, keeps: bool) -> None:
        self.name = fd
        self.mode = mode
        self._fd = fd
        self._end = end
        self._keeps = keeps

    def fileno(self) -> int:
        """Return the descriptor."""
        if self.closed:
            raise ValueError("I/O operation on closed file")
        return self._fd

    def isatty(self) -> bool:
        """Return whether it is a serial port."""
        return self._end.settings is not None

    def readable(self) -> bool:
        """Return whether it may be read."""
        return "r" in self.mode or "+" in self.mode

    def writable(self) -> bool:
        """Return whether it may be written."""
        return "r" not in self.mode or "+" in self.mode

    def readinto(self, buffer: Any) -> int | None:
        """Wait for characters; return how many there were, None if it does not wait."""
        if not self.readable():
            raise io.UnsupportedOperation("File not open for reading")
        try:
            data = _read_line(self._end, self.fileno(), len(buffer))
        except BlockingIOError:
            return None
        buffer[: len(data)] = data
        return len(data)

    def write(self, data: Any) -> int:
        """Write; return how many characters were written."""
        if not self.writable():
            raise io.UnsupportedOperation("File not open for writing")
        return _write_line(self._end, self.fileno(), data)

    def close(self) -> None:
        """Close the descriptor."""
        if not self.closed:
            super().close()
            if not self._keeps:
                os.close(self._fd)


@wraps(_open_file)
def _opened_file(
    file: Any,
    mode: str = "r",
    buffering: int = -1,
    encoding: str | None = None,
    errors: str | None = None,
    newline: str | None = None,
    closefd: bool = True,
    opener: Any = None,
) -> Any:
    """Stand in for open, which opens serial ports and takes descriptors on lines."""
    text = (encoding, errors, newline)
    ports = _ports() if is_meant() and opener is None else None
    bus = None if ports is None or isinstance(file, int) else ports.port(file)
    end = ports.end_of(file) if ports is not None and isinstance(file, int) else None
    if ports is None or (bus is None and end is None):
        path = os.fspath(file) if ports is not None and not isinstance(file, int) else ""
        if ports is not None and isinstance(path, str) and _HARDWARE.fullmatch(path):
            _refuse_hardware("open", path, ports)
        return _open_file(file, mode, buffering, *text, closefd, opener)
    _open_file(os.devnull, mode, buffering, *text).close()  # raises for a wrong mode
    fd = file if bus is None else ports.open(bus).detach()
    found = ports.end_of(fd)
    assert found is not None
    return _layered(_LineFile(fd, found, mode, not closefd), buffering, text)


def _layered(
    raw: _LineFile, buffering: int, text: tuple[str | None, str | None, str | None]
) -> Any:
    """Return the file with the layers that `open` puts on it."""
    if buffering == 0:
        return raw
    by_line = buffering == 1 or (buffering < 0 and raw.isatty())
    size = io.DEFAULT_BUFFER_SIZE if buffering in (-1, 1) else buffering
    kind: Callable[..., Any] = io.BufferedReader if "r" in raw.mode else io.BufferedWriter
    try:
        layer = (io.BufferedRandom if "+" in raw.mode else kind)(raw, size)
    except OSError:  # a port is not seekable
        raw.close()
        raise
    return layer if "b" in raw.mode else io.TextIOWrapper(layer, *text, line_buffering=by_line)


@wraps(_read)
def _reading(fd: int, length: int, /) -> bytes:
    """Stand in for os.read, which waits for a line unless the descriptor is non-blocking."""
    end = _end_of(fd) if is_meant() else None
    return _read(fd, length) if end is None else _read_line(end, fd, length)


def _read_line(end: _End, fd: int, length: int) -> bytes:
    """Read as from a terminal or a connection, and wait in the rig's time."""
    if os.get_blocking(fd):
        is_there = end.runtime.wait_until(
            lambda: bool(_select((fd,), (), (), 0)[0]), end.read_limit_s()
        )
        if not is_there:
            return b""
    return _read(fd, length)


@wraps(_write)
def _writing(fd: int, data: Any, /) -> int:
    """Stand in for os.write."""
    end = _end_of(fd) if is_meant() else None
    return _write(fd, data) if end is None else _write_line(end, fd, data)


def _write_line(end: _End, fd: int, data: Any) -> int:
    """Write to a line, after the characters of others."""
    end.await_silence()
    written = _write(fd, data)
    end.drain()
    return written


@wraps(_isatty)
def _is_terminal(fd: int, /) -> bool:
    """Stand in for os.isatty."""
    end = _end_of(fd) if is_meant() else None
    return _isatty(fd) if end is None else end.settings is not None


@wraps(_ioctl)
def _controlled(fd: Any, request: int, arg: Any = 0, mutate_flag: bool = True, /) -> Any:
    """Stand in for fcntl.ioctl: signals of a serial port, and counts of characters."""
    end = _terminal_of(fd) if is_meant() else None
    if end is None or request == termios.FIONREAD:
        return _ioctl(fd, request, arg, mutate_flag)
    found = b""
    if request == termios.TIOCMGET:
        found = _SIGNALS
    elif request == termios.TIOCOUTQ:
        found = struct.pack("I", end.unsent())
    elif request == _TCGETS2:
        found = _packed_settings(end)
    elif request == _TIOCGSERIAL:
        found = bytes(_SERIAL_STRUCT_BYTES)
    elif request == _TCSETS2 and not isinstance(arg, int):
        _set_packed(end, bytes(memoryview(arg).cast("B")[: _TERMIOS2.size]))
    elif request not in _ACCEPTED:
        raise OSError(errno.ENOTTY, f"request {request:#x} of a serial port: not supported")
    if not found or isinstance(arg, int | bytes | str) or not mutate_flag:
        return found or arg
    own = memoryview(arg).cast("B")
    own[: len(found)] = found[: len(own)]
    return 0


def _packed_settings(end: _End) -> bytes:
    """Return the settings as a struct termios2."""
    settings = _settings(end)
    controls = bytes(one if isinstance(one, int) else one[0] for one in settings[6][:_CONTROLS])
    rate = end.rate or _RATES.get(settings[5], 0)
    return _TERMIOS2.pack(*settings[:4], 0, controls, rate, rate)


def _set_packed(end: _End, data: bytes) -> None:
    """Take the settings of a struct termios2, and a rate that has no name in termios."""
    *flags, _, controls, _, rate = _TERMIOS2.unpack(data)
    speed = flags[2] & _CBAUD
    more = _settings(end)[6][_CONTROLS:]
    end.set([*flags, speed, speed, [*(bytes([one]) for one in controls), *more]])
    end.rate = rate if speed == _BOTHER else 0
    if end.rate:
        end.compare(end.rate, flags[2])


def _terminal_of(fd: Any) -> _End | None:
    """Return the line's end of a serial port, None for all else."""
    end = _end_of(fd if isinstance(fd, int) else fd.fileno())
    return None if end is None or end.settings is None else end


def _settings(end: _End) -> list[Any]:
    assert end.settings is not None
    return end.settings


def _get_settings(end: _End, fd: int) -> list[Any]:
    return [*_settings(end)[:6], list(_settings(end)[6])]


def _set_settings(end: _End, fd: int, when: int, settings: list[Any]) -> None:
    if when != termios.TCSANOW:
        _await_sent(end, fd)
    if when == termios.TCSAFLUSH:
        _flush(end, fd, termios.TCIFLUSH)
    end.set(settings)


def _await_sent(end: _End, fd: int) -> None:
    end.drain()
    runtime = end.runtime
    left_ns = end.free_ns - runtime.now_ns()
    if left_ns > 0:
        runtime.run_for(left_ns / 1e9)


def _flush(end: _End, fd: int, queue: int) -> None:
    if queue in _FLUSHED:
        end.forget()
        with suppress(BlockingIOError), socket.socket(fileno=os.dup(fd)) as own:
            while own.recv(_PIECE, socket.MSG_DONTWAIT):
                pass


def _ignore(end: _End, fd: int, value: int) -> None:
    """Accept a break or a flow control, which a line has not."""


def _of_terminals(name: str, act: Callable[..., Any]) -> Callable[..., Any]:
    """Return a stand-in for a function of termios."""
    original: Callable[..., Any] = getattr(termios, name)

    @wraps(original)
    def stand_in(fd: Any, *arguments: Any) -> Any:
        end = _terminal_of(fd) if is_meant() else None
        if end is None:
            return original(fd, *arguments)
        return act(end, fd if isinstance(fd, int) else fd.fileno(), *arguments)

    return stand_in


_OF_TERMINALS: Final = {
    name: _of_terminals(name, act)
    for name, act in (
        ("tcgetattr", _get_settings),
        ("tcsetattr", _set_settings),
        ("tcdrain", _await_sent),
        ("tcflush", _flush),
        ("tcsendbreak", _ignore),
        ("tcflow", _ignore),
    )
}
