"""Cycle of servos on the host, and its timing statistics.

    SYNC k ----------- counts of k -> servo -> outputs -----------> SYNC k + 1: outputs act

The counts are those at the instant of SYNC k, and the outputs act at SYNC k + 1. The delay is one
cycle, constant, for all motors of a bus. A cycle of two channels is *missed* in two cases. The
counts have not come before the next SYNC is due: the servo then has no input, and the outputs stay.
Or the outputs still wait for the bus then.

A frame does not show which SYNC its counts belong to. Counts after the next SYNC are attributed to
that one, until further counts come in the same cycle (`surplus`). On CAN they are one cycle old at
most, as a node sends them in order. An adapter or a gateway can delay them further. A velocity is
computed from them only if none was missed or surplus for a second (`is_regular`).
"""

import struct
from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Final, Protocol, final

from motorhil.motorapi.adaptations.canopen.bus import CanopenBus
from motorhil.motorapi.adaptations.canopen.node import CanopenNode
from motorhil.motorapi.adaptations.host_servo.occupation import NodeOccupation
from motorhil.motorapi.errors import DeadlineExceeded, LinkError, MotorBusyError, MotorError
from motorhil.motorapi.ownership.physical_motor import PhysicalMotor
from motorhil.motorapi.runtime.can_link import Transmission

if TYPE_CHECKING:
    from motorhil.motorapi.locking.process_lock import LockHandle
    from motorhil.motorapi.ownership.fencing import Fence
    from motorhil.motorapi.runtime.api import Registration

_REGULAR_S: Final = 1.0  # longer than a frame is delayed on its way
_LINGER: Final = 2  # cycles in which 0 is sent, after the last motor was switched off
_OUTPUTS: Final = (struct.Struct("<IB3xh6x"), struct.Struct("<IB3xhh4x"))
_COUNTS: Final = (struct.Struct("<8xi4x").unpack, struct.Struct("<8xii").unpack)


@final
@dataclass(frozen=True, slots=True)
class CycleReport:
    """The timing statistics of a motor's servo, since its frames were first exchanged.

    Attributes:
        period_s: the period of the servo [s].
        cycles: the number of cycles.
        counts_missed: cycles whose count did not come in time.
        outputs_late: cycles whose output still waited for the bus when its SYNC was due.
        worst_in_a_row: the largest number of consecutive misses.
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
        """The number of cycles missed in either way."""
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
        """Process the count of this cycle, and return the output for it (6411h)."""

    def look(self, count: int) -> None:
        """Process a further count of this cycle."""

    def begin(self, cycle: int) -> None:
        """Begin the armed course with the count of this cycle."""

    def began(self, time_ns: int) -> None:
        """Record the time when the SYNC of the beginning was on the wire."""

    def fail(self, error: MotorError) -> None:
        """End the control, as the cycle has failed."""


@final
class ChannelPair:
    """One or two channels of a node, whose outputs share a frame, and whose counts do."""

    def __init__(
        self,
        cycle: "Cycle",
        node: CanopenNode,
        identifiers: tuple[int, int],
        misses_max: int,
        occupation: NodeOccupation,
    ) -> None:
        self.identifiers: Final = identifiers
        self._axes: tuple[Axis | None, Axis | None] = (None, None)
        self._cycle = cycle
        self._node = node
        self._link = node.link
        self._output_id, self._count_id = identifiers
        self._misses_max = misses_max
        self._occupation = occupation
        self._hold: LockHandle | None = None  # of the node, while outputs are sent
        self._awaited = False  # counts, since the last SYNC
        self._out: Transmission | None = None
        self._linger = _LINGER
        self._in_a_row = 0
        self._heard_ns = 0
        self._irregular = -round(_REGULAR_S / cycle.period_s)  # the last such cycle
        self._cycles = self._missed = self._late = self._worst = self._surplus = 0
        self._link.handle(self._count_id, self._on_counts)

    def __repr__(self) -> str:
        return f"<channel pair {self._output_id:03X}h: {self.report()}>"

    def report(self) -> CycleReport:
        """Return the timing statistics."""
        return CycleReport(
            *(self._cycle.period_s, self._cycles, self._missed, self._late),
            *(self._worst, self._surplus),
        )

    def place(self, slot: int, axis: "Axis | None") -> None:
        """Assign the first (0) or second (1) channel to `axis`."""
        first, second = self._axes
        self._axes = (axis, second) if slot == 0 else (first, axis)

    def require_free(self) -> None:
        """Raise MotorBusyError if a motor of these frames is under low-level access."""
        for axis in self._axes:
            if axis is not None:
                axis.physical.require_not_held_elsewhere()

    @property
    def is_regular(self) -> bool:
        """True if each cycle of the last second had its counts, so that none of them was late."""
        return (self._cycle.count - self._irregular) * self._cycle.period_s >= _REGULAR_S

    def is_running(self) -> bool:
        """Return whether the pair takes part in the cycle."""
        return self._cycle.has(self)

    def join(self) -> None:
        """Join the cycle, as long as one of the axes is active.

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
        """Leave the cycle, and stop listening to counts."""
        self._leave()
        self._link.ignore(self._count_id)

    def fence(self) -> "Fence | None":
        """Return the fence that permits the outputs while this process occupies the node."""
        return self._occupation.outputs

    def _leave(self) -> None:
        self._cycle.leave(self)
        self.vacate()

    def vacate(self) -> None:
        """End the occupation of the node for these frames."""
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
            self._irregular = self._cycle.count
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
        except MotorBusyError as error:  # another process occupies the node now
            self.fail(error)
            self._leave()

    def turn(self) -> None:
        """Evaluate the cycle before the SYNC that was just queued."""
        if self._awaited:
            self._irregular = self._cycle.count
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
        """Report a failure of the cycle to the active motors."""
        for axis in self._axes:
            if axis is not None and axis.is_active:
                axis.fail(error)


