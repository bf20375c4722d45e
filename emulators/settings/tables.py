"""Readers for settings tables of emulated controllers, with checks of every key.

A wrong key or value is a `SettingError` with the keys down to it and the expected value. The reader
of the file adds file and line.
"""

import difflib
import hashlib
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, fields, replace
from pathlib import Path
from typing import Final, final

from motorhil.emulators.controller import SettingError
from motorhil.emulators.plant.dc_motor import PI, RANGES, MotorPlant
from motorhil.emulators.plant.nonlinear import EXTRAS, NO_EXTRAS, PlantExtras
from motorhil.emulators.plant.nonlinear import RANGES as EXTRAS_RANGES
from motorhil.emulators.plant.oscillator import Oscillator
from motorhil.emulators.plant.presets import PRESETS

DEFAULT_PRESET: Final = "wheel_60w"
OSCILLATOR_KEYS: Final = ("ppm", "ppm_max", "phase_s", "phase_max_s", "jitter_s")
PPM_MAX: Final = 100_000.0
PHASE_MAX_S: Final = 1.0
JITTER_MAX_S: Final = 0.1

_NS_PER_S: Final = 1_000_000_000
_OPTIONAL: Final[dict[str, float]] = {
    "viscous_friction_n_m_s_rad": 0.0,
    "gear_ratio": 1.0,
    "load_inertia_kg_m2": 0.0,
    "load_torque_n_m": 0.0,
}
_LINEAR: Final = tuple(f.name for f in fields(MotorPlant) if f.name != "extras")
_DATA_SHEET: Final = tuple(name for name in _LINEAR if name not in _OPTIONAL)
# Settings without effect unless one of these is also given.
_SUPPLY: Final = ("source_resistance_ohm",)
_COMPANIONS: Final[dict[str, tuple[str, ...]]] = {
    "coupling_damping_n_m_s_rad": ("coupling_stiffness_n_m_rad", "backlash_rad"),
    "stop_restitution": ("stop_low_rad", "stop_high_rad"),
    "stribeck_speed_rad_s": ("static_friction_n_m",),
    "cogging_periods_rev": ("cogging_torque_n_m",),
    "gravity_zero_rad": ("gravity_torque_n_m",),
    "dc_link_capacitance_f": _SUPPLY,
    "dc_link_bleed_ohm": _SUPPLY,
    "chopper_threshold_v": ("chopper_resistance_ohm",),
    "chopper_resistance_ohm": _SUPPLY,
    "ambient_c": ("thermal_resistance_winding_housing_k_w",),
    "i2t_continuous_a": ("i2t_peak_a",),
    "i2t_peak_s": ("i2t_peak_a",),
}
_WHOLE: Final = ("encoder_increments_rev", "cogging_periods_rev")
_OBJECT: Final = re.compile("([0-9A-Fa-f]{4})[hH]?(?::(?:([0-9]{1,3})|([0-9A-Fa-f]{1,2})[hH]))?")

KeyPath = tuple[str, ...]
"""The keys down to a table or a value."""


@final
@dataclass(frozen=True, slots=True)
class ObjectValue:
    """The power-on value of an object in the rig; `key` as in the rig."""

    key: str
    index: int
    subindex: int
    value: int | float | str


def table_in(table: Mapping[str, object], key: str, path: KeyPath = ()) -> Mapping[str, object]:
    """Return the table of that key, or an empty one if it is absent."""
    value = table.get(key, {})
    if not isinstance(value, Mapping):
        place = ".".join(("controller", "NAME", *path, key))
        raise SettingError((*path, key), f"{value!r} is not a table", f"write [{place}]")
    return value


def refuse_unknown(table: Mapping[str, object], known: Sequence[str], path: KeyPath) -> None:
    """Refuse the first key that is not `known`, with a suggestion (SettingError)."""
    for key in table:
        if key not in known:
            raise SettingError((*path, key), "is not known", nearest(key, known))


def nearest(name: object, known: Sequence[str]) -> str:
    """Return a remedy: the known name most similar to `name`, and all known names."""
    if not known:
        return "remove it; no keys are allowed here"
    close = [one for one in known if isinstance(name, str) and name and one.startswith(name)]
    close = close or difflib.get_close_matches(str(name), known, n=1)
    guess = f"did you mean {close[0]}? " if close else ""
    return f"{guess}known: {', '.join(known)}"


