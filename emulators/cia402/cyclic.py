"""Base of the cyclic synchronous modes (csp, csv, cst): timing of set-points.

A set-point takes effect with its RPDO (at SYNC for types 0 to 240). The demand changes linearly
during the interpolation time period 60C2h. If that is 0 or absent, the time between the last two
set-points is used: with SYNC, the SYNC period.

The loss of SYNC is a fault if the rig sets `sync_lost_periods`, 60C2h states a period and a SYNC
has been received. The fault occurs after that number of periods without SYNC, because the host has
lost its clock. CiA 402 defines no error code for it; the rig can set one.
"""

from typing import Final

from emulators.canopen.shared import NEVER
from emulators.cia402.mode import Mode
from emulators.cia402.objects import DriveObjects
from emulators.cia402.pds_fsa import CW_HALT
from emulators.cia402.statusword import FOLLOWS_COMMAND
from emulators.firmware.axis import Axis

PERIOD_MAX_NS: Final = 1_000_000_000
_NONE_YET: Final = -1


class CyclicMode(Mode):
    """A cyclic mode; statusword bit 12: drive follows the command value; bit 10 is reserved."""

    def __init__(self, axis: Axis, objects: DriveObjects, tick_ns: int) -> None:
        super().__init__(axis, objects, tick_ns)
        self._last_target_ns: int = _NONE_YET
        self._last_sync_ns: int = _NONE_YET
        self._period_ns: int = tick_ns
        self._patience: int = objects.settings.sync_lost_periods
        self.heeds_sync = self._patience > 0

    def enter(self, word: int, now_ns: int) -> None:
        """Reset the timing, as if no set-point and no SYNC had been received."""
        self.halted = word & CW_HALT != 0
        self.lost = False
        self._last_target_ns = _NONE_YET
        self._last_sync_ns = _NONE_YET
        self._period_ns = self.tick_ns

    def leave(self) -> None:
        """Clear the mode's state and the current fed forward."""
        self.halted = False
        self.limited = False
        self.lost = False
        self.axis.feed_current(0.0)

    def obey(self, word: int, rising: int, now_ns: int) -> None:
        """Obey bit 8, halt; after it the next set-point takes effect again."""
        halt = word & CW_HALT != 0
        if halt and not self.halted:
            self.objects.options.halt(self.axis, within_limits=True)
        self.halted = halt

    def synced(self, now_ns: int) -> bool:
        """Restart the monitoring of SYNC; return True at the first SYNC of a monitored mode."""
        if self._patience == 0:
            return False
        is_first = self._last_sync_ns == _NONE_YET
        self._last_sync_ns = now_ns
        return is_first

    def settle(self, now_ns: int) -> None:
        """Set `lost` if SYNC has been absent for too long."""
        if self._last_sync_ns != _NONE_YET and now_ns >= self.sync_due_ns():
            self._last_sync_ns = _NONE_YET
            self.lost = True

    def wake_ns(self) -> int:
        """Return when SYNC will have been absent for too long [ns]."""
        return self.sync_due_ns()

    def sync_due_ns(self) -> int:
        """Return the deadline of SYNC [ns]; NEVER before the first SYNC or without a period."""
        if self._last_sync_ns == _NONE_YET:
            return NEVER
        period_ns = self.objects.motion.interpolation_ns()
        if period_ns == 0:
            return NEVER
        return self._last_sync_ns + self._patience * period_ns

    def status_bits(self) -> int:
        """Return bit 12."""
        return 0 if self.halted or self.limited else FOLLOWS_COMMAND

    def over_ns(self) -> int:
        """Return the time of the move to a set-point [ns]."""
        period_ns = self.objects.motion.interpolation_ns()
        return period_ns if period_ns > 0 else self._period_ns

    def measure(self, now_ns: int) -> None:
        """Measure the time between set-points in whole ticks, because arbitration delays SYNC.

        Values received in the same tick belong to the same set-point.
        """
        last_ns = self._last_target_ns
        tick_ns = self.tick_ns
        if last_ns == _NONE_YET:
            self._last_target_ns = now_ns
            return
        ticks = (now_ns - last_ns + tick_ns // 2) // tick_ns
        if ticks > 0:
            self._last_target_ns = now_ns
            self._period_ns = min(PERIOD_MAX_NS, ticks * tick_ns)
