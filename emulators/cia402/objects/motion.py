"""The objects of motion: targets, speeds, ramps, limits, windows, option codes.

All values are converted to increments and seconds. A value of 0 in a ramp means "not set": 6085h
then falls back to 6084h, and that to 6083h.

The option codes (CiA 402-2, 605Ah to 605Eh, 6007h) tell how the drive stops. Their terms mean:

- *slow-down ramp*: 6084h, or 609Ah if homing is halted. *Quick stop ramp*: 6085h. The demand
  decreases linearly.
- *current limit*: the velocity loop demands standstill at once, and brakes with all the current
  that 6072h, 60E0h and 60E1h allow.
- *voltage limit*: the hardest stop without energy flowing back into the supply, which would raise
  its voltage. The motor brakes as if its terminals were shorted. The standard defines no more than
  the name.
- *coast*: the power stage is switched off.
"""

from typing import Final, final

from motorhil.emulators.canopen.codes import OK
from motorhil.emulators.canopen.object_dictionary import DataType, ObjectDictionary, Variable
from motorhil.emulators.canopen.outbox import MS
from motorhil.emulators.cia402.objects.changes import Choice, ObjectChange, ObjectChanges
from motorhil.emulators.cia402.objects.units import DriveDefaults, FactorGroup
from motorhil.emulators.firmware.axis import Axis
from motorhil.emulators.plant.dc_motor import MotorPlant

_UNLIMITED: Final = 0xFFFF_FFFF
FAR_INC: Final = 1 << 30  # nearer targets are in the same turn of the position counter
_NO_SPEED: Final = 1e300
_TARGET_POSITION: Final = int(ObjectChange.TARGET_POSITION)
_TARGET_VELOCITY: Final = int(ObjectChange.TARGET_VELOCITY)
# 60F2h: origin of a relative set-point (bits 0 and 1), and direction of an axis with a position
# range (bits 6 and 7); no other bit has an effect.
_POSITIONING: Final = frozenset(origin | way << 6 for origin in range(3) for way in range(4))
_D = DataType

NO_WINDOW: Final = 0xFFFF_FFFF

# Common to 605Ah, 605Dh and 605Eh; 605Ah has 5 to 8 for the same reactions, and then stays.
COAST: Final = 0
SLOW_DOWN_RAMP: Final = 1
QUICK_STOP_RAMP: Final = 2
CURRENT_LIMIT: Final = 3
VOLTAGE_LIMIT: Final = 4
STAYS: Final = 5  # from here on, 605Ah stays in QUICK STOP ACTIVE

# Values that have an effect, and can therefore be written.
_ALLOWED: Final = {
    0x6007: frozenset(range(4)),
    0x605A: frozenset(range(9)),
    0x605B: frozenset(range(2)),
    0x605C: frozenset(range(2)),
    0x605D: frozenset(range(1, 5)),
    0x605E: frozenset(range(5)),
}


