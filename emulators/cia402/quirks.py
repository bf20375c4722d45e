"""Installation of quirks in a drive while it is built."""

from typing import final

from emulators.canopen.abort_code import OK
from emulators.canopen.object_dictionary import DataType, ObjectDictionary
from emulators.cia402.objects import DriveObjects
from emulators.cia402.pds_fsa import CW_HALT
from emulators.cia402.power_drive import PowerDrive
from emulators.cia402.quirk_catalogue import Quirks, parameter_ns
from emulators.cia402.quirky_position import (
    EdgeOnlyBits,
    InvertedAcknowledge,
    SingleSetPoint,
    StaleTargetReached,
)
from emulators.cia402.quirky_wire import WireQuirks
from emulators.cia402.settings import EMULATED_MODES


@final
class HaltHoldsMode:
    """A writer of 6060h that ignores writes under halt."""

    def __init__(self, od: ObjectDictionary, objects: DriveObjects) -> None:
        variable = od.ensure(0x6060, 0, DataType.INTEGER8, 0)
        self._objects = objects
        self._inner = variable.writer
        variable.writer = self.write

    def write(self, value: int) -> int:
        """Check a value before it is stored; return 0 or an abort code."""
        if self._objects.controlword & CW_HALT or self._inner is None:
            return OK
        return self._inner(value)


def deviate(
    power_drive: PowerDrive, objects: DriveObjects, od: ObjectDictionary, quirks: Quirks
) -> None:
    """Add the enabled quirks other than those of the wire, before power comes on."""
    modes, pp = power_drive.modes, EMULATED_MODES["pp"]
    if "single_set_point_only" in quirks:
        modes[pp] = SingleSetPoint(modes[pp])
    if "edge_only_bits" in quirks:
        modes[pp] = EdgeOnlyBits(modes[pp])
    if "stale_target_reached" in quirks:
        stale_ns = parameter_ns(quirks, "stale_target_reached", "for_s")
        modes[pp] = StaleTargetReached(modes[pp], stale_ns)
    if "inverted_set_point_acknowledge" in quirks:
        modes[pp] = InvertedAcknowledge(modes[pp])
    if "halt_holds_mode" in quirks:
        HaltHoldsMode(od, objects)


def wire_quirks(quirks: Quirks) -> WireQuirks:
    """Return the enabled quirks of the wire."""
    wire = WireQuirks()
    wire.sdo_mean_ns = parameter_ns(quirks, "slow_sdo", "mean_s")
    wire.sdo_spread_ns = parameter_ns(quirks, "slow_sdo", "spread_s")
    wire.heartbeat_ns = parameter_ns(quirks, "heartbeat_jitter", "max_s")
    wire.deaf_ns = parameter_ns(quirks, "deaf_after_boot_up", "for_s")
    wire.has_stray_emcy = "stray_emcy" in quirks
    wire.has_misplaced_register = "misplaced_error_register" in quirks
    return wire
