"""Settings that several kinds of emulated controllers share: clock, CANopen node, plant.

A controller's table is a class of settings (`motorhil.settings`) that derives from these. A wrong
key or value is a SettingError with the keys down to it; the reader of the file adds file and line.
"""

import hashlib
import re
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any, ClassVar, Final, final

from motorhil.emulators.plant.dc_motor import PI, RANGES, MotorPlant
from motorhil.emulators.plant.nonlinear import NO_EXTRAS, PlantExtras
from motorhil.emulators.plant.nonlinear import RANGES as EXTRAS_RANGES
from motorhil.emulators.plant.oscillator import Oscillator
from motorhil.emulators.plant.presets import PRESETS
from motorhil.frozen import frozen
from motorhil.settings import (
    REQUIRED,
    Declaration,
    Key,
    KeyPath,
    Number,
    Rule,
    Schema,
    SettingError,
    TablesByKey,
    Text,
    flag,
    given,
    kind_of,
    number,
    setting,
    text,
    whole,
)

DEFAULT_PRESET: Final = "wheel_60w"
NODE_ID_MAX: Final = 127
BOOT_UP_S: Final = (1e-3, 60.0)
"""The plausible times from power-on to the first message."""
REPLY_S: Final = (1e-6, 10.0)
"""The plausible times from a request to its response."""
PERIOD_S: Final = (1e-9, 0.1)
"""The plausible periods of firmware, and lateness in them."""
POSITION_RAD: Final = (1e-7, 1e6)
"""The plausible positions of an output."""
_NS_PER_S: Final = 1_000_000_000
_OBJECT: Final = re.compile("([0-9A-Fa-f]{4})[hH]?(?::(?:([0-9]{1,3})|([0-9A-Fa-f]{1,2})[hH]))?")
_OPTIONAL: Final[dict[str, float]] = {
    "viscous_friction_n_m_s_rad": 0.0,
    "gear_ratio": 1.0,
    "load_inertia_kg_m2": 0.0,
    "load_torque_n_m": 0.0,
}
_DATA_SHEET: Final = tuple(name for name in RANGES if name not in _OPTIONAL)
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
_PLAUSIBLE: Final = {  # magnitudes of motors from 1 W to 100 kW with their gears and loads
    "resistance_ohm": (1e-3, 1e3),
    "inductance_h": (1e-6, 0.1),
    "torque_constant_n_m_a": (1e-4, 10.0),
    "rotor_inertia_kg_m2": (1e-10, 1.0),
    "encoder_increments_rev": (4, 1 << 27),
    "supply_v": (1.0, 1000.0),
    "current_max_a": (0.01, 1000.0),
    "coulomb_friction_n_m": (1e-7, 10.0),
    "viscous_friction_n_m_s_rad": (1e-11, 1.0),
    "gear_ratio": (0.01, 10_000.0),
    "load_inertia_kg_m2": (1e-9, 1e4),
    "load_torque_n_m": (1e-6, 1e5),
    "backlash_rad": (1e-6, 0.2),
    "coupling_stiffness_n_m_rad": (1e-3, 1e8),
    "coupling_damping_n_m_s_rad": (1e-6, 1e5),
    "output_coulomb_friction_n_m": (1e-6, 1e4),
    "output_viscous_friction_n_m_s_rad": (1e-7, 1e4),
    "stop_low_rad": (1e-4, 1e5),
    "stop_high_rad": (1e-4, 1e5),
    "static_friction_n_m": (1e-7, 10.0),
    "stribeck_speed_rad_s": (1e-3, 1e3),
    "cogging_torque_n_m": (1e-7, 10.0),
    "gravity_torque_n_m": (1e-6, 1e5),
    "gravity_zero_rad": (1e-4, 1e5),
    "source_resistance_ohm": (1e-4, 100.0),
    "dc_link_capacitance_f": (1e-6, 1.0),
    "dc_link_bleed_ohm": (10.0, 1e7),
    "chopper_threshold_v": (1.0, 1000.0),
    "chopper_resistance_ohm": (0.1, 1e4),
    "thermal_resistance_winding_housing_k_w": (1e-3, 200.0),
    "thermal_resistance_housing_ambient_k_w": (1e-3, 500.0),
    "thermal_time_constant_winding_s": (0.1, 3600.0),
    "thermal_time_constant_motor_s": (10.0, 36_000.0),
    "ambient_c": (0.0, 90.0),
    "copper_coefficient_1_k": (1e-3, 0.01),
    "i2t_continuous_a": (0.01, 1000.0),
    "i2t_peak_a": (0.01, 1000.0),
    "i2t_peak_s": (0.01, 600.0),
}
_PLANT_DOCS: Final = {  # key: unit, description; the limits are those of the physics
    "resistance_ohm": ("ohm", "Terminal resistance."),
    "inductance_h": ("H", "Terminal inductance."),
    "torque_constant_n_m_a": ("N·m/A", "Torque per current, and back-EMF per speed."),
    "rotor_inertia_kg_m2": ("kg·m²", "Inertia of the motor alone."),
    "gear_ratio": ("", "Motor turns per output turn."),
    "load_inertia_kg_m2": ("kg·m²", "Inertia at the output."),
    "viscous_friction_n_m_s_rad": ("N·m·s/rad", "Viscous friction at the motor."),
    "coulomb_friction_n_m": (
        "N·m",
        "Coulomb friction at the motor; with 0 a powered axis never comes to exact rest.",
    ),
    "encoder_increments_rev": ("", "Increments (quadrature edges) per motor turn."),
    "supply_v": ("V", "Voltage that the power stage can apply to the motor."),
    "current_max_a": ("A", "Current that the power stage allows."),
    "load_torque_n_m": (
        "N·m",
        "Constant torque at the output; positive acts towards negative positions.",
    ),
    "backlash_rad": ("rad", "Backlash of the gear from flank to flank, at the output."),
    "coupling_stiffness_n_m_rad": (
        "N·m/rad",
        "Stiffness of gear and shaft, at the output; 0: rigid, or with backlash as stiff as can"
        " be computed.",
    ),
    "coupling_damping_n_m_s_rad": ("N·m·s/rad", "Damping of gear and shaft, at the output."),
    "output_coulomb_friction_n_m": ("N·m", "Coulomb friction of the load, at the output."),
    "output_viscous_friction_n_m_s_rad": ("N·m·s/rad", "Viscous friction of the load."),
    "stop_low_rad": ("rad", "Lower end of travel, at the output."),
    "stop_high_rad": ("rad", "Upper end of travel, at the output."),
    "stop_restitution": ("", "Share of its speed with which the load rebounds from an end."),
    "static_friction_n_m": (
        "N·m",
        "Friction at standstill; 0: the Coulomb friction.",
    ),
    "stribeck_speed_rad_s": (
        "rad/s",
        "Speed at which static friction has fallen halfway to Coulomb friction, at the motor.",
    ),
    "cogging_torque_n_m": ("N·m", "Amplitude of the cogging torque, at the motor."),
    "cogging_periods_rev": ("", "Periods of the cogging torque per motor turn."),
    "gravity_torque_n_m": (
        "N·m",
        "Amplitude of a pendulum's torque, at the output; positive pulls to gravity_zero_rad.",
    ),
    "gravity_zero_rad": ("rad", "Position at which the pendulum hangs, at the output."),
    "source_resistance_ohm": (
        "ohm",
        "Resistance of the supply; 0: ideal. Above 0 the load changes the DC link voltage.",
    ),
    "dc_link_capacitance_f": ("F", "Capacitance of the DC link."),
    "dc_link_bleed_ohm": ("ohm", "Bleed resistor of the DC link; 0: none."),
    "chopper_threshold_v": ("V", "Voltage above which the brake chopper takes current."),
    "chopper_resistance_ohm": ("ohm", "Resistance of the brake chopper; 0: none."),
    "thermal_resistance_winding_housing_k_w": (
        "K/W",
        "Thermal resistance from winding to housing; the four thermal numbers go together.",
    ),
    "thermal_resistance_housing_ambient_k_w": ("K/W", "Thermal resistance to the air."),
    "thermal_time_constant_winding_s": ("s", "Thermal time constant of the winding."),
    "thermal_time_constant_motor_s": ("s", "Thermal time constant of the housing."),
    "ambient_c": ("C", "Temperature of the air, and of the motor at power-on."),
    "copper_coefficient_1_k": (
        "1/K",
        "Increase of the resistance relative to 25 C; copper: 0.0039.",
    ),
    "i2t_continuous_a": ("A", "Continuous current of the I2t model."),
    "i2t_peak_a": ("A", "Current allowed from rest for i2t_peak_s; 0: no I2t model."),
    "i2t_peak_s": ("s", "Duration of that current."),
}


