"""Replay of recorded frames: at their times, scaled, or without pauses.

The schedule is absolute. A frame's due time follows from its own stamp and the start of the replay,
never from the transmission of the previous frame. Delays therefore do not accumulate, over an hour
or a day. A delay of the machine affects only the frames of that moment, and is measured.

The same code serves virtual time and wall time; it waits only in a Runtime.

The cost of a replay grows with its frames, some 0.1 ms of processor time each, and in virtual time
with the frames that the rig sends in between: some milliseconds for a second with ten heartbeats. A
pause of an hour therefore takes seconds. Longer ones are refused unless allowed, and so are damaged
stamps.
"""

from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import dataclass, field
from fractions import Fraction
from typing import Final, Protocol, final

from motorhil.emulators.can.frame_length import INTERMISSION_BITS, LENGTHS_MASK, measure, phases_of
from motorhil.frozen import frozen
from motorhil.motorapi.runtime.api import Runtime
from motorhil.traces.can_frame import EFF_MASK, ERR
from motorhil.traces.decoding.canopen import CanopenDecoder
from motorhil.traces.decoding.events import Kind
from motorhil.traces.errors import TraceError
from motorhil.traces.formats.frames import NS, Frame

STUCK_S: Final = 2.0
PAUSE_MAX_S: Final = 3_600.0
"""The longest pause that is replayed by default [s]."""
STRAY_NS: Final = 60 * NS
"""How far a stamp may be after both its neighbours, or before both [ns]."""
_CLASSIC_SIZE: Final = 16
_BITS: Final = 6  # values are kept to 1 part in 32


class SendError(Exception):
    """A bus that does not take a frame; the message names the bus, the reason and the remedy."""


class Sink(Protocol):
    """Destination of the frames of a recorded bus.

    Attributes:
        name: its name in messages.
        carries_fd: True if it takes CAN FD frames.
    """

    name: str
    carries_fd: bool

    def send(self, frame: bytes) -> None:
        """Queue the frame on the bus. Raises SendError."""

    def is_ready(self) -> bool:
        """Return True if it takes another frame; called before each. Raises SendError."""

    def is_empty(self) -> bool:
        """Return True if all queued frames were on the bus. Raises SendError."""

    def close(self) -> None:
        """Leave the bus."""


@final
@frozen
class Choice:
    """Selection of the frames that pass every given filter.

    Attributes:
        buses: names of buses.
        identifiers: CAN identifiers.
        nodes: node-IDs that a CANopen frame is about; NMT to all nodes passes.
        from_ns, to_ns: log times [ns]; inclusive, exclusive.
    """

    buses: tuple[str, ...] | None = None
    identifiers: tuple[int, ...] | None = None
    nodes: tuple[int, ...] | None = None
    from_ns: int | None = None
    to_ns: int | None = None

    def of(self, frames: Iterable[Frame]) -> Iterator[Frame]:
        """Yield the selected frames in order; `frames` must begin with the recording."""
        decoders: dict[str, CanopenDecoder] = {}
        for frame in frames:
            time_ns, bus, data = frame[:3]
            if self.buses is not None and bus not in self.buses:
                continue
            if self.nodes is not None:  # all frames are decoded, to map PDOs to nodes
                if bus not in decoders:
                    decoders[bus] = CanopenDecoder({}, {})
                said = decoders[bus].decode(data)
                to_all = said.kind is Kind.NMT and said.node is None
                if said.node not in self.nodes and not to_all:
                    continue
            identifier = int.from_bytes(data[:4], "little") & EFF_MASK
            if self.identifiers is not None and (
                identifier not in self.identifiers or is_error(data)
            ):
                continue
            if (self.from_ns is None or time_ns >= self.from_ns) and (
                self.to_ns is None or time_ns < self.to_ns
            ):
                yield frame


