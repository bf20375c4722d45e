"""The adaptation of the motor interface to AZ drives (Oriental Motor).

| command                                  | what the drive is told                             |
| ---------------------------------------- | -------------------------------------------------- |
| set-point or simple trajectory, position | operation type 1, absolute; one request starts it  |
| set-point or simple trajectory, velocity | operation type 16, continuous                      |
| stop, halt, quick stop                   | operation type 0, with the ramp of the motion      |
| homing                                   | here is 0 (35, 37); its encoder is absolute        |
"""

from collections.abc import Mapping
from typing import TYPE_CHECKING, Final, final

from motorapi.adaptations.building import Shared, as_name, number, refuse_unknown
from motorapi.adaptations.oriental_hardware import OrientalAzHwMotor
from motorapi.adaptations.polled_motor import PolledMotor
from motorapi.errors import UsageError

if TYPE_CHECKING:
    from motorapi.adaptations.modbus_line import ByteLine
    from motorapi.model import MotorModel
    from motorapi.runtime import Runtime

__all__ = ["OrientalAzHwMotor", "OrientalAzMotor", "build"]

_KEYS: Final = ("name", "unit", "timeout_s")
_TIMEOUT_S: Final = 0.2
_SHARED: Final[Shared[OrientalAzHwMotor]] = Shared("drive")


@final
class OrientalAzMotor(PolledMotor):
    """A logical motor on an AZ drive. Any number of them may share one hardware object."""

    @property
    def hardware(self) -> OrientalAzHwMotor:
        """The drive, with all it is able to do."""
        assert isinstance(self._polled, OrientalAzHwMotor)
        return self._polled


def build(
    bus: "ByteLine", settings: Mapping[str, object], model: "MotorModel", runtime: "Runtime"
) -> OrientalAzMotor:
    """The motor that a table of settings describes (entry point `motorhil.adaptations`).

    Args:
        bus: the line that the drive is on.
        settings: `unit`; `name` (None: the model's); `timeout_s`, for an answer [s].
        model: the motor's; its gear ratio must be given.
        runtime: where it waits.

    Raises:
        UsageError: a setting is unknown, missing, or wrong.
    """
    refuse_unknown(settings, _KEYS, "setting of an oriental_az motor")
    unit = settings.get("unit")
    if not isinstance(unit, int) or isinstance(unit, bool):
        raise UsageError(f"unit = {unit!r}: must be a server address, 1 to 247")
    timeout_s = number("timeout_s", settings.get("timeout_s", _TIMEOUT_S))
    if not 0.001 <= timeout_s <= 60.0:
        raise UsageError(f"timeout_s = {timeout_s:g}: must be 0.001 to 60 s")
    hardware = _SHARED.get(
        (id(bus), unit),
        lambda: OrientalAzHwMotor(bus, unit, runtime=runtime, timeout_s=timeout_s),
        lambda built: built.registers.timeout_s == timeout_s,
    )
    return OrientalAzMotor(
        hardware,
        model,
        name=as_name(settings.get("name")),
        on_close=lambda: _SHARED.give_back(hardware),
    )


build.bus_kinds = ("modbus_rtu", "modbus_tcp")  # type: ignore[attr-defined]  # a plugin's mark
