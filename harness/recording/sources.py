"""Buses to record from: their places, and taps of hubs and of python-can.

A place is the value of the option `--on`: which bus, how it is reached, and its recorded name. A
tap reads the new frames of one bus. Here are also the conversions between messages of python-can
and frames, which replay needs too.
"""

import re
from collections import deque
from collections.abc import Mapping, Sequence
from enum import Enum
from typing import Final, Protocol, final

import can
from can import CanError

from motorhil.frozen import frozen
from motorhil.harness.python_can.hub_client import HubLink
from motorhil.traces.can_frame import BRS, EFF, ERR, ESI, RTR, classic, flexible, remote
from motorhil.traces.mcap.chunk import Entry

POLLED: Final = -1
_BATCH: Final = 1024
_NS: Final = 1_000_000_000
_STAMP_MAX_S: Final = 9e9  # of 2255; later times do not fit a recording, with any offset
_FAR_S: Final = 86_400.0  # a stamp further from the wall clock does not count from 1970
_PYTHON_CAN_BATCH: Final = 4096
_LINUX_ERRORS: Final = (
    *("emulated", "gs_usb", "serial", "socketcan", "socketcand", "udp_multicast", "virtual"),
)
"""The interfaces of python-can 4.6.1 whose error frames use Linux's error classes."""
_BUS_ERROR: Final = 0x80
_NAME: Final = re.compile(r"[\w.-]+")
_INTERFACE_MAX: Final = 15  # IFNAMSIZ of linux/if.h, without the terminating zero


class PlaceError(Exception):
    """An unreachable or wrongly specified bus; the message gives the reason and the remedy."""


@final
class Kind(Enum):
    """The way in which a bus is reached."""

    SOCKETCAN = "SocketCAN"
    HUB = "hub"
    PYTHON_CAN = "python-can"


@final
@frozen
class Place:
    """A bus to record from or to send to.

    Attributes:
        text: the option's value as given.
        kind: the way in which it is reached.
        interface: python-can's interface name; "" for other kinds.
        channel: the SocketCAN interface, the hub's socket (PATH or PATH#BUS), or python-can's
            channel.
        name: the requested name of the bus; "" if none was given.
    """

    text: str
    kind: Kind
    interface: str
    channel: str
    name: str


def parse_place(text: str) -> Place:
    """Parse `[NAME=]WHERE` into a place.

    WHERE is a SocketCAN interface (`vcan0`), the socket of `motorhil serve --socket` (any text with
    a slash; `PATH#can1` selects a bus other than the first), or `interface:channel` of python-can.

    Raises:
        PlaceError: the text names no bus.
    """
    before, equals, where = text.partition("=")
    name = before if equals and _NAME.fullmatch(before) else ""
    if not name:
        where = text
    if "/" in where.partition(":")[0]:
        return Place(text, Kind.HUB, "", where, name)
    interface, colon, channel = where.partition(":")
    if colon:
        if not interface or not channel:
            raise PlaceError(
                f"--on {text}: incomplete python-can bus; write "
                "interface:channel, as in --on pcan:PCAN_USBBUS1"
            )
        return Place(text, Kind.PYTHON_CAN, interface, channel, name)
    if not where or "=" in where or len(where) > _INTERFACE_MAX or " " in where:
        raise PlaceError(
            f"--on {text}: names no bus; write a SocketCAN interface (vcan0), the path of a "
            "hub's socket (./hub), or interface:channel of python-can, each optionally after "
            "NAME="
        )
    return Place(text, Kind.SOCKETCAN, "", where, name)


def places_of_buses(texts: Sequence[str], buses: Sequence[str]) -> dict[str, Place]:
    """Return the place for each recorded bus, from `[BUS=]WHERE`; a single bus needs no name.

    Args:
        texts: the values of `--on`.
        buses: the buses of the recording, at least one.

    Raises:
        PlaceError: a value names no bus, or does not identify one recorded bus.
    """
    found: dict[str, Place] = {}
    for place in map(parse_place, texts):
        name = place.name or (buses[0] if len(buses) == 1 else "")
        if name not in buses or name in found:
            what = f"{name} has a destination already"
            if name not in found:
                what = f"the recording has frames of {', '.join(buses)}"
            raise PlaceError(f"--on {place.text}: {what}; write --on {buses[0]}=WHERE")
        found[name] = place
    return found


def topic_name(text: str) -> str:
    """Return the text as a valid bus name: only letters, digits, `_`, `-` and `.`."""
    return "_".join(_NAME.findall(text)) or "can"


def refuse_twice(names: Sequence[str], places: Sequence[Place]) -> None:
    """Check that all buses are distinct.

    Raises:
        PlaceError: two buses have the same name or are the same bus.
    """
    known: dict[str, Place] = {}
    for name, place in zip(names, places, strict=True):
        other = known.setdefault(name, place)
        if other is not place:
            raise PlaceError(
                f"--on {place.text}: the name {name} is used already, by {other.text}; give it "
                f"another name: --on NAME={place.text.rpartition('=')[2]}"
            )


