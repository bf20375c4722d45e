"""Cyclic synchronous position mode (csp).

A set-point that cannot be reached in time within 607Fh and 6080h is approached at that speed. The
demand catches up with later set-points, as ABB's ACSM1 does in synchron control (dynamic limiter of
the position reference). Meanwhile bit 11 is on and bit 12 off. A motor that falls behind causes a
following error as usual. A halt ends within 607Dh, on a ramp steeper than 605Dh's if necessary: no
motion under position control passes a software limit (Danfoss VLT servo drive ISD, 607Dh).
"""

from typing import Final, final

from emulators.canopen.shared import NEVER
from emulators.cia402.cyclic import CyclicMode
from emulators.cia402.objects import DriveObjects
from emulators.cia402.statusword import FOLLOWING_ERROR, FOLLOWS_COMMAND
from emulators.cia402.written import FACTORS, MOTION_LIMITS, OFFSETS, TARGET_POSITION
from emulators.firmware import flags as f
from emulators.firmware.axis import Axis

NEAREST: Final = 3  # direction: a target is never half a range away from one cycle to the next


@final
class CyclicPosition(CyclicMode):
    """Mode 8: 607Ah + 60B0h; 60B1h and 60B2h are fed forward. Bit 13: following error."""

    def __init__(self, axis: Axis, objects: DriveObjects, tick_ns: int) -> None:
        super().__init__(axis, objects, tick_ns)
        self._has_offsets: bool = False
        self._speed_max_inc_s: float = 0.0
        self._caught_up_ns: int = NEVER  # when a set-point that was too fast is reached

    def enter(self, word: int, now_ns: int) -> None:
        """Bring the motor to rest until a target is written."""
        super().enter(word, now_ns)
        self._has_offsets = self.objects.offsets.are_set()
        self._speed_max_inc_s = self.objects.motion.velocity_max_inc_s()
        self._caught_up_ns = NEVER
        self.axis.ramp_to_rest(self.objects.motion.deceleration_inc_s2())

    def written(self, what: int, now_ns: int) -> None:
        """Follow a new target or offset."""
        if what & (MOTION_LIMITS | FACTORS):
            self._speed_max_inc_s = self.objects.motion.velocity_max_inc_s()
        if what & OFFSETS:
            self._has_offsets = self.objects.offsets.are_set()
            if not self._has_offsets:
                self.axis.feed_current(0.0)
        elif not what & TARGET_POSITION:
            return
        self.measure(now_ns)
        if self.halted:
            return
        objects = self.objects
        motion = objects.motion
        target = motion.target_position_inc()
        if objects.units.range_size:
            target = motion.target_near_inc(self.axis.demand_inc(), NEAREST)
        if self._has_offsets:
            target += objects.offsets.position_inc()
        allowed = motion.within_limits_inc(target)
        fed_inc_s = objects.offsets.velocity_inc_s() if self._has_offsets else 0.0
        late_ticks = self.axis.follow(
            allowed, self.over_ns(), fed_inc_s, speed_max_inc_s=self._speed_max_inc_s
        )
        self._caught_up_ns = NEVER
        self.limited = allowed != target
        if late_ticks and not self.limited:
            self.limited = True
            self._caught_up_ns = (now_ns // self.tick_ns + 1 + late_ticks) * self.tick_ns
        if not self._has_offsets:
            return
        self.axis.feed_current(objects.offsets.current_a())

    def settle(self, now_ns: int) -> None:
        """Clear the limit once the demand has caught up, and check SYNC."""
        if now_ns >= self._caught_up_ns:
            self._caught_up_ns = NEVER
            self.limited = False
        super().settle(now_ns)

    def wake_ns(self) -> int:
        """Return when the demand will have caught up, or SYNC been absent for too long [ns]."""
        sync_ns = self.sync_due_ns()
        return sync_ns if sync_ns < self._caught_up_ns else self._caught_up_ns

    def leave(self) -> None:
        """Clear the mode's state."""
        self._caught_up_ns = NEVER
        super().leave()

    def status_bits(self) -> int:
        """Return bits 12 and 13; bit 10 is reserved."""
        bits = 0 if self.halted or self.limited else FOLLOWS_COMMAND
        return bits | FOLLOWING_ERROR if self.axis.flags & f.FOLLOWING_ERROR else bits
