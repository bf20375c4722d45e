"""Motor settings of a rig, and the axis built from them.

Third-party controllers may use this module like our own. They bring the protocol, and support every
motor that a rig can describe, with the same keys:

    motor = motor_in(table, context.stream())           # of the keys MOTOR_KEYS
    axis = axis_of(motor, motor.oscillator.rate())      # motorhil.emulators.firmware.axis
    return on_own_time(controller, motor.oscillator)    # motorhil.emulators.firmware.clock
"""

from collections.abc import Mapping
from dataclasses import dataclass, fields, replace
from typing import Final, Protocol, final

from motorhil.emulators.controller import SettingError
from motorhil.emulators.firmware.axis import Axis
from motorhil.emulators.firmware.nonlinear_tables import substeps_for
from motorhil.emulators.firmware.servo_tables import ServoGains
from motorhil.emulators.plant.dc_motor import MotorPlant
from motorhil.emulators.plant.oscillator import Oscillator
from motorhil.emulators.settings.tables import (
    duration_ns,
    initial_position_rad,
    number,
    oscillator_in,
    plant_of,
    refuse_unknown,
    table_in,
    whole,
)

_KEYS: Final = ("tick_s", "current_steps")


def servo_of(table: Mapping[str, object], plant: MotorPlant) -> tuple[int, int, ServoGains]:
    """Return (servo period [ns], current loop steps in each, gains) of a table `servo`.

    Missing gains are tuned for the plant.

    Raises:
        SettingError: a key is unknown, or a value is wrong.
    """
    names = tuple(field.name for field in fields(ServoGains))
    refuse_unknown(table, (*_KEYS, *names), ("servo",))
    tick_ns = duration_ns(table, "tick_s", 0.001, ("servo",), 1e-6, 1.0)
    steps = whole(table.get("current_steps", 10), ("servo", "current_steps"), 1, 1000)
    if tick_ns % steps:
        message = f"{steps} steps do not divide a servo period of {tick_ns} ns"
        raise SettingError(("servo", "current_steps"), message, "usual: 10")
    if tick_ns < steps * 1000:
        message = f"{steps} steps in a servo period of {tick_ns} ns are shorter than a microsecond"
        raise SettingError(
            ("servo", "current_steps"), f"{message} each", "a longer tick_s, or fewer steps"
        )
    try:
        substeps_for(plant, tick_ns / (1e9 * steps))
    except ValueError as error:
        name, _, text = str(error).partition(" = ")
        raise SettingError(("plant", name), text) from error
    given = {name: number(table[name], ("servo", name), 0, 1e12) for name in names if name in table}
    return tick_ns, steps, replace(ServoGains.tuned(plant, tick_ns, steps), **given)


MOTOR_KEYS: Final = ("plant", "servo", "oscillator", "initial_position_rad")


@final
@dataclass(frozen=True, slots=True, kw_only=True)
class MotorSettings:
    """One motor of a rig, with the servo that drives it.

    Attributes:
        plant: the motor, its gear and load, its encoder.
        gains, tick_ns, current_steps: of the servo; its period, and current loop steps in each.
        oscillator: the controller's own clock.
        initial_position_rad: at the output, at power-on.
    """

    plant: MotorPlant
    gains: ServoGains
    tick_ns: int
    current_steps: int
    oscillator: Oscillator
    initial_position_rad: float


def motor_in(table: Mapping[str, object], stream: str) -> MotorSettings:
    """Read the motor in a controller's table; random clock values come from `stream`.

    Raises:
        SettingError: a key inside is unknown, or a value is wrong.
    """
    plant = plant_of(table_in(table, "plant"))
    tick_ns, current_steps, gains = servo_of(table_in(table, "servo"), plant)
    return MotorSettings(
        plant=plant,
        gains=gains,
        tick_ns=tick_ns,
        current_steps=current_steps,
        oscillator=oscillator_in(table, stream),
        initial_position_rad=initial_position_rad(table, plant),
    )


class Motorised(Protocol):
    """Settings that hold a motor; see `MotorSettings`."""

    @property
    def plant(self) -> MotorPlant:
        """The motor, its gear and load, its encoder."""

    @property
    def gains(self) -> ServoGains:
        """The gains of the servo."""

    @property
    def tick_ns(self) -> int:
        """The period of the servo [ns]."""

    @property
    def current_steps(self) -> int:
        """The number of current loop steps in each period."""

    @property
    def initial_position_rad(self) -> float:
        """The position at the output, at power-on [rad]."""


def axis_of(motor: Motorised, clock_rate: float) -> Axis:
    """Build the axis at rest, its power stage off; `clock_rate` as of `Oscillator.rate`.

    Raises:
        ValueError: the gains make the current loop unstable.
    """
    inc_rad = motor.plant.gear_ratio * motor.plant.increments_per_rad()
    return Axis(
        motor.plant,
        motor.gains,
        motor.tick_ns,
        motor.current_steps,
        int(motor.initial_position_rad * inc_rad // 1.0),
        clock_rate,
    )
