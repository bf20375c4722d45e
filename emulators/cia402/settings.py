"""What a rig may say about a CiA 402 drive, checked key by key.

A wrong key or value is a `SettingError` that names the keys down to it and what would be right;
whoever read the file adds file and line.
"""

import difflib
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, fields, replace
from pathlib import Path
from typing import Final, final

from emulators.controller import SettingError
from emulators.firmware.gains import ServoGains
from emulators.plant.dc_motor import PI, RANGES, MotorPlant
from emulators.plant.presets import PRESETS

DEFAULT_PRESET: Final = "wheel_60w"
OWN_EDS: Final = Path(__file__).parents[1] / "eds" / "motorhil_cia402.eds"

# 6060h; the bit of a mode in 6502h is one less. Source: CiA 402-2, modes of operation.
MODES: Final[dict[str, int]] = {
    **{"pp": 1, "vl": 2, "pv": 3, "tq": 4, "hm": 6},
    **{"ip": 7, "csp": 8, "csv": 9, "cst": 10},
}
EMULATED_MODES: Final[dict[str, int]] = {name: MODES[name] for name in ("pp", "pv", "hm", "csp")}

_KEYS: Final = (
    "node_id",
    "eds",
    "plant",
    "servo",
    "timing",
    "units",
    "objects",
    "supported_modes",
    "initial_position_rad",
)
_TIMING_KEYS: Final = ("boot_up_s", "sdo_reply_s", "enable_s")
_UNIT_KEYS: Final = ("position_unit_inc", "velocity_unit_inc_s", "acceleration_unit_inc_s2")
_SERVO_KEYS: Final = ("tick_s", "current_steps")
_NS_PER_S: Final = 1_000_000_000


@final
@dataclass(frozen=True, slots=True)
class ObjectValue:
    """What the rig wants an object to be at power-on; `key` as the rig writes it."""

    key: str
    index: int
    subindex: int
    value: int | float | str


@final
@dataclass(frozen=True, slots=True, kw_only=True)
class DriveSettings:
    """One drive of a rig; everything has a default but the node-ID.

    Attributes:
        node_id: 1..127.
        eds: where its object dictionary comes from.
        plant, gains: the motor, and the servo that drives it.
        tick_ns, current_steps: servo period, and current loop steps in each.
        boot_up_ns: power-on to boot-up message.
        sdo_reply_ns: SDO request to response.
        enable_ns: the power stage's way from switched on to operation enabled.
        position_unit_inc, velocity_unit_inc_s, acceleration_unit_inc_s2: what 1 means in its
            objects; None: what the file says, else one increment (per second, squared).
        objects: power-on values that replace what the file says.
        supported_modes: names; None: what the file says, else all emulated ones.
        initial_position_rad: at the output, at power-on.
    """

    node_id: int
    eds: Path = OWN_EDS
    plant: MotorPlant = PRESETS[DEFAULT_PRESET]
    gains: ServoGains
    tick_ns: int = 1_000_000
    current_steps: int = 10
    boot_up_ns: int = 300_000_000
    sdo_reply_ns: int = 1_000_000
    enable_ns: int = 20_000_000
    position_unit_inc: float | None = None
    velocity_unit_inc_s: float | None = None
    acceleration_unit_inc_s2: float | None = None
    objects: tuple[ObjectValue, ...] = ()
    supported_modes: tuple[str, ...] | None = None
    initial_position_rad: float = 0.0


def read_settings(table: Mapping[str, object], folder: Path) -> DriveSettings:
    """The settings in a rig's table; relative paths start at `folder`.

    Raises:
        SettingError: a key is unknown, or a value is missing or wrong.
    """
    _refuse_unknown(table, _KEYS, ())
    if "node_id" not in table:
        raise SettingError(("node_id",), "is missing", "a number 1..127")
    plant = _plant(_table(table, "plant"))
    servo = _table(table, "servo")
    tick_ns, current_steps, gains = _servo(servo, plant)
    timing = _table(table, "timing")
    _refuse_unknown(timing, _TIMING_KEYS, ("timing",))
    units = _table(table, "units")
    _refuse_unknown(units, _UNIT_KEYS, ("units",))
    return DriveSettings(
        node_id=_whole(table["node_id"], ("node_id",), 1, 127),
        eds=_eds(table, folder),
        plant=plant,
        gains=gains,
        tick_ns=tick_ns,
        current_steps=current_steps,
        boot_up_ns=_duration_ns(timing, "boot_up_s", 0.3, ("timing",)),
        sdo_reply_ns=_duration_ns(timing, "sdo_reply_s", 0.001, ("timing",)),
        enable_ns=_duration_ns(timing, "enable_s", 0.02, ("timing",)),
        position_unit_inc=_positive(units, "position_unit_inc"),
        velocity_unit_inc_s=_positive(units, "velocity_unit_inc_s"),
        acceleration_unit_inc_s2=_positive(units, "acceleration_unit_inc_s2"),
        objects=_objects(_table(table, "objects")),
        supported_modes=_modes(table),
        initial_position_rad=_initial_position(table, plant),
    )


