"""A plant's numbers out of the motor model, when a rig asks for that.

Convenient, and a trap: a wrong gear ratio on both sides hides itself. So a rig has to ask for it
(`plant.from_motor_model = true`), what was taken is told, and what the rig says itself counts more.
"""

from collections.abc import Mapping
from typing import Final

from emulators.plant.presets import PRESETS
from motorapi.model import MotionKind, MotorModel

_TURN_RAD: Final = 6.283185307179586
_WHOLE_TOLERANCE: Final = 1e-3  # increments per turn: a model is written with a few digits


def plant_numbers(model: MotorModel, plant: Mapping[str, object]) -> dict[str, int | float]:
    """What the model knows of the plant and `plant` (the rig's table) does not say itself.

    Args:
        model: of the motor that this plant is behind.
        plant: the rig's table; its gear ratio (or its preset's) is needed for the resolution.

    Raises:
        ValueError: the model's resolution is no whole number of increments per motor turn.
    """
    numbers: dict[str, int | float] = {}
    if model.current_max is not None and "current_max_a" not in plant:
        numbers["current_max_a"] = model.current_max
    rotary = model.kind is MotionKind.ROTARY
    if rotary and model.increments_per_unit is not None and "encoder_increments_rev" not in plant:
        gear_ratio = _gear_ratio(plant)
        increments = abs(model.increments_per_unit) * _TURN_RAD / gear_ratio
        if abs(increments - round(increments)) > _WHOLE_TOLERANCE or increments < 0.5:
            raise ValueError(
                f"increments_per_rad = {model.increments_per_unit} of the motor model makes "
                f"{increments:.6g} increments per motor turn with gear_ratio = {gear_ratio:g}"
            )
        numbers["encoder_increments_rev"] = round(increments)
    return numbers


def _gear_ratio(plant: Mapping[str, object]) -> float:
    """Motor turns per output turn; 1.0 if that is not a number, which others will complain of."""
    preset = PRESETS.get(str(plant.get("preset")))
    value = plant.get("gear_ratio", 1.0 if preset is None else preset.gear_ratio)
    return float(value) if isinstance(value, int | float) and value > 0 else 1.0
