"""Interpolated position mode (ip): set-points from a buffer, one for each period 60C2h, linear.

CiA 402-2, interpolated position mode; sub-mode 60C0h = 0, linear interpolation. Each value written
to 60C1h:1 is one record for the buffer 60C4h. Controlword bit 4 enables the interpolation; then, at
each SYNC, or, as long as none has come, each period by the drive's own clock, one record is taken,
and the demand goes there evenly over 60C2h (one set-point a period, at SYNC: Kollmorgen AKD).
Statusword bit 12: interpolation is active; bit 10: the buffer is empty and the motor stands where
the last record said. An empty buffer is no fault: the motor waits there.
"""

from typing import Final, final

from emulators.canopen.shared import NEVER
from emulators.cia402.cyclic import CyclicMode
from emulators.cia402.objects import DriveObjects
from emulators.cia402.pds_fsa import CW_HALT
from emulators.cia402.statusword import FOLLOWING_ERROR, IP_ACTIVE, TARGET_REACHED
from emulators.firmware import flags as f
from emulators.firmware.axis import Axis

ENABLE_INTERPOLATION: Final = 0x0010


@final
class InterpolatedPosition(CyclicMode):
    """Mode 7."""

    def __init__(self, axis: Axis, objects: DriveObjects, tick_ns: int) -> None:
        super().__init__(axis, objects, tick_ns)
        self._active: bool = False
        self._due_ns: int = NEVER  # when the next record is taken without a SYNC
        self._hears_sync: bool = False
        self.heeds_sync = True

    def enter(self, word: int, now_ns: int) -> None:
        """The motor stands, or comes to rest; bit 4 as it stands enables."""
        super().enter(word, now_ns)
        self._hears_sync = False
        self._stop()
        self.axis.ramp_to_rest(self.objects.motion.deceleration_inc_s2())
        self.obey(word, 0, now_ns)

    def leave(self) -> None:
        """The buffer keeps its records."""
        super().leave()
        self._stop()

    def obey(self, word: int, rising: int, now_ns: int) -> None:
        """Bit 4 enables, bit 8 halts; either way what is in the buffer waits."""
        super().obey(word, rising, now_ns)
        active = word & ENABLE_INTERPOLATION != 0 and word & CW_HALT == 0
        if active == self._active:
            return
        was_halted = self.halted
        self._stop()
        self._active = active
        if active:
            self._due_ns = now_ns
        elif not was_halted:
            self.axis.ramp_to_rest(self.objects.motion.deceleration_inc_s2())

    def synced(self, now_ns: int) -> bool:
        """SYNC sets the pace from the first one on."""
        is_first = super().synced(now_ns)
        self._hears_sync = True
        if not self._active:
            return is_first
        self._due_ns = NEVER
        self._take()
        return True

    def settle(self, now_ns: int) -> None:
        """Without SYNC the drive keeps time itself."""
        super().settle(now_ns)
        if now_ns >= self._due_ns:
            self._due_ns = now_ns + self.over_ns() if self._take() else NEVER

    def written(self, what: int, now_ns: int) -> None:
        """A record for a drive that waits for one, and hears no SYNC."""
        if self._active and self._due_ns == NEVER and not self._hears_sync:
            self._due_ns = now_ns

    def wake_ns(self) -> int:
        """When the next record is due, or SYNC has stayed away."""
        wake_ns = self.sync_due_ns()
        return self._due_ns if self._due_ns < wake_ns else wake_ns

    def status_bits(self) -> int:
        """Bits 10, 12 and 13."""
        bits = IP_ACTIVE if self._active else 0
        flags = self.axis.flags
        if flags & f.FOLLOWING_ERROR:
            bits |= FOLLOWING_ERROR
        if self.halted:
            stands = flags & (f.PROFILE_ACTIVE | f.SPEED_ZERO) == f.SPEED_ZERO
            return bits | TARGET_REACHED if stands else bits
        if self._active and self.objects.ip.is_empty() and flags & f.IN_TARGET_WINDOW:
            bits |= TARGET_REACHED
        return bits

    def _take(self) -> bool:
        """The next record counts, if there is one."""
        ip = self.objects.ip
        if ip.is_empty():
            return False
        motion = self.objects.motion
        target = ip.take_inc()
        allowed = motion.within_limits_inc(target)
        self.limited = allowed != target
        self.axis.follow(allowed, self.over_ns(), has_target=ip.is_empty())
        return True

    def _stop(self) -> None:
        self._active = False
        self._due_ns = NEVER
