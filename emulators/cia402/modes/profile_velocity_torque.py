"""Profile velocity (pv) and profile torque mode (tq).

In pv, 60FFh is reached on the ramps 6083h and 6084h. In tq, 6071h is reached on the ramp 6087h;
6080h limits the speed.
"""

from typing import Final, final

from motorhil.emulators.canopen.outbox import NEVER
from motorhil.emulators.cia402.modes.base import Mode
from motorhil.emulators.cia402.objects.changes import ObjectChange
from motorhil.emulators.cia402.objects.dictionary import DriveObjects
from motorhil.emulators.cia402.state_machine import (
    CW_HALT,
    MAX_SLIPPAGE_ERROR,
    SPEED_IS_ZERO,
    TARGET_REACHED,
)
from motorhil.emulators.firmware import flags as f
from motorhil.emulators.firmware.axis import Axis

_C = ObjectChange
_VELOCITY_DEMAND: Final = int(_C.TARGET_VELOCITY | _C.RAMPS)
_TORQUE_DEMAND: Final = int(_C.TORQUE | _C.FACTORS | _C.MOTION_LIMITS)


@final
class ProfileVelocity(Mode):
    """Mode 3.

    Bit 10: within the velocity window 606Dh for 606Eh. Bit 12: 0 if beyond 606Fh for 6070h. Bit 13:
    the slippage exceeds 60F8h.
    """

    def __init__(self, axis: Axis, objects: DriveObjects, tick_ns: int) -> None:
        super().__init__(axis, objects, tick_ns)
        self._slips: bool = False
        self._wake_ns: int = NEVER

    def enter(self, word: int, now_ns: int) -> None:
        """Ramp to the present 60FFh at once."""
        self.halted: bool = word & CW_HALT != 0
        self._run()

    def leave(self) -> None:
        """Clear the mode's state."""
        self.halted = False
        self.limited: bool = False
        self._slips = False
        self._wake_ns = NEVER

    def settle(self, now_ns: int) -> None:
        """Check the slippage in every tick, if 60F8h is set."""
        most = self.objects.motion.slippage_inc_s()
        if most > 0.0:
            slip = self.axis.demand_velocity_inc_s() - self.axis.velocity_inc_s()
            self._slips = not -most <= slip <= most
            self._wake_ns = (now_ns // self.tick_ns + 1) * self.tick_ns
        else:
            self._slips = False
            self._wake_ns = NEVER

    def wake_ns(self) -> int:
        """Return the next tick while slippage is monitored [ns], else NEVER."""
        return self._wake_ns

    def obey(self, word: int, rising: int, now_ns: int) -> None:
        """Obey bit 8, halt."""
        halt = word & CW_HALT != 0
        if halt != self.halted:
            self.halted = halt
            self._run()

    def written(self, what: int, now_ns: int) -> None:
        """Apply a new velocity or ramp at once."""
        if what & _VELOCITY_DEMAND and not self.halted:
            self._run()

    def status_bits(self) -> int:
        """Return bits 10, 12 and 13."""
        flags = self.axis.flags
        bits = 0 if flags & f.SPEED_EXCEEDED else SPEED_IS_ZERO
        if self._slips:
            bits |= MAX_SLIPPAGE_ERROR
        if self.halted:
            if flags & (f.PROFILE_ACTIVE | f.SPEED_ZERO) == f.SPEED_ZERO:
                bits |= TARGET_REACHED
        elif flags & f.IN_VELOCITY_WINDOW:
            bits |= TARGET_REACHED
        return bits

    def _run(self) -> None:
        objects = self.objects
        if self.halted:
            objects.options.halt(self.axis)
            return
        motion = objects.motion
        self.limited = motion.is_velocity_cut(motion.target_velocity_raw_inc_s())
        self.axis.run_at(
            objects.motion.target_velocity_inc_s(),
            objects.motion.acceleration_inc_s2(),
            objects.motion.deceleration_inc_s2(),
        )


@final
class ProfileTorque(Mode):
    """Mode 4. Bit 10: ramp finished and current near its target; bit 11: a limit reduces it."""

    def enter(self, word: int, now_ns: int) -> None:
        """Ramp to the present torque 6071h."""
        self.halted: bool = word & CW_HALT != 0
        self._run()

    def leave(self) -> None:
        """Clear the mode's state."""
        self.halted = False
        self.limited: bool = False

    def obey(self, word: int, rising: int, now_ns: int) -> None:
        """Obey bit 8, halt: brake to standstill (605Dh) and hold."""
        halt = word & CW_HALT != 0
        if halt != self.halted:
            self.halted = halt
            self._run()

    def written(self, what: int, now_ns: int) -> None:
        """Apply a new torque or ramp at once."""
        if what & _TORQUE_DEMAND and not self.halted:
            self._run()

    def settle(self, now_ns: int) -> None:
        """Update bit 11."""
        self.limited = not self.halted and self.axis.flags & f.CURRENT_SATURATED != 0

    def status_bits(self) -> int:
        """Return bit 10; 12 and 13 are reserved."""
        flags = self.axis.flags
        if self.halted:
            stands = flags & (f.PROFILE_ACTIVE | f.SPEED_ZERO) == f.SPEED_ZERO
            return TARGET_REACHED if stands else 0
        return TARGET_REACHED if flags & f.CURRENT_REACHED else 0

    def _run(self) -> None:
        objects = self.objects
        if self.halted:
            objects.options.halt(self.axis)
        else:
            torque = objects.torque
            speed_max = objects.motion.torque_speed_max_inc_s()
            self.axis.apply_current(torque.target_a(), torque.slope_a_s(), speed_max)
