"""Keys of a rig's plant for an identified model."""

from collections.abc import Mapping
from typing import Final

from motorhil.harness.identification.follower import pendulum_of
from motorhil.harness.identification.inverse_model import Fit
from motorhil.harness.identification.resonance import Resonance
from motorhil.harness.identification.samples import Samples, Told

BACKLASH: Final = (
    "backlash: not seen: positions of the motor alone do not show it;"
    " hold the output, and move the motor slowly there and back"
)
_RIGID: Final = Resonance(0.0)
_ROTOR: Final = "rotor_inertia_kg_m2"
_UNITS: Final[Mapping[str, Mapping[str, str]]] = {
    "inertia": {"rad": "kg·m²", "m": "kg"},
    "viscous": {"rad": "N·m·s/rad", "m": "N·s/m"},
    "coulomb": {"rad": "N·m", "m": "N"},
    "offset": {"rad": "N·m", "m": "N"},
    "gravity": {"rad": "N·m", "m": "N"},
    "delay": {"rad": "s", "m": "s"},
}


def unit_of(name: str, unit: str) -> str:
    """Return the unit of a parameter at the output of an axis in this unit, "rad" or "m"."""
    return _UNITS[name.partition(" ")[0]][unit]


def plant_keys(
    fit: Fit,
    unit: str,
    gear: float,
    resonance: Resonance = _RIGID,
    constant: Told | None = None,
) -> dict[str, float]:
    """Return the plant's keys and values for a turning axis; parameters that are not seen lack.

    Args:
        fit: the model at the output.
        unit: "rad" or "m"; plants of linear axes are turning ones in a rig, so they have no keys.
        gear: motor turns per turn of the output; inertia and friction are told on its motor's side.
        resonance: that of the axis, which divides the inertia between rotor and load.
        constant: the torque constant; None: the drive has not told it.
    """
    if unit != "rad":
        return {}
    values = {name: float(one.told) for name, one in fit.parameters.items() if not one.unseen}
    keys: dict[str, float] = {}
    if "inertia" in values:
        load = values["inertia"] * resonance.load_share()
        keys[_ROTOR] = (values["inertia"] - load) / gear**2
        keys["load_inertia_kg_m2"] = load
        if resonance.is_seen:
            keys["coupling_stiffness_n_m_rad"] = resonance.stiffness(values["inertia"])
    if "viscous" in values:
        keys["viscous_friction_n_m_s_rad"] = max(0.0, values["viscous"] / gear**2)
    if "coulomb" in values:
        keys["coulomb_friction_n_m"] = max(0.0, values["coulomb"] / gear)
    if "offset" in values:
        keys["load_torque_n_m"] = values["offset"]
    if constant is not None:
        keys["torque_constant_n_m_a"] = constant.value
    pendulum = pendulum_of(values)
    if pendulum.gravity_torque_n_m:
        keys["gravity_torque_n_m"] = pendulum.gravity_torque_n_m
        keys["gravity_zero_rad"] = pendulum.gravity_zero_rad
    return keys


def constant_told(constant: Told | None) -> str:
    """Return what is known of the torque constant, or which objects would tell it, as a text."""
    if constant is None:
        return "torque constant: not seen: no pairs of torque and current; read 6075h and 6078h"
    share = constant.deviation / abs(constant.value)
    return f"torque constant: {constant.value:.4g} N·m/A, deviation {share:.1%}"


def table_of(fit: Fit, samples: Samples, gear: float, resonance: Resonance = _RIGID) -> str:
    """Return the model as TOML: the keys of a plant, with what is known about each."""
    lines = [
        f"# {samples.name}: {samples.duration_s:.1f} s at {1.0 / samples.period_s:.0f} Hz",
        f"# effort not explained: {fit.error:.1%}",
    ]
    for one in fit.parameters.values():
        unit = unit_of(one.name, samples.unit)
        told = f"# {one.name} at the output: {one.told} {unit}, deviation {one.share_told}"
        lines.append(f"{told}; not seen: {one.unseen}; {one.remedy}" if one.unseen else told)
    lines += [f"# {one}" for one in (constant_told(samples.constant), resonance.told(), BACKLASH)]
    lines.append("[plant]")
    lines.append(f"gear_ratio = {gear!r}")
    keys = plant_keys(fit, samples.unit, gear, resonance, samples.constant)
    lines += [f"{key} = {value:.6g}" for key, value in keys.items()]
    return "\n".join(lines) + "\n"
