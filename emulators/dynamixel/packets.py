"""Packets of Dynamixel Protocol 2.0: checksum, byte stuffing, and a receiver. Sans-I/O.

  FF FF FD 00, id, length (2), instruction, parameters, CRC (2); numbers are little-endian

The length counts from the instruction to the CRC, after stuffing. Stuffing inserts FD after each
FF FF FD from the instruction to the last parameter. The CRC-16 (polynomial 8005h, not reflected)
is over all bytes before it. Packets are delimited by their length, so an unstuffed FF FF FD in the
parameters is data.

Source: the maker's manual of Protocol 2.0.
"""

from collections.abc import Iterator
from enum import IntEnum
from typing import Final, NamedTuple, final

BROADCAST: Final = 0xFE
STATUS: Final = 0x55
ID_MAX: Final = 252
HEADER: Final = b"\xff\xff\xfd\x00"
_MARK: Final = HEADER[:3]
_HEAD: Final = 7  # bytes up to the length
_LEAST: Final = 3  # instruction and CRC
_MOST: Final = 1024
_GAP_NS: Final = 1_500_000


@final
class Instruction(IntEnum):
    """The instructions of the X series."""

    PING = 0x01
    READ = 0x02
    WRITE = 0x03
    REG_WRITE = 0x04
    ACTION = 0x05
    FACTORY_RESET = 0x06
    REBOOT = 0x08
    CLEAR = 0x10
    BACKUP = 0x20
    SYNC_READ = 0x82
    SYNC_WRITE = 0x83
    FAST_SYNC_READ = 0x8A
    BULK_READ = 0x92
    BULK_WRITE = 0x93
    FAST_BULK_READ = 0x9A


@final
class Error(IntEnum):
    """The error of a status; the alert bit may be added."""

    NONE = 0
    RESULT_FAIL = 1
    INSTRUCTION = 2
    CRC = 3
    DATA_RANGE = 4
    DATA_LENGTH = 5
    DATA_LIMIT = 6
    ACCESS = 7


ALERT: Final = 0x80


@final
class Packet(NamedTuple):
    """A received packet; `parameters` without stuffing."""

    unit: int
    instruction: int
    parameters: bytes


def _table() -> tuple[int, ...]:
    table = []
    for byte in range(256):
        crc = byte << 8
        for _ in range(8):
            crc = (crc << 1 ^ (0x8005 if crc & 0x8000 else 0)) & 0xFFFF
        table.append(crc)
    return tuple(table)


_TABLE: Final = _table()


def crc16(data: bytes) -> bytes:
    """Return the two CRC bytes that follow these bytes."""
    crc = 0
    for byte in data:
        crc = (crc << 8 & 0xFFFF) ^ _TABLE[crc >> 8 ^ byte]
    return crc.to_bytes(2, "little")


def packet(unit: int, instruction: int, parameters: bytes = b"") -> bytes:
    """Return a packet, stuffed and with its CRC."""
    body = (bytes((instruction,)) + parameters).replace(_MARK, _MARK + b"\xfd")
    data = HEADER + bytes((unit,)) + (len(body) + 2).to_bytes(2, "little") + body
    return data + crc16(data)


def status(unit: int, error: int, parameters: bytes = b"") -> bytes:
    """Return a status packet."""
    return packet(unit, STATUS, bytes((error,)) + parameters)


@final
class Receiver:
    """The bytes on the line, cut into packets.

    Attributes:
        invalid: number of packets with a wrong CRC.
        dropped: number of beginnings of packets before a pause of more than 1.5 ms.
    """

    def __init__(self) -> None:
        self.invalid: int = 0
        self.dropped: int = 0
        self._buffer = b""
        self._end_ns = 0

    def feed(self, data: bytes, start_ns: int, end_ns: int) -> Iterator[Packet]:
        """Yield the packets that these bytes complete."""
        if self._buffer and start_ns - self._end_ns > _GAP_NS:
            self._buffer = b""
            self.dropped += 1
        self._end_ns = end_ns
        self._buffer += data
        while (whole := self._next()) is not None:
            if crc16(whole[:-2]) == whole[-2:]:
                body = whole[_HEAD:-2].replace(_MARK + b"\xfd", _MARK)
                yield Packet(whole[4], body[0], body[1:])
            else:
                self.invalid += 1

    def _next(self) -> bytes | None:
        """Take the next packet from the buffer; None: its end is still to come."""
        while True:
            place = self._buffer.find(_MARK)
            buffer = self._buffer = self._buffer[place if place >= 0 else -2 :]
            if place < 0 or len(buffer) < _HEAD:
                return None
            length = int.from_bytes(buffer[5:_HEAD], "little")
            if buffer[3] == 0xFD or not _LEAST <= length <= _MOST:
                self._buffer = buffer[1:]
                continue
            end = _HEAD + length
            if len(buffer) < end:
                return None
            self._buffer = buffer[end:]
            return buffer[:end]
