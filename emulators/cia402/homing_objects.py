"""The objects of homing: 6098h, 6099h, 609Ah, 607Ch.

Zero lies 607Ch beyond home: home itself is called -607Ch. So CiA 402-2, as Elmo, Parker, Applied
Motion, Fastech and Mitsubishi (MR-J5, Pr. PT08) tell it; KEB's F6 has the other sign.
"""

from typing import Final, final

from emulators.canopen.abort_code import AbortCode
from emulators.canopen.object_dictionary import DataType, ObjectDictionary
from emulators.cia402.factors import DriveDefaults
from emulators.cia402.homing_methods import HOMING_METHODS
from emulators.cia402.motion_objects import MotionObjects
from emulators.cia402.units import FactorGroup
from emulators.cia402.written import Choice, Written

_SWITCH_PART: Final = 4  # by default 6099h:1 is this part of 6081h
_ZERO_PART: Final = 40  # and 6099h:2 this one
_D = DataType


@final
class HomingObjects:
    """How to home, and what home is called."""

    def __init__(
        self,
        od: ObjectDictionary,
        factors: FactorGroup,
        motion: MotionObjects,
        defaults: DriveDefaults,
        written: Written,
    ) -> None:
        ensure = od.ensure
        self._factors = factors
        self._motion = motion
        self._home_offset = ensure(0x607C, 0, _D.INTEGER32, 0)
        self._method = ensure(0x6098, 0, _D.INTEGER8, 37)
        methods = frozenset(HOMING_METHODS)
        self._method.writer = Choice(written, 0, methods, int(AbortCode.INVALID_VALUE)).write
        velocity = defaults.velocity
        self._switch_speed = ensure(0x6099, 1, _D.UNSIGNED32, max(1, velocity // _SWITCH_PART))
        self._zero_speed = ensure(0x6099, 2, _D.UNSIGNED32, max(1, velocity // _ZERO_PART))
        self._acceleration = ensure(0x609A, 0, _D.UNSIGNED32, defaults.acceleration)

    def home_inc(self) -> int:
        """What home is called, as 607Ch has it."""
        return -self._factors.units.position_inc(self._home_offset.integer())

    def method(self) -> int:
        """6098h."""
        return self._method.integer()

    def switch_speed_inc_s(self) -> float:
        """6099h:1, within what the motor may do; 0 where it is 0."""
        return self._speed_inc_s(self._switch_speed.integer())

    def zero_speed_inc_s(self) -> float:
        """6099h:2, within what the motor may do; 0 where it is 0."""
        return self._speed_inc_s(self._zero_speed.integer())

    def acceleration_inc_s2(self) -> float:
        """609Ah; 6083h where it is 0; always > 0."""
        raw = self._acceleration.integer()
        if raw <= 0:
            return self._motion.acceleration_inc_s2()
        return raw * self._factors.units.acceleration_unit_inc_s2

    def _speed_inc_s(self, raw: int) -> float:
        speed = raw * self._factors.units.velocity_unit_inc_s
        return min(speed, self._motion.velocity_max_inc_s())
