"""Recording of SocketCAN interfaces: error frames, time stamps, drop counter."""

import errno
import os
import socket
import struct
from contextlib import suppress
from typing import Final, final

from harness.recording.datagrams import DatagramReader
from harness.recording.places import Place, PlaceError
from harness.recording.taps import BusDownError, BusEndedError
from traces.chunk import Entry

# Linux: linux/socket.h, linux/can/raw.h, linux/can/error.h, asm-generic/socket.h
_AF_CAN: Final = 29
_CAN_RAW: Final = 1
_SOL_CAN_RAW: Final = 101
_CAN_RAW_ERR_FILTER: Final = 2
_CAN_RAW_FD_FRAMES: Final = 5
_CAN_ERR_MASK: Final = 0x1FFF_FFFF
_SO_RCVBUFFORCE: Final = 33
_BUFFER_BYTES: Final = 8 << 20  # the default holds about 280 frames, 13 ms of a full 1 Mbit/s bus


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
        raise PlaceError(
            f"--on {place.text}: the kernel refuses a CAN socket ({_reason(error)}); {remedy}"
        ) from None
    try:
        raw.bind((interface,))
        pending = raw.getsockopt(socket.SOL_SOCKET, socket.SO_ERROR)
        if pending:
            raise OSError(pending, os.strerror(pending))
    except OSError as error:
        raw.close()
        raise PlaceError(
            f"--on {place.text}: {_reason(error)}; {_remedy(error, interface)}"
        ) from None
    return raw


@final
class SocketCanTap:
    """Tap of one interface: frames of other hosts, of this host, and error frames."""

    clock = "kernel's, at reception (SO_TIMESTAMPNS, CLOCK_REALTIME), ns since 1970"

    def __init__(self, place: Place) -> None:
        """Open the interface and start reading it. Raises PlaceError if it cannot be opened."""
        self.default_name = place.channel
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
