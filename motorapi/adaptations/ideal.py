"""Ideal motors: the names that applications and rigs use.

They are the reference for every other kind of motor, and the quickest way to try an application.
There is no bus, no drive and no plant: commands are executed exactly and at once. See
`IdealMotor`::

    hw = IdealHwMotor(runtime, "left wheel")
    motor = IdealMotor(hw, model=MotorModel.load("wheel.toml"))
"""

from collections.abc import Mapping
from math import isfinite
from typing import TYPE_CHECKING, Final

from motorapi.adaptations.building import Shared, refuse_unknown
from motorapi.adaptations.ideal_hardware import IdealHwMotor, IdealTrigger
from motorapi.adaptations.ideal_motor import IdealMotor
from motorapi.commands import as_number
from motorapi.errors import UsageError
from motorapi.model import MotionKind

if TYPE_CHECKING:
    from motorapi.model import MotorModel
    from motorapi.runtime import Runtime

__all__ = ["IdealHwMotor", "IdealMotor", "IdealTrigger", "build"]

_KEYS: Final = {
    MotionKind.ROTARY: ("position_rad", "torque_constant_n_m_a"),
    MotionKind.LINEAR: ("position_m", "torque_constant_n_a"),
}
_SHARED: Final[Shared[IdealHwMotor]] = Shared("axis")


def build(
    bus: None, settings: Mapping[str, object], model: "MotorModel", runtime: "Runtime"
) -> IdealMotor:
    """Return the motor described by a settings table (entry point `motorhil.adaptations`, ideal).

    Motors that name the same axis share one hardware object, made by the first of them.

    Args:
        bus: None (see `build.needs_bus`).
        settings: `name`; `axis` (default: the name); the initial position and the torque constant,
            both with their units: `position_rad`, `torque_constant_n_m_a`, of a linear motor
            `position_m`, `torque_constant_n_a`.
        model: the motor model.
        runtime: the runtime of the motor.

    Raises:
        UsageError: a setting is unknown or invalid.
    """
    position_key, constant_key = _KEYS[model.kind]
    known = ("name", "axis", position_key, constant_key)
    refuse_unknown(settings, known, f"setting of an ideal {model.kind.value} motor")
    name = settings.get("name", model.name)
    axis = settings.get("axis", name)
    if not isinstance(name, str) or not isinstance(axis, str) or not axis:
        raise UsageError(f"axis = {axis!r}: must be a name")
    position = _number(settings, position_key)
    constant = _number(settings, constant_key)
    if constant is not None and constant <= 0.0:
        raise UsageError(f"{constant_key} = {constant:g}: must be > 0")
    hardware = _SHARED.get(
        (runtime, axis),
        lambda: IdealHwMotor(
            runtime,
            axis,
            position=0.0 if position is None else position,
            torque_constant=1.0 if constant is None else constant,
        ),
        lambda built: (
            position in (None, built.initial_position) and constant in (None, built.torque_constant)
        ),
    )
    return IdealMotor(hardware, model, name=name, on_close=lambda: _SHARED.give_back(hardware))


build.needs_bus = False  # type: ignore[attr-defined]  # what a rig asks of every adaptation


def _number(settings: Mapping[str, object], key: str) -> float | None:
    value = settings.get(key)
    if value is None:
        return None
    number = as_number(value)
    if isinstance(value, bool) or not isfinite(number):
        raise UsageError(f"{key} = {value!r}: must be a finite number")
    return number
