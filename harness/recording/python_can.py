"""Recording of python-can buses, and conversion of messages and frames."""

from collections import deque
from collections.abc import Mapping
from typing import Final, final

import can

from harness.recording.places import Place, PlaceError, topic_name
from harness.recording.taps import POLLED, BusEndedError
from traces.chunk import Entry
from traces.traffic import BRS, EFF, ERR, ESI, RTR, classic, fields, flexible, remote

_NS: Final = 1_000_000_000
_FAR_S: Final = 86_400.0  # a stamp further from the wall clock does not count from 1970
_BATCH: Final = 4096
_LINUX_ERRORS: Final = (
    *("emulated", "gs_usb", "serial", "socketcan", "socketcand", "udp_multicast", "virtual"),
)
"""The interfaces of python-can 4.6.1 whose error frames use Linux's error classes."""
_BUS_ERROR: Final = 0x80


def frame_of(message: can.Message, interface: str = "socketcan") -> bytes:
    """Return the can_frame or canfd_frame of a message from this interface.

    An error frame of an interface without Linux's error classes becomes a plain bus error.

    Raises:
        ValueError: the message cannot be represented as a frame.
    """
    can_id = message.arbitration_id
    if message.is_error_frame:
        if interface not in _LINUX_ERRORS:
            return classic(ERR | _BUS_ERROR, bytes(8))
        can_id |= ERR
    elif message.is_extended_id:
        can_id |= EFF
    if message.is_remote_frame:
        return remote(can_id & ~RTR, message.dlc)
    data = bytes(message.data)
    if message.is_fd:
        flags = (BRS if message.bitrate_switch else 0) | (
            ESI if message.error_state_indicator else 0
        )
        return flexible(can_id, flags, data)
    return classic(can_id, data)


def message_of(frame: bytes) -> can.Message:
    """Return the message to send for a frame."""
    told = fields(frame)
    asks = bool(told.can_id & RTR)
    return can.Message(
        arbitration_id=told.identifier,
        is_extended_id=bool(told.can_id & EFF),
        is_remote_frame=asks,
        is_fd=told.fd,
        bitrate_switch=bool(told.flags & BRS),
        error_state_indicator=bool(told.flags & ESI),
        dlc=told.length,
        data=None if asks else told.data,
    )


def open_bus(place: Place, options: Mapping[str, object]) -> can.BusABC:
    """Open the python-can bus at a place.

    Raises:
        PlaceError: python-can does not know the interface, or cannot open it.
    """
    if place.interface not in can.VALID_INTERFACES:
        known = ", ".join(sorted(can.VALID_INTERFACES))
        raise PlaceError(
            f"--on {place.text}: python-can has no interface {place.interface!r}; available: "
            f"{known}"
        )
    try:
        return can.Bus(interface=place.interface, channel=place.channel, **options)  # type: ignore[arg-type]  # options of any interface
    except Exception as error:  # drivers raise exceptions of any type
        raise PlaceError(
            f"--on {place.text}: {str(error) or type(error).__name__}; check that the adapter "
            "is connected and its driver installed, and give --bitrate N or --fd where it "
            "needs them"
        ) from error


@final
class _Backlog(can.Listener):
    """Messages heard by python-can's reading thread."""

    def __init__(self) -> None:
        self.messages: deque[can.Message] = deque()
        self.error: Exception | None = None

    def on_message_received(self, msg: can.Message) -> None:
        self.messages.append(msg)

    def on_error(self, exc: Exception) -> None:
        self.error = exc

    def stop(self) -> None:
        """Do nothing; the backlog has nothing to stop."""


@final
class PythonCanTap:
    """One bus of python-can, read by its Notifier.

    Attributes:
        dropped: number of messages that do not fit a frame.
    """

    def __init__(self, place: Place, options: Mapping[str, object]) -> None:
        """Open the bus and start reading it. Raises PlaceError if it cannot be opened."""
        self.default_name = topic_name(place.channel)
        self.dropped = 0
        self.source = 0
        self._bus = open_bus(place, options)
        self._text = place.text
        self._interface = place.interface
        self._backlog = _Backlog()
        self._moved_ns: int | None = None
        self._notifier = can.Notifier(self._bus, [self._backlog], timeout=0.1)

    @property
    def clock(self) -> str:
        """The clock of the python-can interface."""
        moved = ", moved by {} ns to ns since 1970".format
        return "of python-can's interface" + (moved(self._moved_ns) if self._moved_ns else "")

    def fileno(self) -> int:
        """Return POLLED, since the Notifier reads the descriptor."""
        return POLLED

    def read(self, now_ns: int) -> list[Entry]:
        """Return the entries that have arrived; see `Tap.read`."""
        messages = self._backlog.messages
        entries: list[Entry] = []
        while messages and len(entries) < _BATCH:
            message = messages.popleft()
            try:
                frame = frame_of(message, self._interface)
            except ValueError:
                self.dropped += 1
                continue
            time_ns = self._time_ns(message.timestamp, now_ns)
            entries.append((self.source + (not message.is_rx), time_ns, frame))
        if not entries and self._backlog.error is not None:
            raise BusEndedError(f"{self._text}: {self._backlog.error}")
        return entries

    def _time_ns(self, stamp_s: float, now_ns: int) -> int:
        """Return the stamp in ns since 1970; other epochs are shifted by a constant offset."""
        if not stamp_s > 0.0:
            return now_ns
        if self._moved_ns is None:
            far = abs(stamp_s - now_ns / _NS) > _FAR_S
            self._moved_ns = now_ns - round(stamp_s * 1e9) if far else 0
        return max(0, round(stamp_s * 1e9) + self._moved_ns)

    def close(self) -> None:
        """Stop reading and shut the bus down."""
        self._notifier.stop(2.0)
        self._bus.shutdown()
