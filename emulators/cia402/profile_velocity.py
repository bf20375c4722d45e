"""Profile velocity mode (pv): 60FFh is live, with the ramps 6083h and 6084h."""

from typing import final

from emulators.cia402.mode import Mode
from emulators.cia402.pds_fsa import CW_HALT
from emulators.cia402.statusword import SPEED_IS_ZERO, TARGET_REACHED
from emulators.cia402.written import RAMPS, TARGET_VELOCITY
from emulators.firmware import flags as f


@final
class ProfileVelocity(Mode):
    """Mode 3. Bit 10: in the velocity window 606Dh for 606Eh; bit 12: below 606Fh for 6070h."""

    def enter(self, word: int, now_ns: int) -> None:
        """The motor goes at 60FFh, as it stands there, at once."""
        self.halted = word & CW_HALT != 0
        self._run()

    def leave(self) -> None:
        """Nothing is kept."""
        self.halted = False

    def obey(self, word: int, rising: int, now_ns: int) -> None:
        """Bit 8, halt."""
        halt = word & CW_HALT != 0
        if halt != self.halted:
            self.halted = halt
            self._run()

    def written(self, what: int, now_ns: int) -> None:
        """A new velocity, or a new ramp, counts at once."""
        if what & (TARGET_VELOCITY | RAMPS) and not self.halted:
            self._run()

    def status_bits(self) -> int:
        """Bits 10 and 12; slippage (13) is for motors that slip."""
        flags = self.axis.flags
        bits = SPEED_IS_ZERO if flags & f.SPEED_ZERO else 0
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
        self.axis.run_at(
            objects.motion.target_velocity_inc_s(),
            objects.motion.acceleration_inc_s2(),
            objects.motion.deceleration_inc_s2(),
        )
