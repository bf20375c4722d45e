"""Taps: the interface of a bus being recorded, and the tap of a hub's bus."""

from typing import Final, Protocol, final

from can import CanError

from harness.hub_client import HubLink
from harness.recording.places import Kind, Place, PlaceError
from traces.chunk import Entry

POLLED: Final = -1
_BATCH: Final = 1024


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
            BusDownError: the bus cannot be read now; it may be read again.
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
        self.default_name = self._link.bus
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
        self.keeps = len(hubs) == 1 and all(place.kind is Kind.HUB for place in places)

    def shift(self, path: str, time_ns: int, now_ns: int) -> int:
        """Return the shift of this hub's times [ns], fixed by its first frame at `time_ns`."""
        if self.keeps:
            return 0
        return self.moved_ns.setdefault(path, now_ns - time_ns)
