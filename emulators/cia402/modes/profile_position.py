"""Profile position mode (pp): the set-point handshake and the internal profile.

CiA 402-2, profile position mode. A rising edge of *new set-point* (bit 4) offers 607Ah with the
present 6081h, 6083h and 6084h. The drive takes it and sets *set-point acknowledge* (bit 12). One
set-point can wait while another is executed. Meanwhile acknowledge stays, and a further offer
without *change immediately* (bit 5) is not taken. Otherwise acknowledge is cleared together with
bit 4. *Change on set-point* (bit 9) moves through a target, at speed, to the waiting one. *Target
reached* (bit 10) is 0 from the edge until all set-points are done and the motor stands in the
position window. Under *halt* it means standstill.
"""

from typing import Final, final

from motorhil.emulators.canopen.outbox import NEVER
from motorhil.emulators.cia402.modes.base import Mode
from motorhil.emulators.cia402.objects.changes import ObjectChange
from motorhil.emulators.cia402.objects.dictionary import DriveObjects
from motorhil.emulators.cia402.state_machine import (
    CW_HALT,
    FOLLOWING_ERROR,
    SET_POINT_ACKNOWLEDGE,
    TARGET_REACHED,
)
from motorhil.emulators.firmware import flags as f
from motorhil.emulators.firmware.axis import Axis

NEW_SET_POINT: Final = 0x0010
CHANGE_IMMEDIATELY: Final = 0x0020
RELATIVE: Final = 0x0040
CHANGE_ON_SET_POINT: Final = 0x0200
_MOTION_LIMITS: Final = int(ObjectChange.MOTION_LIMITS)

SLOWEST_INC_S: Final = 1.0  # with 6081h = 0 the target would never be reached


@final
class SetPoint:
    """One target with the profile parameters valid when it was taken."""

    def __init__(
        self,
        target_inc: int,
        velocity: float,
        acceleration: float,
        deceleration: float,
        end_velocity: float,
    ) -> None:
        self.target_inc = target_inc
        self.velocity_inc_s = velocity
        self.acceleration_inc_s2 = acceleration
        self.deceleration_inc_s2 = deceleration
        self.end_velocity_inc_s = end_velocity


