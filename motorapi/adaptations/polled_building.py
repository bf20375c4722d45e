"""Shared part of the `build` functions of polled drives."""

from collections.abc import Callable, Mapping
from typing import TYPE_CHECKING, Final, Protocol, TypeVar

from motorapi.adaptations.building import Shared, number, refuse_unknown
from motorapi.errors import UsageError

if TYPE_CHECKING:
    from motorapi.adaptations.modbus_line import ByteLine
    from motorapi.adaptations.modbus_unit import ModbusUnit

BUS_KINDS: Final = ("modbus_rtu", "modbus_tcp")
"""The `bus_kinds` of a `build` for Modbus drives: the kinds of bus they may be on."""
_KEYS: Final = ("name", "unit", "timeout_s")
_TIMEOUT_S: Final = 0.2


class ModbusHardware(Protocol):
    """A hardware object of a Modbus drive, as far as building is concerned."""

    users: int

    @property
    def registers(self) -> "ModbusUnit":
        """The registers of the drive."""

    @property
    def label(self) -> str:
        """The name of the hardware in messages."""

    @property
    def is_closed(self) -> bool:
        """True if the hardware is closed."""

    def close(self) -> None:
        """Close the hardware; no motor can use it afterwards."""


ModbusHardwareT = TypeVar("ModbusHardwareT", bound=ModbusHardware)


def shared_hardware(
    shared: Shared[ModbusHardwareT],
    line: "ByteLine",
    settings: Mapping[str, object],
    kind: str,
    make: Callable[[int, float], ModbusHardwareT],
) -> ModbusHardwareT:
    """Return the hardware object described by a settings table, and count one more user.

    Args:
        shared: the existing hardware objects of this kind.
        line: the line of the drive.
        settings: `unit`; `name`; `timeout_s`, the response timeout [s].
        kind: the kind of motor in messages: "a leadshine motor".
        make: makes a hardware object from its server address and timeout [s].

    Raises:
        UsageError: a setting is unknown, missing or invalid.
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
