"""Buses for replay: of an open rig, hubs, SocketCAN, python-can.

`DrivenBuses` are those that a recorded host drives, in wall time. Sinks take the frames of recorded
traffic.
"""

import errno
import os
import socket
import time
from collections.abc import Callable, Mapping, Sequence
from contextlib import ExitStack, suppress
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Final, Self, final

import can

from motorhil.emulators.can.controller_config import HOST
from motorhil.harness.python_can.hub_client import HubLink
from motorhil.harness.python_can.messages import to_message
from motorhil.harness.recording.socketcan import open_interface
from motorhil.harness.recording.sources import Kind, Place, PlaceError, open_bus
from motorhil.harness.replay.frames import STUCK_S, SendError, Sink, is_error
from motorhil.harness.replay.host import ReceiveQueue
from motorhil.motorapi.runtime.api import Runtime
from motorhil.motorapi.runtime.wall import WallRuntime
from motorhil.traces.decoding.can_errors import ControllerState, bus_error
from motorhil.traces.mcap.reader import read_trace
from motorhil.traces.mcap.writer import TraceWriter
from motorhil.traces.schema import CAN_FRAME, Direction, Schema

if TYPE_CHECKING:
    from motorhil.harness.replay.host import HostPlayer
    from motorhil.harness.rig.rig import Rig

_INTERFACES: Final = {Kind.SOCKETCAN: "socketcan", Kind.HUB: "emulated"}
_BITRATE_BIT_S: Final = 1_000_000
_SOL_CAN_RAW: Final = 101  # linux/can/raw.h
_CAN_RAW_FILTER: Final = 1
_CAN_RAW_ERR_FILTER: Final = 2
_ERRORS: Final = 0x024  # linux/can/error.h: problems of the controller, no acknowledgement
_CAN_RAW_FD_FRAMES: Final = 5
_FD_MTU: Final = 72
_QUEUED_MAX: Final = 64  # frames given to an emulated bus before it has carried them
_PAUSE_S: Final = 0.0005


@final
class DrivenBuses:
    """Open buses by name, and the recording of their traffic; a context manager.

    Args:
        places: the places, by the bus's name in the recording.
        bitrate_bit_s: bit rate of all buses [bit/s]; None: 1 Mbit/s, for frame durations only.
        live: the file to record to.
        recording: the source of the attachments (rig, EDS), so that both files decode alike.

    Raises:
        PlaceError: a bus cannot be reached.
        TraceError: a file cannot be read or written.
    """

    def __init__(
        self,
        places: Mapping[str, Place],
        bitrate_bit_s: int | None,
        live: Path,
        recording: Path,
    ) -> None:
        self.buses: Sequence[str] = list(places)
        self.lines: Sequence[str] = []
        self.what: str = ", ".join(place.text for place in places.values())
        self._bit_ns = 1_000_000_000 // (bitrate_bit_s or _BITRATE_BIT_S)
        options = {"bitrate": bitrate_bit_s} if bitrate_bit_s else {}
        with ExitStack() as cleanup:
            # The writer is closed last, since the runtime may still deliver frames.
            self._writer = cleanup.enter_context(TraceWriter(live))
            self._open: dict[str, can.BusABC] = {}
            for name, place in places.items():
                interface = _INTERFACES.get(place.kind, place.interface)
                told = options if place.kind is Kind.PYTHON_CAN else {}
                bus = open_bus(replace(place, interface=interface), told)
                cleanup.callback(bus.shutdown)
                self._open[name] = bus
            runtime = WallRuntime()
            cleanup.callback(runtime.close)
            self.runtime: Runtime = runtime
            with read_trace(recording) as trace:
                for one in trace.attachments:
                    self._writer.attach(one.name, one.data, one.media_type)
            self._sources = {name: self._sources_on(name) for name in places}
            self._cleanup = cleanup.pop_all()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self._cleanup.close()

    def bit_times_ns(self, bus: str) -> tuple[int, int]:
        """Return the bit times [ns] of a bus; the data bit rate is not known here."""
        return self._bit_ns, self._bit_ns

    def send(self, bus: str, frame: bytes) -> None:
        """Queue the frame on the bus."""
        self.runtime.send(self._open[bus], frame)

    def listen(self, bus: str, player: "HostPlayer", opening: bytes | None = None) -> None:
        """Connect the player and the recording to a bus, from its own frame `opening` on."""
        heard, sent = self._sources[bus]

        def hear(frame: bytes, time_ns: int, transmitted: bool) -> None:
            self._writer.can_frame(sent if transmitted else heard, time_ns, frame)
            player.heard(bus, frame, time_ns, transmitted)

        self.runtime.listen(self._open[bus], ReceiveQueue(hear, opening).heard)

    def _sources_on(self, bus: str) -> tuple[int, int]:
        channel = self._writer.channel(f"/can/{bus}", Schema.of(CAN_FRAME))
        return (
            self._writer.source(channel, "", Direction.RECEIVED),
            self._writer.source(channel, "host", Direction.TRANSMITTED),
        )


