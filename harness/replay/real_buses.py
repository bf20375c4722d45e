"""Buses outside the rig that a recorded host drives, in wall time."""

from collections.abc import Mapping, Sequence
from contextlib import ExitStack
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Final, Self, final

from harness.recording.places import Kind, Place
from harness.recording.python_can import open_bus
from harness.replay.ears import Ears
from motorapi.runtime import Runtime
from motorapi.wall_runtime import WallRuntime
from traces.reader import read_trace
from traces.schema import CAN_FRAME, Direction, Schema
from traces.writer import TraceWriter

if TYPE_CHECKING:
    import can

    from harness.replay.host_player import HostPlayer

_INTERFACES: Final = {Kind.SOCKETCAN: "socketcan", Kind.HUB: "emulated"}
_BITRATE_BIT_S: Final = 1_000_000


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
        self.what = ", ".join(place.text for place in places.values())
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

        self.runtime.listen(self._open[bus], Ears(hear, opening).heard)

    def _sources_on(self, bus: str) -> tuple[int, int]:
        channel = self._writer.channel(f"/can/{bus}", Schema.of(CAN_FRAME))
        return (
            self._writer.source(channel, "", Direction.RECEIVED),
            self._writer.source(channel, "host", Direction.TRANSMITTED),
        )
