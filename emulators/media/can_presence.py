"""Participation of a node in its bus: error counters and roles.

A node that comes back after a cut listens until it has heard 11 recessive bits in a row. A bus-off
node waits until it has counted 128 such runs. Between frames the bus does not process single bits:
it knows when the runs will be complete unless a frame begins before.
"""

from enum import Enum
from typing import Final, final

from emulators.media import error_message as told
from emulators.media.can_episode import Outcome, Station
from emulators.media.can_node import CanNode
from emulators.media.confinement import TEC_MAX, Confinement, ErrorState
from emulators.media.error_journal import state_message

RUN_BITS: Final = 11  # length of a recessive run, for integration and recovery
RECOVERY_RUNS: Final = 128
NEVER_NS: Final = -1


class Role(Enum):
    """The way in which a node takes part."""

    ON = "on"
    SUSPENDED = "suspended"  # hears, but must not start a frame yet
    INTEGRATING = "integrating"  # listens until the bus has been idle
    OFF = "off"  # bus-off


@final
class Presence:
    """A node on a bus. Only the bus writes it.

    Attributes:
        number, name, chip: of its port.
        confinement: its error counters.
        role: the way in which it takes part.
        since_ns: INTEGRATING, OFF: when the run of recessive bits began that it is hearing, or when
            it will begin to count [ns]; NEVER_NS: it counts none. SUSPENDED: the end of the
            suspension.
        runs_left: INTEGRATING, OFF: how many runs of 11 recessive bits it still has to hear.
        aborted: number of its frames that were given up: bus-off, or one-shot.
        errors: number of errors that it has detected.
        stalled: it has heard only dominant bits for long, and waits for a recessive one.
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
        """Return whether the node receives frames and acknowledges them."""
        return self.role is Role.ON or self.role is Role.SUSPENDED

    def is_well(self) -> bool:
        """Return whether the node takes part and its counters are 0."""
        counters = self.confinement
        return self.role is Role.ON and not counters.tec and not counters.rec

    def state(self) -> ErrorState:
        """Return the error state."""
        return ErrorState.BUS_OFF if self.role is Role.OFF else self.confinement.state()

    def due_ns(self, bit_ns: int) -> int:
        """Return when it takes part again on an idle bus; NEVER_NS: it does, or needs a command."""
        if self.role is Role.ON or self.since_ns == NEVER_NS:
            return NEVER_NS
        if self.role is Role.SUSPENDED:
            return self.since_ns
        return self.since_ns + self.runs_left * RUN_BITS * bit_ns

    def suspend(self, until_ns: int) -> None:
        """Forbid the node to start a frame before `until_ns`."""
        self.role = Role.SUSPENDED
        self.since_ns = until_ns

    def integrate(self, since_ns: int) -> None:
        """Let the node integrate on another wire, by hearing 11 recessive bits there."""
        self.stalled = False
        if self.role is Role.OFF:
            if self.since_ns != NEVER_NS:
                self.since_ns = max(since_ns, self.since_ns)
            return
        self.role = Role.INTEGRATING
        self.since_ns = since_ns
        self.runs_left = 1

    def leave(self, off_ns: int) -> None:
        """Enter bus-off and schedule the beginning of the recovery."""
        self.role = Role.OFF
        self.confinement = Confinement(TEC_MAX, self.confinement.rec)
        self.runs_left = RECOVERY_RUNS
        recovery_ns = self.chip.recovery_ns
        self.since_ns = NEVER_NS if recovery_ns is None else off_ns + recovery_ns
        self._told = ErrorState.BUS_OFF

    def recover(self) -> bytes:
        """Take part again with counters of 0 and return the error message that reports it."""
        self.role = Role.ON
        self.since_ns = NEVER_NS
        self.confinement = Confinement()
        self._told = ErrorState.ACTIVE
        return told.pack_error(told.RESTARTED)

    def dominant_from(self, now_ns: int, bit_ns: int) -> None:
        """Count the recessive runs up to the frame that begins now."""
        if self.since_ns != NEVER_NS and now_ns > self.since_ns:
            self.runs_left -= (now_ns - self.since_ns) // (RUN_BITS * bit_ns)

    def recessive_from(self, since_ns: int, runs: int) -> None:
        """Count the runs within a frame that is over; the next run began at `since_ns`."""
        if self.since_ns == NEVER_NS or self.since_ns > since_ns:
            return
        self.runs_left -= runs
        self.since_ns = since_ns

    def station(self, frames: tuple[bytes, ...]) -> Station:
        """Return the node as a station of an episode, with these frames to send."""
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
        """Take over the state in which an episode has left the node."""
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
        """Return the message that reports a changed error state, or no bytes without a change."""
        counters = self.confinement
        state = counters.state()
        if state is self._told:
            return b""
        self._told = state
        return state_message(counters)
