"""Gateway between an emulated bus and a Linux SocketCAN interface.

Source: linux/rtnetlink.h, linux/if_link.h (RTM_GETLINK, IFLA_MTU, IFLA_LINKINFO, IFLA_INFO_KIND).
"""

import contextlib
import errno
import os
import socket
import struct
import sys
from collections.abc import Sequence
from typing import Final, final

from motorhil.emulators.can.frame import FD_FRAME_BYTES, as_driven
from motorhil.emulators.gateways.loop import Source
from motorhil.emulators.simulation.world import World

VIRTUAL: Final = ("vcan", "vxcan")
_RTM_GETLINK: Final = 18
_REQUEST: Final = 1
_MTU: Final = 4
_LINKINFO: Final = 18
_KIND: Final = 1
_MESSAGE: Final = struct.Struct("=IHHII BxHiII")  # nlmsghdr and ifinfomsg
_ATTRIBUTE: Final = struct.Struct("=HH")
_ANSWER_MAX: Final = 1 << 16
_QUEUE_MAX: Final = 1_024  # frames from outside that wait for the bus


def link_kind(interface: str) -> str:
    """Return the kind as in `ip -details link` ("vcan", "can" for hardware), or "".

    Raises:
        OSError: the interface does not exist.
    """
    return _part(_part(_attributes_of(interface), _LINKINFO), _KIND).rstrip(b"\0").decode()


def link_mtu(interface: str) -> int:
    """Return the largest frame [bytes]: 16, or 72 and more with CAN FD.

    Raises:
        OSError: the interface does not exist.
    """
    return int.from_bytes(_part(_attributes_of(interface), _MTU), sys.byteorder)


def _attributes_of(interface: str) -> bytes:
    index = socket.if_nametoindex(interface)
    with socket.socket(socket.AF_NETLINK, socket.SOCK_RAW, socket.NETLINK_ROUTE) as kernel:
        asked = (_MESSAGE.size, _RTM_GETLINK, _REQUEST, 1, 0)
        kernel.send(_MESSAGE.pack(*asked, socket.AF_UNSPEC, 0, index, 0, 0))
        answer = kernel.recv(_ANSWER_MAX)
    return answer[_MESSAGE.size :]


def _part(attributes: bytes, wanted: int) -> bytes:
    """Return the content of an attribute, or b"" if it is absent."""
    at = 0
    while at + _ATTRIBUTE.size <= len(attributes):
        size, kind = _ATTRIBUTE.unpack_from(attributes, at)
        if kind == wanted:
            return attributes[at + _ATTRIBUTE.size : at + size]
        at += max(size + 3 & ~3, _ATTRIBUTE.size)
    return b""


class SocketCanError(Exception):
    """The interface cannot be used; the message has interface, reason and remedy."""


@final
class SocketCanGateway:
    """A Gateway that copies frames between the interface and the emulated bus.

    A frame from outside takes part in the arbitration of the emulated bus. Frames of controllers
    appear outside when they are complete on the emulated bus.

    Error messages of the gateway's own CAN controller are copied to a virtual interface, as the
    driver of a real one would report them. They are not copied to hardware, where a driver would
    send them as frames. Error messages from outside never reach the emulated bus: the kernel gives
    them to sockets that request them, and this one does not.

    CAN FD frames pass if the emulated bus is an FD bus; then the interface must support CAN FD as
    well. A classical bus does not receive them.

    Attributes:
        refused: frames dropped because the kernel did not accept them (its queue was full).
        ignored: frames that the bus did not accept.
    """

    def __init__(self, interface: str, world: World, bus: str) -> None:
        """Open the interface.

        Raises:
            SocketCanError: the interface does not exist or is down, or this kernel has no CAN; or
                the bus is an FD bus and the interface is not.
        """
        self.refused: int = 0
        self.ignored: int = 0
        try:
            self._socket = socket.socket(socket.AF_CAN, socket.SOCK_RAW, socket.CAN_RAW)
        except OSError as error:
            raise SocketCanError(
                f"{interface}: this kernel has no SocketCAN ({error.strerror}); load it with "
                "'modprobe vcan', or serve on a socket with --socket"
            ) from None
        try:
            self._socket.bind((interface,))
            self._is_virtual = link_kind(interface) in VIRTUAL
            self._socket.setblocking(False)
        except OSError as error:
            self._socket.close()
            remedy = (
                f"create it with 'ip link add dev {interface} type vcan'"
                if error.errno == errno.ENODEV
                else f"bring it up with 'ip link set up {interface}'"
            )
            raise SocketCanError(
                f"{interface}: {os.strerror(error.errno or 0)}; {remedy}"
            ) from None
        if world.bus(bus).data_bitrate_bit_s is not None:
            self._open_fd(interface, bus)
        self._world = world
        self._bus = bus
        self._port = world.add_host(bus, interface, self._tell, self._tell_error)

    def _open_fd(self, interface: str, bus: str) -> None:
        """Enable CAN FD frames on the socket."""
        size = link_mtu(interface)
        if size < FD_FRAME_BYTES:
            self._socket.close()
            raise SocketCanError(
                f"{interface}: does not support CAN FD (MTU {size}), but bus {bus} does; for a "
                f"virtual one use 'ip link set down {interface}; ip link set {interface} mtu "
                f"{FD_FRAME_BYTES} up', for hardware 'ip link set {interface} type can ... "
                "dbitrate ... fd on'"
            )
        self._socket.setsockopt(socket.SOL_CAN_RAW, socket.CAN_RAW_FD_FRAMES, 1)

    def _tell(self, frame: bytes, time_ns: int, transmitted: bool) -> None:
        if not transmitted:
            self._put(frame)

    def _tell_error(self, message: bytes, time_ns: int, _: bool) -> None:
        if self._is_virtual:
            self._put(message)

    def _put(self, frame: bytes) -> None:
        try:
            self._socket.send(frame)
        except OSError:  # ENOBUFS: as on a real interface the frame is lost; it is counted
            self.refused += 1

    def sources(self) -> Sequence[Source]:
        """Return the CAN_RAW socket as the only source, unless the emulated bus is behind."""
        return [] if self._is_full() else [self._socket]

    def _is_full(self) -> bool:
        return self._port.pending() >= _QUEUE_MAX

    def readable(self, source: Source) -> None:
        """Queue frames from outside for the emulated bus.

        A virtual interface has no bit rate. What it brings too fast waits in the kernel, which
        drops what its own queue does not hold.
        """
        with contextlib.suppress(BlockingIOError):
            for _ in range(_QUEUE_MAX):
                if self._is_full():
                    return
                frame = self._socket.recv(FD_FRAME_BYTES)
                try:
                    self._port.send(as_driven(frame))
                except ValueError as error:
                    self._ignore(str(error))

    def _ignore(self, reason: str) -> None:
        if not self.ignored:
            now_ns = self._world.queue.now_ns
            self._world.report(now_ns, "warning", self._bus, f"{reason}; further ones are counted")
        self.ignored += 1

    def backlogged(self) -> bool:
        """Return False: frames that the kernel does not accept are lost."""
        return False

    def close(self) -> None:
        """Close the port and the socket."""
        self._port.close()
        self._socket.close()
