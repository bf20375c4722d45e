"""Bit-by-bit simulation of a disturbed frame until all nodes agree again.

A pure function. Bits are counted from 0, the start of frame. An event in a bit is known at the end
of the bit, (bit + 1) bit times after the start of frame.

The simulation is causal. If two episodes differ only from some bit on (a disturbance that lasts
longer, a node that leaves), all before that bit is equal. An episode may therefore be computed as
if nothing more would happen, and again when something does. An episode is computed in sections,
because under heavy noise nodes may not agree for hours.

Bus-off nodes are not stations here; `recessive_runs` and `recessive_bits` tell how many recessive
bits they count. Propagation delays are ignored: within one bit all nodes sample one level.

Source: ISO 11898-1; `can_signalling` and `confinement` document their choices where it is open.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from enum import Enum
from typing import Final, final

from emulators.media.can_frame import BRS, FD_FRAME_BYTES
from emulators.media.can_node import FrameSupport
from emulators.media.can_station import CanStation
from emulators.media.confinement import Confinement
from emulators.media.disturbance import ALL_PORTS, Disturbance, Effect
from emulators.media.error_journal import (
    NOTE_ACCEPTED,
    NOTE_ERROR,
    NOTE_FAILED,
    NOTE_LOST,
    NOTE_SENT,
    NOTE_STATE,
)
from emulators.media.wired_and import Member, WiredAnd

__all__ = [
    "ALL_PORTS",
    "Disturbance",
    "Effect",
    "Episode",
    "Event",
    "EventKind",
    "Outcome",
    "Station",
    "run_episode",
]


@final
@dataclass(frozen=True, slots=True)
class Station:
    """The state of a node in the bit before the start of frame.

    Attributes:
        port: its number on the bus.
        frames: its pending frames, in the order of its queue (16-byte can_frame). The first is sent
            from bit 0 on, unless the node is suspended, integrating or stalled.
        tec, rec: its error counters.
        support: the frame formats that it tolerates.
        one_shot: a frame that fails or loses arbitration is dropped.
        leaves_at: the first bit in which it is absent (power lost, cut off).
        suspended: bits for which it may not start yet (suspend transmission).
        integrating: consecutive recessive bits that it must hear before it takes part; 0: it does.
        stalled: it has sent a flag, and has heard only dominant bits for long.
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
    """The kind of an event at a node."""

    ACCEPTED = NOTE_ACCEPTED  # frame received: last but one bit of end of frame
    SENT = NOTE_SENT  # frame sent: last bit of end of frame
    FAILED = NOTE_FAILED  # an error destroyed the frame it was sending
    LOST = NOTE_LOST  # it lost arbitration with this frame
    ERROR = NOTE_ERROR  # it detected an error; the frame is an error message
    STATE = NOTE_STATE  # its error state changed; the frame is an error message


ALL_BITS: Final = 1 << 62
_KINDS: Final = tuple(EventKind)  # by value; the values count from 0


@final
@dataclass(frozen=True, slots=True)
class Event:
    """An event at a node.

    Attributes:
        bit: the bit in which it happened.
        port: the port of the node.
        kind: the kind of event.
        frame: the frame concerned, or the error message for the node's host (`error_message`).
    """

    bit: int
    port: int
    kind: EventKind
    frame: bytes


