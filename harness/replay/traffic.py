"""Recorded frames sent again: at their times, scaled, or as fast as the buses take them.

The schedule is absolute: when a frame is due follows from its own stamp and from when the replay
began, never from when the frame before it went out. So nothing adds up, over an hour or a day; what
the machine is late is late once, and measured.

One code for virtual time and the wall: it waits in a Runtime only.
"""

from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import dataclass, field
from fractions import Fraction
from typing import Final, Protocol, final

from harness.replay.lateness import Lateness
from motorapi.runtime import Runtime
from traces.decode_canopen import CanopenDecoder
from traces.said import Kind
from traces.traffic import EFF_MASK, ERR, NS, Frame

STUCK_S: Final = 2.0
_CLASSIC_SIZE: Final = 16


class SendError(Exception):
    """A bus does not take frames, or not such ones; says which, why and what to do."""


class Sink(Protocol):
    """Where the frames of a recorded bus go.

    Attributes: name, for messages; carries_fd, whether it takes CAN FD frames.
    """

    name: str
    carries_fd: bool

    def send(self, frame: bytes) -> None:
        """The frame waits its turn on the bus. Raises SendError."""

    def is_ready(self) -> bool:
        """Whether it may be given another one; asked before each. Raises SendError."""

    def is_empty(self) -> bool:
        """Whether all it was given was on the bus. Raises SendError."""

    def close(self) -> None:
        """The bus has been left."""


@final
@dataclass(frozen=True, slots=True)
class Choice:
    """Which frames: those that pass every filter that is given.

    Attributes: buses, identifiers, nodes (by what a CANopen frame says; NMT to all passes);
    from_ns (log time, inclusive), to_ns (exclusive).
    """

    buses: tuple[str, ...] | None = None
    identifiers: tuple[int, ...] | None = None
    nodes: tuple[int, ...] | None = None
    from_ns: int | None = None
    to_ns: int | None = None

    def of(self, frames: Iterable[Frame]) -> Iterator[Frame]:
        """Those of these frames, in their order; they begin with the recording."""
        decoders: dict[str, CanopenDecoder] = {}
        for frame in frames:
            time_ns, bus, data = frame[:3]
            if self.buses is not None and bus not in self.buses:
                continue
            if self.nodes is not None:  # what PDOs belong to whom is learned from all frames
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
@dataclass(slots=True)
class Survey:
    """What there is to send.

    Attributes: frames, long_frames (CAN FD) and error_frames, by bus; first_ns and last_ns, the
    earliest and the latest log time.
    """

    frames: dict[str, int] = field(default_factory=dict)
    long_frames: dict[str, int] = field(default_factory=dict)
    error_frames: dict[str, int] = field(default_factory=dict)
    first_ns: int = 0
    last_ns: int = 0

    @property
    def span_ns(self) -> int:
        """From the first to the last."""
        return self.last_ns - self.first_ns


def survey(frames: Iterable[Frame]) -> Survey:
    """What is among these frames."""
    found = Survey()
    first: int | None = None
    for time_ns, bus, data, _, _ in frames:
        first = time_ns if first is None or time_ns < first else first
        found.last_ns = max(found.last_ns, time_ns)
        found.frames[bus] = found.frames.get(bus, 0) + 1
        if len(data) > _CLASSIC_SIZE:
            found.long_frames[bus] = found.long_frames.get(bus, 0) + 1
        elif is_error(data):
            found.error_frames[bus] = found.error_frames.get(bus, 0) + 1
    found.first_ns = first or 0
    return found


def is_error(frame: bytes) -> bool:
    """Whether it is no traffic, but what a controller said about the bus."""
    return bool(int.from_bytes(frame[:4], "little") & ERR)


def refuse_long(found: Survey, sinks: Mapping[str, Sink]) -> None:
    """Raises SendError: there are CAN FD frames for a bus that carries none."""
    for bus, count in found.long_frames.items():
        sink = sinks.get(bus)
        if sink is not None and not sink.carries_fd:
            raise SendError(
                f"{sink.name}: {count} frames of {bus} are CAN FD, which this bus does not carry; "
                "nothing was sent; choose a CAN FD bus, or say --fd where the interface has it"
            )


@final
@dataclass(slots=True)
class Replayed:
    """What came of it, also while it goes on.

    Attributes: sent, frames by bus; errors, frames that cannot be sent, by bus; late, how much
    later than due each one was sent; began_ns and ended_ns, by the runtime's clock.
    """

    began_ns: int
    ended_ns: int = 0
    sent: dict[str, int] = field(default_factory=dict)
    errors: dict[str, int] = field(default_factory=dict)
    late: Lateness = field(default_factory=Lateness)


@final
class TrafficReplay:
    """Sends recorded frames. Attributes: done, what came of it so far."""

    def __init__(
        self,
        sinks: Mapping[str, Sink],
        runtime: Runtime,
        first_ns: int,
        speed: Fraction | None = Fraction(1),
    ) -> None:
        """It begins now.

        Args:
            sinks: by recorded bus; frames of other buses are left out.
            runtime: whose time it is, and where it waits.
            first_ns: the log time that is now.
            speed: how many times faster; None: as fast as the buses take it.
        """
        self.done = Replayed(runtime.now_ns())
        self._sinks = sinks
        self._runtime = runtime
        self._first_ns = first_ns
        self._speed = speed

    def due_ns(self, time_ns: int) -> int:
        """When a frame of this log time is to be sent, by the runtime's clock."""
        assert self._speed is not None
        step_ns = time_ns - self._first_ns
        return self.done.began_ns + step_ns * self._speed.denominator // self._speed.numerator

    def run(
        self, frames: Iterable[Frame], tell: Callable[[int, int], None] | None = None
    ) -> Replayed:
        """All frames were on their buses.

        Args:
            frames: in order.
            tell: called with the log time [ns] and the number of each frame.

        Raises:
            SendError: a bus does not take one.
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
                    self._runtime.wait_until(_never, left_ns / NS)
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
                f"{sink.name}: has taken no frame for {STUCK_S:g} s; is another node there to "
                "acknowledge, and the bit rate right?"
            )


def _never() -> bool:
    return False
