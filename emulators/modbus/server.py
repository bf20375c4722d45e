"""A Modbus server: from request PDU to response PDU. Sans-I/O.

The checks have the specification's order: function supported (01), quantity and value valid (03),
addresses exist (02). Only then the request is executed (04 and others, if the controller refuses).
A request whose length does not match its function has a wrong value (03).

Source: MODBUS Application Protocol Specification V1.1b3, section 6 and its state diagrams.
"""

from collections.abc import Callable, Sequence
from typing import Final, final

from emulators.modbus import codes
from emulators.modbus.codes import (
    ERROR,
    ILLEGAL_DATA_ADDRESS,
    ILLEGAL_DATA_VALUE,
    ILLEGAL_FUNCTION,
    OK,
)
from emulators.modbus.diagnostics import Diagnostics
from emulators.modbus.identification import Identification
from emulators.modbus.registers import BitBank, RegisterBank

NO_RESPONSE: Final = b""

_Handler = Callable[[bytes], bytes]
_WRITES: Final = (
    codes.WRITE_SINGLE_COIL,
    codes.WRITE_SINGLE_REGISTER,
    codes.WRITE_MULTIPLE_COILS,
    codes.WRITE_MULTIPLE_REGISTERS,
    codes.MASK_WRITE_REGISTER,
)
"""The functions that may be broadcast: those that only write."""


