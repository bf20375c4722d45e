"""Cyclic synchronous position mode (csp): the host plans, the drive follows from cycle to cycle.

A set-point too far to be reached in its time at 607Fh and 6080h is gone to at that speed, and the
demand catches up with what comes afterwards, as ABB's ACSM1 does in synchron control (dynamic
limiter of the position reference); bit 11 shows it, bit 12 is off. If the motor falls behind, that
is a following error as ever. A halt ends within 607Dh, steeper than 605Dh says if it must be: no
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

NEAREST: Final = 3  # way round: from cycle to cycle a target is never half a range away


@final
class CyclicPosition(CyclicMode):
    """Mode 8: 607Ah + 60B0h; 60B1h and 60B2h are fed forward. Bit 13: following error."""

    def __init__(self, axis: Axis, objects: DriveObjects, tick_ns: int) -> None:
        super().__init__(axis, objects, tick_ns)
        self._has_offsets: bool = False
        self._speed_max_inc_s: float = 0.0
        self._caught_up_ns: int = NEVER  # when a set-point that came too fast is reached

    def enter(self, word: int, now_ns: int) -> None:
        """The motor stands, or comes to rest, until a target is written."""
        super().enter(word, now_ns)
        self._has_offsets = self.objects.offsets.are_set()
        self._speed_max_inc_s = self.objects.motion.velocity_max_inc_s()
        self._caught_up_ns = NEVER
        self.axis.ramp_to_rest(self.objects.motion.deceleration_inc_s2())

    def written(self, what: int, now_ns: int) -> None:
        """A target or an offset has come into force."""
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
        """Caught up; and whether SYNC has stayed away for too long."""
        if now_ns >= self._caught_up_ns:
            self._caught_up_ns = NEVER
            self.limited = False
        super().settle(now_ns)

    def wake_ns(self) -> int:
        """When the demand will have caught up, or SYNC have stayed away for too long."""
        sync_ns = self.sync_due_ns()
        return sync_ns if sync_ns < self._caught_up_ns else self._caught_up_ns

    def leave(self) -> None:
        """Nothing is kept."""
        self._caught_up_ns = NEVER
        super().leave()

    def status_bits(self) -> int:
        """Bits 12 and 13; bit 10 is reserved."""
        bits = 0 if self.halted or self.limited else FOLLOWS_COMMAND
        return bits | FOLLOWING_ERROR if self.axis.flags & f.FOLLOWING_ERROR else bits
