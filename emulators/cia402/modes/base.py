"""Base class of the modes of operation."""

from motorhil.emulators.canopen.outbox import NEVER
from motorhil.emulators.cia402.objects.dictionary import DriveObjects
from motorhil.emulators.firmware.axis import Axis
from motorhil.emulators.firmware.digital_inputs import Edge


class Mode:
    """One mode of operation; it is active only while it controls the axis.

    A mode controls the axis in OPERATION ENABLED. All methods are called after `axis.at(now_ns)`.
    """

    def __init__(self, axis: Axis, objects: DriveObjects, tick_ns: int) -> None:
        self.axis = axis
        self.objects = objects
        self.tick_ns = tick_ns
        self.halted: bool = False
        self.limited: bool = False  # a limit is active: statusword bit 11
        self.heeds_sync: bool = False  # True if `synced` must be called
        self.lost: bool = False  # SYNC has been absent for too long to continue

    def enter(self, word: int, now_ns: int) -> None:
        """Take control of the axis; `word` is the present controlword."""

    def leave(self) -> None:
        """Release the axis and discard pending work."""

    def obey(self, word: int, rising: int, now_ns: int) -> None:
        """Obey a controlword; `rising` are the bits that were 0 in the one before."""

    def written(self, what: int, now_ns: int) -> None:
        """Handle objects that were written (bits of `ObjectChange`)."""

    def sees(self, edges: list[Edge]) -> None:
        """Handle edges of digital inputs."""

    def synced(self, now_ns: int) -> bool:
        """Handle SYNC after its data; return True if there is new work or a new deadline."""
        return False

    def settle(self, now_ns: int) -> None:
        """Handle changed flags of the axis, or `wake_ns`."""

    def wake_ns(self) -> int:
        """Return when `settle` must be called at the latest [ns], or NEVER."""
        return NEVER

    def status_bits(self) -> int:
        """Return statusword bits 10, 12 and 13 while the mode controls the axis."""
        return 0

    def idle_bits(self) -> int:
        """Return the same bits while it does not."""
        return 0
