"""Sinks of replayed frames: buses of a rig, hubs, SocketCAN, python-can."""

import errno
import os
import time
from collections.abc import Mapping
from contextlib import suppress
from pathlib import Path
from typing import TYPE_CHECKING, Final, final

import can

from emulators.can_segment import HOST
from harness.hub_client import HubLink
from harness.recording.places import Kind, Place, PlaceError
from harness.recording.python_can import message_of, open_bus
from harness.recording.socketcan import open_interface
from harness.replay.traffic import STUCK_S, SendError, Sink

if TYPE_CHECKING:
    from harness.rig import Rig

_SOL_CAN_RAW: Final = 101  # linux/can/raw.h
_CAN_RAW_FILTER: Final = 1
_CAN_RAW_FD_FRAMES: Final = 5
_FD_MTU: Final = 72
_QUEUED_MAX: Final = 64  # frames given to an emulated bus before it has carried them
_PAUSE_S: Final = 0.0005


def open_sink(place: Place, options: Mapping[str, object]) -> Sink:
    """Open the sink of a bus.

    Args:
        place: a bus outside the rig.
        options: of python-can's interface (bitrate, fd).

    Raises:
        PlaceError: the bus cannot be reached.
    """
    if place.kind is Kind.SOCKETCAN:
        return SocketCanSink(place)
    if place.kind is Kind.HUB:
        return HubSink(place)
    return PythonCanSink(place, options)


@final
class RigSink:
    """A bus of an open rig, in the rig's time."""

    def __init__(self, rig: "Rig", bus: str) -> None:
        """Join the bus. Raises PlaceError if the rig has no such bus."""
        self.name = bus
        known = rig.world.bus_names()
        if bus not in known:
            raise PlaceError(f"--on {bus}: the rig has no such bus; available: {', '.join(known)}")
        self.carries_fd = rig.world.bus(bus).data_bitrate_bit_s is not None
        self._queued = 0
        self._port = rig.world.add_host(bus, HOST, self._hear, self._hear_error)

    def _hear(self, frame: bytes, time_ns: int, transmitted: bool) -> None:
        self._queued -= transmitted

    def _hear_error(self, message: bytes, time_ns: int, _: bool) -> None:
        """Ignore error frames; the queue shows the delay."""

    def send(self, frame: bytes) -> None:
        """Queue the frame on the bus."""
        self._queued += 1
        self._port.send(frame)

    def is_ready(self) -> bool:
        """Return True if the queue has room."""
        return self._queued < _QUEUED_MAX

    def is_empty(self) -> bool:
        """Return True if the queue is empty."""
        return not self._queued

    def close(self) -> None:
        """Stop listening."""
        self._port.close()


@final
class HubSink:
    """A bus of `motorhil serve --socket`, which reports when a frame was carried."""

    def __init__(self, place: Place) -> None:
        """Connect to the hub. Raises PlaceError if no hub serves there, or if it refuses."""
        self.name = place.text
        try:
            self._link = HubLink.with_all(place.channel)
        except can.CanError as error:
            raise PlaceError(f"--on {place.text}: {error}") from None
        self.carries_fd = self._link.fd
        self._queued = 0

    def send(self, frame: bytes) -> None:
        """Pass the frame to the hub."""
        try:
            self._link.send(frame)
        except can.CanError as error:
            raise SendError(str(error)) from None
        self._queued += 1

    def is_ready(self) -> bool:
        """Return True if the queue has room; the hub is read only when it may be full."""
        if self._queued >= _QUEUED_MAX // 2:
            self._listen()
        return self._queued < _QUEUED_MAX

    def is_empty(self) -> bool:
        """Return True if the queue is empty."""
        self._listen()
        return not self._queued

    def _listen(self) -> None:
        try:
            while (heard := self._link.receive(0.0)) is not None:
                self._queued -= heard[2]
        except can.CanError as error:
            raise SendError(str(error)) from None

    def close(self) -> None:
        """Disconnect from the hub."""
        self._link.close()


@final
class SocketCanSink:
    """A SocketCAN interface; the kernel's queue limits the rate."""

    def __init__(self, place: Place) -> None:
        """Open the interface. Raises PlaceError if it cannot be used."""
        self.name = place.text
        self._socket = open_interface(place)
        self._socket.setsockopt(_SOL_CAN_RAW, _CAN_RAW_FILTER, b"")  # receive nothing
        self.carries_fd = _mtu(place.channel) >= _FD_MTU
        if self.carries_fd:
            self._socket.setsockopt(_SOL_CAN_RAW, _CAN_RAW_FD_FRAMES, 1)

    def send(self, frame: bytes) -> None:
        """Put the frame into the interface's queue."""
        deadline_s = time.monotonic() + STUCK_S
        while True:
            try:
                self._socket.send(frame)
            except OSError as error:
                # ENOBUFS: the queue (10 frames by default) is full; poll does not report when it
                # has room.
                if error.errno != errno.ENOBUFS:
                    reason = os.strerror(error.errno or 0).lower()
                    raise SendError(f"{self.name}: {reason}") from None
                if time.monotonic() > deadline_s:
                    raise SendError(
                        f"{self.name}: the queue has been full for {STUCK_S:g} s; check that "
                        "another node acknowledges and that the bit rate is right"
                    ) from None
                time.sleep(_PAUSE_S)
            else:
                return

    def is_ready(self) -> bool:
        """Return True: `send` waits."""
        return True

    def is_empty(self) -> bool:
        """Return True: the kernel does not report it."""
        return True

    def close(self) -> None:
        """Close the socket; the interface itself is unaffected."""
        self._socket.close()


@final
class PythonCanSink:
    """Any bus of python-can; received frames are discarded."""

    def __init__(self, place: Place, options: Mapping[str, object]) -> None:
        """Open the bus. Raises PlaceError if it cannot be opened."""
        self.name = place.text
        self._bus = open_bus(place, options)
        fd = (can.CanProtocol.CAN_FD, can.CanProtocol.CAN_FD_NON_ISO)
        self.carries_fd = bool(options.get("fd")) or self._bus.protocol in fd
        self._notifier = can.Notifier(self._bus, [], timeout=0.1)

    def send(self, frame: bytes) -> None:
        """Pass the frame to the interface."""
        try:
            self._bus.send(message_of(frame), STUCK_S)
        except (can.CanError, OSError, ValueError) as error:
            raise SendError(f"{self.name}: {error}") from None

    def is_ready(self) -> bool:
        """Return True: `send` waits."""
        return True

    def is_empty(self) -> bool:
        """Return True: most interfaces do not report it."""
        return True

    def close(self) -> None:
        """Leave the bus."""
        self._notifier.stop(2.0)
        self._bus.shutdown()


def _mtu(interface: str) -> int:
    """Return the largest frame that the interface carries [bytes]; 0 if unknown."""
    with suppress(OSError, ValueError):
        return int(Path(f"/sys/class/net/{interface}/mtu").read_text())
    return 0
