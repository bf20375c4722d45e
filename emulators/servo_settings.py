"""Servo settings of a drive in a rig: the table `servo`."""

from collections.abc import Mapping
from dataclasses import fields, replace
from typing import Final

from emulators.controller import SettingError
from emulators.firmware.extras_tables import substeps_for
from emulators.firmware.gains import ServoGains
from emulators.plant.dc_motor import MotorPlant
from emulators.setting_tables import duration_ns, number, refuse_unknown, whole

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
