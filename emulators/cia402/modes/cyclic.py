"""Cyclic synchronous modes: position (csp), velocity (csv), torque (cst).

A set-point takes effect with its RPDO (at SYNC for types 0 to 240). The demand changes linearly
during the interpolation time period 60C2h. If that is 0 or absent, the time between the last two
set-points is used: with SYNC, the SYNC period.

The loss of SYNC is a fault if the rig sets `sync_lost_periods`, 60C2h states a period and a SYNC
has been received. The fault occurs after that number of periods without SYNC, because the host has
lost its clock. CiA 402 defines no error code for it; the rig can set one.

In csp, a set-point that cannot be reached in time within 607Fh and 6080h is approached at that
speed. The demand catches up with later set-points, as ABB's ACSM1 does in synchron control (dynamic
limiter of the position reference). Meanwhile bit 11 is on and bit 12 off. A motor that falls behind
causes a following error as usual. A halt ends within 607Dh, on a ramp steeper than 605Dh's if
necessary: no motion under position control passes a software limit (Danfoss VLT servo drive ISD,
607Dh).

In csv the host closes the position loop. In cst the drive closes only the current loop.
"""

from typing import Final, final

from motorhil.emulators.canopen.outbox import NEVER
from motorhil.emulators.cia402.modes.base import Mode
from motorhil.emulators.cia402.objects.changes import ObjectChange
from motorhil.emulators.cia402.objects.dictionary import DriveObjects
from motorhil.emulators.cia402.objects.motion import FAR_INC
from motorhil.emulators.cia402.state_machine import CW_HALT, FOLLOWING_ERROR, FOLLOWS_COMMAND
from motorhil.emulators.firmware import flags as f
from motorhil.emulators.firmware.axis import Axis

PERIOD_MAX_NS: Final = 1_000_000_000
_NONE_YET: Final = -1

_C = ObjectChange
_OFFSETS: Final = int(_C.OFFSETS)
_SPEED_LIMIT: Final = int(_C.MOTION_LIMITS | _C.FACTORS)
_TARGET_POSITION: Final = int(_C.TARGET_POSITION)
_VELOCITY_DEMAND: Final = int(_C.TARGET_VELOCITY | _C.OFFSETS)
_TORQUE_DEMAND: Final = int(_C.TORQUE | _C.OFFSETS | _C.FACTORS | _C.MOTION_LIMITS)

NEAREST: Final = 3  # direction: a target is never half a range away from one cycle to the next


class CyclicMode(Mode):
    """A cyclic mode; statusword bit 12: drive follows the command value; bit 10 is reserved."""

    def __init__(self, axis: Axis, objects: DriveObjects, tick_ns: int) -> None:
        super().__init__(axis, objects, tick_ns)
        self._last_target_ns: int = _NONE_YET
        self._last_sync_ns: int = _NONE_YET
        self._period_ns: int = tick_ns
        self._patience: int = objects.settings.sync_lost_periods
        self.heeds_sync: bool = self._patience > 0

    def enter(self, word: int, now_ns: int) -> None:
        """Reset the timing, as if no set-point and no SYNC had been received."""
        self.halted: bool = word & CW_HALT != 0
        self.lost: bool = False
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


@final
class CyclicPosition(CyclicMode):
    """Mode 8: 607Ah + 60B0h; 60B1h and 60B2h are fed forward. Bit 13: following error."""

    def __init__(self, axis: Axis, objects: DriveObjects, tick_ns: int) -> None:
        super().__init__(axis, objects, tick_ns)
        self._has_offsets: bool = False
        self._last_inc: int = 0  # the last target
        self._speed_max_inc_s: float = 0.0
        self._caught_up_ns: int = NEVER  # when a set-point that was too fast is reached

    def enter(self, word: int, now_ns: int) -> None:
        """Bring the motor to rest until a target is written."""
        super().enter(word, now_ns)
        self._has_offsets = self.objects.offsets.are_set()
        self._last_inc = self.axis.demand_inc()
        self._speed_max_inc_s = self.objects.motion.velocity_max_inc_s()
        self._caught_up_ns = NEVER
        self.axis.ramp_to_rest(self.objects.motion.deceleration_inc_s2())

    def written(self, what: int, now_ns: int) -> None:
        """Follow a new target or offset."""
        if what & _SPEED_LIMIT:
            self._speed_max_inc_s = self.objects.motion.velocity_max_inc_s()
        if what & _OFFSETS:
            self._has_offsets = self.objects.offsets.are_set()
            if not self._has_offsets:
                self.axis.feed_current(0.0)
        elif not what & _TARGET_POSITION:
            return
        self.measure(now_ns)
        if self.halted:
            return
        objects = self.objects
        motion = objects.motion
        target = motion.target_position_inc()
        if objects.units.range_size or not -FAR_INC < target - self._last_inc < FAR_INC:
            target = motion.target_near_inc(self.axis.demand_inc(), NEAREST)
        self._last_inc = target
        if self._has_offsets:
            target += objects.offsets.position_inc()
        allowed = motion.within_limits_inc(target)
        fed_inc_s = objects.offsets.velocity_inc_s() if self._has_offsets else 0.0
        late_ticks = self.axis.follow(
            allowed, self.over_ns(), fed_inc_s, speed_max_inc_s=self._speed_max_inc_s
        )
        self._caught_up_ns = NEVER
        self.limited: bool = allowed != target
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
        if not what & _VELOCITY_DEMAND:
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
        self.limited: bool = allowed != velocity
        self.axis.follow_velocity(allowed, self.over_ns())
        self.axis.feed_current(offsets.current_a())


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
        if not what & _TORQUE_DEMAND:
            return
        self.measure(now_ns)
        if not self.halted:
            self._follow()

    def settle(self, now_ns: int) -> None:
        """Update bit 11, and check SYNC."""
        super().settle(now_ns)
        self.limited: bool = not self.halted and self.axis.flags & f.CURRENT_SATURATED != 0

    def _follow(self) -> None:
        objects = self.objects
        current_a = objects.torque.target_a() + objects.offsets.current_a()
        self.axis.follow_current(current_a, self.over_ns(), objects.motion.torque_speed_max_inc_s())