@final
@dataclass(frozen=True, slots=True)
class Outcome:
    """The state of a node after an episode. Attributes shared with `Station` mean the same.

    Attributes:
        off_at: the bit that made it bus-off; None: it is not.
        recessive_runs: runs of 11 recessive bits since then.
        recessive_bits: recessive bits since the last of these runs, or the last dominant bit.
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
    """The result of an episode.

    Attributes:
        is_over: all nodes agree. Otherwise it continues after `bits`, and the outcomes are as of
            then.
        bits: its length; the bit with this number may be the next start of frame.
        events: in the order of their bits; within a bit in the order of the stations.
        outcomes: of the stations, in their order; of a station that left, as of then.
        recessive_runs: runs of 11 recessive bits on the wire.
        recessive_bits: recessive bits since the last dominant bit, or the last of those runs.
        fast: (first, end) of each stretch of bits at the data rate, in order.
    """

    is_over: bool
    bits: int
    events: tuple[Event, ...]
    outcomes: tuple[Outcome, ...]
    recessive_runs: int
    recessive_bits: int
    fast: tuple[tuple[int, int], ...]

    def end_ns(self, bit: int, bit_ns: int, data_bit_ns: int) -> int:
        """Return the end of this bit, counted from the start of frame [ns]."""
        end_ns = (bit + 1) * bit_ns
        for first, end in self.fast:
            if first <= bit:
                end_ns -= (min(end, bit + 1) - first) * (bit_ns - data_bit_ns)
        return end_ns


def run_episode(
    stations: Sequence[Station],
    disturbances: Sequence[Disturbance] = (),
    recessive_bits: int = 0,
    ratio: int = 1,
    until_bit: int = ALL_BITS,
) -> Episode:
    """Simulate from a start of frame until every node could start the next one.

    The episode ends earlier if some node hears only dominant bits for ever (`stalled`) and the
    others are ready. Handing on the disturbances that are not over is the caller's task.

    Args:
        stations: the nodes on the bus that are not bus-off; equal ones cost as much as one.
        disturbances: those that strike the nodes; one that begins after the end has no effect.
        recessive_bits: as in `Episode`, before the start of frame.
        ratio: how many bits at the data rate (CAN FD, bit rate switch) last as long as a nominal
            one, rounded, at least 1.
        until_bit: the bit at which the computation stops, unless nothing changes before a later
            one.

    Raises:
        ValueError: a frame that its node cannot send, or counters that no node on the bus has.
    """
    groups: dict[tuple[object, ...], _Twins] = {}
    by_station: list[_Twins] = []
    for station in stations:
        struck_by = [one for one in disturbances if one.ports >> station.port & 1]
        key = (
            *(station.frames, station.tec, station.rec, station.support, station.one_shot),
            *(station.leaves_at, station.suspended, station.integrating, station.stalled),
            *struck_by,
        )
        twins = groups.get(key)
        if twins is None:
            twins = groups[key] = _Twins(station, struck_by)
        twins.ports.append(station.port)
        by_station.append(twins)
    members = [twins.member for twins in groups.values()]
    switching = any(_switches(frame) for station in stations for frame in station.frames)
    wire = WiredAnd(members, disturbances, recessive_bits, ratio if switching else 0)
    is_over = wire.is_over()
    while not is_over and wire.bit < until_bit:
        wire.step()
        is_over = wire.is_over()
    return Episode(
        is_over,
        wire.bit,
        _events(list(groups.values()), stations),
        tuple(
            _outcome(station.port, twins.member.node)
            for station, twins in zip(stations, by_station, strict=True)
        ),
        wire.recessive_runs,
        wire.recessive_bits,
        wire.fast_stretches(),
    )


def _switches(frame: bytes) -> bool:
    """Return whether part of the frame is at the data rate."""
    return len(frame) == FD_FRAME_BYTES and bool(frame[5] & BRS)


@final
class _Twins:
    """Indistinguishable stations, simulated as one."""

    def __init__(self, station: Station, struck_by: list[Disturbance]) -> None:
        self.ports: list[int] = []
        node = CanStation(
            list(station.frames),
            Confinement(station.tec, station.rec),
            station.one_shot,
            station.support,
        )
        if station.stalled:
            node.begin_stalled()
        elif station.integrating:
            node.begin_integrating(station.integrating)
        else:
            node.begin_idle(station.suspended)
        self.member = Member(node, station.leaves_at, struck_by)


def _events(groups: list[_Twins], stations: Sequence[Station]) -> tuple[Event, ...]:
    """Return the events of all stations, in order."""
    events = [
        Event(bit, port, _KINDS[kind], frame)
        for twins in groups
        for bit, kind, frame in twins.member.node.journal.notes
        for port in twins.ports
    ]
    turn = {station.port: number for number, station in enumerate(stations)}
    events.sort(key=lambda event: (event.bit, turn[event.port]))
    return tuple(events)


def _outcome(port: int, node: CanStation) -> Outcome:
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
