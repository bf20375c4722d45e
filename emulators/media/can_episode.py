"""What comes of a frame that is struck: all nodes of a bus, bit by bit, until they agree again.

A pure function. Bits are counted from 0, the start of frame; what happens at a bit is known at
its end, (bit + 1) bit times after the start of frame. It is causal: of two episodes that differ
only in what happens from some bit on (a disturbance that lasts longer, a node that leaves), all is
equal before. So an episode may be computed as if nothing more would happen, and again when
something does.

Nodes that are off the bus are no stations here; that they count recessive bits is told by
`recessive_runs` and `recessive_bits`. Distances are no matter: in one bit all hear one level.

Source: ISO 11898-1; `can_signalling` and `confinement` say what they decide that it leaves open.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from enum import Enum
from typing import Final, final

from emulators.media.can_node import FrameSupport
from emulators.media.can_station import (
    IDLE,
    INTEGRATION_BITS,
    SENDING,
    CanStation,
)
from emulators.media.can_wire import DOMINANT, RECESSIVE
from emulators.media.confinement import Confinement
from emulators.media.error_journal import (
    NOTE_ACCEPTED,
    NOTE_ERROR,
    NOTE_FAILED,
    NOTE_LOST,
    NOTE_SENT,
    NOTE_STATE,
)

ALL_PORTS: Final = -1  # as a mask of 1 << port


class Effect(Enum):
    """What a disturbance does to a level."""

    FLIP = "flip"
    DOMINANT = "dominant"
    RECESSIVE = "recessive"


@final
@dataclass(frozen=True, slots=True)
class Disturbance:
    """Something that makes ports sample another level than the nodes put on the wire.

    Attributes:
        first: the bit in which it begins.
        effect: what it does; of two in one bit the one named later has the last word.
        bits: for how many bits; None: for ever.
        ports: who samples it (1 << port, or'ed); ALL_PORTS: it is on the wire.
    """

    first: int
    effect: Effect = Effect.FLIP
    bits: int | None = 1
    ports: int = ALL_PORTS


@final
@dataclass(frozen=True, slots=True)
class Station:
    """A node as an episode finds it, in the bit before the start of frame.

    Attributes:
        port: its number on the bus.
        frames: those it has to send, in the order in which its queue would (16-byte can_frame).
            The first is sent from bit 0 on, unless the node is suspended, integrating or stalled.
        tec, rec: its error counters.
        support: which frames it can stand.
        one_shot: a frame that fails or loses arbitration is dropped.
        leaves_at: the bit from which on it is not there any more (power lost, cut off).
        suspended: bits for which it may not start yet (suspend transmission).
        integrating: recessive bits in a row that it has to hear before it takes part; 0: it does.
        stalled: it has sent a flag, and has heard nothing but dominant bits for long.
    """

    port: int
    frames: tuple[bytes, ...] = ()
    tec: int = 0
    rec: int = 0
    support: FrameSupport = FrameSupport.CLASSICAL
    one_shot: bool = False
    leaves_at: int | None = None
    suspended: int = 0
    integrating: int = 0
    stalled: bool = False


class EventKind(Enum):
    """What happened to a node."""

    ACCEPTED = NOTE_ACCEPTED  # it received this frame: last but one bit of end of frame
    SENT = NOTE_SENT  # it sent this frame: last bit of end of frame
    FAILED = NOTE_FAILED  # an error destroyed the frame it was sending
    LOST = NOTE_LOST  # it lost arbitration with this frame
    ERROR = NOTE_ERROR  # it noticed an error; the frame is an error message
    STATE = NOTE_STATE  # its error state changed; the frame is an error message


_KINDS: Final = tuple(EventKind)  # by their values, which count from 0


@final
@dataclass(frozen=True, slots=True)
class Event:
    """Something that happened to a node.

    Attributes:
        bit: in which.
        port: of the node.
        kind: what.
        frame: the one concerned, or the error message for the node's host (`error_message`).
    """

    bit: int
    port: int
    kind: EventKind
    frame: bytes


@final
@dataclass(frozen=True, slots=True)
class Outcome:
    """A node as an episode leaves it. What is named as in `Station` means the same there.

    Attributes:
        off_at: the bit that made it bus-off; None: it is not.
        recessive_runs: since then, runs of 11 recessive bits.
        recessive_bits: since the last of them, or the last dominant bit.
    """

    port: int
    frames: tuple[bytes, ...]
    tec: int
    rec: int
    suspended: int
    integrating: int
    stalled: bool
    off_at: int | None
    recessive_runs: int
    recessive_bits: int


@final
@dataclass(frozen=True, slots=True)
class Episode:
    """What came of it.

    Attributes:
        bits: it is over after so many; the bit with this number may be the next start of frame.
        events: in the order of their bits; within a bit in that of the stations.
        outcomes: of the stations, in their order; of one that left, as it was then.
        recessive_runs: runs of 11 recessive bits on the wire.
        recessive_bits: those since the last dominant bit, or since the last of those runs.
    """

    bits: int
    events: tuple[Event, ...]
    outcomes: tuple[Outcome, ...]
    recessive_runs: int
    recessive_bits: int


def run_episode(
    stations: Sequence[Station], disturbances: Sequence[Disturbance] = (), recessive_bits: int = 0
) -> Episode:
    """All that happens from a start of frame until every node could start the next one.

    It is over before that if some node hears nothing but dominant bits for ever (`stalled`), and
    the others are ready. The disturbances that are not over are the caller's to hand on.

    Args:
        stations: the nodes on the bus that are not bus-off; equal ones cost as much as one.
        disturbances: what strikes them; one that begins later than all is over has no effect.
        recessive_bits: as in `Episode`, before the start of frame.

    Raises:
        ValueError: a frame that its node cannot send (`can_bits.measure`), or counters that no
            node on the bus has.
    """
    run = _Run(stations, disturbances, recessive_bits)
    while not run.is_over():
        run.step()
    return run.episode()


@final
class _Twins:
    """Stations that nothing tells apart, as one."""

    def __init__(self, station: Station, struck_by: list[Disturbance]) -> None:
        self.ports: list[int] = []
        self.leaves_at = station.leaves_at
        self.struck_by = struck_by
        self.node = CanStation(
            list(station.frames), Confinement(station.tec, station.rec), station.one_shot
        )
        if station.stalled:
            self.node.begin_stalled()
        elif station.integrating:
            self.node.begin_integrating(station.integrating)
        else:
            self.node.begin_idle(station.suspended)


def _strikes(disturbance: Disturbance, bit: int) -> bool:
    """Whether it lasts in this bit."""
    first = disturbance.first
    return first <= bit and (disturbance.bits is None or bit < first + disturbance.bits)


def _disturbed(level: int, struck_by: list[Disturbance], bit: int) -> int:
    """The level sampled in this bit by who is struck by these."""
    for one in struck_by:
        if _strikes(one, bit):
            if one.effect is Effect.FLIP:
                level = 1 - level
            else:
                level = DOMINANT if one.effect is Effect.DOMINANT else RECESSIVE
    return level


@final
class _Run:
    """An episode while it is computed."""

    def __init__(
        self, stations: Sequence[Station], disturbances: Sequence[Disturbance], recessive_bits: int
    ) -> None:
        self._bit = 0
        self._recessive_runs = 0
        self._recessive_bits = recessive_bits
        self._twins: list[_Twins] = []
        self._by_station: list[_Twins] = []
        self._stations = stations
        self._on_wire = [one for one in disturbances if one.ports == ALL_PORTS]
        self._disturbances = disturbances
        known: dict[tuple[object, ...], _Twins] = {}
        for station in stations:
            struck_by = [one for one in disturbances if one.ports >> station.port & 1]
            key = (
                *(station.frames, station.tec, station.rec, station.support, station.one_shot),
                *(station.leaves_at, station.suspended, station.integrating, station.stalled),
                *struck_by,
            )
            twins = known.get(key)
            if twins is None:
                twins = known[key] = _Twins(station, struck_by)
                self._twins.append(twins)
            twins.ports.append(station.port)
            self._by_station.append(twins)
        self._live = list(self._twins)
        self._nodes = [twins.node for twins in self._twins]
        self._struck = False  # somebody may sample another level than there is
        self._changes = self._change_bits()

    def _change_bits(self) -> list[int]:
        """When a disturbance begins or ends, or a node leaves; in order, the last one first."""
        changes: list[int] = []
        for one in self._disturbances:
            changes.append(one.first)
            if one.bits is not None:
                changes.append(one.first + one.bits)
        for twins in self._twins:
            if twins.leaves_at is not None:
                changes.append(twins.leaves_at)
        return sorted(changes, reverse=True)

    def step(self) -> None:
        """One bit time has passed."""
        bit = self._bit
        if self._changes and self._changes[-1] <= bit:
            self._change(bit)
        level = RECESSIVE
        for node in self._nodes:
            if node.drives == DOMINANT:
                level = DOMINANT
        if self._struck:
            for twins in self._live:
                twins.node.hear(_disturbed(level, twins.struck_by, bit), bit)
            level = _disturbed(level, self._on_wire, bit)
        else:
            for node in self._nodes:
                node.hear(level, bit)
        self._recessive_bits = self._recessive_bits + 1 if level else 0
        if self._recessive_bits == INTEGRATION_BITS:
            self._recessive_bits = 0
            self._recessive_runs += 1
        self._bit = bit + 1

    def _change(self, bit: int) -> None:
        """Disturbances have begun or ended, or nodes have left."""
        while self._changes and self._changes[-1] <= bit:
            self._changes.pop()
        self._live = [
            twins for twins in self._live if twins.leaves_at is None or bit < twins.leaves_at
        ]
        self._nodes = [twins.node for twins in self._live]
        self._struck = any(_strikes(one, bit) for one in self._disturbances)

    def is_over(self) -> bool:
        """Whether nobody need wait for anybody.

        If all wait for the end of a disturbance, it is the next bit.
        """
        if not self._bit:
            return not self._live
        stuck = 0
        ready = 0
        for twins in self._live:
            node = twins.node
            if node.is_ready():
                ready += node.phase in (IDLE, SENDING)
            elif self._is_stuck(twins):
                stuck += 1
            else:
                return False
        if ready or not stuck or not self._changes:
            return True
        if _disturbed(RECESSIVE, self._on_wire, self._bit) == RECESSIVE:
            return True  # on the wire it is over
        self._bit = max(self._bit, self._changes[-1])
        return False

    def _is_stuck(self, twins: _Twins) -> bool:
        """Whether it will hear dominant bits as long as nothing changes, and nothing but."""
        return (
            twins.node.is_stalled()
            and _disturbed(RECESSIVE, twins.struck_by, self._bit) == DOMINANT
        )

    def episode(self) -> Episode:
        """What came of it, port by port."""
        events = [
            Event(bit, port, _KINDS[kind], frame)
            for twins in self._twins
            for bit, kind, frame in twins.node.journal.notes
            for port in twins.ports
        ]
        turn = {station.port: number for number, station in enumerate(self._stations)}
        events.sort(key=lambda event: (event.bit, turn[event.port]))
        return Episode(
            self._bit,
            tuple(events),
            tuple(
                _outcome(station.port, twins)
                for station, twins in zip(self._stations, self._by_station, strict=True)
            ),
            self._recessive_runs,
            self._recessive_bits,
        )


def _outcome(port: int, twins: _Twins) -> Outcome:
    node = twins.node
    return Outcome(
        port,
        tuple(node.frames),
        node.confinement.tec,
        node.confinement.rec,
        node.suspended,
        node.waits_for,
        node.is_after_flag(),
        node.off_at if node.off_at >= 0 else None,
        node.recessive_runs,
        node.recessive_bits,
    )