def _plant_keys() -> dict[str, Key]:
    keys = {"preset": Key(Text(tuple(PRESETS), "preset"), "A plant by name, to start from.")}
    for name, (low, high) in {**RANGES, **EXTRAS_RANGES}.items():
        unit, doc = _PLANT_DOCS[name]
        usual = _PLAUSIBLE.get(name)
        number = Number(low, high, unit, is_whole=name in _WHOLE, plausible=usual)
        keys[name] = Key(number, doc)
    return keys


PLANT: Final = Declaration(
    "plant",
    "The motor, its gear and its load: a preset, all data-sheet numbers, or a preset and some.",
    _plant_keys(),
    {
        **dict.fromkeys(("preset", *_DATA_SHEET)),
        **_OPTIONAL,
        **{name: getattr(NO_EXTRAS, name) for name in EXTRAS_RANGES},
    },
)
"""The table of a plant; the values that it gives, by key, go to `plant_of`."""


@final
@frozen(kw_only=True, slots=False)
class OscillatorTable:
    """The controller's own clock, by which it measures all its times; absent, it is exact."""

    ppm: float = number(0.0, -100_000.0, 100_000.0, "ppm", "How much too fast the clock runs.")
    ppm_max: float = number(0.0, 0, 100_000.0, "ppm", "Random rate error, either way, at most.")
    phase_s: float = number(0.0, 0, 1.0, "s", "Offset of the clock.", plausible=PERIOD_S)
    phase_max_s: float = number(
        0.0, 0, 1.0, "s", "Random offset of the clock, at most.", plausible=PERIOD_S
    )
    jitter_s: float = number(
        0.0, 0, 0.1, "s", "Random lateness of each timed action, at most.", plausible=PERIOD_S
    )

    RULES: ClassVar = (
        Rule(
            "ppm",
            refused=("ppm_max",),
            message="has no effect, because ppm is given",
            remedy="remove one of them",
        ),
        Rule(
            "phase_s",
            refused=("phase_max_s",),
            message="has no effect, because phase_s is given",
            remedy="remove one of them",
        ),
    )

    def oscillator(self, stream: str) -> Oscillator:
        """Return the oscillator; `_max` keys draw from `stream` (seed and name)."""
        ppm, phase_s = self.ppm, self.phase_s
        if self.ppm_max:
            ppm = self.ppm_max * (2.0 * _drawn(f"{stream}:oscillator:ppm") - 1.0)
        if self.phase_max_s:
            phase_s = self.phase_max_s * _drawn(f"{stream}:oscillator:phase")
        jitter_ns = ns(self.jitter_s)
        jitter_seed = int(_drawn(f"{stream}:oscillator:jitter") * 2.0**53) if jitter_ns else 0
        return Oscillator(round(ppm * 1e6), ns(phase_s), jitter_ns, jitter_seed)


