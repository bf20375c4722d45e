"""Cyclic synchronous torque mode (cst): the drive closes only the current loop."""

from typing import final

from emulators.cia402.cyclic import CyclicMode
from emulators.cia402.written import FACTORS, MOTION_LIMITS, OFFSETS, TORQUE
from emulators.firmware import flags as f


@final
class CyclicTorque(CyclicMode):
    """Mode 10: 6071h + 60B2h. Bit 11: the current, torque or speed limit reduces the torque."""

    def enter(self, word: int, now_ns: int) -> None:
        """Follow 6071h as it is; stand still under halt."""
        super().enter(word, now_ns)
        if self.halted:
            self.axis.ramp_to_rest(self.objects.motion.deceleration_inc_s2())
        else:
            self._follow()

    def written(self, what: int, now_ns: int) -> None:
        """Follow a new torque or offset."""
        if not what & (TORQUE | OFFSETS | FACTORS | MOTION_LIMITS):
            return
        self.measure(now_ns)
        if not self.halted:
            self._follow()

    def settle(self, now_ns: int) -> None:
        """Update bit 11, and check SYNC."""
        super().settle(now_ns)
        self.limited = not self.halted and self.axis.flags & f.CURRENT_SATURATED != 0

    def _follow(self) -> None:
        objects = self.objects
        current_a = objects.torque.target_a() + objects.offsets.current_a()
        self.axis.follow_current(current_a, self.over_ns(), objects.motion.torque_speed_max_inc_s())
