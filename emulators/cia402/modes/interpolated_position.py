"""Interpolated position mode (ip): linear interpolation of buffered set-points.

CiA 402-2, interpolated position mode; sub-mode 60C0h = 0, linear interpolation. Each value written
to 60C1h:1 is one record for the buffer 60C4h. Controlword bit 4 enables the interpolation. One
record is then taken at each SYNC. Before the first SYNC, one is taken in each period of the drive's
own clock. The demand moves linearly to the record in 60C2h (one set-point per period, at SYNC:
Kollmorgen AKD).

Statusword bit 12: interpolation is active. Bit 10: the buffer is empty and the motor stands at the
last record. An empty buffer is not a fault; the motor waits there.
"""

from typing import Final, final

from motorhil.emulators.canopen.outbox import NEVER
from motorhil.emulators.cia402.modes.cyclic import CyclicMode
from motorhil.emulators.cia402.objects.dictionary import DriveObjects
from motorhil.emulators.cia402.state_machine import (
    CW_HALT,
    FOLLOWING_ERROR,
    IP_ACTIVE,
    TARGET_REACHED,
)
from motorhil.emulators.firmware import flags as f
from motorhil.emulators.firmware.axis import Axis

ENABLE_INTERPOLATION: Final = 0x0010


@final
class InterpolatedPosition(CyclicMode):
    """Mode 7."""

    def __init__(self, axis: Axis, objects: DriveObjects, tick_ns: int) -> None:
        super().__init__(axis, objects, tick_ns)
        self._active: bool = False
        self._due_ns: int = NEVER  # when the next record is taken without SYNC
        self._hears_sync: bool = False
        self.heeds_sync = True

    def enter(self, word: int, now_ns: int) -> None:
        """Bring the motor to rest; enable interpolation if bit 4 is set."""
        super().enter(word, now_ns)
        self._hears_sync = False
        self._stop()
        self.axis.ramp_to_rest(self.objects.motion.deceleration_inc_s2())
        self.obey(word, 0, now_ns)

    def leave(self) -> None:
        """Stop the interpolation; the buffer keeps its records."""
        super().leave()
        self._stop()

    def obey(self, word: int, rising: int, now_ns: int) -> None:
        """Enable on bit 4, halt on bit 8; records in the buffer wait meanwhile."""
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
        """Take a record; from the first SYNC on, SYNC sets the pace."""
        is_first = super().synced(now_ns)
        self._hears_sync = True
        if not self._active:
            return is_first
        self._due_ns = NEVER
        self._take()
        return True

    def settle(self, now_ns: int) -> None:
        """Take records by the own clock if there is no SYNC."""
        super().settle(now_ns)
        if now_ns >= self._due_ns:
            self._due_ns = now_ns + self.over_ns() if self._take() else NEVER

    def written(self, what: int, now_ns: int) -> None:
        """Start on a new record if the drive waits for one without SYNC."""
        if self._active and self._due_ns == NEVER and not self._hears_sync:
            self._due_ns = now_ns

    def wake_ns(self) -> int:
        """Return when the next record is due, or SYNC absent for too long [ns]."""
        wake_ns = self.sync_due_ns()
        return self._due_ns if self._due_ns < wake_ns else wake_ns

    def status_bits(self) -> int:
        """Return bits 10, 12 and 13."""
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
        """Take the next record; return False if there is none."""
        ip = self.objects.ip
        if ip.is_empty():
            return False
        motion = self.objects.motion
        target = ip.take_inc()
        allowed = motion.within_limits_inc(target)
        self.limited: bool = allowed != target
        self.axis.follow(allowed, self.over_ns(), has_target=ip.is_empty())
        return True

    def _stop(self) -> None:
        self._active = False
        self._due_ns = NEVER