@final
class MotionObjects:
    """Motion parameters that a host can set.

    Attributes:
        target_position_raw, target_velocity_raw: 607Ah and 60FFh as last written.
    """

    def __init__(
        self,
        od: ObjectDictionary,
        plant: MotorPlant,
        factors: FactorGroup,
        defaults: DriveDefaults,
        changes: ObjectChanges,
    ) -> None:
        ensure = od.ensure
        self._factors = factors
        self._changes = changes
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
        linear = Choice(frozenset((0,))).write
        ensure(0x6086, 0, _D.INTEGER16, 0).writer = linear
        ensure(0x6088, 0, _D.INTEGER16, 0).writer = linear
        self._slippage = ensure(0x60F8, 0, _D.INTEGER32, 0)
        self._acceleration_max = ensure(0x60C5, 0, _D.UNSIGNED32, 0)
        self._deceleration_max = ensure(0x60C6, 0, _D.UNSIGNED32, 0)
        self._period = ensure(0x60C2, 1, _D.UNSIGNED8, 0)
        self._period_exponent = ensure(0x60C2, 2, _D.INTEGER8, -3)
        self._positioning_option = ensure(0x60F2, 0, _D.UNSIGNED16, 0)
        self._positioning_option.writer = Choice(_POSITIONING).write
        self._acceleration_fallback_inc_s2 = defaults.acceleration_inc_s2
        self._velocity_physical_inc_s = defaults.no_load_inc_s

    def reload(self) -> None:
        """Reload the targets after the objects were reset to their defaults (reset node)."""
        self.target_position_raw = self._target_position.integer()
        self.target_velocity_raw = self._target_velocity.integer()

    def target_position_inc(self) -> int:
        """Return 607Ah as a distance, or as a position on an axis without a position range."""
        return self._factors.units.position_inc(self.target_position_raw)

    def target_near_inc(self, demand_inc: int, way: int) -> int:
        """Return 607Ah in the present turn of the position range (607Bh), or of the 32 bits."""
        units = self._factors.units
        if units.range_size == 0:
            target_inc = units.position_inc(self.target_position_raw)
            if -FAR_INC < target_inc - demand_inc < FAR_INC:
                return target_inc
        return units.turned_inc(self.target_position_raw, demand_inc, way)

    def target_velocity_inc_s(self) -> float:
        """Return 60FFh, limited to the motor's maximum speed."""
        limit = self.velocity_max_inc_s()
        return max(-limit, min(limit, self.target_velocity_raw_inc_s()))

    def target_velocity_raw_inc_s(self) -> float:
        """Return 60FFh without the limit."""
        units = self._factors.units
        return self.target_velocity_raw * units.velocity_unit_inc_s * units.velocity_sign

    def torque_speed_max_inc_s(self) -> float:
        """Return 6080h if it is below the no-load speed: the speed limit of the torque modes."""
        rpm = self._motor_rpm_max.integer()
        limit = rpm * self._encoder_increments_rev / 60.0
        return limit if rpm > 0 and limit < self._velocity_physical_inc_s - 1.0 else _NO_SPEED

    def velocity_max_inc_s(self) -> float:
        """Return the least of 607Fh, 6080h [motor rpm] and the no-load speed."""
        limit = self._velocity_physical_inc_s
        profile_max = self._velocity_max.integer()
        if profile_max > 0:
            limit = min(limit, profile_max * self._factors.units.velocity_unit_inc_s)
        rpm = self._motor_rpm_max.integer()
        if rpm > 0:
            limit = min(limit, rpm * self._encoder_increments_rev / 60.0)
        return limit

    def set_velocity_inc_s(self) -> float:
        """Return 6081h without the limit."""
        return self._velocity.integer() * self._factors.units.velocity_unit_inc_s

    def acceleration_inc_s2(self) -> float:
        """Return 6083h, limited by 60C5h; always > 0."""
        raw = self._acceleration.integer()
        if raw <= 0:
            return self._acceleration_fallback_inc_s2
        limit = self._acceleration_max.integer()
        unit = self._factors.units.acceleration_unit_inc_s2
        return (min(raw, limit) if limit > 0 else raw) * unit

    def deceleration_inc_s2(self) -> float:
        """Return 6084h, limited by 60C6h; 6083h if it is 0 or absent; always > 0."""
        raw = self._deceleration.integer()
        if raw <= 0:
            return self.acceleration_inc_s2()
        limit = self._deceleration_max.integer()
        unit = self._factors.units.acceleration_unit_inc_s2
        return (min(raw, limit) if limit > 0 else raw) * unit

    def quick_stop_deceleration_inc_s2(self) -> float:
        """Return 6085h; 6084h if it is 0 or absent; always > 0."""
        raw = self._quick_deceleration.integer()
        if raw <= 0:
            return self.deceleration_inc_s2()
        return raw * self._factors.units.acceleration_unit_inc_s2

    def within_limits_inc(self, position_inc: int) -> int:
        """Return the nearest position that 607Dh allows."""
        if not self.has_position_limits():
            return position_inc
        low_inc, high_inc = self.position_limits_inc()
        return max(low_inc, min(high_inc, position_inc))

    def has_position_limits(self) -> bool:
        """Return True if 607Dh is a limit: its minimum is below its maximum (as with Yaskawa)."""
        return self._limit_min.integer() < self._limit_max.integer()

    def position_limits_inc(self) -> tuple[int, int]:
        """Return 607Dh, the lower limit first, whatever the polarity.

        The limits count from home, not from zero, which is 607Ch beyond home (CiA 402-2, 607Dh;
        Elmo, Synapticon, Fastech and Mitsubishi agree).
        """
        units = self._factors.units
        offset = self._home_offset.integer()
        one_inc = units.position_inc(self._limit_min.integer() - offset)
        other_inc = units.position_inc(self._limit_max.integer() - offset)
        return (one_inc, other_inc) if one_inc <= other_inc else (other_inc, one_inc)

    def interpolation_ns(self) -> int:
        """Return 60C2h [ns]; 0 if it is 0 or absent."""
        value = self._period.integer()
        if value == 0:
            return 0
        exponent = 9 + self._period_exponent.integer()
        return value * int(10**exponent) if exponent >= 0 else value // int(10 ** (-exponent))

    def end_velocity_inc_s(self) -> float:
        """Return 6082h; 0 if 607Dh sets limits, where nothing else would stop the motor."""
        if self.has_position_limits():
            return 0.0
        return self._end_velocity.integer() * self._factors.units.velocity_unit_inc_s

    def is_velocity_cut(self, velocity_inc_s: float) -> bool:
        """Return True if 607Fh, 6080h or the supply allow less than this velocity."""
        return abs(velocity_inc_s) > self.velocity_max_inc_s()

    def slippage_inc_s(self) -> float:
        """Return 60F8h; 0: slippage is not monitored."""
        return abs(self._slippage.integer()) * self._factors.units.velocity_unit_inc_s

    def way_round(self) -> int:
        """Return 60F2h bits 6 and 7: 0 linear axis, 1 negative, 2 positive, 3 shortest way."""
        return self._positioning_option.integer() >> 6 & 3

    def relative_to(self) -> int:
        """Return 60F2h bits 0 and 1: 0 previous set-point, 1 demand, 2 actual position."""
        return self._positioning_option.integer() & 3

    # --- internals

    def _ramp(self, od: ObjectDictionary, index: int) -> Variable:
        """Return the variable of a deceleration: by default 6083h; hidden, it follows 6083h."""
        visible = od.get(index) is not None
        return od.ensure(index, 0, _D.UNSIGNED32, self._acceleration.integer() if visible else 0)

    def _write_target_position(self, value: int) -> int:
        self.target_position_raw = value
        self._changes.pending |= _TARGET_POSITION
        return OK

    def _write_target_velocity(self, value: int) -> int:
        self.target_velocity_raw = value
        self._changes.pending |= _TARGET_VELOCITY
        return OK


