"""The registers of one Modbus drive."""

from typing import TYPE_CHECKING, ClassVar, final

from pymodbus.pdu.register_message import (
    ReadHoldingRegistersRequest,
    WriteMultipleRegistersRequest,
    WriteSingleRegisterRequest,
)

from motorhil.motorapi.adaptations.modbus.client import ModbusExchange, ModbusLine
from motorhil.motorapi.api.line_unit import LineUnit

if TYPE_CHECKING:
    from pymodbus.pdu import ModbusPDU

    from motorhil.motorapi.api.line_exchanges import ByteLine


@final
class ModbusUnit(LineUnit["ModbusPDU", "ModbusPDU"]):
    """The registers of one unit, and the record of its motor."""

    LINE: ClassVar[type[ModbusLine]] = ModbusLine

    def _units(self, line: "ByteLine") -> range:
        return range(1, 256 if line.framing == "tcp" else 248)  # 255: the only unit there

    def read(self, address: int, count: int = 1) -> list[int]:
        """Return the contents of holding registers, 0 to FFFFh each.

        Raises: as `LineUnit.ask_repeatedly`.
        """
        return list(self.ask_repeatedly(lambda: _read(address, count)).registers)

    def first_read(self, address: int, patience_s: float) -> int:
        """Return one register of a drive that may still be booting; repeat until it answers.

        Raises: as `LineUnit.ask_patiently`.
        """
        return self.ask_patiently(lambda: _read(address, 1), patience_s).registers[0]

    def read_i32(self, address: int) -> int:
        """Return a signed 32-bit value, upper register first."""
        return as_i32(*self.read(address, 2))

    def write(self, address: int, *values: int, starts: bool = False) -> None:
        """Write holding registers from `address` on; a single one by function 06h.

        Raises: as `LineUnit.command`.
        """
        self.command(_write(address, values), starts=starts)

    def post(self, address: int, *values: int) -> ModbusExchange:
        """Write without waiting and without owning the motor: for stops."""
        return self.post_request(_write(address, values))


def _read(address: int, count: int) -> "ModbusPDU":
    return ReadHoldingRegistersRequest(address=address, count=count)


def _write(address: int, values: tuple[int, ...]) -> "ModbusPDU":
    registers = [value & 0xFFFF for value in values]
    if len(values) == 1:
        return WriteSingleRegisterRequest(address=address, registers=registers)
    return WriteMultipleRegistersRequest(address=address, registers=registers)


def as_i32(upper: int, lower: int) -> int:
    """Return the signed number in two registers."""
    value = upper << 16 | lower
    return value - (1 << 32) if value & 0x8000_0000 else value


def words(*values: int) -> tuple[int, ...]:
    """Return 32-bit numbers as registers, upper half first."""
    return tuple(half for value in values for half in (value >> 16 & 0xFFFF, value & 0xFFFF))
