"""What a bus being recorded offers to the loop that reads it, and one that is a hub's."""

from typing import Final, Protocol, final

from can import CanError

from harness.hub_client import HubLink
from harness.recording.places import Kind, Place, PlaceError
from traces.chunk import Entry

POLLED: Final = -1
_BATCH: Final = 1024


class BusDownError(Exception):
    """The bus gives nothing now but may again; says why."""


class BusEndedError(Exception):
    """The bus will give nothing any more; says why."""


class Tap(Protocol):
    """One bus being read.

    Attributes:
        default_name: what it is called if nobody says.
        source: the number of its first of two sources; whoever records sets it.
    """

    default_name: str
    source: int

    @property
    def dropped(self) -> int:
        """Frames lost on the way to us, as far as is known."""

    @property
    def clock(self) -> str:
        """Whose its stamps are, in words; may become known with the first frame."""

    def fileno(self) -> int:
        """What becomes readable when there is something; POLLED: look every now and then."""

    def read(self, now_ns: int) -> list[Entry]:
        """What has come (source, time [ns since 1970], frame), a bounded number; [] if nothing has.

        Raises:
            BusDownError: not now; it may be read again.
            BusEndedError: nor ever again.
        """

    def close(self) -> None:
        """The bus has been left."""


@final
class HubTap:
    """A bus of `motorhil serve --socket`: lossless, in the bus's own order, with its own times.

    All buses of a hub have one clock, so they must be shifted alike: `moved_ns`.
    """

    def __init__(self, place: Place, clocks: "HubClocks") -> None:
        """Connected.

        Raises:
            PlaceError: nobody serves there, or the hub refuses.
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
        """The hub's own, or moved by how much."""
        moved_ns = self._clocks.moved_ns.get(self._path, 0)
        return "the hub's" + (f", moved by {moved_ns} ns to ns since 1970" if moved_ns else "")

    def fileno(self) -> int:
        """The socket's."""
        return self._link.fileno()

    def read(self, now_ns: int) -> list[Entry]:
        """What has come; see Tap. Frames of the application that records: there are none."""
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
        """Disconnected."""
        self._link.close()


@final
class HubClocks:
    """By how much the times of each hub are moved to become ns since 1970.

    Where everything comes from one hub, its own times are kept as they are.
    """

    def __init__(self, places: list[Place]) -> None:
        """For a recording from these places."""
        hubs = {place.channel.partition("#")[0] for place in places if place.kind is Kind.HUB}
        self.moved_ns: dict[str, int] = {}
        self.keeps = len(hubs) == 1 and all(place.kind is Kind.HUB for place in places)

    def shift(self, path: str, time_ns: int, now_ns: int) -> int:
        """What to add to the times of this hub; it is `now_ns`, and something came at `time_ns`."""
        if self.keeps:
            return 0
        return self.moved_ns.setdefault(path, now_ns - time_ns)
