"""A node of a CAN bus: frames, participation, and deliveries.

A node that comes back after a cut listens until it has heard 11 recessive bits in a row. A bus-off
node waits until it has counted 128 such runs. Between frames the bus does not process single bits:
it knows when the runs will be complete unless a frame begins before.

A delivery is (frame, port that sent it, kind). Without faults the kind is always 0. Otherwise its
low two bits select the action. The bits above are the ports (1 << number) that do not hear this
frame; `hears` reads them.
"""

from enum import Enum
from heapq import heappop, heappush
from typing import Final, final

from motorhil.emulators.can.bitlevel.controller import state_message
from motorhil.emulators.can.bitlevel.episode import Outcome, Station
from motorhil.emulators.can.controller_config import CanNode, QueueOrder
from motorhil.emulators.can.error_confinement import (
    RESTARTED,
    TEC_MAX,
    Confinement,
    ErrorState,
    pack_error,
)
from motorhil.emulators.can.frame_length import KEY_SHIFT

# An entry in an arbitration: key << 30 | port << 18 | lengths. The lowest wins. Its 62 bits fit
# the tagged integers of compiled code. The lengths are those of `frame_length`.
PORT_SHIFT: Final = 18
PORT_MASK: Final = 0xFFF
CUT_OFF: Final = -1  # in place of the candidate's entry: off the bus, all frames wait

RUN_BITS: Final = 11  # length of a recessive run, for integration and recovery
RECOVERY_RUNS: Final = 128
NEVER_NS: Final = -1

Delivery = tuple[bytes, int, int]
DELIVERED: Final = 0  # all others hear it, and the sender is informed that it was sent
LOST: Final = 1  # the sender is informed that it was sent; no node hears it, or not yet
TOLD: Final = 3  # an error message from its CAN controller, for the port named as sender only
HEARD: Final = 2  # all others hear it; the sender is informed before or later
KIND_MASK: Final = 3
NOTED: Final = TOLD | 1 << 2  # an error message that the node does not request: recorded only

_KIND_BITS: Final = 2


@final
class CanPort:
    """The frames of one node. Only the bus reads and writes it.

    Attributes:
        chip: the setup of its CAN controller.
        tag: the port's number, at its place in an entry.
        entry: of the candidate, which competes or is in flight; 0: there is none; or CUT_OFF.
        frame: the candidate.
        behind: heap of (rank, turn, entry, frame); rank is the key, or 0 in a FIFO.
        starts_seen: the bus's count of arbitrations before the candidate's first.
        losses: arbitrations lost by earlier candidates.
        repeated: frames that a fault made the node send again.
        babbling: the candidate is a babbled frame, not a submitted one.
        turn: number of frames queued so far, the order within a rank.
    """

    def __init__(self, number: int, name: str, chip: CanNode) -> None:
        self.name = name
        self.chip = chip
        self.tag: int = number << PORT_SHIFT
        self.by_priority: bool = chip.queue is QueueOrder.PRIORITY
        self.entry: int = 0
        self.frame: bytes = b""
        self.behind: list[tuple[int, int, int, bytes]] = []
        self.starts_seen = 0
        self.losses: int = 0
        self.repeated: set[bytes] = set()
        self.babbling = False
        self.turn: int = 0

    def pending(self) -> int:
        """Return the number of pending frames."""
        return len(self.behind) + (1 if self.entry > 0 else 0)

    def queue(self, entry: int, frame: bytes) -> None:
        """Queue the frame as the last of its rank."""
        self.turn += 1
        heappush(self.behind, (self._rank(entry), self.turn, entry, frame))

    def put_back(self) -> None:
        """Put the candidate back as the first of its rank, leaving no candidate."""
        self.turn += 1
        heappush(self.behind, (self._rank(self.entry), -self.turn, self.entry, self.frame))
        self.entry = 0

    def promote(self) -> bool:
        """Make the best queued frame the candidate; return False if there is none."""
        if not self.behind:
            self.entry = 0
            return False
        _, _, self.entry, self.frame = heappop(self.behind)
        return True

    def adopt(self, other: "CanPort") -> None:
        """Take over the queued frames and the counts of another port."""
        self.behind, other.behind = other.behind, []
        self.losses = other.losses
        self.repeated = other.repeated
        self.turn, other.turn = other.turn, 0

    def _rank(self, entry: int) -> int:
        return entry >> KEY_SHIFT if self.by_priority else 0


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
        self.confinement: Confinement = Confinement()
        self.role: Role = Role.ON
        self.since_ns: int = NEVER_NS
        self.runs_left: int = 0
        self.aborted = 0
        self.errors = 0
        self.stalled: bool = False
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
        return pack_error(RESTARTED)

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


def hears(kind: int, port: int) -> bool:
    """Return whether this port, not the sender's, hears a delivery of this kind."""
    return kind & KIND_MASK in (DELIVERED, HEARD) and not kind >> (_KIND_BITS + port) & 1


def confirms(kind: int) -> bool:
    """Return whether a delivery of this kind informs the sender that its frame was sent."""
    return kind & KIND_MASK in (DELIVERED, LOST)


def kind_without(kind: int, deaf_mask: int) -> int:
    """Return this kind (DELIVERED or HEARD) without some ports, a mask of 1 << number."""
    return kind | deaf_mask << _KIND_BITS