Note = Callable[[str], None]


@final
class _Acknowledgements:
    """Watch on error messages of a bus: says once, and at once, that no node acknowledges."""

    def __init__(self, name: str, note: Note) -> None:
        self._name = name
        self._note = note
        self._is_told = False

    def hear(self, message: bytes) -> None:
        """Take an error message of the own CAN controller."""
        told = bus_error(message)
        lost = told.is_unacknowledged or told.state is ControllerState.PASSIVE
        if lost and not self._is_told:
            self._is_told = True
            self._note(
                f"{self._name}: {told.text}; frames need another node that acknowledges them; "
                "check that one is on the bus, its power and its bit rate"
            )


def open_sink(place: Place, options: Mapping[str, object], note: Note) -> Sink:
    """Open the sink of a bus.

    Args:
        place: a bus outside the rig.
        options: of python-can's interface (bitrate, fd).
        note: called once if no node acknowledges the frames.

    Raises:
        PlaceError: the bus cannot be reached.
    """
    if place.kind is Kind.SOCKETCAN:
        return SocketCanSink(place, note)
    if place.kind is Kind.HUB:
        return HubSink(place, note)
    return PythonCanSink(place, options)


@final
class RigSink:
    """A bus of an open rig, in the rig's time."""

    def __init__(self, rig: "Rig", bus: str, note: Note) -> None:
        """Join the bus. Raises PlaceError if the rig has no such bus."""
        self.name = bus
        known = rig.world.bus_names()
        if bus not in known:
            raise PlaceError(f"--on {bus}: the rig has no such bus; available: {', '.join(known)}")
        self.carries_fd: bool = rig.world.bus(bus).data_bitrate_bit_s is not None
        self._queued = 0
        self._acknowledgements = _Acknowledgements(bus, note)
        self._port = rig.world.add_host(bus, HOST, self._hear, self._hear_error)

    def _hear(self, frame: bytes, time_ns: int, transmitted: bool) -> None:
        self._queued -= transmitted

    def _hear_error(self, message: bytes, time_ns: int, _: bool) -> None:
        self._acknowledgements.hear(message)

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

    def __init__(self, place: Place, note: Note) -> None:
        """Connect to the hub. Raises PlaceError if no hub serves there, or if it refuses."""
        self.name: str = place.text
        self._acknowledgements = _Acknowledgements(place.text, note)
        try:
            self._link = HubLink.with_all(place.channel)
        except can.CanError as error:
            raise PlaceError(f"--on {place.text}: {error}") from None
        self.carries_fd: bool = self._link.fd
        self._queued = 0

    def send(self, frame: bytes) -> None:
        """Pass the frame to the hub."""
        try:
            self._link.send(frame)
        except can.CanError as error:
            raise SendError(str(error)) from None
        self._queued += 1

    def is_ready(self) -> bool:
        """Return True if the queue has room."""
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
                if is_error(heard[0]):
                    self._acknowledgements.hear(heard[0])
        except can.CanError as error:
            raise SendError(str(error)) from None

    def close(self) -> None:
        """Disconnect from the hub."""
        self._link.close()


@final
class SocketCanSink:
    """A SocketCAN interface; the kernel's queue limits the rate."""

    def __init__(self, place: Place, note: Note) -> None:
        """Open the interface. Raises PlaceError if it cannot be used."""
        self.name: str = place.text
        self._acknowledgements = _Acknowledgements(place.text, note)
        self._socket = open_interface(place)
        self._socket.setsockopt(_SOL_CAN_RAW, _CAN_RAW_FILTER, b"")  # receive no frames
        self._socket.setsockopt(_SOL_CAN_RAW, _CAN_RAW_ERR_FILTER, _ERRORS)
        self.carries_fd: bool = _mtu(place.channel) >= _FD_MTU
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
        self._listen()
        return True

    def is_empty(self) -> bool:
        """Return True: the kernel does not report it."""
        self._listen()
        return True

    def _listen(self) -> None:
        """Read the error messages of the controller."""
        with suppress(OSError):
            while True:
                self._acknowledgements.hear(self._socket.recv(_FD_MTU, socket.MSG_DONTWAIT))

    def close(self) -> None:
        """Close the socket; the interface itself is unaffected."""
        self._socket.close()


@final
class PythonCanSink:
    """Any bus of python-can; received frames are discarded."""

    def __init__(self, place: Place, options: Mapping[str, object]) -> None:
        """Open the bus. Raises PlaceError if it cannot be opened."""
        self.name: str = place.text
        self._bus = open_bus(place, options)
        fd = (can.CanProtocol.CAN_FD, can.CanProtocol.CAN_FD_NON_ISO)
        self.carries_fd: bool = bool(options.get("fd")) or self._bus.protocol in fd
        self._notifier = can.Notifier(self._bus, [], timeout=0.1)

    def send(self, frame: bytes) -> None:
        """Pass the frame to the interface."""
        try:
            self._bus.send(to_message(frame, 0, self.name, received=False), STUCK_S)
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
