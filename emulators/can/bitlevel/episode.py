"""Bit-by-bit simulation of a disturbed frame until all nodes agree again.

While a node is in the data phase of a CAN FD frame, a step is a bit at the data rate. A node
outside the data phase sends an error flag, waits for the bus to be idle, or takes the frame for a
classical one. For it, `ratio` such steps form one bit, sampled in the last of them. Its bit grid
begins with the first error flag; a node that joins it later does so with the rest of a bit. A node
that waits for an idle bus hears a dominant level if any step of its bit had one. Without an error
the grid begins where the data phase ends.

`run_episode` is a pure function. Bits are counted from 0, the start of frame. An event in a bit is
known at the end of the bit, (bit + 1) bit times after the start of frame.

The simulation is causal. If two episodes differ only from some bit on (a disturbance that lasts
longer, a node that leaves), all before that bit is equal. An episode may therefore be computed as
if nothing more would happen, and again when something does. An episode is computed in sections,
because under heavy noise nodes may not agree for hours.

Bus-off nodes are not stations here; `recessive_runs` and `recessive_bits` tell how many recessive
bits they count. Propagation delays are ignored: within one bit all nodes sample one level.

Source: ISO 11898-1; `controller` and `error_confinement` document their choices where it is open.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from enum import Enum
from typing import Final, final

from motorhil.emulators.can.bitlevel.controller import (
    IDLE,
    INTEGRATING,
    INTEGRATION_BITS,
    NOTE_ACCEPTED,
    NOTE_ERROR,
    NOTE_FAILED,
    NOTE_LOST,
    NOTE_SENT,
    NOTE_STATE,
    OFF,
    RECEIVING,
    SENDING,
    SIGNALLING,
    CanStation,
)
from motorhil.emulators.can.bitlevel.encoder import DOMINANT, RECESSIVE
from motorhil.emulators.can.controller_config import FrameSupport
from motorhil.emulators.can.error_confinement import Confinement
from motorhil.emulators.can.frame import BRS, FD_FRAME_BYTES

ALL_PORTS: Final = -1  # as a mask of 1 << port

ALL_BITS: Final = 1 << 62


class Effect(Enum):
    """The effect of a disturbance on a level."""

    FLIP = "flip"
    DOMINANT = "dominant"
    RECESSIVE = "recessive"


@final
@dataclass(frozen=True, slots=True)
class Disturbance:
    """A disturbance that makes ports sample another level than the nodes put on the wire.

    Attributes:
        first: the bit in which it begins.
        effect: its effect; of two in one bit the one named later prevails.
        bits: its duration in bits; None: for ever.
        ports: the ports that sample it (1 << port, or'ed); ALL_PORTS: it is on the wire.
    """

    first: int
    effect: Effect = Effect.FLIP
    bits: int | None = 1
    ports: int = ALL_PORTS

    def strikes(self, bit: int) -> bool:
        """Return whether it is active in this bit."""
        return self.first <= bit and (self.bits is None or bit < self.first + self.bits)


@final
class Strikes:
    """Disturbances, and those active in the current bit. Bits are visited in order.

    Args:
        all_of_them: in the order in which they are applied.
    """

    def __init__(self, all_of_them: Sequence[Disturbance]) -> None:
        self._to_come = sorted(enumerate(all_of_them), key=_first, reverse=True)
        self._lasting: list[tuple[int, Disturbance]] = []

    def look_at(self, bit: int) -> bool:
        """Visit this bit and return whether any disturbance is active in it."""
        lasting = [one for one in self._lasting if one[1].strikes(bit)]
        while self._to_come and self._to_come[-1][1].first <= bit:
            begun = self._to_come.pop()
            if begun[1].strikes(bit):
                lasting.append(begun)
        lasting.sort(key=_turn)
        self._lasting = lasting
        return bool(lasting)

    def disturbed(self, level: int) -> int:
        """Return the level sampled in the current bit under these disturbances."""
        for _, one in self._lasting:
            if one.effect is Effect.FLIP:
                level = 1 - level
            else:
                level = DOMINANT if one.effect is Effect.DOMINANT else RECESSIVE
        return level


def _first(numbered: tuple[int, Disturbance]) -> int:
    return numbered[1].first


def _turn(numbered: tuple[int, Disturbance]) -> int:
    return numbered[0]


@final
class Member:
    """A controller on the wire.

    Args:
        node: the controller.
        leaves_at: the first bit in which it is absent.
        struck_by: the disturbances that strike it.
    """

    def __init__(
        self, node: CanStation, leaves_at: int | None, struck_by: Sequence[Disturbance]
    ) -> None:
        self.node = node
        self.leaves_at = leaves_at
        self.strikes: Strikes = Strikes(struck_by)
        self.fast = False
        self.heard_dominant = False  # in its own nominal bit so far

    def is_stuck(self, bit: int) -> bool:
        """Return whether it hears only dominant bits until a disturbance changes."""
        if not self.node.is_stalled():
            return False
        self.strikes.look_at(bit)
        return self.strikes.disturbed(RECESSIVE) == DOMINANT


@final
class WiredAnd:
    """The wire and its controllers.

    Args:
        members: the controllers on the wire.
        disturbances: all that strike any of them.
        recessive_bits: the number of recessive bits before the first bit.
        ratio: how many bits at the data rate last as long as a nominal one; 0: no frame has any.

    Attributes (read only):
        bit: the number of the next bit.
        recessive_runs: runs of 11 recessive bits so far.
        recessive_bits: recessive bits since the last of them, or the last dominant bit.
    """

    def __init__(
        self,
        members: Sequence[Member],
        disturbances: Sequence[Disturbance],
        recessive_bits: int,
        ratio: int,
    ) -> None:
        self.bit: int = 0
        self.recessive_runs: int = 0
        self.recessive_bits: int = recessive_bits
        self._fast: list[tuple[int, int]] = []
        self._ratio = ratio
        self._live = list(members)
        self._nodes = [member.node for member in members]
        self._on_wire = Strikes([one for one in disturbances if one.ports == ALL_PORTS])
        self._struck = False  # a member may sample another level than that of the wire
        self._fast_from = -1  # first bit of the current data phase; -1: none
        self._fast_count = 0  # members in the data phase
        self._ticks = 0  # bits at the data rate since the end of the last nominal bit
        self._flagged = False  # the nominal grid is that of an error flag
        self._wire_dominant = False  # as `Member.heard_dominant`
        changes = [one.first for one in disturbances]
        changes += [one.first + one.bits for one in disturbances if one.bits is not None]
        changes += [member.leaves_at for member in members if member.leaves_at is not None]
        self._changes = sorted(changes, reverse=True)

    def step(self) -> None:
        """Simulate one bit."""
        bit = self.bit
        if self._changes and self._changes[-1] <= bit:
            self._change(bit)
        level = RECESSIVE
        for node in self._nodes:
            if node.drives == DOMINANT:
                level = DOMINANT
        if self._fast_count or self._ticks:
            self._step_fast(level, bit)
        else:
            if self._struck:
                for member in self._live:
                    member.node.hear(member.strikes.disturbed(level), bit)
                level = self._on_wire.disturbed(level)
            else:
                for node in self._nodes:
                    node.hear(level, bit)
            self._count(level)
            if self._ratio:
                self._look_for_data_phase()
        self.bit = bit + 1

    def fast_stretches(self) -> tuple[tuple[int, int], ...]:
        """Return (first, end) of each stretch of bits at the data rate so far."""
        if self._fast_from < 0:
            return tuple(self._fast)
        return (*self._fast, (self._fast_from, self.bit))

    def is_over(self) -> bool:
        """Return whether all members are ready for the next frame.

        If all wait for the end of a disturbance, skip to that bit.
        """
        if not self.bit:
            return not self._live
        stuck = 0
        ready = 0
        for member in self._live:
            node = member.node
            if node.is_ready():
                ready += node.phase in (IDLE, SENDING)
            elif member.is_stuck(self.bit):
                stuck += 1
            else:
                return False
        if ready or not stuck or not self._changes:
            return True
        self._on_wire.look_at(self.bit)
        if self._on_wire.disturbed(RECESSIVE) == RECESSIVE:
            return True  # the disturbance on the wire is over
        self.bit = max(self.bit, self._changes[-1])
        return False

    def _change(self, bit: int) -> None:
        """Apply disturbances that begin or end, and remove nodes that leave."""
        while self._changes and self._changes[-1] <= bit:
            self._changes.pop()
        self._live = [
            member for member in self._live if member.leaves_at is None or bit < member.leaves_at
        ]
        self._nodes = [member.node for member in self._live]
        self._struck = self._on_wire.look_at(bit)
        for member in self._live:
            if member.strikes.look_at(bit):
                self._struck = True
        self._fast_count = sum(member.fast for member in self._live)
        self._end_data_phase(bit)

    def _count(self, level: int) -> None:
        """Count a nominal bit with this level on the wire."""
        self.recessive_bits = self.recessive_bits + 1 if level else 0
        if self.recessive_bits == INTEGRATION_BITS:
            self.recessive_bits = 0
            self.recessive_runs += 1

    # --- at the data rate

    def _look_for_data_phase(self) -> None:
        """Find, after a nominal bit, the members whose next bit is at the data rate."""
        for member in self._live:
            member.fast = member.node.is_fast()
            self._fast_count += member.fast
        if self._fast_count:
            self._fast_from = self.bit + 1

    def _end_data_phase(self, bit: int) -> None:
        """End the data phase before this bit if no member is in it and no bit has begun."""
        if self._fast_from >= 0 and not self._fast_count and not self._ticks:
            self._fast.append((self._fast_from, bit))
            self._fast_from = -1
            self._flagged = False

    def _step_fast(self, level: int, bit: int) -> None:
        """Process a bit at the data rate; every `ratio` of them make a nominal bit."""
        self._ticks += 1
        whole = self._ticks == self._ratio
        first_flag = False
        over = False
        for member in self._live:
            node = member.node
            sampled = member.strikes.disturbed(level) if self._struck else level
            if member.fast:
                node.hear(sampled, bit)
                if not node.is_fast():
                    member.fast = False
                    self._fast_count -= 1
                    first_flag = first_flag or node.phase == SIGNALLING
                    over = over or node.phase in (SENDING, RECEIVING)
                continue
            member.heard_dominant = member.heard_dominant or sampled == DOMINANT
            if whole:
                waits = node.phase in (INTEGRATING, OFF) and member.heard_dominant
                signalled = node.phase == SIGNALLING
                node.hear(DOMINANT if waits else sampled, bit)
                member.heard_dominant = False
                if node.phase == SIGNALLING and not signalled:
                    self._flagged = True  # by a classical node, on its own grid
        on_wire = self._on_wire.disturbed(level) if self._struck else level
        self._wire_dominant = self._wire_dominant or on_wire == DOMINANT
        if whole:
            self._count(DOMINANT if self._wire_dominant else RECESSIVE)
            self._wire_dominant = False
            self._ticks = 0
        if first_flag and not self._flagged:
            self._flagged = True
            self._ticks = 0
        elif over and not self._fast_count:
            self._ticks = 0
        self._end_data_phase(bit + 1)


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
