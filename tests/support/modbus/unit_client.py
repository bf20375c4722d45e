"""pymodbus' client calls on a line of motorapi."""

from typing import Final, final

from pymodbus.client.mixin import ModbusClientMixin
from pymodbus.pdu import ModbusPDU

from motorhil.motorapi.adaptations.modbus.client import ModbusLine


@final
class UnitClient(ModbusClientMixin[ModbusPDU]):
    """pymodbus' client calls for one unit of a line, blocking in the runtime."""

    def __init__(self, line: ModbusLine, unit: int, timeout_s: float) -> None:
        super().__init__()  # type: ignore[no-untyped-call]  # pymodbus'
        self.line: Final = line
        self.unit: Final = unit
        self.timeout_s: Final = timeout_s

    def execute(self, no_response_expected: bool, request: ModbusPDU) -> ModbusPDU:
        """Send a request and return its answer; raises as `ModbusLine.ask`."""
        return self.line.ask(request, self.unit, self.timeout_s)
