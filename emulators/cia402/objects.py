"""The drive's part of the object dictionary: every object 6000h-67FFh that has a behaviour.

What the file has is bound to the drive; what it lacks is invisible to SDO and PDO but behaves with
the default stated here (CiA 402-2's, or taken from the motor). A value of 0 in a ramp means "not
set", not "never": 6085h falls back to 6084h, and that to 6083h.
"""

from typing import Final, final

from emulators.canopen.abort_code import OK, AbortCode
from emulators.canopen.object_dictionary import DataType, ObjectDictionary, Variable
from emulators.cia402.control_parameters import ControlParameters
from emulators.cia402.factors import DriveDefaults, fill_factors
from emulators.cia402.settings import EMULATED_MODES, DriveSettings
from emulators.cia402.supported_modes import honest_modes, modes_with_target
from emulators.cia402.torque_objects import TorqueObjects
from emulators.cia402.units import Units, units_of

# What was written since the drive last looked.
CONTROLWORD: Final = 1
MODE: Final = 2
TARGET_POSITION: Final = 4
TARGET_VELOCITY: Final = 8
RAMPS: Final = 16
WINDOWS: Final = 32
FACTORS: Final = 64
TORQUE: Final = 128  # target or slope
TORQUE_LIMIT: Final = 256
GAINS: Final = 512

HOMING_METHODS: Final = (35, 37)  # on the present position; 35 is the old number of 37
NO_WINDOW: Final = 0xFFFF_FFFF
_D = DataType

# index, sub-index, what it counts as when written
_WATCHED: Final = (
    (0x6065, 0, WINDOWS),
    (0x6066, 0, WINDOWS),
    (0x6067, 0, WINDOWS),
    (0x6068, 0, WINDOWS),
    (0x606D, 0, WINDOWS),
    (0x606E, 0, WINDOWS),
    (0x606F, 0, WINDOWS),
    (0x6070, 0, WINDOWS),
    (0x6071, 0, TORQUE),
    *((index, 0, TORQUE_LIMIT) for index in (0x6072, 0x60E0, 0x60E1)),
    (0x6075, 0, FACTORS | TORQUE_LIMIT),
    (0x6076, 0, FACTORS | TORQUE_LIMIT),
    (0x6087, 0, TORQUE),
    (0x607F, 0, RAMPS),
    (0x6080, 0, RAMPS),
    (0x6083, 0, RAMPS),
    (0x6084, 0, RAMPS),
    (0x60C5, 0, RAMPS),
    (0x60C6, 0, RAMPS),
    (0x608C, 0, FACTORS),
    (0x608E, 0, FACTORS),
    (0x608F, 1, FACTORS),
    (0x608F, 2, FACTORS),
    (0x6091, 1, FACTORS),
    (0x6091, 2, FACTORS),
    (0x6092, 1, FACTORS),
    (0x6092, 2, FACTORS),
    (0x6096, 1, FACTORS),
    (0x6096, 2, FACTORS),
    (0x6097, 1, FACTORS),
    (0x6097, 2, FACTORS),
    (0x60A8, 0, FACTORS),
    (0x60A9, 0, FACTORS),
)


@final
class Watch:
    """A writer that allows every value and notes that there was one."""

    def __init__(self, objects: "DriveObjects", what: int) -> None:
        self._objects = objects
        self._what = what

    def write(self, value: int) -> int:
        """Called before the value is stored; always allowed."""
        self._objects.written |= self._what
        return OK


@final
class GainWatch:
    """A writer that refuses a gain with which the current loop would be unstable."""

    def __init__(self, objects: "DriveObjects", place: int) -> None:
        self._objects = objects
        self._place = place

    def write(self, value: int) -> int:
        """Called before the value is stored."""
        objects = self._objects
        code = objects.control.check(self._place, value)
        if code == OK:
            objects.written |= GAINS
        return code