class BusDownError(Exception):
    """A bus that cannot be read now but may recover; the message says why."""


class BusEndedError(Exception):
    """A bus that has ended for good; the message says why."""


class Tap(Protocol):
    """One bus being read.

    Attributes:
        default_name: the bus's name if none is given.
        source: the number of its first of two sources, set by the recorder.
    """

    default_name: str
    source: int

    @property
    def dropped(self) -> int:
        """Number of frames known to be lost before they reached the tap."""

    @property
    def clock(self) -> str:
        """Description of the clock of the stamps; may be unknown until the first frame."""

    def fileno(self) -> int:
        """Return the descriptor that becomes readable when frames arrive, or POLLED."""

    def read(self, now_ns: int) -> list[Entry]:
        """Return (source, time [ns since 1970], frame) of new frames, a bounded number; [] if none.

        Raises:
            BusDownError: the bus cannot be read now, or has odd times; it may be read again.
            BusEndedError: the bus cannot be read any more.
        """

    def close(self) -> None:
        """Leave the bus."""


@final
class HubTap:
    """Lossless tap of a `motorhil serve --socket` bus, in its own order and with its own times.

    All buses of a hub share one clock, so they are shifted by the same `moved_ns`.
    """

    def __init__(self, place: Place, clocks: "HubClocks") -> None:
        """Connect to the hub.

        Raises:
            PlaceError: no hub serves there, or the hub refuses the connection.
        """
        try:
            self._link = HubLink.with_all(place.channel)
        except CanError as error:
            raise PlaceError(f"--on {place.text}: {error}") from None
        self.default_name: str = self._link.bus
        self.dropped = 0
        self.source = 0
        self._clocks = clocks
        self._path = self._link.path

    @property
    def clock(self) -> str:
        """The hub's own clock, with the applied shift."""
        moved_ns = self._clocks.moved_ns.get(self._path, 0)
        return "the hub's" + (f", moved by {moved_ns} ns to ns since 1970" if moved_ns else "")

    def fileno(self) -> int:
        """Return the socket's descriptor."""
        return self._link.fileno()

    def read(self, now_ns: int) -> list[Entry]:
        """Return the entries that have arrived; see `Tap.read`.

        The recorder itself sends no frames.
        """
        entries: list[Entry] = []
        try:
            while len(entries) < _BATCH:
                heard = self._link.receive(0.0)
                if heard is None:
                    break
                frame, time_ns, transmitted = heard
                moved_ns = self._clocks.shift(self._path, time_ns, now_ns)
                entries.append((self.source + transmitted, time_ns + moved_ns, frame))
        except CanError as error:
            if not entries:
                raise BusEndedError(str(error)) from None
        return entries

    def close(self) -> None:
        """Disconnect from the hub."""
        self._link.close()


@final
class HubClocks:
    """Shifts that convert each hub's times to ns since 1970.

    The times of a single hub stay unchanged if it is the only source.
    """

    def __init__(self, places: list[Place]) -> None:
        """Decide from the recorded places whether the hub's own times are kept."""
        hubs = {place.channel.partition("#")[0] for place in places if place.kind is Kind.HUB}
        self.moved_ns: dict[str, int] = {}
        self.keeps: bool = len(hubs) == 1 and all(place.kind is Kind.HUB for place in places)

    def shift(self, path: str, time_ns: int, now_ns: int) -> int:
        """Return the shift of this hub's times [ns], fixed by its first frame at `time_ns`."""
        if self.keeps:
            return 0
        return self.moved_ns.setdefault(path, now_ns - time_ns)


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
        self.default_name: str = topic_name(place.channel)
        self.dropped: int = 0
        self.source = 0
        self._bus = open_bus(place, options)
        self._text = place.text
        self._interface = place.interface
        self._backlog = _Backlog()
        self._moved_ns: int | None = None
        self._odd_stamp = ""  # the problem of the first stamp that is not a time
        self._is_told = False
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
        if self._odd_stamp and not self._is_told:
            self._is_told = True
            raise BusDownError(self._odd_stamp)
        messages = self._backlog.messages
        entries: list[Entry] = []
        while messages and len(entries) < _PYTHON_CAN_BATCH:
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
        if not 0.0 < stamp_s < _STAMP_MAX_S:
            if stamp_s != 0.0 and not self._odd_stamp:  # 0: python-can's value for none
                what = f"{self._text}: a frame has the stamp {stamp_s:g} s"
                self._odd_stamp = f"{what}; such frames get this computer's time"
            return now_ns
        if self._moved_ns is None:
            far = abs(stamp_s - now_ns / _NS) > _FAR_S
            self._moved_ns = now_ns - round(stamp_s * 1e9) if far else 0
        return max(0, round(stamp_s * 1e9) + self._moved_ns)

    def close(self) -> None:
        """Stop reading and shut the bus down."""
        self._notifier.stop(2.0)
        self._bus.shutdown()
