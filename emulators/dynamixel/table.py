"""Control tables of the X series: items and models, as data.

Addresses below 64 are EEPROM: they survive power-off, and are locked while torque is on. 4096
counts are a turn. 15.625 counts/s is the unit of velocity, 244.140625 counts/s^2 of acceleration.

Source: the maker's manuals of the models.
"""

from dataclasses import dataclass
from typing import Final, NamedTuple, final

TURN: Final = 4096
CENTRE: Final = 2048
"""The count at the output's zero."""
COUNTS_S: Final = 15.625
COUNTS_S2: Final = 244.140625
PWM_MAX: Final = 885
RAM: Final = 64
EXTENDED_MAX: Final = 1_048_575
BAUD: Final = (9600, 57_600, 115_200, 1_000_000, 2_000_000, 3_000_000, 4_000_000, 4_500_000)
FIRST_INDIRECT: Final = 168


@final
class Item(NamedTuple):
    """An item of the control table; read-only if `low` and `high` are None."""

    address: int
    size: int
    name: str
    initial: int = 0
    low: int | None = None
    high: int | None = None

    def pack(self, value: int) -> bytes:
        """Return the bytes of a value."""
        return (value & (1 << 8 * self.size) - 1).to_bytes(self.size, "little")

    def unpack(self, data: bytes) -> int:
        """Return the value of bytes; items are unsigned unless negative values are in range."""
        return int.from_bytes(data, "little", signed=self.name in _SIGNED or (self.low or 0) < 0)


_SIGNED: Final = (
    *("present_current", "present_pwm", "present_velocity", "present_position"),
    *("velocity_trajectory", "position_trajectory"),
)
GAINS: Final = ("velocity_i", "velocity_p", "position_d", "position_i", "position_p")


@final
@dataclass(frozen=True, slots=True)
class Model:
    """A model of servo, with its defaults.

    Attributes:
        number, firmware: registers 0 and 6.
        temperature: its limit [degC].
        voltage: minimum, nominal, maximum [0.1 V].
        current: its limit in its unit; 0: it does not measure current.
        current_unit_a: that unit [A].
        velocity: its limit [0.229 rpm].
        gains: velocity I and P; position D, I and P.
        pwm_slope: register 62; 0: it has none.
        shutdown: register 63.
        modes: its operating modes.
    """

    number: int
    firmware: int
    temperature: int
    voltage: tuple[int, int, int]
    current: int
    current_unit_a: float
    velocity: int
    gains: tuple[int, int, int, int, int]
    pwm_slope: int = 0
    shutdown: int = 52
    modes: tuple[int, ...] = (0, 1, 3, 4, 5, 16)

    @property
    def is_x330(self) -> bool:
        """True for XL330 and XC330, which measure voltages below 10 V and have a PWM slope."""
        return self.pwm_slope != 0

    @property
    def since_fast(self) -> int:
        """The firmware that brought fast reads, the backup and torque on by a goal."""
        return 46 if self.is_x330 else 45


MODELS: Final = {
    "xl330-m288": Model(
        *(1200, 52, 70, (35, 50, 70), 1750, 1e-3, 445, (1600, 180, 0, 0, 400)),
        *(140, 53),
    ),
    "xc330-t288": Model(
        *(1220, 52, 70, (55, 111, 140), 910, 1e-3, 320, (1200, 40, 0, 0, 900)), 255
    ),
    "xc330-m288": Model(
        *(1240, 52, 70, (35, 50, 70), 2352, 1e-3, 350, (1600, 50, 500, 0, 1100)), 140
    ),
    "xm430-w350": Model(
        *(1020, 48, 80, (95, 120, 160), 1193, 2.69e-3, 200, (1920, 100, 0, 0, 800))
    ),
    "xm540-w270": Model(
        *(1120, 48, 80, (95, 120, 160), 2047, 2.69e-3, 128, (1920, 100, 0, 0, 800))
    ),
    "xl430-w250": Model(
        *(1060, 48, 72, (60, 111, 140), 0, 0.0, 265, (1000, 100, 4000, 0, 640)),
        modes=(1, 3, 4, 16),
    ),
}


def indirect_blocks(model: Model, firmware: int) -> tuple[tuple[int, int, int], ...]:
    """Return (first address item, first data item, number) of the indirect items."""
    if not model.is_x330:
        return (FIRST_INDIRECT, 224, 28), (578, 634, 28)
    return ((FIRST_INDIRECT, 208, 20),) if firmware <= 52 else ((FIRST_INDIRECT, 224, 28),)