@final
class Cycle:
    """The servos' common clock on one link: one SYNC for all of them.

    Attributes:
        period_s: the period of SYNC [s].
        count: the number of the last SYNC.
        armed: axes that one trigger starts together.
    """

    def __init__(self, bus: CanopenBus, period_s: float) -> None:
        self.period_s: Final = period_s
        self.count: int = 0
        self.armed: list[Axis] = []
        self._link: Final = bus.link
        self._sync: Final = bus.sync
        self._pairs: tuple[ChannelPair, ...] = ()
        self._registration: Registration | None = None
        self._starts: list[tuple[tuple[Axis, ...], list[int]]] = []

    def has(self, pair: ChannelPair) -> bool:
        """Return whether the pair takes part."""
        return pair in self._pairs

    def join(self, pair: ChannelPair) -> None:
        """Add a pair, from the next SYNC on; the first pair starts SYNC.

        Raises:
            UsageError: SYNC runs with another period on this bus.
        """
        if self._registration is None:
            self._registration = self._sync.join(
                self.period_s, self._after_sync, self._sync_lost, self._fence
            )
        self._pairs = (*self._pairs, pair)

    def leave(self, pair: ChannelPair) -> None:
        """Remove a pair; the last one ends SYNC."""
        self._pairs = tuple(other for other in self._pairs if other is not pair)
        if not self._pairs and self._registration is not None:
            self._registration.cancel()
            self._registration = None

    def _fence(self) -> "Fence | None":
        """Return the fence of the SYNC: that of one of the nodes that use it."""
        return self._pairs[0].fence() if self._pairs else None

    def _sync_lost(self, error: LinkError) -> None:
        """End the control, as the SYNC of the servos is lost."""
        pairs, self._pairs = self._pairs, ()
        self._registration = None
        for pair in pairs:
            pair.fail(error)
            pair.vacate()

    def start(self, axes: Sequence[Axis]) -> None:
        """Start the armed courses of all axes by one SYNC, and wait until it was on the wire.

        Raises:
            LinkError: no SYNC was transmitted.
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

        self._sync.at_next(on_wire)


@final
class _Cycles:
    """The cycle of the servos on one bus."""

    def __init__(self) -> None:
        self.cycle: Cycle | None = None


def cycle_of(bus: CanopenBus, period_s: float) -> Cycle:
    """Return the cycle of this bus, made on first use.

    A different period yields a separate cycle, whose `join` is refused if SYNC runs.
    """
    cycles = bus.parts.part(_Cycles)
    cycle = cycles.cycle
    if cycle is None or (cycle.period_s != period_s and bus.sync.period_ns is None):
        cycle = cycles.cycle = Cycle(bus, period_s)
        bus.sync.planned_s = period_s
    elif cycle.period_s != period_s:
        return Cycle(bus, period_s)
    return cycle


@final
class ServoTrigger:
    """A trigger for one motor, or for all motors armed together on a bus."""

    def __init__(self, cycle: Cycle, axis: Axis | None) -> None:
        self._cycle = cycle
        self._axis = axis

    def fire(self) -> None:
        """Start the motors, and wait until their SYNC was on the wire."""
        cycle = self._cycle
        if self._axis is not None:
            cycle.start((self._axis,))
            return
        armed, cycle.armed = cycle.armed, []
        cycle.start(armed)

    def __eq__(self, other: object, /) -> bool:
        return (
            isinstance(other, ServoTrigger)
            and other._cycle is self._cycle
            and other._axis is self._axis
        )

    def __hash__(self) -> int:
        return hash((id(self._cycle), id(self._axis)))