@final
class WindowObjects:
    """6065h to 6068h, 606Dh to 6070h."""

    def __init__(self, od: ObjectDictionary, factors: FactorGroup, defaults: DriveDefaults) -> None:
        ensure = od.ensure
        self._factors = factors
        self._following_window = ensure(0x6065, 0, _D.UNSIGNED32, defaults.following_window)
        self._following_ms = ensure(0x6066, 0, _D.UNSIGNED16, 10)
        self._target_window = ensure(0x6067, 0, _D.UNSIGNED32, defaults.target_window)
        self._target_ms = ensure(0x6068, 0, _D.UNSIGNED16, 5)
        self._velocity_window = ensure(0x606D, 0, _D.UNSIGNED16, defaults.velocity_window)
        self._velocity_window_ms = ensure(0x606E, 0, _D.UNSIGNED16, 10)
        self._velocity_threshold = ensure(0x606F, 0, _D.UNSIGNED16, defaults.velocity_window)
        self._velocity_threshold_ms = ensure(0x6070, 0, _D.UNSIGNED16, 10)

    def read(self) -> tuple[int, int, int, int, float, int, float, int]:
        """Return target, following error, velocity and threshold windows, each with its time [ns].

        The windows are in increments and increments per second. A window of FFFF FFFFh is off, and
        so is a following error window of 0.
        """
        units = self._factors.units
        target = self._target_window.integer()
        following = self._following_window.integer()
        off = 1 << 62
        return (
            off if target == NO_WINDOW else abs(units.position_inc(target)),
            self._target_ms.integer() * MS,
            off if following in (0, NO_WINDOW) else abs(units.position_inc(following)),
            self._following_ms.integer() * MS,
            self._velocity_window.integer() * units.velocity_unit_inc_s,
            self._velocity_window_ms.integer() * MS,
            self._velocity_threshold.integer() * units.velocity_unit_inc_s,
            self._velocity_threshold_ms.integer() * MS,
        )


