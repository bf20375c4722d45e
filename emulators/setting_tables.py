"""What the settings tables of emulated controllers have in common, checked key by key.

A wrong key or value is a `SettingError` that names the keys down to it and what would be right;
whoever read the file adds file and line.
"""

import difflib
import hashlib
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, fields, replace
from pathlib import Path
from typing import Final, final

from emulators.controller import SettingError
from emulators.plant.dc_motor import PI, RANGES, MotorPlant
from emulators.plant.extras import EXTRAS, NO_EXTRAS, PlantExtras
from emulators.plant.extras import RANGES as EXTRAS_RANGES
from emulators.plant.oscillator import Oscillator
from emulators.plant.presets import PRESETS

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
# What does nothing, unless one of these is there, too.
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
    """What the rig wants an object to be at power-on; `key` as the rig writes it."""

    key: str
    index: int
    subindex: int
    value: int | float | str


def table_in(table: Mapping[str, object], key: str, path: KeyPath = ()) -> Mapping[str, object]:
    """The table of that key; an empty one where there is none."""
    value = table.get(key, {})
    if not isinstance(value, Mapping):
        place = ".".join(("controller", "NAME", *path, key))
        raise SettingError((*path, key), f"{value!r} is no table", f"write [{place}]")
    return value


def refuse_unknown(table: Mapping[str, object], known: Sequence[str], path: KeyPath) -> None:
    """Raises SettingError at the first key that is not `known`, suggesting the nearest."""
    for key in table:
        if key not in known:
            raise SettingError((*path, key), "is not known", nearest(key, known))


def nearest(name: object, known: Sequence[str]) -> str:
    """A remedy: the known name that is most like `name`, and all there are."""
    if not known:
        return "take it out, there are none"
    close = [one for one in known if isinstance(name, str) and name and one.startswith(name)]
    close = close or difflib.get_close_matches(str(name), known, n=1)
    guess = f"did you mean {close[0]}? " if close else ""
    return f"{guess}known: {', '.join(known)}"


def number(value: object, path: KeyPath, low: float, high: float) -> float:
    """The value, a number from `low` to `high`."""
    if isinstance(value, bool) or not isinstance(value, int | float):
        raise SettingError(path, f"{value!r} is no number", f"{low:g}..{high:g}, without quotes")
    if not low <= value <= high:
        raise SettingError(path, f"{value} is outside {low:g}..{high:g}")
    return float(value)


def whole(value: object, path: KeyPath, low: int, high: int) -> int:
    """The value, a whole number from `low` to `high`."""
    if isinstance(value, bool) or not isinstance(value, int):
        raise SettingError(path, f"{value!r} is no whole number", f"{low}..{high}")
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
    """The time of that key, given in seconds [ns]."""
    value = number(table.get(key, default_s), (*path, key), low_s, high_s)
    return round(value * _NS_PER_S)


def oscillator_in(table: Mapping[str, object], stream: str) -> Oscillator:
    """The controller's own clock; a `_max` draws from `stream`, the seed and the name of it."""
    own = table_in(table, "oscillator")
    path = ("oscillator",)
    refuse_unknown(own, OSCILLATOR_KEYS, path)
    for drawn, given in (("ppm_max", "ppm"), ("phase_max_s", "phase_s")):
        if drawn in own and given in own:
            message = f"{given} is given already, there is nothing to draw"
            raise SettingError((*path, drawn), message, "take one of them out")
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
    """The one number, 0.0 to below 1.0, of a stream by that name."""
    return (int.from_bytes(hashlib.sha256(stream.encode()).digest()[:8], "big") >> 11) / 2.0**53


def node_id_in(table: Mapping[str, object]) -> int:
    """The node-ID, which must be there."""
    if "node_id" not in table:
        raise SettingError(("node_id",), "is missing", "a number 1..127")
    return whole(table["node_id"], ("node_id",), 1, 127)


def flag(table: Mapping[str, object], key: str) -> bool:
    """The value of that key, true or false; false where there is none."""
    value = table.get(key, False)
    if not isinstance(value, bool):
        raise SettingError((key,), f"{value!r} is neither true nor false", f"{key} = true")
    return value


def eds_in(table: Mapping[str, object], folder: Path, own: Path) -> Path:
    """The EDS named in the table, from `folder` on; `own` where none is."""
    value = table.get("eds")
    if value is None:
        return own
    if not isinstance(value, str) or not value:
        raise SettingError(("eds",), f"{value!r} is no path", 'a file name: eds = "drive.eds"')
    path = folder / value
    if not path.is_file():
        raise SettingError(
            ("eds",), f"there is no file {path}", "check the path; without eds our own is used"
        )
    return path


def memory_file_in(table: Mapping[str, object]) -> str | None:
    """The file of what is kept without power, as the table names it; None: it names none."""
    value = table.get("nonvolatile_memory")
    if value is not None and (not isinstance(value, str) or not value):
        remedy = 'a file name: nonvolatile_memory = "drive.parameters"'
        raise SettingError(("nonvolatile_memory",), f"{value!r} is no path", remedy)
    return value


def plant_of(table: Mapping[str, object], path: KeyPath = ("plant",)) -> MotorPlant:
    """The motor a plant table describes: a preset, all its numbers, or a preset and some."""
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
    """A number that nothing asks for would be taken for physics that is there."""
    for name, needed in _COMPANIONS.items():
        idle = all(getattr(extras, one) == getattr(NO_EXTRAS, one) for one in needed)
        if idle and more.get(name, getattr(NO_EXTRAS, name)) != getattr(NO_EXTRAS, name):
            message = f"{more[name]:g} does nothing without {' or '.join(needed)}"
            raise SettingError((*path, name), message, "give the plant that, too")


def _numbers(
    table: Mapping[str, object], ranges: Mapping[str, tuple[float, float]], path: KeyPath
) -> dict[str, float]:
    """What the table says of these keys."""
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
    """Where the output stands at power-on; within 32 bits of increments."""
    path = (*path, "initial_position_rad")
    position_rad = number(table.get("initial_position_rad", 0.0), path, -1e9, 1e9)
    low_rad, high_rad = plant.extras.stop_low_rad, plant.extras.stop_high_rad
    if not low_rad <= position_rad <= high_rad:
        message = f"{position_rad} rad is beyond an end of the plant's way"
        raise SettingError(path, message, f"{low_rad:g}..{high_rad:g} rad")
    inc_rad = plant.encoder_increments_rev * plant.gear_ratio / (2.0 * PI)
    if abs(position_rad * inc_rad) >= 1 << 31:
        message = f"{position_rad * inc_rad:.0f} increments do not fit 32 bits"
        limit_rad = (1 << 31) / inc_rad
        raise SettingError(path, message, f"at most {limit_rad:g} rad either way")
    return position_rad


def objects_of(table: Mapping[str, object]) -> tuple[ObjectValue, ...]:
    """The power-on values of objects that a table named `objects` gives."""
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
