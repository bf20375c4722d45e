"""The demo's mast on Modbus: two PR-mode drives on a serial line, in place of those on CAN."""

from dataclasses import replace
from typing import TYPE_CHECKING, Final

from harness.rig_buses import MODBUS_RTU, BusDescription
from harness.settings import RigError

if TYPE_CHECKING:
    from harness.rig_file import RigDescription

MASTS: Final = ("can", "modbus")
LINE: Final = "rs485"
_BAUD_BIT_S: Final = 115_200
_UNITS: Final = {"pan": 1, "tilt": 2}


def with_modbus_mast(description: "RigDescription") -> "RigDescription":
    """The rig with pan and tilt on a line of their own; nothing else differs.

    Raises:
        RigError: it has no such drives.
    """
    controllers, motors = dict(description.controllers), dict(description.motors)
    for name, unit in _UNITS.items():
        controller = controllers.get(name)
        if controller is None or controller.kind != "cia402":
            problem = f"{name} is no drive of its own"
            raise RigError(description.source.path, problem, "use --mast with --rig rover")
        settings: dict[str, object] = {"plant": controller.settings["plant"], "unit": unit}
        controllers[name] = replace(
            controller, kind="leadshine_pr", bus=LINE, node_id=unit, settings=settings
        )
        motors[name] = replace(
            motors[name], adaptation="leadshine", bus=LINE, node_id=unit, settings={}
        )
    line = BusDescription(LINE, MODBUS_RTU, _BAUD_BIT_S, parity="N")
    buses = {**description.buses, LINE: line}
    return replace(description, buses=buses, controllers=controllers, motors=motors)