@final
class DriveObjects:
    """What a host may write to the drive, in the drive's own terms: increments and seconds.

    Attributes:
        written: what was written since the drive last looked; it clears the bits.
        controlword, mode, target_position_raw, target_velocity_raw: as last written.
        supported_modes: 6502h.
        units: what the numbers mean.
        torque: the objects of torque and current.
        control: the servo's gains.
    """

    def __init__(self, od: ObjectDictionary, settings: DriveSettings) -> None:
        """One function, and long, because a native class declares its attributes here."""
        self.od = od
        self.settings = settings
        self.written: int = 0
        self.controlword: int = 0
        self.mode: int = 0
        self.target_position_raw: int = 0
        self.target_velocity_raw: int = 0
        fill_factors(od, settings.plant)
        self.units: Units = self._read_units()
        defaults = DriveDefaults(settings.plant, self.units)
        ensure = od.ensure

        self._controlword = ensure(0x6040, 0, _D.UNSIGNED16, 0)
        self._controlword.writer = self._write_controlword
        self._mode = ensure(0x6060, 0, _D.INTEGER8, EMULATED_MODES["pp"])
        self._mode.writer = self._write_mode
        self._target_position = ensure(0x607A, 0, _D.INTEGER32, 0)
        self._target_position.writer = self._write_target_position
        self._target_velocity = ensure(0x60FF, 0, _D.INTEGER32, 0)
        self._target_velocity.writer = self._write_target_velocity
        self.error_code = ensure(0x603F, 0, _D.UNSIGNED16, 0)
        self._supported = ensure(0x6502, 0, _D.UNSIGNED32, modes_with_target(od))
        self.supported_modes: int = self._honest_modes()

        self._abort_connection = ensure(0x6007, 0, _D.INTEGER16, 1)
        self._quick_stop = ensure(0x605A, 0, _D.INTEGER16, 2)
        self._shutdown = ensure(0x605B, 0, _D.INTEGER16, 0)
        self._disable = ensure(0x605C, 0, _D.INTEGER16, 1)
        self._halt = ensure(0x605D, 0, _D.INTEGER16, 1)
        self._fault_reaction = ensure(0x605E, 0, _D.INTEGER16, 2)
        self._quick_stop.writer = self._write_quick_stop

        self._following_window = ensure(0x6065, 0, _D.UNSIGNED32, defaults.following_window)
        self._following_ms = ensure(0x6066, 0, _D.UNSIGNED16, 10)
        self._target_window = ensure(0x6067, 0, _D.UNSIGNED32, defaults.target_window)
        self._target_ms = ensure(0x6068, 0, _D.UNSIGNED16, 5)
        self._velocity_window = ensure(0x606D, 0, _D.UNSIGNED16, defaults.velocity_window)
        self._velocity_window_ms = ensure(0x606E, 0, _D.UNSIGNED16, 10)
        self._velocity_threshold = ensure(0x606F, 0, _D.UNSIGNED16, defaults.velocity_window)
        self._velocity_threshold_ms = ensure(0x6070, 0, _D.UNSIGNED16, 10)

        self.torque: TorqueObjects = TorqueObjects(od, settings.plant, defaults)
        self.control: ControlParameters = ControlParameters(
            od,
            settings.plant,
            settings.gains,
            settings.tick_ns,
            settings.current_steps,
            settings.oscillator.rate(),
        )
        self._limit_min = ensure(0x607D, 1, _D.INTEGER32, 0)
        self._limit_max = ensure(0x607D, 2, _D.INTEGER32, 0)
        self._home_offset = ensure(0x607C, 0, _D.INTEGER32, 0)
        self._homing_method = ensure(0x6098, 0, _D.INTEGER8, 37)
        self._homing_method.writer = self._write_homing_method
        self._velocity_max = ensure(0x607F, 0, _D.UNSIGNED32, NO_WINDOW)
        self._motor_rpm_max = ensure(0x6080, 0, _D.UNSIGNED32, defaults.motor_rpm_max)
        self._velocity = ensure(0x6081, 0, _D.UNSIGNED32, defaults.velocity)
        self._acceleration = ensure(0x6083, 0, _D.UNSIGNED32, defaults.acceleration)
        self._deceleration = self._ramp(0x6084)
        self._quick_deceleration = self._ramp(0x6085)
        self._acceleration_max = ensure(0x60C5, 0, _D.UNSIGNED32, 0)
        self._deceleration_max = ensure(0x60C6, 0, _D.UNSIGNED32, 0)
        self._period = ensure(0x60C2, 1, _D.UNSIGNED8, 0)
        self._period_exponent = ensure(0x60C2, 2, _D.INTEGER8, -3)
        self._positioning_option = ensure(0x60F2, 0, _D.UNSIGNED16, 0)
        for place, gain in enumerate(self.control.places):
            gain.writer = GainWatch(self, place).write
        for index, subindex, what in _WATCHED:
            variable = od.get(index, subindex)
            if variable is not None:
                variable.writer = Watch(self, what).write

        self._acceleration_fallback_inc_s2 = defaults.acceleration_inc_s2
        self._velocity_physical_inc_s = defaults.no_load_inc_s
        self.reload()

    def reload(self) -> None:
        """Values have become their defaults (reset node): forget what was written."""
        self.written = 0
        self.controlword = self._controlword.integer()
        self.mode = self._mode.integer()
        self.target_position_raw = self._target_position.integer()
        self.target_velocity_raw = self._target_velocity.integer()
        self.units = self._read_units()

    def reload_units(self) -> None:
        """A factor object was written: what the numbers mean has changed."""
        self.units = self._read_units()

    # --- motion, in increments and seconds

    def target_position_inc(self) -> int:
        """607Ah."""
        return self.units.position_inc(self.target_position_raw)

    def target_velocity_inc_s(self) -> float:
        """60FFh, within what the motor may do."""
        limit = self.velocity_max_inc_s()
        return max(-limit, min(limit, self.target_velocity_raw * self.units.velocity_unit_inc_s))

    def velocity_max_inc_s(self) -> float:
        """The least of 607Fh, 6080h [motor rpm] and what the supply can turn the motor at."""
        limit = self._velocity_physical_inc_s
        profile_max = self._velocity_max.integer()
        if profile_max > 0:
            limit = min(limit, profile_max * self.units.velocity_unit_inc_s)
        rpm = self._motor_rpm_max.integer()
        if rpm > 0:
            limit = min(limit, rpm * self.settings.plant.encoder_increments_rev / 60.0)
        return limit

    def profile_velocity_inc_s(self) -> float:
        """6081h, within what the motor may do."""
        return min(
            self._velocity.integer() * self.units.velocity_unit_inc_s, self.velocity_max_inc_s()
        )

    def acceleration_inc_s2(self) -> float:
        """6083h, within 60C5h; always > 0."""
        raw = self._acceleration.integer()
        if raw <= 0:
            return self._acceleration_fallback_inc_s2
        limit = self._acceleration_max.integer()
        return (min(raw, limit) if limit > 0 else raw) * self.units.acceleration_unit_inc_s2

    def deceleration_inc_s2(self) -> float:
        """6084h, within 60C6h; 6083h where it is 0 or absent; always > 0."""
        raw = self._deceleration.integer()
        if raw <= 0:
            return self.acceleration_inc_s2()
        limit = self._deceleration_max.integer()
        return (min(raw, limit) if limit > 0 else raw) * self.units.acceleration_unit_inc_s2

    def quick_stop_deceleration_inc_s2(self) -> float:
        """6085h; as 6084h where it is 0 or absent; always > 0."""
        raw = self._quick_deceleration.integer()
        if raw <= 0:
            return self.deceleration_inc_s2()
        return raw * self.units.acceleration_unit_inc_s2

    def within_limits_inc(self, position_inc: int) -> int:
        """The nearest position that 607Dh allows; minimum and maximum 0 mean no limit."""
        low = self._limit_min.integer()
        high = self._limit_max.integer()
        if low == 0 and high == 0:
            return position_inc
        low_inc = self.units.position_inc(low)
        high_inc = self.units.position_inc(high)
        return max(low_inc, min(high_inc, position_inc))

    def home_offset_inc(self) -> int:
        """607Ch."""
        return self.units.position_inc(self._home_offset.integer())

    def homing_method(self) -> int:
        """6098h."""
        return self._homing_method.integer()

    def interpolation_ns(self) -> int:
        """60C2h; 0 where it is 0 or absent."""
        exponent = 9 + self._period_exponent.integer()
        value = self._period.integer()
        return value * int(10**exponent) if exponent >= 0 else value // int(10 ** (-exponent))

    def relative_to(self) -> int:
        """60F2h bits 0 and 1: 0 the set-point before, 1 the demand, 2 the actual position."""
        return self._positioning_option.integer() & 3

    # --- option codes

    def quick_stop_option(self) -> int:
        """605Ah."""
        return self._quick_stop.integer()

    def shutdown_ramps(self) -> bool:
        """605Bh: whether transition 8 brakes first."""
        return self._shutdown.integer() == 1

    def disable_ramps(self) -> bool:
        """605Ch: whether transition 5 brakes first."""
        return self._disable.integer() == 1

    def halt_deceleration_inc_s2(self) -> float:
        """605Dh: 2 brakes as a quick stop, everything else on the slow-down ramp."""
        if self._halt.integer() == 2:
            return self.quick_stop_deceleration_inc_s2()
        return self.deceleration_inc_s2()

    def fault_deceleration_inc_s2(self) -> float | None:
        """605Eh: how a fault brakes; None: it does not, the motor coasts."""
        option = self._fault_reaction.integer()
        if option == 1:
            return self.deceleration_inc_s2()
        return None if option == 0 else self.quick_stop_deceleration_inc_s2()

    def abort_connection_option(self) -> int:
        """6007h."""
        return self._abort_connection.integer()

    # --- inside

    def supports(self, mode: int) -> bool:
        """Whether 6502h names the mode."""
        return mode > 0 and self.supported_modes >> (mode - 1) & 1 != 0

    def windows(self) -> tuple[int, int, int, int, float, int, float, int]:
        """Target and following window [inc], velocity window and threshold [inc/s]; each with [ns].

        A window of FFFF FFFFh is switched off, and so is a following error window of 0.
        """
        ms = 1_000_000
        units = self.units
        target = self._target_window.integer()
        following = self._following_window.integer()
        off = 1 << 62
        return (
            off if target == NO_WINDOW else units.position_inc(target),
            self._target_ms.integer() * ms,
            off if following in (0, NO_WINDOW) else units.position_inc(following),
            self._following_ms.integer() * ms,
            self._velocity_window.integer() * units.velocity_unit_inc_s,
            self._velocity_window_ms.integer() * ms,
            self._velocity_threshold.integer() * units.velocity_unit_inc_s,
            self._velocity_threshold_ms.integer() * ms,
        )

    def _ramp(self, index: int) -> Variable:
        """A deceleration: as 6083h by default; hidden, it follows 6083h."""
        visible = self.od.get(index) is not None
        return self.od.ensure(
            index, 0, _D.UNSIGNED32, self._acceleration.integer() if visible else 0
        )

    def _read_units(self) -> Units:
        settings = self.settings
        return units_of(
            self.od,
            settings.plant,
            position_unit_inc=settings.position_unit_inc,
            velocity_unit_inc_s=settings.velocity_unit_inc_s,
            acceleration_unit_inc_s2=settings.acceleration_unit_inc_s2,
        )

    def _honest_modes(self) -> int:
        """6502h."""
        modes = honest_modes(self._supported.integer(), self.settings.supported_modes)
        self._supported.set_default(modes)
        return modes

    def _write_controlword(self, value: int) -> int:
        self.controlword = value
        self.written |= CONTROLWORD
        return OK

    def _write_mode(self, value: int) -> int:
        if value != 0 and not self.supports(value):
            return AbortCode.INVALID_VALUE
        self.mode = value
        self.written |= MODE
        return OK

    def _write_target_position(self, value: int) -> int:
        self.target_position_raw = value
        self.written |= TARGET_POSITION
        return OK

    def _write_target_velocity(self, value: int) -> int:
        self.target_velocity_raw = value
        self.written |= TARGET_VELOCITY
        return OK

    def _write_homing_method(self, value: int) -> int:
        return OK if value in HOMING_METHODS else AbortCode.INVALID_VALUE

    def _write_quick_stop(self, value: int) -> int:
        return OK if value in (0, 1, 2, 5, 6) else AbortCode.INVALID_VALUE
