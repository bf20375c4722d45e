"""What a node's CAN controller is made and set up for: the chip, not what is behind it."""

from dataclasses import dataclass
from enum import Enum
from typing import Final, final

from emulators.media.can_sampling import ONE, USUAL_TIMING, BitTiming


class QueueOrder(Enum):
    """Which of a node's pending frames competes for the bus."""

    FIFO = "fifo"  # the oldest: most drives, and Linux
    PRIORITY = "priority"  # the one whose identifier wins; the oldest of several alike


class FrameSupport(Enum):
    """Which frames a CAN controller can stand, and send (ISO 11898-1:2015)."""

    CLASSICAL = "classical"  # it takes FD frames for classical ones, finds errors: destroys them
    FD_TOLERANT = "fd_tolerant"  # it lets FD frames pass, and does not see them
    FD = "fd"  # both


@final
@dataclass(frozen=True, slots=True)
class CanNode:
    """How a node's CAN controller is set up.

    Attributes:
        queue: which of its pending frames competes for the bus.
        frames: which frames it can stand.
        one_shot: a frame that fails, or loses arbitration, is not sent again.
        recovery_ns: how long after bus-off it begins to wait for the 128 x 11 recessive bits [ns];
            None: only when it is told to.
        shared: its port is that of one of several programs that share one CAN controller: of two
            frames with one identifier that they send, one waits for the other.
        error_reporting: it is told every single error, not only when its state changes (SocketCAN:
            berr-reporting).
        clock_error_1e12: how much faster than true its oscillator runs [1e-12]; so much shorter
            are the frames it sends. Below 0: slower.
        timing: of its bits: whose frames it can read depends on it.
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
        """Refuse what cannot be.

        Raises:
            ValueError: recovery_ns is below 0, or the clock does not run.
        """
        if self.clock_error_1e12 <= -ONE:
            raise ValueError(f"clock_error_1e12 {self.clock_error_1e12}: a clock goes on")
        if self.recovery_ns is not None and self.recovery_ns < 0:
            raise ValueError(f"recovery_ns {self.recovery_ns} is below 0")


PLAIN: Final = CanNode()
