"""Cyclic synchronous velocity mode (csv): the host closes the position loop."""

from typing import final

from emulators.cia402.cyclic import CyclicMode
from emulators.cia402.written import OFFSETS, TARGET_VELOCITY


@final
class CyclicVelocity(CyclicMode):
    """Mode 9: 60FFh + 60B1h; 60B2h is fed forward. Bit 13 is reserved."""

    def enter(self, word: int, now_ns: int) -> None:
        """Follow 60FFh as it is, without a ramp; stand still under halt."""
        super().enter(word, now_ns)
        if self.halted:
            self.axis.ramp_to_rest(self.objects.motion.deceleration_inc_s2())
        else:
            self._follow()

    def written(self, what: int, now_ns: int) -> None:
        """Follow a new velocity or offset."""
        if not what & (TARGET_VELOCITY | OFFSETS):
            return
        self.measure(now_ns)
        if not self.halted:
            self._follow()

    def _follow(self) -> None:
        motion = self.objects.motion
        offsets = self.objects.offsets
        velocity = motion.target_velocity_raw_inc_s() + offsets.velocity_inc_s()
        most = motion.velocity_max_inc_s()
        allowed = max(-most, min(most, velocity))
        self.limited = allowed != velocity
        self.axis.follow_velocity(allowed, self.over_ns())
        self.axis.feed_current(offsets.current_a())
