"""A Gateway between an emulated bus and a Linux SocketCAN interface (vcan0, or a real can0)."""

import contextlib
import errno
import os
import socket
from collections.abc import Sequence
from typing import Final, final

from emulators.can_link import VIRTUAL, link_kind
from emulators.gateway import Source
from emulators.world import World

_FRAME_SIZE: Final = 16


class SocketCanError(Exception):
    """The interface cannot be used; the message says which, why and what to do."""


@final
class SocketCanGateway:
    """Frames on the interface are on the emulated bus too, and the other way round.

    A frame that comes from outside takes its turn on the emulated bus; what controllers send
    appears outside when it is complete on the emulated bus.

    What the gateway's own CAN controller on the emulated bus tells of errors is told on a virtual
    interface, as the driver of a real one would. On hardware it is not: a driver would send it as a
    frame. Error messages from outside never reach the emulated bus: the kernel gives them to
    sockets that ask for them, and this one does not.

    Attributes:
        refused: frames the kernel would not take (its queue was full), given up.
        ignored: CAN FD frames, which the bus does not carry yet.
    """

    def __init__(self, interface: str, world: World, bus: str) -> None:
        """The interface is open.

        Raises:
            SocketCanError: no such interface, it is down, or this kernel has no CAN.
        """
        self.refused = 0
        self.ignored = 0
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
                f"make it with 'ip link add dev {interface} type vcan'"
                if error.errno == errno.ENODEV
                else f"bring it up with 'ip link set up {interface}'"
            )
            raise SocketCanError(
                f"{interface}: {os.strerror(error.errno or 0)}; {remedy}"
            ) from None
        self._port = world.add_host(bus, interface, self._tell, self._tell_error)

    def _tell(self, frame: bytes, time_ns: int, transmitted: bool) -> None:
        if not transmitted:
            self._put(frame)

    def _tell_error(self, message: bytes, time_ns: int, _: bool) -> None:
        if self._is_virtual:
            self._put(message)

    def _put(self, frame: bytes) -> None:
        try:
            self._socket.send(frame)
        except OSError:  # ENOBUFS: as on a real interface, the frame is gone; it is counted
            self.refused += 1

    def sources(self) -> Sequence[Source]:
        """The one CAN_RAW socket."""
        return [self._socket]

    def readable(self, source: Source) -> None:
        """Frames from outside queue for the emulated bus."""
        with contextlib.suppress(BlockingIOError):
            while True:
                frame = self._socket.recv(72)
                if len(frame) == _FRAME_SIZE:
                    self._port.send(frame)
                else:
                    self.ignored += 1

    def backlogged(self) -> bool:
        """Never: what the kernel does not take is gone."""
        return False

    def close(self) -> None:
        """The interface is left alone."""
        self._port.close()
        self._socket.close()