@final
class ProfilePosition(Mode):
    """Mode 1."""

    def __init__(self, axis: Axis, objects: DriveObjects, tick_ns: int) -> None:
        super().__init__(axis, objects, tick_ns)
        self._running: SetPoint | None = None
        self._waiting: SetPoint | None = None
        self._passing: bool = False  # the running target is passed at speed
        self._acknowledged: bool = False
        self._offered: bool = False  # bit 4 as last written
        self._last_target_inc: int | None = None
        self._goes_on: bool = False  # beyond its target, at 6082h
        self._wake_ns: int = NEVER

    def enter(self, word: int, now_ns: int) -> None:
        """Bring the motor to rest; no set-point has been offered yet."""
        self.leave()
        self.halted: bool = word & CW_HALT != 0
        self.axis.ramp_to_rest(self.objects.motion.deceleration_inc_s2())

    def leave(self) -> None:
        """Discard all set-points not reached yet."""
        self._running = None
        self._waiting = None
        self._passing = False
        self._acknowledged = False
        self._last_target_inc = None
        self._goes_on = False
        self._wake_ns = NEVER
        self.halted = False
        self.limited: bool = False

    def obey(self, word: int, rising: int, now_ns: int) -> None:
        """Obey bits 4, 5, 6, 8 and 9."""
        halt = word & CW_HALT != 0
        if halt and not self.halted:
            self.halted = True
            self._wake_ns = NEVER
            self.objects.options.halt(self.axis, within_limits=True)
        self._offered = word & NEW_SET_POINT != 0
        if rising & NEW_SET_POINT:
            self._take(word, now_ns)
        elif not self._offered and self._waiting is None:
            self._acknowledged = False
        if self.halted and not halt:
            self.halted = False
            self._start(now_ns)  # "positioning shall be executed or continued"

    def written(self, what: int, now_ns: int) -> None:
        """Apply a changed limit to the present move too."""
        if what & _MOTION_LIMITS and not self.halted and self.axis.flags & f.PROFILE_ACTIVE:
            self._start(now_ns)

    def settle(self, now_ns: int) -> None:
        """Continue with the waiting set-point when a target is reached or passed."""
        self._wake_ns = NEVER
        running = self._running
        if running is None or self.halted:
            return
        if self._passing and self._waiting is not None:
            if not self._is_past(running.target_inc, self._waiting.target_inc):
                self._wake_ns = (now_ns // self.tick_ns + 1) * self.tick_ns
                return
        elif self.axis.flags & f.PROFILE_ACTIVE:
            return
        self._goes_on = running.end_velocity_inc_s > 0.0 and not self._passing
        self._running = self._waiting
        self._waiting = None
        self._passing = False
        if self._running is not None:
            if not self._offered:
                self._acknowledged = False
            self._start(now_ns)

    def wake_ns(self) -> int:
        """Return the next tick while a target is being passed [ns], else NEVER."""
        return self._wake_ns

    def status_bits(self) -> int:
        """Return bits 10, 12 and 13."""
        flags = self.axis.flags
        bits = SET_POINT_ACKNOWLEDGE if self._acknowledged else 0
        if self.halted:
            if flags & (f.PROFILE_ACTIVE | f.SPEED_ZERO) == f.SPEED_ZERO:
                bits |= TARGET_REACHED
        elif self._goes_on or flags & f.IN_TARGET_WINDOW:
            bits |= TARGET_REACHED
        if flags & f.FOLLOWING_ERROR:
            bits |= FOLLOWING_ERROR
        return bits

    # --- internals

    def _take(self, word: int, now_ns: int) -> None:
        immediately = word & CHANGE_IMMEDIATELY != 0
        if self._waiting is not None and not immediately:
            return  # one runs and one waits: no room, as acknowledge shows
        set_point = self._offered_set_point(word)
        self._acknowledged = True
        if immediately or self._running is None:
            self._running = set_point
            self._waiting = None
            self._passing = False
        else:
            self._waiting = set_point
            self._passing = word & CHANGE_ON_SET_POINT != 0 and self._continues(set_point)
            if not self._passing:
                return
        if not self.halted:
            self._start(now_ns)

    def _offered_set_point(self, word: int) -> SetPoint:
        objects = self.objects
        motion = objects.motion
        if word & RELATIVE:
            target = motion.target_position_inc() + self._origin_inc()
        else:
            target = motion.target_near_inc(self.axis.demand_inc(), motion.way_round())
        allowed = motion.within_limits_inc(target)
        speed = motion.set_velocity_inc_s()
        self.limited = allowed != target or motion.is_velocity_cut(speed)
        self._last_target_inc = allowed
        return SetPoint(
            allowed,
            max(SLOWEST_INC_S, speed),
            motion.acceleration_inc_s2(),
            motion.deceleration_inc_s2(),
            motion.end_velocity_inc_s(),
        )

    def _origin_inc(self) -> int:
        """Return the origin of a relative set-point, according to 60F2h."""
        option = self.objects.motion.relative_to()
        if option == 2:
            return self.axis.position_inc()
        if option == 1 or self._last_target_inc is None:
            return self.axis.demand_inc()
        return self._last_target_inc

    def _continues(self, waiting: SetPoint) -> bool:
        """Return True if the waiting target lies beyond the running one in the same direction."""
        running = self._running
        if running is None:
            return False
        first = running.target_inc - self.axis.demand_inc()
        second = waiting.target_inc - running.target_inc
        return (first > 0 and second > 0) or (first < 0 and second < 0)

    def _is_past(self, target_inc: int, next_inc: int) -> bool:
        demand = self.axis.demand_inc()
        return demand >= target_inc if next_inc > target_inc else demand <= target_inc

    def _start(self, now_ns: int) -> None:
        """Start the move to the running target, or through it to the waiting one."""
        running = self._running
        if running is None:
            return
        target_inc = running.target_inc
        self._goes_on = False
        if self._passing and self._waiting is not None:
            target_inc = self._waiting.target_inc
            self._wake_ns = (now_ns // self.tick_ns + 1) * self.tick_ns
        speed = min(running.velocity_inc_s, self.objects.motion.velocity_max_inc_s())
        self.axis.move_to(
            target_inc,
            max(SLOWEST_INC_S, speed),
            running.acceleration_inc_s2,
            running.deceleration_inc_s2,
            0.0 if self._passing else running.end_velocity_inc_s,
        )
