"""What the cyclic synchronous modes share (csp, csv, cst): when set-points come, and when not.

A set-point counts when its RPDO does (at SYNC for types 0 to 240). The demand goes there evenly,
over the interpolation time period 60C2h, or, where that is 0 or absent, over the time that lay
between the last two set-points: with a SYNC, its period.

Where the rig sets `sync_lost_periods`, 60C2h states a period and a SYNC has come, its absence for
so many of them is a fault: the host has lost its clock. CiA 402 names no error code; the rig may.
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
    """Statusword bit 12: the drive follows the command value; bit 10 is reserved."""

    def __init__(self, axis: Axis, objects: DriveObjects, tick_ns: int) -> None:
        super().__init__(axis, objects, tick_ns)
        self._last_target_ns: int = _NONE_YET
        self._last_sync_ns: int = _NONE_YET
        self._period_ns: int = tick_ns
        self._patience: int = objects.settings.sync_lost_periods
        self.heeds_sync = self._patience > 0

    def enter(self, word: int, now_ns: int) -> None:
        """As if no set-point and no SYNC had ever come."""
        self.halted = word & CW_HALT != 0
        self.lost = False
        self._last_target_ns = _NONE_YET
        self._last_sync_ns = _NONE_YET
        self._period_ns = self.tick_ns

    def leave(self) -> None:
        """Nothing is kept, and nothing fed forward."""
        self.halted = False
        self.limited = False
        self.lost = False
        self.axis.feed_current(0.0)

    def obey(self, word: int, rising: int, now_ns: int) -> None:
        """Bit 8, halt; afterwards the next set-point counts again."""
        halt = word & CW_HALT != 0
        if halt and not self.halted:
            self.objects.options.halt(self.axis, within_limits=True)
        self.halted = halt

    def synced(self, now_ns: int) -> bool:
        """The host is alive; from now on it is waited for, if the rig says for how long."""
        if self._patience == 0:
            return False
        is_first = self._last_sync_ns == _NONE_YET
        self._last_sync_ns = now_ns
        return is_first

    def settle(self, now_ns: int) -> None:
        """Whether SYNC has stayed away for too long."""
        if self._last_sync_ns != _NONE_YET and now_ns >= self.sync_due_ns():
            self._last_sync_ns = _NONE_YET
            self.lost = True

    def wake_ns(self) -> int:
        """When SYNC will have stayed away for too long."""
        return self.sync_due_ns()

    def sync_due_ns(self) -> int:
        """The same, of a mode that may wait for something else, too; NEVER without SYNC so far."""
        if self._last_sync_ns == _NONE_YET:
            return NEVER
        period_ns = self.objects.motion.interpolation_ns()
        if period_ns == 0:
            return NEVER
        return self._last_sync_ns + self._patience * period_ns

    def status_bits(self) -> int:
        """Bit 12."""
        return 0 if self.halted or self.limited else FOLLOWS_COMMAND

    def over_ns(self) -> int:
        """How long the way to a set-point takes."""
        period_ns = self.objects.motion.interpolation_ns()
        return period_ns if period_ns > 0 else self._period_ns

    def measure(self, now_ns: int) -> None:
        """The time between set-points, in whole ticks: arbitration makes SYNC come a little late.

        What comes in the same tick belongs to the same set-point.
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