def number(value: object, path: KeyPath, low: float, high: float) -> float:
    """Return the value if it is a number from `low` to `high`."""
    if isinstance(value, bool) or not isinstance(value, int | float):
        raise SettingError(path, f"{value!r} is not a number", f"{low:g}..{high:g}, without quotes")
    if not low <= value <= high:
        raise SettingError(path, f"{value} is outside {low:g}..{high:g}")
    return float(value)


def whole(value: object, path: KeyPath, low: int, high: int) -> int:
    """Return the value if it is a whole number from `low` to `high`."""
    if isinstance(value, bool) or not isinstance(value, int):
        raise SettingError(path, f"{value!r} is not a whole number", f"{low}..{high}")
    if not low <= value <= high:
        raise SettingError(path, f"{value} is outside {low}..{high}")
    return value


def duration_ns(
    table: Mapping[str, object],
    key: str,
    default_s: float,
    path: KeyPath,
    low_s: float = 0,
    high_s: float = 3600,
) -> int:
    """Return the time of that key, given in seconds, in [ns]."""
    value = number(table.get(key, default_s), (*path, key), low_s, high_s)
    return round(value * _NS_PER_S)


def oscillator_in(table: Mapping[str, object], stream: str) -> Oscillator:
    """Read the controller's own clock; `_max` keys draw from `stream` (seed and name)."""
    own = table_in(table, "oscillator")
    path = ("oscillator",)
    refuse_unknown(own, OSCILLATOR_KEYS, path)
    for drawn, given in (("ppm_max", "ppm"), ("phase_max_s", "phase_s")):
        if drawn in own and given in own:
            message = f"has no effect, because {given} is given"
            raise SettingError((*path, drawn), message, "remove one of them")
    ppm = number(own.get("ppm", 0.0), (*path, "ppm"), -PPM_MAX, PPM_MAX)
    ppm_max = number(own.get("ppm_max", 0.0), (*path, "ppm_max"), 0, PPM_MAX)
    phase_s = number(own.get("phase_s", 0.0), (*path, "phase_s"), 0, PHASE_MAX_S)
    phase_max_s = number(own.get("phase_max_s", 0.0), (*path, "phase_max_s"), 0, PHASE_MAX_S)
    if ppm_max:
        ppm = ppm_max * (2.0 * _drawn(f"{stream}:oscillator:ppm") - 1.0)
    if phase_max_s:
        phase_s = phase_max_s * _drawn(f"{stream}:oscillator:phase")
    jitter_ns = duration_ns(own, "jitter_s", 0.0, path, 0, JITTER_MAX_S)
    jitter_seed = int(_drawn(f"{stream}:oscillator:jitter") * 2.0**53) if jitter_ns else 0
    return Oscillator(round(ppm * 1e6), round(phase_s * _NS_PER_S), jitter_ns, jitter_seed)


def _drawn(stream: str) -> float:
    """Return the number of the stream with this name, 0.0 <= x < 1.0."""
    return (int.from_bytes(hashlib.sha256(stream.encode()).digest()[:8], "big") >> 11) / 2.0**53


def node_id_in(table: Mapping[str, object]) -> int:
    """Return the node-ID, which is required."""
    if "node_id" not in table:
        raise SettingError(("node_id",), "is missing", "a number 1..127")
    return whole(table["node_id"], ("node_id",), 1, 127)


def flag(table: Mapping[str, object], key: str) -> bool:
    """Return the boolean value of that key, or False if it is absent."""
    value = table.get(key, False)
    if not isinstance(value, bool):
        raise SettingError((key,), f"{value!r} is neither true nor false", f"{key} = true")
    return value


def eds_in(table: Mapping[str, object], folder: Path, own: Path) -> Path:
    """Return the EDS named in the table, relative to `folder`, or `own` if it is absent."""
    value = table.get("eds")
    if value is None:
        return own
    if not isinstance(value, str) or not value:
        raise SettingError(("eds",), f"{value!r} is not a path", 'a file name: eds = "drive.eds"')
    path = folder / value
    if not path.is_file():
        raise SettingError(
            ("eds",),
            f"file {path} not found",
            "check the path, or leave eds out to use the built-in one",
        )
    return path


def memory_file_in(table: Mapping[str, object]) -> str | None:
    """Return the file for nonvolatile data that the table names, or None."""
    value = table.get("nonvolatile_memory")
    if value is not None and (not isinstance(value, str) or not value):
        remedy = 'a file name: nonvolatile_memory = "drive.parameters"'
        raise SettingError(("nonvolatile_memory",), f"{value!r} is not a path", remedy)
    return value


