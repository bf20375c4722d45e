"""How a node takes part in its bus: error counters, and what keeps it from sending or hearing.

A node that comes back after a cut listens until it has heard 11 recessive bits in a row; one that
is bus-off until it has counted 128 such runs. Between frames the bus does not call for that: when
the runs will be complete is known, unless a frame begins before.
"""

from enum import Enum
from typing import Final, final

from emulators.media import error_message as told
from emulators.media.can_episode import Outcome, Station
from emulators.media.can_node import CanNode
from emulators.media.confinement import TEC_MAX, Confinement, ErrorState
from emulators.media.error_journal import state_message

RUN_BITS: Final = 11  # recessive: what a node integrates by, and what recovery counts
RECOVERY_RUNS: Final = 128
NEVER_NS: Final = -1


class Role(Enum):
    """How a node takes part."""

    ON = "on"
    SUSPENDED = "suspended"  # it hears, and must not start a frame yet
    INTEGRATING = "integrating"  # it listens until the bus has been idle
    OFF = "off"  # bus-off


@final
class Presence:
    """A node on a bus. Whoever has the bus writes it.

    Attributes:
        number, name, chip: of its port.
        confinement: its error counters.
        role: how it takes part.
        since_ns: INTEGRATING, OFF: when the run of recessive bits began that it is hearing, or
            will begin to count [ns]; NEVER_NS: it counts none. SUSPENDED: until when.
        runs_left: INTEGRATING, OFF: how many runs of 11 recessive bits it still has to hear.
        aborted: frames of its that were given up: bus-off, or one-shot.
        errors: errors that it has noticed.
        stalled: it has heard nothing but dominant bits for long, and waits for a recessive one.
    """

    def __init__(self, number: int, name: str, chip: CanNode) -> None:
        self.number = number
        self.name = name
        self.chip = chip
        self.confinement = Confinement()
        self.role = Role.ON
        self.since_ns = NEVER_NS
        self.runs_left = 0
        self.aborted = 0
        self.errors = 0
        self.stalled = False
        self._told = ErrorState.ACTIVE

    def hears(self) -> bool:
        """Whether frames reach it, and it acknowledges them."""
        return self.role is Role.ON or self.role is Role.SUSPENDED

    def is_well(self) -> bool:
        """Whether it takes part, and its counters are 0."""
        counters = self.confinement
        return self.role is Role.ON and not counters.tec and not counters.rec

    def state(self) -> ErrorState:
        """What its counters make of it."""
        return ErrorState.BUS_OFF if self.role is Role.OFF else self.confinement.state()

    def due_ns(self, bit_ns: int) -> int:
        """When it takes part again, if the bus stays idle; NEVER_NS: not by itself, or it does."""
        if self.role is Role.ON or self.since_ns == NEVER_NS:
            return NEVER_NS
        if self.role is Role.SUSPENDED:
            return self.since_ns
        return self.since_ns + self.runs_left * RUN_BITS * bit_ns

    def suspend(self, until_ns: int) -> None:
        """It must not start a frame before."""
        self.role = Role.SUSPENDED
        self.since_ns = until_ns

    def integrate(self, since_ns: int) -> None:
        """It is on another wire, and has to hear 11 recessive bits there."""
        self.stalled = False
        if self.role is Role.OFF:
            if self.since_ns != NEVER_NS:
                self.since_ns = max(since_ns, self.since_ns)
            return
        self.role = Role.INTEGRATING
        self.since_ns = since_ns
        self.runs_left = 1

    def leave(self, off_ns: int) -> None:
        """It is bus-off, and knows when it will begin to recover."""
        self.role = Role.OFF
        self.confinement = Confinement(TEC_MAX, self.confinement.rec)
        self.runs_left = RECOVERY_RUNS
        recovery_ns = self.chip.recovery_ns
        self.since_ns = NEVER_NS if recovery_ns is None else off_ns + recovery_ns
        self._told = ErrorState.BUS_OFF

    def recover(self) -> bytes:
        """It takes part again, with counters of 0; the message that tells it."""
        self.role = Role.ON
        self.since_ns = NEVER_NS
        self.confinement = Confinement()
        self._told = ErrorState.ACTIVE
        return told.pack_error(told.RESTARTED)

    def dominant_from(self, now_ns: int, bit_ns: int) -> None:
        """A frame has begun: the run of recessive bits is over."""
        if self.since_ns != NEVER_NS and now_ns > self.since_ns:
            self.runs_left -= (now_ns - self.since_ns) // (RUN_BITS * bit_ns)

    def recessive_from(self, since_ns: int, runs: int) -> None:
        """A frame is over; it had so many runs in it, and another one has begun in it."""
        if self.since_ns == NEVER_NS or self.since_ns > since_ns:
            return
        self.runs_left -= runs
        self.since_ns = since_ns

    def station(self, frames: tuple[bytes, ...]) -> Station:
        """It, as an episode finds it; it has these frames to send."""
        counters = self.confinement
        return Station(
            port=self.number,
            frames=frames,
            tec=counters.tec,
            rec=counters.rec,
            support=self.chip.frames,
            one_shot=self.chip.one_shot,
            integrating=RUN_BITS if self.role is Role.INTEGRATING else 0,
            stalled=self.stalled,
        )

    def end(self, outcome: Outcome, over_ns: int, off_ns: int, bit_ns: int) -> None:
        """It is as an episode has left it."""
        if outcome.off_at is not None:
            self.leave(off_ns)
            if self.since_ns != NEVER_NS and self.since_ns <= off_ns:
                self.runs_left -= outcome.recessive_runs
                self.since_ns = over_ns - outcome.recessive_bits * bit_ns
            elif self.since_ns != NEVER_NS:
                self.since_ns = max(self.since_ns, over_ns - outcome.recessive_bits * bit_ns)
            return
        self.stalled = outcome.stalled
        self.confinement = Confinement(outcome.tec, outcome.rec)
        self._told = self.confinement.state()
        if outcome.integrating:
            self.role = Role.INTEGRATING
            self.runs_left = 1
            self.since_ns = over_ns - (RUN_BITS - outcome.integrating) * bit_ns
        elif outcome.suspended:
            self.suspend(over_ns + outcome.suspended * bit_ns)
        else:
            self.role = Role.ON
            self.since_ns = NEVER_NS

    def change(self) -> bytes:
        """The message that tells it of its new state; no bytes if that is what it was."""
        counters = self.confinement
        state = counters.state()
        if state is self._told:
            return b""
        self._told = state
        return state_message(counters)
