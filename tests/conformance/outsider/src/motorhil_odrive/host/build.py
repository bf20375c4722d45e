"""Builder of an ODrive motor; entry point `motorhil.adaptations`, name `odrive`."""

from collections.abc import Mapping
from dataclasses import fields
from typing import TYPE_CHECKING, Final

from motorhil.motorapi.adaptations.registration import Shared, as_name, number, refuse_unknown
from motorhil.motorapi.errors import UsageError

from motorhil_odrive.host.hardware import OdriveHwMotor
from motorhil_odrive.host.motor import OdriveMotor
from motorhil_odrive.host.options import OdriveOptions

if TYPE_CHECKING:
    import can
    from motorhil.motorapi.model import MotorModel
    from motorhil.motorapi.runtime.api import Runtime

_OPTIONS: Final = tuple(field.name for field in fields(OdriveOptions))
_SHARED: Final[Shared[OdriveHwMotor]] = Shared("drive")


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
    refuse_unknown(settings, ("name", "node_id", *_OPTIONS), "setting of an odrive motor")
    node_id = settings.get("node_id")
    if not isinstance(node_id, int) or isinstance(node_id, bool):
        raise UsageError(f"node_id = {node_id!r}: must be the drive's node-ID, 0 to 62")
    given = {key: number(key, settings[key]) for key in _OPTIONS if key in settings}
    options = OdriveOptions(**given)
    hardware = _SHARED.get(
        bus,
        node_id,
        lambda: OdriveHwMotor(bus, node_id, runtime=runtime, options=options),
        lambda built: built.options == options,
    )
    return OdriveMotor(
        hardware,
        model,
        name=as_name(settings.get("name")),
        on_close=lambda: _SHARED.give_back(hardware),
    )


build.conformance_rig = "../rig.toml"  # type: ignore[attr-defined]  # a plugin's mark
