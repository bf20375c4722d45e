"""SDO block transfer (CiA 301, 7.2.4.3.9 to 7.2.4.3.15): data and CRC.

A block has up to 127 segments of 7 bytes, numbered from 1, and is confirmed as a whole. The
receiver reports the last number that arrived in sequence, and the size of the next block. Segments
behind a gap are sent again. The last segment carries a flag. The end message has the number of its
valid bytes, and the CRC of all data if both sides support it.

This module has the state of a transfer only; `SdoServer` handles requests and responses.
"""

from typing import Final, final

from emulators.canopen.abort_code import AbortCode

SEGMENT_BYTES: Final = 7
BLOCK_MAX: Final = 127

_LAST: Final = 0x80
_POLYNOMIAL: Final = 0x1021


def _table() -> list[int]:
    out: list[int] = []
    for byte in range(256):
        crc = byte << 8
        for _ in range(8):
            crc = crc << 1 ^ _POLYNOMIAL if crc & 0x8000 else crc << 1
        out.append(crc & 0xFFFF)
    return out


_CRC: Final = _table()


def block_crc(data: bytes) -> int:
    """Return the CRC of a block transfer: x^16 + x^12 + x^5 + 1, from 0 (CiA 301, 7.2.4.3.16)."""
    crc = 0
    for byte in data:
        crc = (crc << 8 & 0xFF00) ^ _CRC[crc >> 8 ^ byte]
    return crc


@final
class BlockDownload:
    """Collects the data that a client sends in blocks.

    Attributes:
        expected: the announced number of bytes, or None.
        block_size: the maximum number of segments in a block.
        is_complete: the last segment has arrived; the end message is expected.
    """

    def __init__(self, expected: int | None, has_crc: bool, limit: int) -> None:
        """Expect this many bytes (None: unknown), `limit` at most, with or without a CRC."""
        self.block_size = BLOCK_MAX
        self.is_complete = False
        self.expected = expected
        self._has_crc = has_crc
        self._limit = limit
        self._data = bytearray()
        self._good = 0  # number of the last segment in sequence, in this block

    def segment(self, head: int, data: bytes) -> int | None:
        """Return the number to confirm if the block is over, else None.

        Segments behind a gap are dropped; the client learns this at the end of the block.
        """
        number = head & ~_LAST
        if number == self._good + 1:
            self._good = number
            self._data += data
            if head & _LAST:
                self.is_complete = True
        if number < self.block_size and not head & _LAST:
            return None
        good, self._good = self._good, 0
        return good

    def overflows(self) -> bool:
        """Return whether more data have arrived than allowed."""
        most = self._limit if self.expected is None else self.expected
        return len(self._data) >= most + SEGMENT_BYTES

    def end(self, unused: int, crc: int) -> bytes | AbortCode:
        """Return all data without the unused bytes of the last segment, or an abort code."""
        data = bytes(self._data[: len(self._data) - unused])
        if self._has_crc and block_crc(data) != crc:
            return AbortCode.CRC_ERROR
        if self.expected is not None and len(data) != self.expected:
            too_low = len(data) < self.expected
            return AbortCode.LENGTH_TOO_LOW if too_low else AbortCode.LENGTH_TOO_HIGH
        return data


@final
class BlockUpload:
    """Sends a value in blocks."""

    def __init__(self, data: bytes, block_size: int, has_crc: bool) -> None:
        """Send blocks of this many segments, with or without a CRC at the end."""
        self._data = data
        self._block_size = block_size
        self._has_crc = has_crc
        self._begun = 0  # start of the unconfirmed block in the data
        self._sent = 0  # segments of this block

    def block(self) -> list[tuple[int, bytes]]:
        """Return the segments of the next block: head and up to 7 bytes each."""
        out: list[tuple[int, bytes]] = []
        at = self._begun
        while len(out) < self._block_size:
            part = self._data[at : at + SEGMENT_BYTES]
            at += SEGMENT_BYTES
            is_last = at >= len(self._data)
            out.append((len(out) + 1 | (_LAST if is_last else 0), part))
            if is_last:
                break
        self._sent = len(out)
        return out

    def confirm(self, good: int, block_size: int) -> AbortCode | None:
        """Confirm `good` segments and set the next block size; return an abort code or None."""
        if good > self._sent:
            return AbortCode.INVALID_SEQUENCE_NUMBER
        if not 1 <= block_size <= BLOCK_MAX:
            return AbortCode.INVALID_BLOCK_SIZE
        self._begun += good * SEGMENT_BYTES
        self._block_size = block_size
        return None

    def is_over(self) -> bool:
        """Return whether all data are confirmed."""
        return self._begun >= len(self._data) and self._begun > 0

    def end(self) -> tuple[int, int]:
        """Return (number of unused bytes in the last segment, CRC or 0)."""
        return -len(self._data) % SEGMENT_BYTES if self._data else SEGMENT_BYTES, (
            block_crc(self._data) if self._has_crc else 0
        )
