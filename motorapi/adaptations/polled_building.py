"""What the `build` of each kind of polled drive does: a table of settings becomes hardware."""

from collections.abc import Callable, Mapping
from typing import TYPE_CHECKING, Final, Protocol, TypeVar

from motorapi.adaptations.building import Shared, number, refuse_unknown
from motorapi.errors import UsageError

if TYPE_CHECKING:
    from motorapi.adaptations.modbus_line import ByteLine
    from motorapi.adaptations.modbus_unit import ModbusUnit

BUS_KINDS: Final = ("modbus_rtu", "modbus_tcp")
"""The `bus_kinds` of a `build` for drives on Modbus: what rigs may put them on."""
_KEYS: Final = ("name", "unit", "timeout_s")
_TIMEOUT_S: Final = 0.2


class ModbusHardware(Protocol):
    """A hardware object of a Modbus drive, as far as building it goes."""

    users: int

    @property
    def registers(self) -> "ModbusUnit":
        """Its registers."""

    @property
    def label(self) -> str:
        """Its name for people."""

    @property
    def is_closed(self) -> bool:
        """Whether it can be used no more."""

    def close(self) -> None:
        """It is used no more."""


ModbusHardwareT = TypeVar("ModbusHardwareT", bound=ModbusHardware)


def shared_hardware(
    shared: Shared[ModbusHardwareT],
    line: "ByteLine",
    settings: Mapping[str, object],
    kind: str,
    make: Callable[[int, float], ModbusHardwareT],
) -> ModbusHardwareT:
    """The hardware object that a table of settings describes, with one user more.

    Args:
        shared: those of this kind that there are.
        line: the line that the drive is on.
        settings: `unit`; `name`; `timeout_s`, for an answer [s].
        kind: what messages call the kind of motor: "a leadshine motor".
        make: makes one, of its server address and timeout [s].

    Raises:
        UsageError: a setting is unknown, missing, or wrong.
    """
    refuse_unknown(settings, _KEYS, f"setting of {kind}")
    unit = settings.get("unit")
    if not isinstance(unit, int) or isinstance(unit, bool):
        raise UsageError(f"unit = {unit!r}: must be a server address, 1 to 247")
    timeout_s = number("timeout_s", settings.get("timeout_s", _TIMEOUT_S))
    if not 0.001 <= timeout_s <= 60.0:
        raise UsageError(f"timeout_s = {timeout_s:g}: must be 0.001 to 60 s")
    return shared.get(
        (id(line), unit),
        lambda: make(unit, timeout_s),
        lambda built: built.registers.timeout_s == timeout_s,
    )
