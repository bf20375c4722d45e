"""The cycle of servos on the host: SYNC, counts in, outputs back, and whether it was in time.

    SYNC k ----------- counts of k -> servo -> outputs -----------> SYNC k + 1: outputs act

The counts are those of the very moment of SYNC k, the outputs act at SYNC k + 1: a delay of one
cycle, always the same one, for all motors of a bus at once. A cycle is *missed* by two channels if
their counts have not come before the next SYNC is due (the servo then has nothing to act on, and
the outputs stay), or if the outputs still wait for the bus then. A frame does not tell which SYNC
its counts are of: what comes after the next SYNC is taken for that one's, until a further one comes
in the same cycle (`surplus`). On CAN they are a cycle old at most, for a node sends them in order.
"""

import struct
from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Final, Protocol, final

from motorapi.adaptations.canopen_link import CanopenLink, Transmission
from motorapi.errors import DeadlineExceeded, LinkError, MotorBusyError, MotorError
from motorapi.sharing import PhysicalMotor

if TYPE_CHECKING:
    from motorapi.adaptations.drive_node import DriveNode
    from motorapi.adaptations.node_occupation import NodeOccupation
    from motorapi.fencing import Fence
    from motorapi.process_lock import Hold
    from motorapi.runtime import Registration

_LINGER: Final = 2  # cycles in which 0 is sent, after the last motor was switched off
_OUTPUTS: Final = (struct.Struct("<IB3xh6x"), struct.Struct("<IB3xhh4x"))
_COUNTS: Final = (struct.Struct("<8xi4x").unpack, struct.Struct("<8xii").unpack)


@final
@dataclass(frozen=True, slots=True)
class CycleReport:
    """How well a motor's servo has kept its time, since its frames were first exchanged.

    Attributes:
        period_s: of the servo [s].
        cycles: how many there were.
        counts_missed: cycles whose count did not come in time.
        outputs_late: cycles whose output still waited for the bus when its SYNC was due.
        worst_in_a_row: most misses in a row.
        surplus: further counts in one cycle: most likely those that had been missed.
    """

    period_s: float
    cycles: int
    counts_missed: int
    outputs_late: int
    worst_in_a_row: int
    surplus: int

    @property
    def missed(self) -> int:
        """Cycles missed in either way."""
        return self.counts_missed + self.outputs_late

    def __str__(self) -> str:
        if not self.missed:
            return f"{self.cycles} cycles of {self.period_s * 1e3:g} ms, none missed"
        return (
            f"{self.cycles} cycles of {self.period_s * 1e3:g} ms: {self.counts_missed} counts"
            f" missed, {self.outputs_late} outputs late, at most {self.worst_in_a_row} in a row"
        )


class Axis(Protocol):
    """One motor of the cycle."""

    is_active: bool

    @property
    def physical(self) -> PhysicalMotor:
        """The record of the motor."""

    def step(self, count: int, cycle: int, time_ns: int) -> int:
        """A count came, of this cycle: the output for it (6411h)."""

    def look(self, count: int) -> None:
        """A further count of this cycle came."""

    def begin(self, cycle: int) -> None:
        """What was armed begins with the count of this cycle."""

    def began(self, time_ns: int) -> None:
        """That cycle's SYNC was on the wire at `time_ns`."""

    def fail(self, error: MotorError) -> None:
        """The cycle has failed it: no more control."""


