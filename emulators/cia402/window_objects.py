"""The windows for target reached, standstill, velocity and following error."""

from typing import Final, final

from emulators.canopen.object_dictionary import DataType, ObjectDictionary
from emulators.canopen.shared import MS
from emulators.cia402.factors import DriveDefaults
from emulators.cia402.units import FactorGroup

NO_WINDOW: Final = 0xFFFF_FFFF
_D = DataType


@final
class WindowObjects:
    """6065h to 6068h, 606Dh to 6070h."""

    def __init__(self, od: ObjectDictionary, factors: FactorGroup, defaults: DriveDefaults) -> None:
        ensure = od.ensure
        self._factors = factors
        self._following_window = ensure(0x6065, 0, _D.UNSIGNED32, defaults.following_window)
        self._following_ms = ensure(0x6066, 0, _D.UNSIGNED16, 10)
        self._target_window = ensure(0x6067, 0, _D.UNSIGNED32, defaults.target_window)
        self._target_ms = ensure(0x6068, 0, _D.UNSIGNED16, 5)
        self._velocity_window = ensure(0x606D, 0, _D.UNSIGNED16, defaults.velocity_window)
        self._velocity_window_ms = ensure(0x606E, 0, _D.UNSIGNED16, 10)
        self._velocity_threshold = ensure(0x606F, 0, _D.UNSIGNED16, defaults.velocity_window)
        self._velocity_threshold_ms = ensure(0x6070, 0, _D.UNSIGNED16, 10)

    def read(self) -> tuple[int, int, int, int, float, int, float, int]:
        """Return target, following error, velocity and threshold windows, each with its time [ns].

        The windows are in increments and increments per second. A window of FFFF FFFFh is off, and
        so is a following error window of 0.
        """
        units = self._factors.units
        target = self._target_window.integer()
        following = self._following_window.integer()
        off = 1 << 62
        return (
            off if target == NO_WINDOW else abs(units.position_inc(target)),
            self._target_ms.integer() * MS,
            off if following in (0, NO_WINDOW) else abs(units.position_inc(following)),
            self._following_ms.integer() * MS,
            self._velocity_window.integer() * units.velocity_unit_inc_s,
            self._velocity_window_ms.integer() * MS,
            self._velocity_threshold.integer() * units.velocity_unit_inc_s,
            self._velocity_threshold_ms.integer() * MS,
        )
