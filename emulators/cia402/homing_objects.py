"""The objects of homing: 6098h, 6099h, 609Ah, 607Ch.

The zero position is 607Ch beyond home, so the position of home is -607Ch. CiA 402-2 defines it this
way, as do Elmo, Parker, Applied Motion, Fastech and Mitsubishi (MR-J5, Pr. PT08). KEB's F6 has the
opposite sign.
"""

from typing import Final, final

from emulators.canopen.abort_code import AbortCode
from emulators.canopen.object_dictionary import DataType, ObjectDictionary
from emulators.cia402.factors import DriveDefaults
from emulators.cia402.homing_methods import HOMING_METHODS
from emulators.cia402.motion_objects import MotionObjects
from emulators.cia402.units import FactorGroup
from emulators.cia402.written import Choice, Written

_SWITCH_PART: Final = 4  # default 6099h:1 is 6081h divided by this
_ZERO_PART: Final = 40  # default 6099h:2 is 6081h divided by this
_D = DataType


@final
class HomingObjects:
    """Method, speeds and offset of homing."""

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
        """Return the position of home, according to 607Ch [increments]."""
        return -self._factors.units.position_inc(self._home_offset.integer())

    def method(self) -> int:
        """Return 6098h."""
        return self._method.integer()

    def switch_speed_inc_s(self) -> float:
        """Return 6099h:1, limited to the motor's maximum speed; 0 if it is 0."""
        return self._speed_inc_s(self._switch_speed.integer())

    def zero_speed_inc_s(self) -> float:
        """Return 6099h:2, limited to the motor's maximum speed; 0 if it is 0."""
        return self._speed_inc_s(self._zero_speed.integer())

    def acceleration_inc_s2(self) -> float:
        """Return 609Ah, or 6083h if it is 0; always > 0."""
        raw = self._acceleration.integer()
        if raw <= 0:
            return self._motion.acceleration_inc_s2()
        return raw * self._factors.units.acceleration_unit_inc_s2

    def _speed_inc_s(self, raw: int) -> float:
        speed = raw * self._factors.units.velocity_unit_inc_s
        return min(speed, self._motion.velocity_max_inc_s())