@final
class ChannelPair:
    """Two channels of a node (or one), whose outputs share a frame, and whose counts do."""

    def __init__(
        self,
        cycle: "Cycle",
        node: "DriveNode",
        identifiers: tuple[int, int],
        misses_max: int,
        occupation: "NodeOccupation",
    ) -> None:
        self.identifiers: Final = identifiers
        self._axes: tuple[Axis | None, Axis | None] = (None, None)
        self._cycle = cycle
        self._node = node
        self._link = node.link
        self._output_id, self._count_id = identifiers
        self._misses_max = misses_max
        self._occupation = occupation
        self._hold: Hold | None = None  # of the node, while outputs are sent
        self._awaited = False  # counts, since the last SYNC
        self._out: Transmission | None = None
        self._linger = _LINGER
        self._in_a_row = 0
        self._heard_ns = 0
        self._cycles = self._missed = self._late = self._worst = self._surplus = 0
        self._link.handle(self._count_id, self._on_counts)

    def __repr__(self) -> str:
        return f"<channel pair {self._output_id:03X}h: {self.report()}>"

    def report(self) -> CycleReport:
        """How well the cycle has been kept."""
        return CycleReport(
            *(self._cycle.period_s, self._cycles, self._missed, self._late),
            *(self._worst, self._surplus),
        )

    def place(self, slot: int, axis: "Axis | None") -> None:
        """The first (0) or second (1) channel is this axis'."""
        first, second = self._axes
        self._axes = (axis, second) if slot == 0 else (first, axis)

    def require_free(self) -> None:
        """Raises MotorBusyError if somebody has low-level access to a motor of these frames."""
        for axis in self._axes:
            if axis is not None:
                axis.physical.require_not_held_elsewhere()

    def is_running(self) -> bool:
        """Whether it takes part in the cycle."""
        return self._cycle.has(self)

    def join(self) -> None:
        """It takes part in the cycle as long as one of its axes is active.

        Raises:
            MotorBusyError: another process's servo runs on the node.
        """
        hold, before = self._occupation.occupy(), self._hold
        self._hold = hold
        if before is not None:
            before.release()
        self._linger = _LINGER
        if not self._cycle.has(self):
            self._awaited = False
            self._out = None
            self._in_a_row = 0
            self._cycle.join(self)

    def close(self) -> None:
        """It takes part no more, and hears nothing."""
        self._leave()
        self._link.ignore(self._count_id)

    def fence(self) -> "Fence | None":
        """Lets its outputs out while the node is this process's."""
        return self._occupation.outputs

    def _leave(self) -> None:
        self._cycle.leave(self)
        self.vacate()

    def vacate(self) -> None:
        """Its frames are sent no more: the node is not occupied for them."""
        hold, self._hold = self._hold, None
        if hold is not None:
            hold.release()

    def _on_counts(self, frame: bytes, time_ns: int) -> None:
        axes = self._axes
        size = frame[4]
        if size not in (4, 8):
            self._node.malformed += 1
            return
        counts = _COUNTS[size // 4 - 1](frame)
        self._heard_ns = time_ns
        if not self._awaited:
            self._surplus += 1
            for axis, count in zip(axes, counts, strict=False):
                if axis is not None:
                    axis.look(count)
            return
        self._awaited = False
        cycle = self._cycle.count
        first = second = 0
        if axes[0] is not None:
            first = axes[0].step(counts[0], cycle, time_ns)
        try:
            if size == 4:
                frame = _OUTPUTS[0].pack(self._output_id, 2, first)
            else:
                if axes[1] is not None:
                    second = axes[1].step(counts[1], cycle, time_ns)
                frame = _OUTPUTS[1].pack(self._output_id, 4, first, second)
            self._out = self._link.send_tracked(frame, self._occupation.outputs)
        except LinkError as error:
            self.fail(error)
        except MotorBusyError as error:  # the node is another process's by now
            self.fail(error)
            self._leave()

    def turn(self) -> None:
        """A SYNC was just queued: the cycle before it is over, and is judged."""
        first, second = self._axes
        is_active = (first is not None and first.is_active) or (
            second is not None and second.is_active
        )
        if is_active:
            self._cycles += 1
            self._judge()
        elif self._linger == 0:
            self._leave()
            return
        else:
            self._linger -= 1
        self._awaited = True

    def _judge(self) -> None:
        node = self._node
        if node.is_lost or not node.is_up:
            try:
                node.check_link()
            except LinkError as error:
                self.fail(error)
            return
        if self._awaited:
            self._missed += 1
        elif self._out is not None and self._out.time_ns is None:
            self._late += 1
        else:
            self._in_a_row = 0
            return
        self._in_a_row += 1
        self._worst = max(self._worst, self._in_a_row)
        if self._in_a_row < self._misses_max:
            return
        period_s = self._cycle.period_s
        what = f"{self._in_a_row} cycles of {period_s * 1e3:g} ms in a row"
        self._in_a_row = 0
        if self._awaited:
            self.fail(
                LinkError(
                    link=node.label, reason=f"no counts came in {what}", since_ns=self._heard_ns
                )
            )
        else:
            self.fail(
                DeadlineExceeded(
                    awaited=f"{node.label}: outputs on the bus before SYNC",
                    timeout_s=period_s,
                    last_heard=f"they still waited in {what}",
                )
            )

    def fail(self, error: MotorError) -> None:
        """The cycle has failed its motors."""
        for axis in self._axes:
            if axis is not None and axis.is_active:
                axis.fail(error)


@final
class Cycle:
    """The servos' common clock on one link: one SYNC for all of them.

    Attributes:
        period_s: of SYNC [s].
        count: the number of the last SYNC.
        armed: axes that one trigger starts together.
    """

    def __init__(self, link: CanopenLink, period_s: float) -> None:
        self.period_s: Final = period_s
        self.count = 0
        self.armed: list[Axis] = []
        self._link: Final = link
        self._pairs: tuple[ChannelPair, ...] = ()
        self._registration: Registration | None = None
        self._starts: list[tuple[tuple[Axis, ...], list[int]]] = []

    def has(self, pair: ChannelPair) -> bool:
        """Whether it takes part."""
        return pair in self._pairs

    def join(self, pair: ChannelPair) -> None:
        """It takes part, from the next SYNC on; the first one starts SYNC.

        Raises:
            UsageError: SYNC runs with another period on this bus.
        """
        if self._registration is None:
            self._registration = self._link.on_sync(
                self.period_s, self._after_sync, self._sync_lost, self._fence
            )
        self._pairs = (*self._pairs, pair)

    def leave(self, pair: ChannelPair) -> None:
        """It takes part no more; the last one ends SYNC."""
        self._pairs = tuple(other for other in self._pairs if other is not pair)
        if not self._pairs and self._registration is not None:
            self._registration.cancel()
            self._registration = None

    def _fence(self) -> "Fence | None":
        """Of the SYNC: one of the nodes that go by it."""
        return self._pairs[0].fence() if self._pairs else None

    def _sync_lost(self, error: LinkError) -> None:
        """Another's SYNC, which the servos went by, comes no more: there is no control."""
        pairs, self._pairs = self._pairs, ()
        self._registration = None
        for pair in pairs:
            pair.fail(error)
            pair.vacate()

    def start(self, axes: Sequence[Axis]) -> None:
        """All of these have begun what was armed, with one SYNC, which was on the wire.

        Raises:
            LinkError: there is none.
        """
        begun: list[int] = []
        start = (tuple(axes), begun)
        self._starts.append(start)
        timeout_s = max(0.5, 10 * self.period_s)
        if not self._link.wait_until(lambda: bool(begun), timeout_s):
            if start in self._starts:
                self._starts.remove(start)
            raise LinkError(
                link=self._link.name, reason=f"no SYNC was transmitted within {timeout_s:g} s"
            )

    def _after_sync(self) -> None:
        self.count += 1
        if self._starts:
            self._begin()
        for pair in self._pairs:
            pair.turn()

    def _begin(self) -> None:
        starts, self._starts = self._starts, []
        for axes, _ in starts:
            for axis in axes:
                axis.begin(self.count)

        def on_wire(time_ns: int) -> None:
            for axes, begun in starts:
                for axis in axes:
                    axis.began(time_ns)
                begun.append(time_ns)

        self._link.at_next_sync(on_wire)


def cycle_of(link: CanopenLink, period_s: float) -> Cycle:
    """The cycle of this link, made if it is the first use.

    One of another period is given as well; its `join` is refused where that matters.
    """
    cycle = link.cycle
    if not isinstance(cycle, Cycle) or (cycle.period_s != period_s and link.sync_period_ns is None):
        link.cycle = cycle = Cycle(link, period_s)
    elif cycle.period_s != period_s:
        return Cycle(link, period_s)
    return cycle