def plant_of(table: Mapping[str, object], path: KeyPath = ("plant",)) -> MotorPlant:
    """Return the motor of a plant table: a preset, all its numbers, or a preset and some."""
    refuse_unknown(table, ("preset", *_LINEAR, *EXTRAS), path)
    preset = table.get("preset")
    if preset is not None and (not isinstance(preset, str) or preset not in PRESETS):
        remedy = nearest(preset, tuple(PRESETS))
        raise SettingError((*path, "preset"), f"there is no preset {preset!r}", remedy)
    numbers = _numbers(table, RANGES, path)
    base = PRESETS[preset] if isinstance(preset, str) else PRESETS[DEFAULT_PRESET]
    needed = [name for name in _DATA_SHEET if name not in numbers]
    if preset is None and numbers and needed:
        raise SettingError(
            path,
            f"{', '.join(needed)} missing",
            f"give all data-sheet numbers, or start from a preset: {', '.join(PRESETS)}",
        )
    if preset is None and numbers:
        base = replace(base, **_OPTIONAL)  # type: ignore[arg-type]  # names of its own fields
    try:
        more = _numbers(table, EXTRAS_RANGES, path)
        extras: PlantExtras = replace(base.extras, **more)  # type: ignore[arg-type]  # likewise
        _refuse_idle(more, extras, path)
        return replace(base, **numbers, extras=extras)  # type: ignore[arg-type]  # checked above
    except ValueError as error:
        name, _, text = str(error).partition(" = ")
        raise SettingError((*path, name), text) from error


def _refuse_idle(more: Mapping[str, float], extras: PlantExtras, path: KeyPath) -> None:
    """Refuse a number without effect; users would believe that it is simulated."""
    for name, needed in _COMPANIONS.items():
        idle = all(getattr(extras, one) == getattr(NO_EXTRAS, one) for one in needed)
        if idle and more.get(name, getattr(NO_EXTRAS, name)) != getattr(NO_EXTRAS, name):
            message = f"{more[name]:g} does nothing without {' or '.join(needed)}"
            raise SettingError((*path, name), message, "add it to the plant")


def _numbers(
    table: Mapping[str, object], ranges: Mapping[str, tuple[float, float]], path: KeyPath
) -> dict[str, float]:
    """Return the values of these keys in the table."""
    return {
        name: whole(table[name], (*path, name), int(low), int(high))
        if name in _WHOLE
        else number(table[name], (*path, name), low, high)
        for name, (low, high) in ranges.items()
        if name in table
    }


def initial_position_rad(
    table: Mapping[str, object], plant: MotorPlant, path: KeyPath = ()
) -> float:
    """Return the position of the output at power-on [rad]; within 32 bits of increments."""
    path = (*path, "initial_position_rad")
    position_rad = number(table.get("initial_position_rad", 0.0), path, -1e9, 1e9)
    low_rad, high_rad = plant.extras.stop_low_rad, plant.extras.stop_high_rad
    if not low_rad <= position_rad <= high_rad:
        message = f"{position_rad} rad is beyond the plant's end stops"
        raise SettingError(path, message, f"{low_rad:g}..{high_rad:g} rad")
    inc_rad = plant.encoder_increments_rev * plant.gear_ratio / (2.0 * PI)
    if abs(position_rad * inc_rad) >= 1 << 31:
        message = f"{position_rad * inc_rad:.0f} increments do not fit 32 bits"
        limit_rad = (1 << 31) / inc_rad
        raise SettingError(path, message, f"at most {limit_rad:g} rad in either direction")
    return position_rad


def objects_of(table: Mapping[str, object]) -> tuple[ObjectValue, ...]:
    """Return the power-on values of objects in a table named `objects`."""
    entries: dict[tuple[int, int], ObjectValue] = {}
    for key, value in table.items():
        path = ("objects", key)
        found = _OBJECT.fullmatch(key)
        if found is None:
            raise SettingError(path, "is not an object", 'like "6065h" or "1A00h:1"')
        index, decimal, hexadecimal = found.groups()
        place = (int(index, 16), int(hexadecimal, 16) if hexadecimal else int(decimal or "0"))
        if place[0] < 0x1000 or place[1] > 254:
            raise SettingError(path, "is not an object", "1000h..FFFFh, sub-index 0..254")
        if isinstance(value, bool) or not isinstance(value, int | float | str):
            raise SettingError(
                path, f"{value!r} is not a value", "a number, or a text for a string"
            )
        if place in entries:
            raise SettingError(path, "is given twice", "remove one")
        entries[place] = ObjectValue(key, *place, value)
    return tuple(entries.values())
