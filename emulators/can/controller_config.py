"""Configuration of a node's CAN controller, and its clock's effect on sampling.

A receiver starts its bit times with the edge of the start of frame. From then on it only corrects
them: at each recessive to dominant edge by its phase error, at most the synchronisation jump width.
Between edges it drifts by the difference of the two clocks. The receiver misreads a bit once its
sample point has left that bit. Stuffing guarantees an edge every ten bits. Below some clock
difference no frame is misread: `tolerance_1e12`.

The computation uses whole numbers with a bit time of ONE. Real controllers see edges only in steps
of a time quantum, and cables have delays. Both are left out, so take the result as a margin, not as
an exact figure.

Source: ISO 11898-1, synchronisation; Hartwich & Bassemir, The configuration of the CAN bit timing
(1999), oscillator tolerance.
"""

from dataclasses import dataclass
from enum import Enum
from typing import Final, final

ONE: Final = (
    10**12
)  # a bit time; also the rate of an ideal clock (motorhil.emulators.plant.oscillator)
RECESSIVE: Final = 1
HOST: Final = "host"  # name of the host's interface on every bus

_EDGES_APART: Final = 10  # maximum number of bits between edges to dominant: five of each level
_TO_ERROR_FLAG: Final = 13  # bits from such an edge to the one at the end of an error flag


@final
@dataclass(frozen=True, slots=True)
class BitTiming:
    """The division of a bit time in time quanta.

    Attributes:
        quanta: in a bit time, 8..25 on most controllers.
        sample: the sample point, in quanta from the beginning of the bit; CiA 301 wants 87.5 %.
        jump: the synchronisation jump width.

    Raises:
        ValueError: the sample point is not inside the bit, or the jump width exceeds the rest of
            the bit behind it.
    """

    quanta: int = 16
    sample: int = 14
    jump: int = 1

    def __post_init__(self) -> None:
        if not 1 < self.sample < self.quanta:
            raise ValueError(
                f"sample point {self.sample}: invalid; expected 2 to {self.quanta - 1} quanta"
            )
        if not 1 <= self.jump <= self.quanta - self.sample:
            raise ValueError(
                f"jump width {self.jump}: invalid; expected 1 to "
                f"{self.quanta - self.sample}, the quanta behind the sample point"
            )

    def tolerance_1e12(self) -> int:
        """Return the clock difference [1e-12] up to which two nodes read each other without errors.

        One edge can correct the drift since the edge before. The thirteenth bit after an edge is
        still sampled within itself (an error flag and the bits behind it have no edge).
        """
        by_jump = self.jump * ONE // (_EDGES_APART * self.quanta)
        before, after = self.sample, self.quanta - self.sample
        by_sample = min(before, after) * ONE // (_TO_ERROR_FLAG * self.quanta - after)
        return min(by_jump, by_sample)


USUAL_TIMING: Final = BitTiming()


def first_misread(levels: bytes, drift_1e12: int, timing: BitTiming) -> int | None:
    """Return the first bit that the receiver misreads, or None if it reads all.

    Args:
        levels: of the bits as sent, 0 dominant and 1 recessive, start of frame first.
        drift_1e12: how much longer its bit times are than the sender's [1e-12]; below 0: shorter.
        timing: of the receiver.
    """
    sample = timing.sample * ONE // timing.quanta
    jump = timing.jump * ONE // timing.quanta
    at_sample = sample + drift_1e12 * timing.sample // timing.quanta
    late = 0  # delay of the receiver's bit against the sender's
    before = RECESSIVE
    last = len(levels) - 1
    for number, level in enumerate(levels):
        if number and before == RECESSIVE != level:
            late -= min(late, jump) if late > 0 else max(late, -jump)
        looked_at = min(max(number + (late + at_sample) // ONE, 0), last)
        if levels[looked_at] != level:
            return number
        before = level
        late += drift_1e12
    return None


class QueueOrder(Enum):
    """The pending frame of a node that competes for the bus."""

    FIFO = "fifo"  # the oldest: most drives, and Linux
    PRIORITY = "priority"  # the one whose identifier wins; the oldest of equal ones


class FrameSupport(Enum):
    """The frame formats that a CAN controller tolerates and sends (ISO 11898-1:2015)."""

    CLASSICAL = "classical"  # reads FD frames as classical ones, finds errors and destroys them
    FD_TOLERANT = "fd_tolerant"  # lets FD frames pass and does not receive them
    FD = "fd"  # sends and receives both


@final
@dataclass(frozen=True, slots=True)
class CanNode:
    """The setup of a node's CAN controller.

    Attributes:
        queue: the pending frame that competes for the bus.
        frames: the frame formats that it tolerates.
        one_shot: a frame that fails, or loses arbitration, is not sent again.
        recovery_ns: delay after bus-off before it begins to wait for the 128 x 11 recessive bits
            [ns]; None: it waits for a command.
        shared: its port belongs to one of several programs that share one CAN controller. If two of
        them send frames with one identifier, one frame waits for the other.
        error_reporting: it reports every single error, not only changes of its state (SocketCAN:
            berr-reporting).
        clock_error_1e12: relative error of its oscillator [1e-12]. Above 0 it runs fast, and the
            frames that it sends are shorter by that much.
        timing: its bit timing, which decides whose frames it can read.
    """

    queue: QueueOrder = QueueOrder.FIFO
    frames: FrameSupport = FrameSupport.CLASSICAL
    one_shot: bool = False
    recovery_ns: int | None = 0
    error_reporting: bool = False
    shared: bool = False
    clock_error_1e12: int = 0
    timing: BitTiming = USUAL_TIMING

    def __post_init__(self) -> None:
        """Check the values.

        Raises:
            ValueError: recovery_ns is below 0, or the clock does not run.
        """
        if self.clock_error_1e12 <= -ONE:
            raise ValueError(
                f"clock_error_1e12: invalid value {self.clock_error_1e12}; "
                "expected more than -1e12, a running clock"
            )
        if self.recovery_ns is not None and self.recovery_ns < 0:
            raise ValueError(f"recovery_ns: invalid value {self.recovery_ns}; expected 0 or more")


PLAIN: Final = CanNode()
