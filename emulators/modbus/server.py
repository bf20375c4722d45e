"""A Modbus server: from request PDU to response PDU. Sans-I/O.

The checks have the specification's order: function supported (01), quantity and value valid (03),
addresses exist (02). Only then the request is executed (04 and others, if the controller refuses).
A request whose length does not match its function has a wrong value (03).

`Diagnostics` is function 08h of a server on a serial line. Counters have 16 bits and wrap around.
Messages and communication errors are those of the whole line; every listener counts them.
`Identification` is functions 11h (report server ID) and 2Bh/0Eh.

Source: MODBUS Application Protocol Specification V1.1b3, section 6 and its state diagrams; 6.8
(diagnostics); 6.13, 6.19 and 6.21 (identification).
"""

from collections.abc import Callable, Mapping, Sequence
from functools import partial
from typing import Final, final

from motorhil.emulators.modbus import codes
from motorhil.emulators.modbus.codes import (
    DIAGNOSTICS,
    ENCAPSULATED_INTERFACE,
    ERROR,
    ILLEGAL_DATA_ADDRESS,
    ILLEGAL_DATA_VALUE,
    ILLEGAL_FUNCTION,
    OK,
    PDU_MAX,
)
from motorhil.emulators.modbus.registers import BitBank, RegisterBank

NO_RESPONSE: Final = b""
_WRITES: Final = (
    codes.WRITE_SINGLE_COIL,
    codes.WRITE_SINGLE_REGISTER,
    codes.WRITE_MULTIPLE_COILS,
    codes.WRITE_MULTIPLE_REGISTERS,
    codes.MASK_WRITE_REGISTER,
)
"""The functions that may be broadcast: those that only write."""
_QUERY_DATA: Final = 0x00
_RESTART: Final = 0x01
_REGISTER: Final = 0x02
_LISTEN_ONLY: Final = 0x04
_CLEAR: Final = 0x0A
_CLEAR_OVERRUN: Final = 0x14
_KEEP_LOG: Final = b"\x00\x00"
_CLEAR_LOG: Final = b"\xff\x00"
READ_DEVICE_IDENTIFICATION: Final = 0x0E
VENDOR_NAME: Final = 0x00
PRODUCT_CODE: Final = 0x01
REVISION: Final = 0x02
_BASIC_END: Final = 0x03
_REGULAR_END: Final = 0x80
_STREAMS: Final = {1: _BASIC_END, 2: _REGULAR_END, 3: 0x100}
_INDIVIDUAL: Final = 4
_HEAD: Final = 7
_RANGE: Final = 5  # bytes: function, address, quantity


@final
class Diagnostics:
    """The counters of one unit, and its listen-only state.

    Attributes:
        bus_messages: messages on the line with a correct checksum.
        bus_errors: messages with a wrong checksum.
        exceptions: exception responses of this unit.
        server_messages: messages to this unit, or to all.
        no_responses: those of them without a response.
        overruns: characters that came faster than they could be read.
        listens_only: the unit does not respond until it is restarted.
        restarts_counted: number of communication restarts since power-on.
    """

    def __init__(self) -> None:
        self.power_on()

    def power_on(self) -> None:
        """Begin anew with power."""
        self.restarts_counted: int = 0
        self.begin()

    def begin(self) -> None:
        """Restart communication: clear the counters and leave listen-only."""
        self.clear()
        self.listens_only: bool = False

    def clear(self) -> None:
        """Clear the counters."""
        self.bus_messages = 0
        self.bus_errors = 0
        self.exceptions = 0
        self.server_messages = 0
        self.no_responses = 0
        self.overruns: int = 0

    def restarts(self, request: bytes) -> bool:
        """Return whether the request ends the listen-only state."""
        return len(request) == 5 and request[:3] == bytes((DIAGNOSTICS, 0, _RESTART))

    def respond(self, request: bytes) -> bytes:
        """Return the response PDU, or b"" for no response."""
        if len(request) < 3:
            return bytes((DIAGNOSTICS | ERROR, ILLEGAL_DATA_VALUE))
        what = int.from_bytes(request[1:3], "big")
        data = request[3:]
        if what == _QUERY_DATA:
            # any number of words is returned unchanged
            return request if data and not len(data) % 2 else self._refused(ILLEGAL_DATA_VALUE)
        if what == _RESTART:
            if data not in (_KEEP_LOG, _CLEAR_LOG):
                return self._refused(ILLEGAL_DATA_VALUE)
            listened = self.listens_only
            self.begin()
            self.restarts_counted += 1
            return b"" if listened else request
        counters = {
            _REGISTER: 0,
            0x0B: self.bus_messages,
            0x0C: self.bus_errors,
            0x0D: self.exceptions,
            0x0E: self.server_messages,
            0x0F: self.no_responses,
            0x10: 0,  # "negative acknowledge" is never sent
            0x11: 0,  # nor "busy"
            0x12: self.overruns,
        }
        if what not in counters and what not in (_LISTEN_ONLY, _CLEAR, _CLEAR_OVERRUN):
            return self._refused(ILLEGAL_FUNCTION)
        if data != b"\x00\x00":
            return self._refused(ILLEGAL_DATA_VALUE)
        if what == _LISTEN_ONLY:
            self.listens_only = True
            return b""
        if what == _CLEAR:
            self.clear()
            return request
        if what == _CLEAR_OVERRUN:
            self.overruns = 0
            return request
        return request[:3] + (counters[what] & 0xFFFF).to_bytes(2, "big")

    def _refused(self, code: int) -> bytes:
        return bytes((DIAGNOSTICS | ERROR, code))


