"""A wired-AND bus with its controllers, stepped bit by bit.

While a node is in the data phase of a CAN FD frame, a step is a bit at the data rate. A node
outside the data phase sends an error flag, waits for the bus to be idle, or takes the frame for a
classical one. For it, `ratio` such steps form one bit, sampled in the last of them. Its bit grid
begins with the first error flag; a node that joins it later does so with the rest of a bit. A node
that waits for an idle bus hears a dominant level if any step of its bit had one. Without an error
the grid begins where the data phase ends.
"""

from collections.abc import Sequence
from typing import final

from emulators.media.can_station import (
    IDLE,
    INTEGRATING,
    INTEGRATION_BITS,
    OFF,
    RECEIVING,
    SENDING,
    SIGNALLING,
    CanStation,
)
from emulators.media.can_wire import DOMINANT, RECESSIVE
from emulators.media.disturbance import ALL_PORTS, Disturbance, Strikes


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
        self.strikes = Strikes(struck_by)
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
        self.bit = 0
        self.recessive_runs = 0
        self.recessive_bits = recessive_bits
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
