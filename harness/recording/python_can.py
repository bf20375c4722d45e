"""Any bus that python-can reaches, being recorded; and its messages as frames, both ways."""

from collections import deque
from collections.abc import Mapping
from typing import Final, final

import can

from harness.recording.places import Place, PlaceError, topic_name
from harness.recording.taps import POLLED, BusEndedError
from traces.chunk import Entry
from traces.traffic import BRS, EFF, ERR, ESI, RTR, classic, fields, flexible, remote

_NS: Final = 1_000_000_000
_FAR_S: Final = 86_400.0  # further from our clock, a stamp counts from something else than 1970
_BATCH: Final = 4096
_LINUX_ERRORS: Final = (
    *("emulated", "gs_usb", "serial", "socketcan", "socketcand", "udp_multicast", "virtual"),
)
"""Interfaces of python-can 4.6.1 whose error frames have Linux's classes; others have their own."""
_BUS_ERROR: Final = 0x80


def frame_of(message: can.Message, interface: str = "socketcan") -> bytes:
    """The can_frame or canfd_frame of a message of this interface.

    Where an error frame has other classes than Linux's, it is told as a bus error and no more.

    Raises:
        ValueError: it cannot be one.
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
    """The message to send for a frame."""
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
    """python-can's bus there.

    Raises:
        PlaceError: python-can knows no such interface, or cannot open it.
    """
    if place.interface not in can.VALID_INTERFACES:
        known = ", ".join(sorted(can.VALID_INTERFACES))
        raise PlaceError(
            f"--on {place.text}: python-can has no interface {place.interface!r}; it has {known}"
        )
    try:
        return can.Bus(interface=place.interface, channel=place.channel, **options)  # type: ignore[arg-type]  # options of any interface
    except Exception as error:  # drivers raise whatever they like: their words, and a place
        raise PlaceError(
            f"--on {place.text}: {str(error) or type(error).__name__}; is the adapter there, its "
            "driver installed, and --bitrate N or --fd said where it needs it?"
        ) from error


@final
class _Backlog(can.Listener):
    """What python-can's reading thread has heard."""

    def __init__(self) -> None:
        self.messages: deque[can.Message] = deque()
        self.error: Exception | None = None

    def on_message_received(self, msg: can.Message) -> None:
        self.messages.append(msg)

    def on_error(self, exc: Exception) -> None:
        self.error = exc

    def stop(self) -> None:
        """Nothing is to be stopped."""


@final
class PythonCanTap:
    """One bus of python-can, read by its Notifier.

    Attributes:
        unreadable: messages that no frame can hold; they count as dropped.
    """

    def __init__(self, place: Place, options: Mapping[str, object]) -> None:
        """It is being read. Raises PlaceError: it cannot be."""
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
        """The interface's own."""
        moved = ", moved by {} ns to ns since 1970".format
        return "of python-can's interface" + (moved(self._moved_ns) if self._moved_ns else "")

    def fileno(self) -> int:
        """None: it is read elsewhere."""
        return POLLED

    def read(self, now_ns: int) -> list[Entry]:
        """What has come; see Tap."""
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
        """The stamp since 1970; what counts from elsewhere is moved, always by the same."""
        if not stamp_s > 0.0:
            return now_ns
        if self._moved_ns is None:
            far = abs(stamp_s - now_ns / _NS) > _FAR_S
            self._moved_ns = now_ns - round(stamp_s * 1e9) if far else 0
        return max(0, round(stamp_s * 1e9) + self._moved_ns)

    def close(self) -> None:
        """The bus has been left."""
        self._notifier.stop(2.0)
        self._bus.shutdown()
