"""Profile torque mode (tq): 6071h on the ramp 6087h; 6080h limits the speed."""

from typing import final

from emulators.cia402.mode import Mode
from emulators.cia402.pds_fsa import CW_HALT
from emulators.cia402.statusword import TARGET_REACHED
from emulators.cia402.written import FACTORS, MOTION_LIMITS, TORQUE
from emulators.firmware import flags as f


@final
class ProfileTorque(Mode):
    """Mode 4. Bit 10: ramp finished and current near its target; bit 11: a limit reduces it."""

    def enter(self, word: int, now_ns: int) -> None:
        """Ramp to the present torque 6071h."""
        self.halted = word & CW_HALT != 0
        self._run()

    def leave(self) -> None:
        """Clear the mode's state."""
        self.halted = False
        self.limited = False

    def obey(self, word: int, rising: int, now_ns: int) -> None:
        """Obey bit 8, halt: brake to standstill (605Dh) and hold."""
        halt = word & CW_HALT != 0
        if halt != self.halted:
            self.halted = halt
            self._run()

    def written(self, what: int, now_ns: int) -> None:
        """Apply a new torque or ramp at once."""
        if what & (TORQUE | FACTORS | MOTION_LIMITS) and not self.halted:
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
