"""Ideal motors: what an application imports, and what a rig builds.

The yardstick for every other kind of motor, and the quickest way to try an application: no bus, no
drive, no plant; what is commanded happens, exactly and at once. See `ideal_motor`::

    hw = IdealHwMotor(runtime, "left wheel")
    motor = IdealMotor(hw, model=MotorModel.load("wheel.toml"))
"""

from collections.abc import Mapping
from difflib import get_close_matches
from math import isfinite
from typing import TYPE_CHECKING, Final
from weakref import WeakValueDictionary

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
_BUILT: "Final[WeakValueDictionary[tuple[Runtime, str], IdealHwMotor]]" = WeakValueDictionary()


def build(
    bus: None, settings: Mapping[str, object], model: "MotorModel", runtime: "Runtime"
) -> IdealMotor:
    """The motor that a table of settings describes (entry point `motorhil.adaptations`, ideal).

    Motors that name the same axis share one hardware object, made by the first of them.

    Args:
        bus: none (`build.needs_bus` says so).
        settings: `name`; `axis` (the name, if left out); where the motor is at the beginning and
            its torque constant, both with their units: `position_rad`, `torque_constant_n_m_a`, of
            a linear motor `position_m`, `torque_constant_n_a`.
        model: the motor's.
        runtime: the time it lives in.

    Raises:
        UsageError: a setting is unknown or wrong.
    """
    position_key, constant_key = _KEYS[model.kind]
    known = ("name", "axis", position_key, constant_key)
    for key in settings:
        if key not in known:
            near = get_close_matches(key, known, 1)
            hint = f"did you mean {near[0]}?" if near else f"known: {', '.join(known)}"
            raise UsageError(f"{key} is no setting of an ideal {model.kind.value} motor; {hint}")
    name = settings.get("name", model.name)
    axis = settings.get("axis", name)
    if not isinstance(name, str) or not isinstance(axis, str) or not axis:
        raise UsageError(f"axis = {axis!r}: must be a name")
    position = _number(settings, position_key)
    constant = _number(settings, constant_key)
    if constant is not None and constant <= 0.0:
        raise UsageError(f"{constant_key} = {constant:g}: must be > 0")
    hardware = _shared_hardware(runtime, axis, position, constant)
    return IdealMotor(hardware, model, name=name, on_close=lambda: _give_back(hardware))


build.needs_bus = False  # type: ignore[attr-defined]  # what a rig asks of every adaptation


def _number(settings: Mapping[str, object], key: str) -> float | None:
    value = settings.get(key)
    if value is None:
        return None
    number = as_number(value)
    if isinstance(value, bool) or not isfinite(number):
        raise UsageError(f"{key} = {value!r}: must be a finite number")
    return number


def _shared_hardware(
    runtime: "Runtime", axis: str, position: float | None, constant: float | None
) -> IdealHwMotor:
    hardware = _BUILT.get((runtime, axis))
    if hardware is None or hardware.is_closed:
        hardware = IdealHwMotor(
            runtime,
            axis,
            position=0.0 if position is None else position,
            torque_constant=1.0 if constant is None else constant,
        )
        _BUILT[runtime, axis] = hardware
    elif position not in (None, hardware.initial_position) or constant not in (
        None,
        hardware.torque_constant,
    ):
        raise UsageError(
            f"axis {axis} is used with other settings already; motors that share an axis share its"
            " settings"
        )
    hardware.users += 1
    return hardware


def _give_back(hardware: IdealHwMotor) -> None:
    hardware.users -= 1
    if hardware.users == 0:
        hardware.close()