@final
class Pauses:
    """The longest pause that a replay keeps, and a stamp that contradicts both its neighbours.

    A replay waits for each stamp beyond all before it, and first of all for the earliest stamp.
    """

    def __init__(self) -> None:
        self._first_ns: int | None = None
        self._earliest = (0, "")  # with its bus
        self._latest_ns = 0
        self._longest = (0, 0, "")  # with its end and bus
        self._stray: tuple[int, int, str] | None = None
        self._last: dict[str, tuple[int, int]] = {}  # two stamps, by bus

    def take(self, bus: str, time_ns: int) -> None:
        """Take the stamp of the next message on a bus [ns]."""
        if self._first_ns is None:
            self._first_ns = self._latest_ns = time_ns
            self._earliest = time_ns, bus
        if time_ns < self._earliest[0]:
            self._earliest = time_ns, bus
        elif time_ns > self._latest_ns:
            if time_ns - self._latest_ns > self._longest[0]:
                self._longest = time_ns - self._latest_ns, time_ns, bus
            self._latest_ns = time_ns
        before_ns, stamp_ns = self._last.get(bus, (time_ns, time_ns))
        if self._stray is None and abs(stamp_ns - before_ns) > STRAY_NS:
            off_ns = min(stamp_ns - before_ns, stamp_ns - time_ns, key=abs)
            if (stamp_ns > before_ns) is (stamp_ns > time_ns) and abs(off_ns) > STRAY_NS:
                self._stray = off_ns, stamp_ns, bus
        self._last[bus] = stamp_ns, time_ns

    def refuse(self, recording: str, longest_s: float) -> None:
        """Raise TraceError for a stray stamp, or for a pause of more than `longest_s`."""
        if self._stray is not None:
            off_ns, stamp_ns, bus = self._stray
            side = "after" if off_ns > 0 else "before"
            raise TraceError(
                recording,
                f"the stamp {stamp_ns / NS:.6f} s on {bus} is {abs(off_ns) / NS:.6g} s {side} both "
                f"its neighbours; expected at most {STRAY_NS // NS} s",
                remedy="correct it, or remove this frame",
            )
        pause_ns, stamp_ns, bus = self._longest
        lead_ns = (self._first_ns or 0) - self._earliest[0]
        what = f"{pause_ns / NS:.6g} s after all before it"
        if lead_ns > pause_ns:
            pause_ns, (stamp_ns, bus) = lead_ns, self._earliest
            what = f"{lead_ns / NS:.6g} s before the first of the recording"
        if pause_ns > longest_s * NS:
            raise TraceError(
                recording,
                f"the stamp {stamp_ns / NS:.6f} s on {bus} is {what}; "
                f"expected at most {longest_s:g} s",
                remedy="correct it, or allow this pause by --max-pause",
            )


@final
@dataclass(slots=True)
class Survey:
    """Summary of the frames to send.

    Attributes:
        frames, long_frames, error_frames: numbers of all, CAN FD and error frames, by bus.
        first_ns, last_ns: the earliest and the latest log time [ns].
        pauses: the pauses between them.
    """

    frames: dict[str, int] = field(default_factory=dict)
    long_frames: dict[str, int] = field(default_factory=dict)
    error_frames: dict[str, int] = field(default_factory=dict)
    first_ns: int = 0
    last_ns: int = 0
    pauses: Pauses = field(default_factory=Pauses)

    @property
    def span_ns(self) -> int:
        """The time between the first and the last frame [ns]."""
        return self.last_ns - self.first_ns


def survey(frames: Iterable[Frame]) -> Survey:
    """Count these frames."""
    found = Survey()
    first: int | None = None
    for time_ns, bus, data, _, _ in frames:
        first = time_ns if first is None or time_ns < first else first
        found.last_ns = max(found.last_ns, time_ns)
        found.pauses.take(bus, time_ns)
        found.frames[bus] = found.frames.get(bus, 0) + 1
        if len(data) > _CLASSIC_SIZE:
            found.long_frames[bus] = found.long_frames.get(bus, 0) + 1
        elif is_error(data):
            found.error_frames[bus] = found.error_frames.get(bus, 0) + 1
    found.first_ns = first or 0
    return found


def duration_ns(frame: bytes, bit_ns: int, data_bit_ns: int) -> int:
    """Return the time from the first to the last bit of a frame [ns].

    Args:
        frame: a can_frame or canfd_frame.
        bit_ns: nominal bit time [ns].
        data_bit_ns: bit time of the CAN FD data phase [ns].

    Raises:
        ValueError: the frame is impossible on a bus.
    """
    nominal, data = phases_of(measure(frame) & LENGTHS_MASK)
    return (nominal - INTERMISSION_BITS) * bit_ns + data * data_bit_ns


def is_error(frame: bytes) -> bool:
    """Return True for an error frame, which is a controller's report and not traffic."""
    return bool(int.from_bytes(frame[:4], "little") & ERR)


def refuse_long(found: Survey, sinks: Mapping[str, Sink]) -> None:
    """Raise SendError if there are CAN FD frames for a bus that does not carry them."""
    for bus, count in found.long_frames.items():
        sink = sinks.get(bus)
        if sink is not None and not sink.carries_fd:
            raise SendError(
                f"{sink.name}: {count} frames of {bus} are CAN FD, which this bus does not "
                "carry; nothing was sent; choose a CAN FD bus, or give --fd where the "
                "interface supports it"
            )


