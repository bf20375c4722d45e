"""Homing mode (hm). Methods 35 and 37: the present position is the home position.

Statusword bits 10, 12 and 13 (CiA 402-2, homing mode):

====  ====  ====  ==========================================
13    12    10
====  ====  ====  ==========================================
0     0     0     in progress
0     0     1     interrupted, or not started
0     1     1     attained, and at rest
1     0     0     error, still moving
1     0     1     error, at rest
====  ====  ====  ==========================================
"""

from enum import IntEnum
from typing import Final, final

from emulators.canopen.shared import NEVER
from emulators.cia402.homing_objects import HOMING_METHODS
from emulators.cia402.mode import Mode
from emulators.cia402.objects import DriveObjects
from emulators.cia402.pds_fsa import CW_HALT
from emulators.cia402.statusword import HOMING_ATTAINED, HOMING_ERROR, TARGET_REACHED
from emulators.firmware.axis import Axis

HOMING_START: Final = 0x0010


@final
class HomingState(IntEnum):
    """Where a homing is."""

    NOT_STARTED = 0
    IN_PROGRESS = 1
    ATTAINED = 2
    FAILED = 3


@final
class Homing(Mode):
    """Mode 6."""

    def __init__(self, axis: Axis, objects: DriveObjects, tick_ns: int) -> None:
        super().__init__(axis, objects, tick_ns)
        self.state: HomingState = HomingState.NOT_STARTED
        self._wake_ns: int = NEVER

    def enter(self, word: int, now_ns: int) -> None:
        """The motor stands, or comes to rest; what was attained stays attained."""
        self.leave()
        self.halted = word & CW_HALT != 0
        self.axis.ramp_to_rest(self.objects.motion.deceleration_inc_s2())

    def leave(self) -> None:
        """A homing still in progress is interrupted."""
        self.halted = False
        self._interrupt()

    def forget(self) -> None:
        """Power-on: nothing is attained."""
        self.state = HomingState.NOT_STARTED
        self._wake_ns = NEVER

    def obey(self, word: int, rising: int, now_ns: int) -> None:
        """Bit 4 starts and, when it falls, interrupts; so does bit 8."""
        self.halted = word & CW_HALT != 0
        if self.halted or not word & HOMING_START:
            self._interrupt()
        elif rising & HOMING_START:
            self._begin(now_ns)

    def settle(self, now_ns: int) -> None:
        """A tick later the position has its new zero."""
        if self.state is HomingState.IN_PROGRESS and now_ns >= self._wake_ns:
            self._wake_ns = NEVER
            self.axis.set_position(self.objects.homing.home_offset_inc())
            self.state = HomingState.ATTAINED

    def wake_ns(self) -> int:
        """One tick after the start."""
        return self._wake_ns

    def status_bits(self) -> int:
        """Bits 10, 12 and 13."""
        if self.state is HomingState.IN_PROGRESS:
            return 0
        if self.state is HomingState.ATTAINED:
            return HOMING_ATTAINED | TARGET_REACHED
        bits = 0 if self._moves() else TARGET_REACHED
        if self.state is HomingState.FAILED:
            return bits | HOMING_ERROR
        return TARGET_REACHED

    def idle_bits(self) -> int:
        """What was attained shows when the power stage is off, too."""
        return HOMING_ATTAINED | TARGET_REACHED if self.state is HomingState.ATTAINED else 0

    def _begin(self, now_ns: int) -> None:
        method = self.objects.homing.method()
        if method not in HOMING_METHODS or self._moves():
            self.state = HomingState.FAILED
            return
        self.state = HomingState.IN_PROGRESS
        self._wake_ns = (now_ns // self.tick_ns + 1) * self.tick_ns

    def _moves(self) -> bool:
        return self.axis.demand_velocity_inc_s() != 0.0

    def _interrupt(self) -> None:
        if self.state is HomingState.IN_PROGRESS:
            self.state = HomingState.NOT_STARTED
            self._wake_ns = NEVER
