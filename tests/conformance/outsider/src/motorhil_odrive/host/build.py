"""Builder of an ODrive motor; entry point `motorhil.adaptations`, name `odrive`."""

from collections.abc import Mapping
from typing import TYPE_CHECKING, Final

from motorhil.motorapi.api import Shared, adaptation, read_settings

from motorhil_odrive.host.hardware import OdriveHwMotor
from motorhil_odrive.host.motor import OdriveMotor
from motorhil_odrive.host.options import OdriveMotorTable, OdriveOptions

if TYPE_CHECKING:
    import can
    from motorhil.motorapi.api import MotorModel, Runtime

_SHARED: Final[Shared[OdriveHwMotor]] = Shared("drive")


@adaptation(api=1, rig="../rig.toml")
def build(
    bus: "can.BusABC", settings: Mapping[str, object], model: "MotorModel", runtime: "Runtime"
) -> OdriveMotor:
    """Build the motor that a table of settings describes.

    Motors that name the same drive share one hardware object, built by the first of them.

    Args:
        bus: the bus of the drive.
        settings: `node_id`; `name` (None: the model's); and any field of OdriveOptions.
        model: the motor's model, with its gear ratio.
        runtime: the runtime in which the motor waits.

    Raises:
        UsageError: a setting is unknown, missing, or wrong.
    """
    own = read_settings(OdriveMotorTable, settings)
    hardware, give_back = _SHARED.on_can(
        OdriveHwMotor, bus, own.node_id, runtime, own.part(OdriveOptions)
    )
    return OdriveMotor(
        hardware,
        model,
        name=own.name,
        on_close=give_back,
    )
