"""CiA 402 drives on CANopen: the names that applications and rigs use.

No other module of this package need be imported::

    hw = Cia402HwMotor(bus, node_id=3)
    motor = Cia402Motor(hw, model=MotorModel.load("wheel.toml"))
"""

from collections.abc import Mapping
from dataclasses import fields
from typing import TYPE_CHECKING, Final

from motorapi.adaptations.building import Shared, as_name, number, refuse_unknown
from motorapi.adaptations.cia402_hardware import Cia402HwMotor
from motorapi.adaptations.cia402_motor import Cia402Motor
from motorapi.adaptations.cia402_parameters import Cia402Parameters
from motorapi.adaptations.drive_setup import HwOptions
from motorapi.errors import UsageError
from motorapi.sharing import bus_key

if TYPE_CHECKING:
    import can

    from motorapi.model import MotorModel
    from motorapi.runtime import Runtime

__all__ = ["Cia402HwMotor", "Cia402Motor", "Cia402Parameters", "HwOptions", "build"]

_OPTIONS: Final = tuple(field.name for field in fields(HwOptions))
_KEYS: Final = ("name", "node_id", *_OPTIONS)
_SHARED: Final[Shared[Cia402HwMotor]] = Shared("drive")


def build(
    bus: "can.BusABC", settings: Mapping[str, object], model: "MotorModel", runtime: "Runtime"
) -> Cia402Motor:
    """Return the motor described by a settings table (entry point `motorhil.adaptations`, cia402).

    Motors that name the same drive share one hardware object, made by the first of them.

    Args:
        bus: the bus of the drive.
        settings: `node_id`; `name` (None: the model's); and any field of HwOptions.
        model: the motor model.
        runtime: the runtime to wait with.

    Raises:
        UsageError: a setting is unknown, missing or invalid.
    """
    refuse_unknown(settings, _KEYS, "setting of a cia402 motor")
    node_id = settings.get("node_id")
    if not isinstance(node_id, int) or isinstance(node_id, bool):
        raise UsageError(f"node_id = {node_id!r}: must be a node-ID, 1 to 127")
    given = {
        key: None if value is None else number(key, value)
        for key, value in settings.items()
        if key in _OPTIONS
    }
    options = HwOptions(**given)  # type: ignore[arg-type]  # HwOptions checks them
    hardware = _SHARED.get(
        (*bus_key(bus), node_id),
        lambda: Cia402HwMotor(bus, node_id, runtime=runtime, options=options),
        lambda built: built.options == options,
    )
    return Cia402Motor(
        hardware,
        model,
        name=as_name(settings.get("name")),
        on_close=lambda: _SHARED.give_back(hardware),
    )
