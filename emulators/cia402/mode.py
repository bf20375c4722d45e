"""What all modes of operation have in common."""

from emulators.canopen.shared import NEVER
from emulators.cia402.objects import DriveObjects
from emulators.firmware.axis import Axis
from emulators.firmware.digital_inputs import Edge


class Mode:
    """One mode of operation; it is asked and told only while it has the axis.

    It has it in OPERATION ENABLED. All calls come after `axis.at(now_ns)`.
    """

    def __init__(self, axis: Axis, objects: DriveObjects, tick_ns: int) -> None:
        self.axis = axis
        self.objects = objects
        self.tick_ns = tick_ns
        self.halted: bool = False
        self.limited: bool = False  # a limit holds it back: statusword bit 11
        self.heeds_sync: bool = False  # whether `synced` is to be called
        self.lost: bool = False  # SYNC has stayed away too long for it to go on

    def enter(self, word: int, now_ns: int) -> None:
        """The mode gets the axis; `word` is the present controlword."""

    def leave(self) -> None:
        """The axis is somebody else's now; what was still to be done is forgotten."""

    def obey(self, word: int, rising: int, now_ns: int) -> None:
        """A controlword was written; `rising` are the bits that were 0 in the one before."""

    def written(self, what: int, now_ns: int) -> None:
        """Objects were written (see objects.py)."""

    def sees(self, edges: list[Edge]) -> None:
        """Digital inputs have changed."""

    def synced(self, now_ns: int) -> bool:
        """SYNC was on the bus, and what it brought into force has been told.

        True: something is to be done, or waited for, that was not before.
        """
        return False

    def settle(self, now_ns: int) -> None:
        """The axis' flags have changed, or `wake_ns` has come."""

    def wake_ns(self) -> int:
        """When `settle` must be called at the latest [ns], or NEVER."""
        return NEVER

    def status_bits(self) -> int:
        """Statusword bits 10, 12 and 13 while the mode has the axis."""
        return 0

    def idle_bits(self) -> int:
        """The same while it has not."""
        return 0
