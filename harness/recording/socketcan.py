"""Recording of SocketCAN: batched reading with kernel time stamps and drop counter.

recvmmsg(2) fills one block of memory. Each frame has a row in it: its bytes, then the kernel's
control messages. Python decodes the block once for the whole batch. Python's own `recvmsg` costs
ten times as much per frame.

Source: linux/can/raw.h, Documentation/networking/can.rst (MSG_DONTROUTE: a frame of this host),
asm-generic/socket.h, net/socket.c (the time stamp precedes the drop counter).
"""

import ctypes
import errno
import os
import socket
import struct
from contextlib import suppress
from typing import Final, final

from motorhil.harness.recording.sources import BusDownError, BusEndedError, Place, PlaceError
from motorhil.traces.mcap.chunk import Entry

FRAME_SIZES: Final = (16, 72)
BATCH: Final = 256
_SO_TIMESTAMPNS: Final = 35
_SO_RXQ_OVFL: Final = 40
_MSG_DONTROUTE: Final = 0x04
_NS: Final = 1_000_000_000
# Linux: linux/socket.h, linux/can/raw.h, linux/can/error.h, asm-generic/socket.h
_AF_CAN: Final = 29
_CAN_RAW: Final = 1
_SOL_CAN_RAW: Final = 101
_CAN_RAW_ERR_FILTER: Final = 2
_CAN_RAW_FD_FRAMES: Final = 5
_CAN_ERR_MASK: Final = 0x1FFF_FFFF
_SO_RCVBUFFORCE: Final = 33
_BUFFER_BYTES: Final = 8 << 20  # the default holds about 280 frames, 13 ms of a full 1 Mbit/s bus


class _Piece(ctypes.Structure):
    _fields_ = (("base", ctypes.c_void_p), ("length", ctypes.c_size_t))


class _Header(ctypes.Structure):
    """The C type `struct msghdr`."""

    _fields_ = (
        ("name", ctypes.c_void_p),
        ("name_length", ctypes.c_uint),
        ("pieces", ctypes.c_void_p),
        ("piece_count", ctypes.c_size_t),
        ("control", ctypes.c_void_p),
        ("control_length", ctypes.c_size_t),
        ("flags", ctypes.c_int),
    )


class _Message(ctypes.Structure):
    """The C type `struct mmsghdr`."""

    _fields_ = (("header", _Header), ("length", ctypes.c_uint))


# A row: the frame, a cmsghdr with a timespec, and a cmsghdr with a counter, padded to whole words.
_CMSG: Final = struct.calcsize("@Nii")
_STAMP_SPACE: Final = struct.calcsize("@Niill")
_SHORT_ROW: Final = struct.Struct(f"@16s{56 + _CMSG}xll{_CMSG}xI0N")
_LONG_ROW: Final = struct.Struct(f"@72s{_CMSG}xll{_CMSG}xI0N")
_ROW_SIZE: Final = _LONG_ROW.size
_CONTROL: Final = 72
_CONTROL_SPACE: Final = _ROW_SIZE - _CONTROL
_HEAD: Final = struct.Struct(f"@{_Header.control_length.offset}xNi0NI0N")


@final
class DatagramReader:
    """Reader of CAN frames from a datagram socket.

    Attributes:
        stamped: True if the kernel provides time stamps for this kind of socket.
        dropped: number of frames dropped by the kernel since the socket was opened. The kernel
            reports it with the next frame.
        ignored: number of datagrams that were neither a can_frame nor a canfd_frame.
    """

    def __init__(self, source: socket.socket) -> None:
        """Enable time stamps and the drop counter on the socket, where the kernel supports them.

        Args:
            source: remains owned by the caller; it is read without blocking.
        """
        self.stamped: bool = _switched_on(source, _SO_TIMESTAMPNS)
        self.dropped: int = 0
        self.ignored: int = 0
        _switched_on(source, _SO_RXQ_OVFL)
        self._socket = source
        self._rows = ctypes.create_string_buffer(_ROW_SIZE * BATCH)
        self._pieces = (_Piece * BATCH)()
        self._heads = (_Message * BATCH)()
        rows = ctypes.addressof(self._rows)
        for number, (piece, message) in enumerate(zip(self._pieces, self._heads, strict=True)):
            row = rows + number * _ROW_SIZE
            piece.base, piece.length = row, FRAME_SIZES[-1]
            head = message.header
            head.pieces, head.piece_count = ctypes.addressof(piece), 1
            head.control, head.control_length = row + _CONTROL, _CONTROL_SPACE
        self._fresh_heads = bytes(self._heads)  # the kernel overwrites the lengths
        self._row_view = memoryview(self._rows).cast("B")
        self._head_view = memoryview(self._heads).cast("B")
        self._receive = ctypes.CDLL(None, use_errno=True).recvmmsg

    def read(self, received: int, transmitted: int, now_ns: int) -> list[Entry]:
        """Return the frames that are waiting, at most `BATCH`; [] if there are none.

        Args:
            received: source number of frames from other hosts.
            transmitted: source number of frames of this host.
            now_ns: time for frames without a time stamp [ns].

        Raises:
            OSError: the socket cannot be read, temporarily or permanently.
        """
        self._head_view[:] = self._fresh_heads
        descriptor = self._socket.fileno()
        count = self._receive(descriptor, self._heads, BATCH, socket.MSG_DONTWAIT, None)
        if count <= 0:
            number = ctypes.get_errno()
            if count == 0 or number in (errno.EAGAIN, errno.EINTR):
                return []
            raise OSError(number, os.strerror(number))
        rows = self._row_view[: count * _ROW_SIZE]
        heads = list(_HEAD.iter_unpack(self._head_view[: count * _HEAD.size]))
        told, flags, length = heads[-1]
        if told > _STAMP_SPACE:
            self._count_drops(count - 1)
        if length == 16 and told >= _STAMP_SPACE and heads.count(heads[-1]) == count:
            source = transmitted if flags & _MSG_DONTROUTE else received
            return [(source, s * _NS + ns, f) for f, s, ns, _ in _SHORT_ROW.iter_unpack(rows)]
        entries: list[Entry] = []
        for (frame, s, ns, _), (told, flags, length) in zip(
            _LONG_ROW.iter_unpack(rows), heads, strict=True
        ):
            if length not in FRAME_SIZES:
                self.ignored += 1
                continue
            time_ns = s * _NS + ns if told >= _STAMP_SPACE else now_ns
            source = transmitted if flags & _MSG_DONTROUTE else received
            entries.append((source, time_ns, frame[:length]))
        return entries

    def _count_drops(self, number: int) -> None:
        """Add the drops reported with the last frame; the kernel's 32-bit counter wraps around."""
        (_, _, _, count) = _SHORT_ROW.unpack_from(self._row_view, number * _ROW_SIZE)
        self.dropped += (count - self.dropped) % (1 << 32)


