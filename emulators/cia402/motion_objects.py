"""The objects of motion: targets, speeds, ramps and limits, in increments and seconds.

A value of 0 in a ramp means "not set", not "never": 6085h falls back to 6084h, and that to 6083h.
"""

from typing import Final, final

from emulators.canopen.abort_code import OK, AbortCode
from emulators.canopen.object_dictionary import DataType, ObjectDictionary, Variable
from emulators.cia402.factors import DriveDefaults
from emulators.cia402.units import FactorGroup
from emulators.cia402.written import TARGET_POSITION, TARGET_VELOCITY, Choice, Written
from emulators.plant.dc_motor import MotorPlant

_UNLIMITED: Final = 0xFFFF_FFFF
_NO_SPEED: Final = 1e300
# 60F2h: what a relative set-point counts from (bits 0 and 1), and which way round an axis with a
# position range goes (bits 6 and 7); nothing else has a behaviour.
_POSITIONING: Final = frozenset(origin | way << 6 for origin in range(3) for way in range(4))
_D = DataType


@final
class MotionObjects:
    """What a host asks of the motion.

    Attributes:
        target_position_raw, target_velocity_raw: 607Ah and 60FFh as last written.
    """

    def __init__(
        self,
        od: ObjectDictionary,
        plant: MotorPlant,
        factors: FactorGroup,
        defaults: DriveDefaults,
        written: Written,
    ) -> None:
        ensure = od.ensure
        self._factors = factors
        self._written = written
        self._encoder_increments_rev = plant.encoder_increments_rev
        self.target_position_raw: int = 0
        self.target_velocity_raw: int = 0
        self._target_position = ensure(0x607A, 0, _D.INTEGER32, 0)
        self._target_position.writer = self._write_target_position
        self._target_velocity = ensure(0x60FF, 0, _D.INTEGER32, 0)
        self._target_velocity.writer = self._write_target_velocity
        self._limit_min = ensure(0x607D, 1, _D.INTEGER32, 0)
        self._limit_max = ensure(0x607D, 2, _D.INTEGER32, 0)
        self._home_offset = ensure(0x607C, 0, _D.INTEGER32, 0)
        self._velocity_max = ensure(0x607F, 0, _D.UNSIGNED32, _UNLIMITED)
        self._motor_rpm_max = ensure(0x6080, 0, _D.UNSIGNED32, defaults.motor_rpm_max)
        self._velocity = ensure(0x6081, 0, _D.UNSIGNED32, defaults.velocity)
        self._acceleration = ensure(0x6083, 0, _D.UNSIGNED32, defaults.acceleration)
        self._deceleration = self._ramp(od, 0x6084)
        self._quick_deceleration = self._ramp(od, 0x6085)
        self._end_velocity = ensure(0x6082, 0, _D.UNSIGNED32, 0)
        refused = int(AbortCode.INVALID_VALUE)
        linear = Choice(written, 0, frozenset((0,)), refused).write
        ensure(0x6086, 0, _D.INTEGER16, 0).writer = linear
        ensure(0x6088, 0, _D.INTEGER16, 0).writer = linear
        self._slippage = ensure(0x60F8, 0, _D.INTEGER32, 0)
        self._acceleration_max = ensure(0x60C5, 0, _D.UNSIGNED32, 0)
        self._deceleration_max = ensure(0x60C6, 0, _D.UNSIGNED32, 0)
        self._period = ensure(0x60C2, 1, _D.UNSIGNED8, 0)
        self._period_exponent = ensure(0x60C2, 2, _D.INTEGER8, -3)
        self._positioning_option = ensure(0x60F2, 0, _D.UNSIGNED16, 0)
        self._positioning_option.writer = Choice(written, 0, _POSITIONING, refused).write
        self._acceleration_fallback_inc_s2 = defaults.acceleration_inc_s2
        self._velocity_physical_inc_s = defaults.no_load_inc_s

    def reload(self) -> None:
        """Values have become their defaults (reset node)."""
        self.target_position_raw = self._target_position.integer()
        self.target_velocity_raw = self._target_velocity.integer()

    def target_position_inc(self) -> int:
        """607Ah, as a distance or on an axis without a position range."""
        return self._factors.units.position_inc(self.target_position_raw)

    def target_near_inc(self, demand_inc: int, way: int) -> int:
        """607Ah on an axis whose position range 607Bh repeats, seen from here."""
        units = self._factors.units
        if units.range_size == 0:
            return units.position_inc(self.target_position_raw)
        return units.turned_inc(self.target_position_raw, demand_inc, way)

    def target_velocity_inc_s(self) -> float:
        """60FFh, within what the motor may do."""
        limit = self.velocity_max_inc_s()
        return max(-limit, min(limit, self.target_velocity_raw_inc_s()))

    def target_velocity_raw_inc_s(self) -> float:
        """60FFh, whatever the motor may do."""
        units = self._factors.units
        return self.target_velocity_raw * units.velocity_unit_inc_s * units.velocity_sign

    def torque_speed_max_inc_s(self) -> float:
        """6080h where it is less than the supply can turn the motor at: torque modes heed it."""
        rpm = self._motor_rpm_max.integer()
        limit = rpm * self._encoder_increments_rev / 60.0
        return limit if rpm > 0 and limit < self._velocity_physical_inc_s - 1.0 else _NO_SPEED

    def velocity_max_inc_s(self) -> float:
        """The least of 607Fh, 6080h [motor rpm] and what the supply can turn the motor at."""
        limit = self._velocity_physical_inc_s
        profile_max = self._velocity_max.integer()
        if profile_max > 0:
            limit = min(limit, profile_max * self._factors.units.velocity_unit_inc_s)
        rpm = self._motor_rpm_max.integer()
        if rpm > 0:
            limit = min(limit, rpm * self._encoder_increments_rev / 60.0)
        return limit

    def set_velocity_inc_s(self) -> float:
        """6081h, whatever the motor may do."""
        return self._velocity.integer() * self._factors.units.velocity_unit_inc_s

    def acceleration_inc_s2(self) -> float:
        """6083h, within 60C5h; always > 0."""
        raw = self._acceleration.integer()
        if raw <= 0:
            return self._acceleration_fallback_inc_s2
        limit = self._acceleration_max.integer()
        unit = self._factors.units.acceleration_unit_inc_s2
        return (min(raw, limit) if limit > 0 else raw) * unit

    def deceleration_inc_s2(self) -> float:
        """6084h, within 60C6h; 6083h where it is 0 or absent; always > 0."""
        raw = self._deceleration.integer()
        if raw <= 0:
            return self.acceleration_inc_s2()
        limit = self._deceleration_max.integer()
        unit = self._factors.units.acceleration_unit_inc_s2
        return (min(raw, limit) if limit > 0 else raw) * unit

    def quick_stop_deceleration_inc_s2(self) -> float:
        """6085h; as 6084h where it is 0 or absent; always > 0."""
        raw = self._quick_deceleration.integer()
        if raw <= 0:
            return self.deceleration_inc_s2()
        return raw * self._factors.units.acceleration_unit_inc_s2

    def within_limits_inc(self, position_inc: int) -> int:
        """The nearest position that 607Dh allows."""
        if not self.has_position_limits():
            return position_inc
        low_inc, high_inc = self.position_limits_inc()
        return max(low_inc, min(high_inc, position_inc))

    def has_position_limits(self) -> bool:
        """Whether the minimum of 607Dh is below its maximum; else there is no limit (Yaskawa)."""
        return self._limit_min.integer() < self._limit_max.integer()

    def position_limits_inc(self) -> tuple[int, int]:
        """607Dh, the lower one first, whatever the polarity.

        The limits count from home, not from zero, which lies 607Ch beyond it (CiA 402-2, 607Dh, as
        Elmo, Synapticon, Fastech and Mitsubishi tell it).
        """
        units = self._factors.units
        offset = self._home_offset.integer()
        one_inc = units.position_inc(self._limit_min.integer() - offset)
        other_inc = units.position_inc(self._limit_max.integer() - offset)
        return (one_inc, other_inc) if one_inc <= other_inc else (other_inc, one_inc)

    def interpolation_ns(self) -> int:
        """60C2h; 0 where it is 0 or absent."""
        value = self._period.integer()
        if value == 0:
            return 0
        exponent = 9 + self._period_exponent.integer()
        return value * int(10**exponent) if exponent >= 0 else value // int(10 ** (-exponent))

    def end_velocity_inc_s(self) -> float:
        """6082h; 0 within a range 607Dh, at whose end nothing else would stop the motor."""
        if self.has_position_limits():
            return 0.0
        return self._end_velocity.integer() * self._factors.units.velocity_unit_inc_s

    def is_velocity_cut(self, velocity_inc_s: float) -> bool:
        """Whether 607Fh, 6080h or the supply allow less than this."""
        return abs(velocity_inc_s) > self.velocity_max_inc_s()

    def slippage_inc_s(self) -> float:
        """60F8h; 0: not watched."""
        return abs(self._slippage.integer()) * self._factors.units.velocity_unit_inc_s

    def way_round(self) -> int:
        """60F2h bits 6 and 7: 0 as a linear axis, 1 negative, 2 positive, 3 the shortest way."""
        return self._positioning_option.integer() >> 6 & 3

    def relative_to(self) -> int:
        """60F2h bits 0 and 1: 0 the set-point before, 1 the demand, 2 the actual position."""
        return self._positioning_option.integer() & 3

    # --- inside

    def _ramp(self, od: ObjectDictionary, index: int) -> Variable:
        """A deceleration: as 6083h by default; hidden, it follows 6083h."""
        visible = od.get(index) is not None
        return od.ensure(index, 0, _D.UNSIGNED32, self._acceleration.integer() if visible else 0)

    def _write_target_position(self, value: int) -> int:
        self.target_position_raw = value
        self._written.kinds |= TARGET_POSITION
        return OK

    def _write_target_velocity(self, value: int) -> int:
        self.target_velocity_raw = value
        self._written.kinds |= TARGET_VELOCITY
        return OK