@final
class OptionCodes:
    """The option codes as in their objects; a default of the EDS outside the table is kept."""

    def __init__(self, od: ObjectDictionary, motion: MotionObjects) -> None:
        ensure = od.ensure
        self._motion = motion
        self._abort_connection = ensure(0x6007, 0, _D.INTEGER16, 1)
        self._quick_stop = ensure(0x605A, 0, _D.INTEGER16, 2)
        self._shutdown = ensure(0x605B, 0, _D.INTEGER16, 0)
        self._disable = ensure(0x605C, 0, _D.INTEGER16, 1)
        self._halt = ensure(0x605D, 0, _D.INTEGER16, 1)
        self._fault_reaction = ensure(0x605E, 0, _D.INTEGER16, 2)
        codes: tuple[Variable, ...] = (
            *(self._abort_connection, self._quick_stop, self._shutdown),
            *(self._disable, self._halt, self._fault_reaction),
        )
        for code in codes:
            code.writer = Choice(_ALLOWED[code.index]).write

    def quick_stops_and_stays(self) -> bool:
        """Return True if 605Ah >= 5: the drive stays in QUICK STOP ACTIVE until transition 16."""
        return self._quick_stop.integer() >= STAYS

    def shutdown_ramps(self) -> bool:
        """Return True if transition 8 brakes first (605Bh)."""
        return self._shutdown.integer() == 1

    def disable_ramps(self) -> bool:
        """Return True if transition 5 brakes first (605Ch)."""
        return self._disable.integer() == 1

    def abort_connection(self) -> int:
        """Return 6007h."""
        return self._abort_connection.integer()

    def quick_stop(self, axis: Axis) -> bool:
        """Start the reaction of 605Ah; return False to coast. An unknown code brakes on 6085h."""
        option = self._quick_stop.integer()
        return self._stop(axis, option - 4 if option >= STAYS else option, QUICK_STOP_RAMP)

    def halt(self, axis: Axis, slow_down_inc_s2: float = 0.0, within_limits: bool = False) -> None:
        """Start the reaction of 605Dh, which ends at standstill. An unknown code slows down.

        Args:
            axis: the axis to stop.
            slow_down_inc_s2: the mode's own slow-down ramp, if > 0, else 6084h is used.
            within_limits: True to stop within 607Dh, with a steeper ramp if necessary.
        """
        option = self._halt.integer()
        within_inc: tuple[int, int] | None = None
        if within_limits and self._motion.has_position_limits():
            within_inc = self._motion.position_limits_inc()
        how = option if option != COAST else SLOW_DOWN_RAMP
        self._stop(axis, how, SLOW_DOWN_RAMP, slow_down_inc_s2, within_inc)

    def react(self, axis: Axis) -> bool:
        """Start the reaction of 605Eh; return False to coast. An unknown code brakes on 6085h."""
        return self._stop(axis, self._fault_reaction.integer(), QUICK_STOP_RAMP)

    def _stop(
        self,
        axis: Axis,
        how: int,
        otherwise: int,
        slow_down_inc_s2: float = 0.0,
        within_inc: tuple[int, int] | None = None,
    ) -> bool:
        if how < COAST or how > VOLTAGE_LIMIT:
            how = otherwise
        if how == COAST:
            return False
        if how == SLOW_DOWN_RAMP:
            axis.ramp_to_rest(slow_down_inc_s2 or self._motion.deceleration_inc_s2(), within_inc)
        elif how == QUICK_STOP_RAMP:
            axis.ramp_to_rest(self._motion.quick_stop_deceleration_inc_s2(), within_inc)
        else:
            axis.brake(how == VOLTAGE_LIMIT)
        return True