def _eds(table: Mapping[str, object], folder: Path) -> Path:
    value = table.get("eds")
    if value is None:
        return OWN_EDS
    if not isinstance(value, str) or not value:
        raise SettingError(("eds",), f"{value!r} is no path", 'a file name: eds = "drive.eds"')
    path = folder / value
    if not path.is_file():
        raise SettingError(
            ("eds",), f"there is no file {path}", "check the path; without eds our own is used"
        )
    return path


def _plant(table: Mapping[str, object]) -> MotorPlant:
    names = tuple(field.name for field in fields(MotorPlant))
    _refuse_unknown(table, ("preset", *names), ("plant",))
    preset = table.get("preset")
    if preset is not None and (not isinstance(preset, str) or preset not in PRESETS):
        raise SettingError(
            ("plant", "preset"), f"there is no preset {preset!r}", f"known: {', '.join(PRESETS)}"
        )
    numbers: dict[str, float] = {}
    for name in names:
        if name in table:
            numbers[name] = (
                _whole(table[name], ("plant", name), 1, 1 << 31)
                if name == "encoder_increments_rev"
                else _number(table[name], ("plant", name), *RANGES[name])
            )
    base = PRESETS[preset] if isinstance(preset, str) else PRESETS[DEFAULT_PRESET]
    needed = [name for name in names if name not in numbers and name in _DATA_SHEET]
    if preset is None and numbers and needed:
        raise SettingError(
            ("plant",),
            f"{', '.join(needed)} missing",
            f"give all data-sheet numbers, or start from a preset: {', '.join(PRESETS)}",
        )
    if preset is None and numbers:
        base = replace(base, **_OPTIONAL)  # type: ignore[arg-type]  # names of its own fields
    try:
        return replace(base, **numbers)  # type: ignore[arg-type]  # checked above, name by name
    except ValueError as error:
        name = str(error).split(" ", 1)[0]
        raise SettingError(("plant", name), str(error).partition(": ")[2]) from error


_OPTIONAL: Final[dict[str, float]] = {
    "viscous_friction_n_m_s_rad": 0.0,
    "gear_ratio": 1.0,
    "load_inertia_kg_m2": 0.0,
    "load_torque_n_m": 0.0,
}
_DATA_SHEET: Final = tuple(f.name for f in fields(MotorPlant) if f.name not in _OPTIONAL)


def _servo(table: Mapping[str, object], plant: MotorPlant) -> tuple[int, int, ServoGains]:
    names = tuple(field.name for field in fields(ServoGains))
    _refuse_unknown(table, (*_SERVO_KEYS, *names), ("servo",))
    tick_ns = _duration_ns(table, "tick_s", 0.001, ("servo",), 1e-6, 1.0)
    steps = _whole(table.get("current_steps", 10), ("servo", "current_steps"), 1, 1000)
    if tick_ns % steps:
        message = f"{steps} steps do not divide a servo period of {tick_ns} ns"
        raise SettingError(("servo", "current_steps"), message, "usual: 10")
    if tick_ns < steps * 1000:
        message = f"{steps} steps in a servo period of {tick_ns} ns are shorter than a microsecond"
        raise SettingError(
            ("servo", "current_steps"), f"{message} each", "a longer tick_s, or fewer steps"
        )
    given = {
        name: _number(table[name], ("servo", name), 0, 1e12) for name in names if name in table
    }
    return tick_ns, steps, replace(ServoGains.tuned(plant, tick_ns, steps), **given)


