"""CiA 402 drives on CANopen: what an application imports, and what a rig builds.

Nothing else of this package need be imported::

    hw = Cia402HwMotor(bus, node_id=3)
    motor = Cia402Motor(hw, model=MotorModel.load("wheel.toml"))
"""

from collections.abc import Mapping
from dataclasses import fields
from difflib import get_close_matches
from typing import TYPE_CHECKING, Final
from weakref import WeakValueDictionary

from motorapi.adaptations.cia402_hardware import Cia402HwMotor
from motorapi.adaptations.cia402_motor import Cia402Motor
from motorapi.adaptations.cia402_parameters import Cia402Parameters
from motorapi.adaptations.drive_setup import HwOptions
from motorapi.errors import UsageError
from motorapi.sharing import bus_key

if TYPE_CHECKING:
    from collections.abc import Hashable

    import can

    from motorapi.model import MotorModel
    from motorapi.runtime import Runtime

__all__ = ["Cia402HwMotor", "Cia402Motor", "Cia402Parameters", "HwOptions", "build"]

_OPTIONS: Final = tuple(field.name for field in fields(HwOptions))
_KEYS: Final = ("name", "node_id", *_OPTIONS)
_BUILT: "Final[WeakValueDictionary[Hashable, Cia402HwMotor]]" = WeakValueDictionary()


def build(
    bus: "can.BusABC", settings: Mapping[str, object], model: "MotorModel", runtime: "Runtime"
) -> Cia402Motor:
    """The motor that a table of settings describes (entry point `motorhil.adaptations`, cia402).

    Motors that name the same drive share one hardware object, made by the first of them.

    Args:
        bus: where the drive is.
        settings: `node_id`; `name` (None: the model's); and any field of HwOptions.
        model: the motor's.
        runtime: where it waits.

    Raises:
        UsageError: a setting is unknown, missing, or wrong.
    """
    for key in settings:
        if key not in _KEYS:
            near = get_close_matches(key, _KEYS, 1)
            hint = f"did you mean {near[0]}?" if near else f"known: {', '.join(_KEYS)}"
            raise UsageError(f"{key} is no setting of a cia402 motor; {hint}")
    node_id = settings.get("node_id")
    if not isinstance(node_id, int) or isinstance(node_id, bool):
        raise UsageError(f"node_id = {node_id!r}: must be a node-ID, 1 to 127")
    name = settings.get("name")
    given = {key: _option(key, value) for key, value in settings.items() if key in _OPTIONS}
    options = HwOptions(**given)  # type: ignore[arg-type]  # HwOptions checks them
    hardware = _shared_hardware(bus, node_id, options, runtime)
    return Cia402Motor(
        hardware,
        model,
        name=None if name is None else str(name),
        on_close=lambda: _give_back(hardware),
    )


def _option(key: str, value: object) -> float | int | None:
    if isinstance(value, bool) or not isinstance(value, int | float | None):
        raise UsageError(f"{key} = {value!r}: must be a number")
    return value


def _shared_hardware(
    bus: "can.BusABC", node_id: int, options: HwOptions, runtime: "Runtime"
) -> Cia402HwMotor:
    key = (*bus_key(bus), node_id)
    hardware = _BUILT.get(key)
    if hardware is None or hardware.is_closed:
        hardware = Cia402HwMotor(bus, node_id, runtime=runtime, options=options)
        _BUILT[key] = hardware
    elif hardware.options != options:
        raise UsageError(
            f"{hardware.label} is used with other settings already; motors that share a drive "
            "share its settings"
        )
    hardware.users += 1
    return hardware


def _give_back(hardware: Cia402HwMotor) -> None:
    hardware.users -= 1
    if hardware.users == 0:
        hardware.close()