def _drawn(stream: str) -> float:
    """Return the number of the stream with this name, 0.0 <= x < 1.0."""
    return (int.from_bytes(hashlib.sha256(stream.encode()).digest()[:8], "big") >> 11) / 2.0**53


def ns(seconds: float) -> int:
    """Return a time in [ns]."""
    return round(seconds * _NS_PER_S)


@final
@frozen
class ObjectValue:
    """The power-on value of an object in the rig; `key` as in the rig."""

    key: str
    index: int
    subindex: int
    value: int | float | str


@final
class _Scalar:
    """A number or a text: the value of an object."""

    def read(self, value: object, path: KeyPath) -> int | float | str:
        if isinstance(value, bool) or not isinstance(value, int | float | str):
            message = f"must be a number or a string, but is {kind_of(value)}"
            raise SettingError(path, message, "a number, or a text for a string")
        return value

    def schema(self) -> Schema:
        return {"type": ["number", "string"]}

    def example(self) -> str:
        return ""


@frozen(kw_only=True, slots=False)
class TimingTable:
    """Delays of a CANopen controller."""

    boot_up_s: float = number(
        0.3, 0, 3600, "s", "From power-on to the boot-up message.", plausible=BOOT_UP_S
    )
    sdo_reply_s: float = number(
        0.001, 0, 3600, "s", "From an SDO request to its response.", plausible=REPLY_S
    )