def _objects(table: Mapping[str, object]) -> tuple[ObjectValue, ...]:
    entries: dict[tuple[int, int], ObjectValue] = {}
    for key, value in table.items():
        path = ("objects", key)
        found = _OBJECT.fullmatch(key)
        if found is None:
            raise SettingError(path, "is no object", 'like "6065h" or "1A00h:1"')
        index, decimal, hexadecimal = found.groups()
        place = (int(index, 16), int(hexadecimal, 16) if hexadecimal else int(decimal or "0"))
        if place[0] < 0x1000 or place[1] > 254:
            raise SettingError(path, "is no object", "1000h..FFFFh, sub-index 0..254")
        if isinstance(value, bool) or not isinstance(value, int | float | str):
            raise SettingError(path, f"{value!r} is no value", "a number, or a text for a string")
        if place in entries:
            raise SettingError(path, "is given twice", "take one out")
        entries[place] = ObjectValue(key, *place, value)
    return tuple(entries.values())


_OBJECT: Final = re.compile("([0-9A-Fa-f]{4})[hH]?(?::(?:([0-9]{1,3})|([0-9A-Fa-f]{1,2})[hH]))?")


def _modes(table: Mapping[str, object]) -> tuple[str, ...] | None:
    value = table.get("supported_modes")
    if value is None:
        return None
    path = ("supported_modes",)
    known = f"known: {', '.join(EMULATED_MODES)}"
    if isinstance(value, str) or not isinstance(value, Sequence) or not value:
        raise SettingError(path, f"{value!r} is no list of modes", f'["pp", "pv"]; {known}')
    names: list[str] = []
    for name in value:
        if not isinstance(name, str) or name not in MODES:
            raise SettingError(path, f"there is no mode {name!r}", known)
        if name not in EMULATED_MODES:
            raise SettingError(path, f"mode {name} is not emulated", known)
        names.append(name)
    return tuple(names)


def _table(table: Mapping[str, object], key: str) -> Mapping[str, object]:
    value = table.get(key, {})
    if not isinstance(value, Mapping):
        raise SettingError((key,), f"{value!r} is no table", f"write [controller.NAME.{key}]")
    return value


def _refuse_unknown(
    table: Mapping[str, object], known: Sequence[str], path: tuple[str, ...]
) -> None:
    for key in table:
        if key not in known:
            close = [name for name in known if name.startswith(key)]
            close = close or difflib.get_close_matches(key, known, n=1)
            guess = f"did you mean {close[0]}? " if close else ""
            raise SettingError((*path, key), "is not known", f"{guess}known: {', '.join(known)}")


def _number(value: object, path: tuple[str, ...], low: float, high: float) -> float:
    if isinstance(value, bool) or not isinstance(value, int | float):
        raise SettingError(path, f"{value!r} is no number", f"{low:g}..{high:g}, without quotes")
    if not low <= value <= high:
        raise SettingError(path, f"{value} is outside {low:g}..{high:g}")
    return float(value)


def _whole(value: object, path: tuple[str, ...], low: int, high: int) -> int:
    if isinstance(value, bool) or not isinstance(value, int):
        raise SettingError(path, f"{value!r} is no whole number", f"{low}..{high}")
    if not low <= value <= high:
        raise SettingError(path, f"{value} is outside {low}..{high}")
    return value


def _positive(table: Mapping[str, object], key: str) -> float | None:
    return _number(table[key], ("units", key), 1e-12, 1e12) if key in table else None


def _duration_ns(
    table: Mapping[str, object],
    key: str,
    default_s: float,
    path: tuple[str, ...],
    low_s: float = 0,
    high_s: float = 3600,
) -> int:
    value = _number(table.get(key, default_s), (*path, key), low_s, high_s)
    return round(value * _NS_PER_S)


def _initial_position(table: Mapping[str, object], plant: MotorPlant) -> float:
    path = ("initial_position_rad",)
    position_rad = _number(table.get("initial_position_rad", 0.0), path, -1e9, 1e9)
    inc_rad = plant.encoder_increments_rev * plant.gear_ratio / (2.0 * PI)
    if abs(position_rad * inc_rad) >= 1 << 31:
        message = f"{position_rad * inc_rad:.0f} increments do not fit 32 bits"
        limit_rad = (1 << 31) / inc_rad
        raise SettingError(path, message, f"at most {limit_rad:g} rad either way")
    return position_rad