@final
class ModbusServer:
    """A server that responds to the requests to one unit.

    Args:
        holding, inputs: registers; None: neither these nor their functions are supported.
        coils, discretes: bits, likewise.
        identification: its identification; None: functions 11h and 2Bh are not supported.
        diagnostics: the counters of a serial line; None: function 08h is not supported (TCP).
        functions: the function codes that this device supports; None: all possible ones.

    Attributes:
        run_indicator: the run indicator in function 11h: whether the controller is on.
    """

    def __init__(
        self,
        holding: RegisterBank | None = None,
        inputs: RegisterBank | None = None,
        coils: BitBank | None = None,
        discretes: BitBank | None = None,
        identification: Identification | None = None,
        diagnostics: Diagnostics | None = None,
        functions: Sequence[int] | None = None,
    ) -> None:
        self.holding: Final = holding
        self.inputs: Final = inputs
        self.coils: Final = coils
        self.discretes: Final = discretes
        self.identification: Final = identification
        self.diagnostics: Final = diagnostics
        self.run_indicator = True
        handlers: dict[int, _Handler] = {}
        if coils is not None:
            handlers[codes.READ_COILS] = self._read_coils
            handlers[codes.WRITE_SINGLE_COIL] = self._write_coil
            handlers[codes.WRITE_MULTIPLE_COILS] = self._write_coils
        if discretes is not None:
            handlers[codes.READ_DISCRETE_INPUTS] = self._read_discretes
        if holding is not None:
            handlers[codes.READ_HOLDING_REGISTERS] = self._read_holding
            handlers[codes.WRITE_SINGLE_REGISTER] = self._write_register
            handlers[codes.WRITE_MULTIPLE_REGISTERS] = self._write_registers
            handlers[codes.MASK_WRITE_REGISTER] = self._mask_write
            handlers[codes.READ_WRITE_MULTIPLE_REGISTERS] = self._read_write
        if inputs is not None:
            handlers[codes.READ_INPUT_REGISTERS] = self._read_inputs
        if diagnostics is not None:
            handlers[codes.DIAGNOSTICS] = diagnostics.respond
        if identification is not None:
            handlers[codes.REPORT_SERVER_ID] = self._report_server_id
            handlers[codes.ENCAPSULATED_INTERFACE] = identification.respond
        if functions is not None:
            handlers = {code: handler for code, handler in handlers.items() if code in functions}
        self._handlers: Final = handlers

    def functions(self) -> list[int]:
        """Return the supported function codes."""
        return sorted(self._handlers)

    def respond(self, request: bytes) -> bytes:
        """Return the response PDU to a request PDU; `NO_RESPONSE` if there is none."""
        diagnostics = self.diagnostics
        if diagnostics is not None:
            diagnostics.server_messages += 1
            if diagnostics.listens_only and not diagnostics.restarts(request):
                diagnostics.no_responses += 1
                return NO_RESPONSE
        if not request:
            return NO_RESPONSE  # without a function code to respond to
        handler = self._handlers.get(request[0])
        if handler is None:
            response = bytes((request[0] | ERROR, ILLEGAL_FUNCTION))
        else:
            response = handler(request)
        if diagnostics is not None:
            if not response:
                diagnostics.no_responses += 1
            elif response[0] & ERROR:
                diagnostics.exceptions += 1
        return response

    def broadcast(self, request: bytes) -> None:
        """Execute a request to all units if it only writes; there is no response."""
        diagnostics = self.diagnostics
        if diagnostics is not None:
            diagnostics.server_messages += 1
            diagnostics.no_responses += 1
            if diagnostics.listens_only and not diagnostics.restarts(request):
                return
        if request and (request[0] in _WRITES or request[0] == codes.DIAGNOSTICS):
            handler = self._handlers.get(request[0])
            if handler is not None:
                handler(request)

    # ---- bits ----

    def _read_coils(self, request: bytes) -> bytes:
        assert self.coils is not None
        return _read_bits(request, self.coils)

    def _read_discretes(self, request: bytes) -> bytes:
        assert self.discretes is not None
        return _read_bits(request, self.discretes)

    def _write_coil(self, request: bytes) -> bytes:
        coils = self.coils
        assert coils is not None
        if len(request) != 5 or request[3:] not in (b"\x00\x00", b"\xff\x00"):
            return _refused(request, ILLEGAL_DATA_VALUE)
        address = int.from_bytes(request[1:3], "big")
        if not coils.has(address, 1):
            return _refused(request, ILLEGAL_DATA_ADDRESS)
        failed = coils.write(address, 1, b"\x01" if request[3] else b"\x00")
        return _refused(request, failed) if failed else request

    def _write_coils(self, request: bytes) -> bytes:
        coils = self.coils
        assert coils is not None
        if len(request) < 6:
            return _refused(request, ILLEGAL_DATA_VALUE)
        count = int.from_bytes(request[3:5], "big")
        size = request[5]
        right = 1 <= count <= codes.WRITE_BITS_MAX and size == (count + 7) // 8
        if not right or len(request) != 6 + size:
            return _refused(request, ILLEGAL_DATA_VALUE)
        address = int.from_bytes(request[1:3], "big")
        if not coils.has(address, count):
            return _refused(request, ILLEGAL_DATA_ADDRESS)
        failed = coils.write(address, count, request[6:])
        return _refused(request, failed) if failed else request[:5]

    # ---- registers ----

    def _read_holding(self, request: bytes) -> bytes:
        assert self.holding is not None
        return _read_registers(request, self.holding)

    def _read_inputs(self, request: bytes) -> bytes:
        assert self.inputs is not None
        return _read_registers(request, self.inputs)

    def _write_register(self, request: bytes) -> bytes:
        bank = self.holding
        assert bank is not None
        if len(request) != 5:
            return _refused(request, ILLEGAL_DATA_VALUE)
        address = int.from_bytes(request[1:3], "big")
        if not bank.can_write(address, 1):
            return _refused(request, ILLEGAL_DATA_ADDRESS)
        failed = bank.write(address, request[3:])
        return _refused(request, failed) if failed else request

    def _write_registers(self, request: bytes) -> bytes:
        bank = self.holding
        assert bank is not None
        if len(request) < 6:
            return _refused(request, ILLEGAL_DATA_VALUE)
        count = int.from_bytes(request[3:5], "big")
        size = request[5]
        right = 1 <= count <= codes.WRITE_REGISTERS_MAX and size == 2 * count
        if not right or len(request) != 6 + size:
            return _refused(request, ILLEGAL_DATA_VALUE)
        address = int.from_bytes(request[1:3], "big")
        if not bank.can_write(address, count):
            return _refused(request, ILLEGAL_DATA_ADDRESS)
        failed = bank.write(address, request[6:])
        return _refused(request, failed) if failed else request[:5]

    def _mask_write(self, request: bytes) -> bytes:
        bank = self.holding
        assert bank is not None
        if len(request) != 7:
            return _refused(request, ILLEGAL_DATA_VALUE)
        address = int.from_bytes(request[1:3], "big")
        if not bank.can_write(address, 1) or not bank.can_read(address, 1):
            return _refused(request, ILLEGAL_DATA_ADDRESS)
        present = int.from_bytes(bank.read(address, 1), "big")
        keep = int.from_bytes(request[3:5], "big")
        put = int.from_bytes(request[5:7], "big")
        value = present & keep | put & ~keep & 0xFFFF
        failed = bank.write(address, value.to_bytes(2, "big"))
        return _refused(request, failed) if failed else request

    def _read_write(self, request: bytes) -> bytes:
        bank = self.holding
        assert bank is not None
        if len(request) < 10:
            return _refused(request, ILLEGAL_DATA_VALUE)
        reads = int.from_bytes(request[3:5], "big")
        writes = int.from_bytes(request[7:9], "big")
        size = request[9]
        right = 1 <= reads <= codes.READ_REGISTERS_MAX
        right = right and 1 <= writes <= codes.READ_WRITE_WRITE_MAX and size == 2 * writes
        if not right or len(request) != 10 + size:
            return _refused(request, ILLEGAL_DATA_VALUE)
        read_at = int.from_bytes(request[1:3], "big")
        write_at = int.from_bytes(request[5:7], "big")
        if not bank.can_read(read_at, reads) or not bank.can_write(write_at, writes):
            return _refused(request, ILLEGAL_DATA_ADDRESS)
        failed = bank.write(write_at, request[10:])
        if failed:
            return _refused(request, failed)
        return bytes((request[0], 2 * reads)) + bank.read(read_at, reads)

    def _report_server_id(self, request: bytes) -> bytes:
        assert self.identification is not None
        if len(request) != 1:
            return _refused(request, ILLEGAL_DATA_VALUE)
        said = self.identification.server_id + (b"\xff" if self.run_indicator else b"\x00")
        return bytes((request[0], len(said))) + said


def _read_bits(request: bytes, bank: BitBank) -> bytes:
    count = int.from_bytes(request[3:5], "big")
    if len(request) != 5 or not 1 <= count <= codes.READ_BITS_MAX:
        return _refused(request, ILLEGAL_DATA_VALUE)
    address = int.from_bytes(request[1:3], "big")
    if not bank.has(address, count):
        return _refused(request, ILLEGAL_DATA_ADDRESS)
    data = bank.read(address, count)
    return bytes((request[0], len(data))) + data


def _read_registers(request: bytes, bank: RegisterBank) -> bytes:
    count = int.from_bytes(request[3:5], "big")
    if len(request) != 5 or not 1 <= count <= codes.READ_REGISTERS_MAX:
        return _refused(request, ILLEGAL_DATA_VALUE)
    address = int.from_bytes(request[1:3], "big")
    if not bank.can_read(address, count):
        return _refused(request, ILLEGAL_DATA_ADDRESS)
    return bytes((request[0], 2 * count)) + bank.read(address, count)


def _refused(request: bytes, code: int) -> bytes:
    assert code != OK
    return bytes((request[0] | ERROR, code))
