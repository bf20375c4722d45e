"""Server identification: functions 11h (report server ID) and 2Bh/0Eh.

Source: MODBUS Application Protocol Specification V1.1b3, sections 6.13, 6.19 and 6.21.
"""

from collections.abc import Mapping
from typing import Final, final

from emulators.modbus.codes import (
    ENCAPSULATED_INTERFACE,
    ERROR,
    ILLEGAL_DATA_ADDRESS,
    ILLEGAL_DATA_VALUE,
    ILLEGAL_FUNCTION,
    PDU_MAX,
)

READ_DEVICE_IDENTIFICATION: Final = 0x0E
VENDOR_NAME: Final = 0x00
PRODUCT_CODE: Final = 0x01
REVISION: Final = 0x02
_BASIC_END: Final = 0x03
_REGULAR_END: Final = 0x80
_STREAMS: Final = {1: _BASIC_END, 2: _REGULAR_END, 3: 0x100}
_INDIVIDUAL: Final = 4
_HEAD: Final = 7


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
            return _refused(ILLEGAL_FUNCTION)
        if len(request) != 4:
            return _refused(ILLEGAL_DATA_VALUE)
        code, first = request[2], request[3]
        if code == _INDIVIDUAL:
            if first not in self._objects:
                return _refused(ILLEGAL_DATA_ADDRESS)
            return self._answer(code, [first], 0)
        if code not in _STREAMS:
            return _refused(ILLEGAL_DATA_VALUE)
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


def _refused(code: int) -> bytes:
    return bytes((ENCAPSULATED_INTERFACE | ERROR, code))