def items_of(model: Model, firmware: int) -> tuple[Item, ...]:
    """Return the control table of a model with this firmware, by address."""
    rows = [*_eeprom(model, firmware), *_ram(model)]
    blocks = indirect_blocks(model, firmware)
    end = blocks[-1][1] + blocks[-1][2] - 1
    number = 0
    for address, data, count in blocks:
        for n in range(count):
            number += 1
            named = f"indirect_address_{number}"
            rows.append(Item(address + 2 * n, 2, named, data + n, RAM, end))
            rows.append(Item(data + n, 1, f"indirect_data_{number}", 0, 0, 255))
    return tuple(sorted(rows))


def _speed_max(model: Model) -> int:
    return 2047 if model.is_x330 else 1023


def _eeprom(model: Model, firmware: int) -> list[Item]:
    low_v, _, high_v = model.voltage
    pwm, amps = PWM_MAX, model.current
    rows = [
        Item(0, 2, "model_number", model.number),
        Item(2, 4, "model_information"),
        Item(6, 1, "firmware", firmware),
        Item(7, 1, "id", 1, 0, 252),
        Item(8, 1, "baud_rate", 1, 0, 6 if model.is_x330 else 7),
        Item(9, 1, "return_delay_time", 250, 0, 254),
        Item(10, 1, "drive_mode", 0, 0, 13),
        Item(11, 1, "operating_mode", 3, 0, 16),
        Item(12, 1, "secondary_id", 255, 0, 255),
        Item(13, 1, "protocol_type", 2, 2, 2),
        Item(20, 4, "homing_offset", 0, -1_044_479, 1_044_479),
        Item(24, 4, "moving_threshold", 10, 0, 1023),
        Item(31, 1, "temperature_limit", model.temperature, 0, 100),
        Item(32, 2, "max_voltage_limit", high_v, low_v, high_v),
        Item(34, 2, "min_voltage_limit", low_v, low_v, high_v),
        Item(36, 2, "pwm_limit", pwm, 0, pwm),
        Item(44, 4, "velocity_limit", model.velocity, 0, _speed_max(model)),
        Item(48, 4, "max_position_limit", TURN - 1, 0, TURN - 1),
        Item(52, 4, "min_position_limit", 0, 0, TURN - 1),
        Item(60, 1, "startup_configuration", 0, 0, 3),
        Item(63, 1, "shutdown", model.shutdown, 0, 0x3D),
    ]
    if amps:
        rows += [Item(38, 2, "current_limit", amps, 0, amps)]
    if model.is_x330:
        rows += [Item(62, 1, "pwm_slope", model.pwm_slope, 1, 255)]
    return rows


def _ram(model: Model) -> list[Item]:
    pwm, amps, speed = PWM_MAX, model.current, _speed_max(model)
    gains = dict(zip(GAINS, model.gains, strict=True))
    profile_max, goal_max = 32_767, (1 << 31) - 1
    rows = [
        Item(64, 1, "torque_enable", 0, 0, 1),
        Item(65, 1, "led", 0, 0, 1),
        Item(68, 1, "status_return_level", 2, 0, 2),
        Item(69, 1, "registered_instruction"),
        Item(70, 1, "hardware_error_status"),
        *(Item(76 + 2 * n, 2, name, gains[name], 0, 16_383) for n, name in enumerate(GAINS)),
        Item(88, 2, "feedforward_2nd", 0, 0, 16_383),
        Item(90, 2, "feedforward_1st", 0, 0, 16_383),
        Item(98, 1, "bus_watchdog", 0, -1, 127),
        Item(100, 2, "goal_pwm", pwm, -pwm, pwm),
        Item(104, 4, "goal_velocity", 0, -speed, speed),
        Item(108, 4, "profile_acceleration", 0, 0, profile_max),
        Item(112, 4, "profile_velocity", 0, 0, profile_max),
        Item(116, 4, "goal_position", 0, -goal_max, goal_max),
        Item(120, 2, "realtime_tick"),
        Item(122, 1, "moving"),
        Item(123, 1, "moving_status"),
        Item(124, 2, "present_pwm"),
        Item(126, 2, "present_current"),
        Item(128, 4, "present_velocity"),
        Item(132, 4, "present_position"),
        Item(136, 4, "velocity_trajectory"),
        Item(140, 4, "position_trajectory"),
        Item(144, 2, "present_input_voltage"),
        Item(146, 1, "present_temperature"),
        Item(147, 1, "backup_ready"),
    ]
    if amps:
        rows += [Item(102, 2, "goal_current", amps, -amps, amps)]
    return rows