@final
class Identification:
    """The objects of one server: text by object id.

    Args:
        objects: vendor name (0), product code (1) and revision (2) at least; 3 to 7Fh are of the
            standard's regular category, 80h to FFh the vendor's own.
        server_id: the beginning of the response to function 11h.

    Raises:
        ValueError: one of the three is missing, an id is out of range, or a text too long.
    """

    def __init__(self, objects: Mapping[int, str], server_id: bytes = b"\x01") -> None:
        self.server_id: Final = server_id
        self._objects = {number: objects[number].encode("ascii") for number in sorted(objects)}
        if any(number not in self._objects for number in (VENDOR_NAME, PRODUCT_CODE, REVISION)):
            raise ValueError(
                "identification: objects 0, 1 and 2 (vendor, product code, revision) are required"
            )
        for number, text in self._objects.items():
            if not 0 <= number <= 0xFF or len(text) > PDU_MAX - _HEAD - 2:
                raise ValueError(
                    f"object {number:X}h, {len(text)} bytes: invalid; expected 0 "
                    "to FFh and at most 244 bytes"
                )
        highest = max(self._objects)
        level = 1 if highest < _BASIC_END else 2 if highest < _REGULAR_END else 3
        self._conformity = 0x80 | level  # individual access as well

    def respond(self, request: bytes) -> bytes:
        """Return the response PDU."""
        if len(request) < 2 or request[1] != READ_DEVICE_IDENTIFICATION:
            return _identification_refused(ILLEGAL_FUNCTION)
        if len(request) != 4:
            return _identification_refused(ILLEGAL_DATA_VALUE)
        code, first = request[2], request[3]
        if code == _INDIVIDUAL:
            if first not in self._objects:
                return _identification_refused(ILLEGAL_DATA_ADDRESS)
            return self._answer(code, [first], 0)
        if code not in _STREAMS:
            return _identification_refused(ILLEGAL_DATA_VALUE)
        end = min(_STREAMS[code], _STREAMS[self._conformity & 0x7F])
        known = [number for number in self._objects if number < end]
        if first not in known:
            first = 0  # the standard: start with the first object
        wanted = [number for number in known if number >= first]
        fitting: list[int] = []
        size = _HEAD
        for number in wanted:
            size += 2 + len(self._objects[number])
            if size > PDU_MAX:
                return self._answer(code, fitting, number)
            fitting.append(number)
        return self._answer(code, fitting, 0)

    def _answer(self, code: int, numbers: list[int], following: int) -> bytes:
        head = bytes(
            (
                *(ENCAPSULATED_INTERFACE, READ_DEVICE_IDENTIFICATION, code, self._conformity),
                *(0xFF if following else 0x00, following, len(numbers)),
            )
        )
        parts = (bytes((n, len(self._objects[n]))) + self._objects[n] for n in numbers)
        return head + b"".join(parts)


def _identification_refused(code: int) -> bytes:
    return bytes((ENCAPSULATED_INTERFACE | ERROR, code))


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
        handlers: dict[int, Callable[[bytes], bytes]] = {}
        if coils is not None:
            handlers[codes.READ_COILS] = partial(_read_bits, coils)
            handlers[codes.WRITE_SINGLE_COIL] = self._write_coil
            handlers[codes.WRITE_MULTIPLE_COILS] = self._write_coils
        if discretes is not None:
            handlers[codes.READ_DISCRETE_INPUTS] = partial(_read_bits, discretes)
        if holding is not None:
            handlers[codes.READ_HOLDING_REGISTERS] = partial(_read_registers, holding)
            handlers[codes.WRITE_SINGLE_REGISTER] = self._write_register
            handlers[codes.WRITE_MULTIPLE_REGISTERS] = self._write_registers
            handlers[codes.MASK_WRITE_REGISTER] = self._mask_write
            handlers[codes.READ_WRITE_MULTIPLE_REGISTERS] = self._read_write
        if inputs is not None:
            handlers[codes.READ_INPUT_REGISTERS] = partial(_read_registers, inputs)
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


def _read_bits(bank: BitBank, request: bytes) -> bytes:
    count = int.from_bytes(request[3:5], "big")
    if len(request) != 5 or not 1 <= count <= codes.READ_BITS_MAX:
        return _refused(request, ILLEGAL_DATA_VALUE)
    address = int.from_bytes(request[1:3], "big")
    if not bank.has(address, count):
        return _refused(request, ILLEGAL_DATA_ADDRESS)
    data = bank.read(address, count)
    return bytes((request[0], len(data))) + data


def _read_registers(bank: RegisterBank, request: bytes) -> bytes:
    if len(request) != _RANGE:
        return _refused(request, ILLEGAL_DATA_VALUE)
    address = request[1] << 8 | request[2]
    count = request[3] << 8 | request[4]
    if not 1 <= count <= codes.READ_REGISTERS_MAX:
        return _refused(request, ILLEGAL_DATA_VALUE)
    if not bank.can_read(address, count):
        return _refused(request, ILLEGAL_DATA_ADDRESS)
    return bytes((request[0], 2 * count)) + bank.read(address, count)


def _refused(request: bytes, code: int) -> bytes:
    assert code != OK
    return bytes((request[0] | ERROR, code))
