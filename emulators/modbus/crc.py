"""Checksum of Modbus RTU: CRC-16, polynomial A001h (reflected), low byte first.

Source: MODBUS over Serial Line, Specification and Implementation Guide V1.02, section 2.5.1.2.
"""

from functools import lru_cache
from typing import Final

_POLYNOMIAL: Final = 0xA001


def _table() -> list[int]:
    table = []
    for byte in range(256):
        crc = byte
        for _ in range(8):
            crc = crc >> 1 ^ (_POLYNOMIAL if crc & 1 else 0)
        table.append(crc)
    return table


_TABLE: Final = _table()


@lru_cache(maxsize=1024)  # polling clients repeat the same requests
def crc16(data: bytes) -> bytes:
    """Return the two CRC bytes that follow these bytes on the line."""
    crc = 0xFFFF
    for byte in data:
        crc = crc >> 8 ^ _TABLE[(crc ^ byte) & 0xFF]
    return bytes((crc & 0xFF, crc >> 8))


def with_crc(data: bytes) -> bytes:
    """Return the bytes with their CRC appended."""
    return data + crc16(data)
