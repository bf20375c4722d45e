"""Configuration of a node's CAN controller, independent of the device behind it."""

from dataclasses import dataclass
from enum import Enum
from typing import Final, final

from emulators.media.can_sampling import ONE, USUAL_TIMING, BitTiming


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