@frozen(kw_only=True, slots=False)
class CanopenTable:
    """Keys of every CANopen controller."""

    node_id: int = whole(REQUIRED, 1, NODE_ID_MAX, "", "Its node-ID.", example="1")
    node_id_by_lss: bool = flag(False, "It has no node-ID until LSS (CiA 305) gives it one.")
    eds: str | None = text(
        None, "EDS file of its object dictionary, from the rig's folder on.", example='"drive.eds"'
    )
    nonvolatile_memory: str | None = text(
        None,
        "File of its nonvolatile data; absent, the data last as long as the rig is open.",
        example='"drive.parameters"',
    )
    objects: Mapping[str, Any] = setting(
        {},
        TablesByKey(
            _Scalar(),
            _OBJECT.pattern,
            "is not an object",
            'like "6065h" or "1A00h:1"',
        ),
        "Power-on values that replace those of the EDS, by object.",
    )

    def eds_path(self, folder: Path, own: Path) -> Path:
        """Return the EDS, relative to `folder`, or `own` if none is named.

        Raises:
            SettingError: there is no such file.
        """
        if self.eds is None:
            return own
        path = folder / self.eds
        if not path.is_file():
            remedy = "check the path, or leave eds out to use the built-in one"
            raise SettingError(("eds",), f"file {path} not found", remedy)
        return path

    def object_values(self) -> tuple[ObjectValue, ...]:
        """Return the power-on values of objects.

        Raises:
            SettingError: an object is out of range, or given twice.
        """
        entries: dict[tuple[int, int], ObjectValue] = {}
        for key, value in self.objects.items():
            found = _OBJECT.fullmatch(key)
            assert found is not None
            index, decimal, hexadecimal = found.groups()
            place = (int(index, 16), int(hexadecimal, 16) if hexadecimal else int(decimal or "0"))
            if place[0] < 0x1000 or place[1] > 254:
                message = "is not an object"
                raise SettingError(("objects", key), message, "1000h..FFFFh, sub-index 0..254")
            if place in entries:
                raise SettingError(("objects", key), "is given twice", "remove one")
            entries[place] = ObjectValue(key, *place, value)
        return tuple(entries.values())


def plant_of(table: Mapping[str, object], path: KeyPath = ("plant",)) -> MotorPlant:
    """Return the motor of a plant table: a preset, all its numbers, or a preset and some.

    Raises:
        SettingError: a key is unknown, a value is wrong, or numbers are missing.
    """
    values = given(PLANT, table, path)
    preset = values.pop("preset", None)
    numbers = {name: value for name, value in values.items() if name in RANGES}
    base = PRESETS[DEFAULT_PRESET if preset is None else preset]
    needed = [name for name in _DATA_SHEET if name not in numbers]
    if preset is None and numbers and needed:
        raise SettingError(
            path,
            f"{', '.join(needed)} missing",
            f"give all data-sheet numbers, or start from a preset: {', '.join(PRESETS)}",
        )
    if preset is None and numbers:
        base = replace(base, **_OPTIONAL)  # type: ignore[arg-type]  # names of its own fields
    more = {name: value for name, value in values.items() if name in EXTRAS_RANGES}
    try:
        extras = replace(base.extras, **more)
        _refuse_idle(more, extras, path)
        return replace(base, **numbers, extras=extras)
    except ValueError as error:
        name, _, problem = str(error).partition(" = ")
        raise SettingError((*path, name), problem) from error


def _refuse_idle(more: Mapping[str, float], extras: PlantExtras, path: KeyPath) -> None:
    """Refuse a number without effect; users would believe that it is simulated."""
    for name, needed in _COMPANIONS.items():
        idle = all(getattr(extras, one) == getattr(NO_EXTRAS, one) for one in needed)
        if idle and more.get(name, getattr(NO_EXTRAS, name)) != getattr(NO_EXTRAS, name):
            message = f"{more[name]:g} does nothing without {' or '.join(needed)}"
            raise SettingError((*path, name), message, "add it to the plant")


def check_position(position_rad: float, plant: MotorPlant, path: KeyPath = ()) -> None:
    """Check the position of the output at power-on: within the stops and 32 bits of increments.

    Raises:
        SettingError: it is not.
    """
    path = (*path, "initial_position_rad")
    low_rad, high_rad = plant.extras.stop_low_rad, plant.extras.stop_high_rad
    if not low_rad <= position_rad <= high_rad:
        message = f"{position_rad} rad is beyond the plant's end stops"
        raise SettingError(path, message, f"{low_rad:g}..{high_rad:g} rad")
    inc_rad = plant.encoder_increments_rev * plant.gear_ratio / (2.0 * PI)
    if abs(position_rad * inc_rad) >= 1 << 31:
        message = f"{position_rad * inc_rad:.0f} increments do not fit 32 bits"
        limit_rad = (1 << 31) / inc_rad
        raise SettingError(path, message, f"at most {limit_rad:g} rad in either direction")