@final
class Lateness:
    """Histogram of delays [ns]; quantiles are at most 1/32 too large.

    Attributes:
        count: the number of delays.
        worst_ns, last_ns: the exact largest and last delay [ns]; 0 if there is none.
    """

    def __init__(self) -> None:
        self.count: int = 0
        self.worst_ns: int = 0
        self.last_ns: int = 0
        self._counts: dict[tuple[int, int], int] = {}

    def add(self, late_ns: int) -> None:
        """Add one delay; negative values count as 0."""
        late_ns = max(0, late_ns)
        self.count += 1
        self.last_ns = late_ns
        self.worst_ns = max(self.worst_ns, late_ns)
        shift = max(0, late_ns.bit_length() - _BITS)
        key = shift, late_ns >> shift
        self._counts[key] = self._counts.get(key, 0) + 1

    def quantile_ns(self, share: float) -> int:
        """Return the delay that this share of all delays (0 to 1) does not exceed; 0 if none."""
        left = share * self.count
        for (shift, high), count in sorted(self._counts.items()):
            left -= count
            if left <= 0:
                return min(self.worst_ns, ((high + 1) << shift) - 1)
        return self.worst_ns


@final
@dataclass(slots=True)
class Replayed:
    """Result of a replay, updated while it runs.

    Attributes:
        sent: number of frames sent, by bus.
        errors: number of error frames, which cannot be sent, by bus.
        late: delays of the frames after their due times.
        began_ns, ended_ns: by the runtime's clock [ns].
    """

    began_ns: int
    ended_ns: int = 0
    sent: dict[str, int] = field(default_factory=dict)
    errors: dict[str, int] = field(default_factory=dict)
    late: Lateness = field(default_factory=Lateness)


@final
class TrafficReplay:
    """Replay of recorded frames.

    Attributes:
        done: the result so far.
    """

    def __init__(
        self,
        sinks: Mapping[str, Sink],
        runtime: Runtime,
        first_ns: int,
        speed: Fraction | None = Fraction(1),
    ) -> None:
        """Start the replay now.

        Args:
            sinks: by recorded bus; frames of other buses are left out.
            runtime: provides the time and waits.
            first_ns: the log time that corresponds to now [ns].
            speed: acceleration factor; None: as fast as the buses take the frames.
        """
        self.done: Replayed = Replayed(runtime.now_ns())
        self._sinks = sinks
        self._runtime = runtime
        self._first_ns = first_ns
        self._speed = speed

    def due_ns(self, time_ns: int) -> int:
        """Return when a frame of this log time is due, by the runtime's clock [ns]."""
        assert self._speed is not None
        step_ns = time_ns - self._first_ns
        return self.done.began_ns + step_ns * self._speed.denominator // self._speed.numerator

    def run(
        self, frames: Iterable[Frame], tell: Callable[[int, int], None] | None = None
    ) -> Replayed:
        """Send all frames, and wait until they were on their buses.

        Args:
            frames: the frames in order.
            tell: called with the log time [ns] and the number of each frame.

        Raises:
            SendError: a bus does not take a frame.
        """
        now_ns = self._runtime.now_ns
        done = self.done
        for number, (time_ns, bus, data, _, _) in enumerate(frames):
            sink = self._sinks.get(bus)
            if sink is None:
                continue
            if is_error(data):
                done.errors[bus] = done.errors.get(bus, 0) + 1
                continue
            if self._speed is not None:
                due_ns = self.due_ns(time_ns)
                left_ns = due_ns - now_ns()
                if left_ns > 0:
                    self._runtime.wait_until(never, left_ns / NS)
            if not sink.is_ready():
                self._wait_for(sink, sink.is_ready)
            if self._speed is not None:
                done.late.add(now_ns() - due_ns)
            sink.send(data)
            done.sent[bus] = done.sent.get(bus, 0) + 1
            if tell is not None:
                tell(time_ns, number)
        for sink in self._sinks.values():
            self._wait_for(sink, sink.is_empty)
        done.ended_ns = now_ns()
        return done

    def _wait_for(self, sink: Sink, done: Callable[[], bool]) -> None:
        if not self._runtime.wait_until(done, STUCK_S):
            raise SendError(
                f"{sink.name}: has taken no frame for {STUCK_S:g} s; check that another node "
                "acknowledges and that the bit rate is right"
            )


def never() -> bool:
    """Return False, for a wait that only time ends."""
    return False
