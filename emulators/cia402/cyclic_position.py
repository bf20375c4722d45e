"""Cyclic synchronous position mode (csp): the host plans, the drive follows from cycle to cycle.

A target counts when its RPDO does (at SYNC for types 0 to 240). The demand goes there evenly, over
the interpolation time period 60C2h, or, where that is 0 or absent, over the time that lay between
the last two targets: with a SYNC, its period.
"""

from typing import Final, final

from emulators.cia402.mode import Mode
from emulators.cia402.objects import DriveObjects
from emulators.cia402.pds_fsa import CW_HALT
from emulators.cia402.statusword import FOLLOWING_ERROR, FOLLOWS_COMMAND
from emulators.cia402.written import TARGET_POSITION
from emulators.firmware import flags as f
from emulators.firmware.axis import Axis

PERIOD_MAX_NS: Final = 1_000_000_000
_NONE_YET: Final = -1


@final
class CyclicPosition(Mode):
    """Mode 8. Bit 12: the drive follows the command value; bit 13: following error."""

    def __init__(self, axis: Axis, objects: DriveObjects, tick_ns: int) -> None:
        super().__init__(axis, objects, tick_ns)
        self._last_target_ns: int = _NONE_YET
        self._period_ns: int = tick_ns

    def enter(self, word: int, now_ns: int) -> None:
        """The motor stands, or comes to rest, until a target is written."""
        self.halted = word & CW_HALT != 0
        self._last_target_ns = _NONE_YET
        self._period_ns = self.tick_ns
        self.axis.ramp_to_rest(self.objects.motion.deceleration_inc_s2())

    def leave(self) -> None:
        """Nothing is kept."""
        self.halted = False
        self.limited = False

    def obey(self, word: int, rising: int, now_ns: int) -> None:
        """Bit 8, halt; afterwards the next target counts again."""
        halt = word & CW_HALT != 0
        if halt and not self.halted:
            self.axis.ramp_to_rest(self.objects.options.halt_deceleration_inc_s2())
        self.halted = halt

    def written(self, what: int, now_ns: int) -> None:
        """A target has come into force."""
        if not what & TARGET_POSITION:
            return
        self._measure(now_ns)
        if self.halted:
            return
        objects = self.objects
        target = objects.motion.target_position_inc()
        allowed = objects.motion.within_limits_inc(target)
        self.limited = allowed != target
        period_ns = objects.motion.interpolation_ns()
        self.axis.follow(allowed, period_ns if period_ns > 0 else self._period_ns)

    def status_bits(self) -> int:
        """Bits 12 and 13; bit 10 is reserved."""
        bits = 0 if self.halted or self.limited else FOLLOWS_COMMAND
        if self.axis.flags & f.FOLLOWING_ERROR:
            bits |= FOLLOWING_ERROR
        return bits

    def _measure(self, now_ns: int) -> None:
        """The time between targets, in whole ticks: arbitration makes SYNC come a little late."""
        last_ns = self._last_target_ns
        self._last_target_ns = now_ns
        if last_ns == _NONE_YET:
            return
        tick_ns = self.tick_ns
        ticks = (now_ns - last_ns + tick_ns // 2) // tick_ns
        self._period_ns = min(PERIOD_MAX_NS, max(1, ticks) * tick_ns)
