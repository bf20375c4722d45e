"""Adaptation for CiA 402 drives on CANopen.

Its names are loaded when they are first used: a rig without CAN needs the units of drives alone.
"""

from importlib import import_module
from typing import TYPE_CHECKING, Final

if TYPE_CHECKING:
    from motorhil.motorapi.adaptations.cia402.bringup import HwOptions
    from motorhil.motorapi.adaptations.cia402.hardware import Cia402HwMotor
    from motorhil.motorapi.adaptations.cia402.motor import Cia402Motor, build
    from motorhil.motorapi.adaptations.cia402.parameters import Cia402Parameters

__all__ = ["Cia402HwMotor", "Cia402Motor", "Cia402Parameters", "HwOptions", "build"]

_LATE: Final = {
    "Cia402HwMotor": "hardware",
    "Cia402Motor": "motor",
    "Cia402Parameters": "parameters",
    "HwOptions": "bringup",
    "build": "motor",
}


def __getattr__(name: str) -> object:
    """Import a name at its first use."""
    if name not in _LATE:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    return getattr(import_module(f"{__name__}.{_LATE[name]}"), name)