def _switched_on(source: socket.socket, option: int) -> bool:
    try:
        source.setsockopt(socket.SOL_SOCKET, option, 1)
    except OSError:
        return False
    return True


def open_interface(place: Place) -> socket.socket:
    """Open a raw socket on an interface that exists and is up.

    Raises:
        PlaceError: the interface is missing or down, or access is denied.
    """
    interface = place.channel
    try:
        raw = socket.socket(_AF_CAN, socket.SOCK_RAW, _CAN_RAW)
    except OSError as error:
        if error.errno in (errno.EPERM, errno.EACCES):
            remedy = "run as a user who may open raw CAN sockets"
        else:
            remedy = "load it with 'modprobe vcan' (or the driver of your adapter)"
        reason = f"the kernel refuses a CAN socket ({_reason(error)})"
        raise _refusal(place, reason, remedy) from None
    try:
        raw.bind((interface,))
        pending = raw.getsockopt(socket.SOL_SOCKET, socket.SO_ERROR)
        if pending:
            raise OSError(pending, os.strerror(pending))
    except OSError as error:
        raw.close()
        raise _refusal(place, _reason(error), _remedy(error, interface)) from None
    return raw


@final
class SocketCanTap:
    """Tap of one interface: frames of other hosts, of this host, and error frames."""

    clock = "kernel's, at reception (SO_TIMESTAMPNS, CLOCK_REALTIME), ns since 1970"

    def __init__(self, place: Place) -> None:
        """Open the interface and start reading it. Raises PlaceError if it cannot be opened."""
        self.default_name: str = place.channel
        self.source = 0
        self._socket = open_interface(place)
        options = self._socket.setsockopt
        options(_SOL_CAN_RAW, _CAN_RAW_ERR_FILTER, struct.pack("@I", _CAN_ERR_MASK))
        with suppress(OSError):  # kernels before 3.6 lack this option
            options(_SOL_CAN_RAW, _CAN_RAW_FD_FRAMES, 1)
        try:
            options(socket.SOL_SOCKET, _SO_RCVBUFFORCE, _BUFFER_BYTES)
        except OSError:  # limited by net.core.rmem_max
            options(socket.SOL_SOCKET, socket.SO_RCVBUF, _BUFFER_BYTES)
        self._reader = DatagramReader(self._socket)

    @property
    def dropped(self) -> int:
        """Number of frames dropped by the kernel for lack of buffer space."""
        return self._reader.dropped

    def fileno(self) -> int:
        """Return the socket's descriptor."""
        return self._socket.fileno()

    def read(self, now_ns: int) -> list[Entry]:
        """Return the entries that have arrived; see `Tap.read`."""
        try:
            return self._reader.read(self.source, self.source + 1, now_ns)
        except OSError as error:
            text = f"{self.default_name}: {_reason(error)}"
            if error.errno == errno.ENETDOWN:
                raise BusDownError(f"{text}; it is read again when it is up") from None
            raise BusEndedError(text) from None

    def close(self) -> None:
        """Close the socket; the interface itself is unaffected."""
        self._socket.close()


def _refusal(place: Place, reason: str, remedy: str) -> PlaceError:
    name = place.channel
    return PlaceError(
        f"--on {place.text}: SocketCAN interface {name}: {reason}; {remedy}; or, for the socket of "
        f"a hub, write a path with a slash: ./{name}"
    )


def _reason(error: OSError) -> str:
    return (error.strerror or str(error)).lower()


def _remedy(error: OSError, interface: str) -> str:
    if error.errno == errno.ENODEV:
        return (
            "list the interfaces with 'ip link', or create one with 'ip link add dev "
            f"{interface} type vcan'"
        )
    if error.errno == errno.ENETDOWN:
        return f"bring it up with 'ip link set up {interface}' (CAN hardware: 'type can bitrate N')"
    return f"inspect it with 'ip -details link show {interface}'"
