"""SDO block transfer (CiA 301, 7.2.4.3.9 to 7.2.4.3.15): the data on both ways, and their CRC.

A block is up to 127 segments of 7 bytes, numbered from 1, that are confirmed together: the receiver
says up to which number all came in order, and how many the next block may have. What lies behind a
gap is sent again. The last segment carries a flag; how many of its bytes count comes with the end,
as does the CRC of all data, if both sides have one.

Only what a transfer knows is here; requests and responses are `emulators.canopen.sdo_server`'s.
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
    """The CRC of a block transfer's data: x^16 + x^12 + x^5 + 1, from 0 (CiA 301, 7.2.4.3.16)."""
    crc = 0
    for byte in data:
        crc = (crc << 8 & 0xFF00) ^ _CRC[crc >> 8 ^ byte]
    return crc


@final
class BlockDownload:
    """What a client sends in blocks is collected.

    Attributes:
        expected: how many bytes there are to be; None: not told.
        block_size: how many segments a block has at most.
        is_complete: whether the last segment is there: the end is expected.
    """

    def __init__(self, expected: int | None, has_crc: bool, limit: int) -> None:
        """Of so many bytes (None: not told), with a CRC at its end or not; `limit` at most."""
        self.block_size = BLOCK_MAX
        self.is_complete = False
        self.expected = expected
        self._has_crc = has_crc
        self._limit = limit
        self._data = bytearray()
        self._good = 0  # number of the last segment that came in order, in this block

    def segment(self, head: int, data: bytes) -> int | None:
        """The number to confirm, if the block is over; None: it goes on.

        What comes behind a gap is not kept; the client learns of it when the block is over.
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
        """Whether more has come than can be right."""
        most = self._limit if self.expected is None else self.expected
        return len(self._data) >= most + SEGMENT_BYTES

    def end(self, unused: int, crc: int) -> bytes | AbortCode:
        """All data, without the bytes of the last segment that are none; or what is wrong."""
        data = bytes(self._data[: len(self._data) - unused])
        if self._has_crc and block_crc(data) != crc:
            return AbortCode.CRC_ERROR
        if self.expected is not None and len(data) != self.expected:
            too_low = len(data) < self.expected
            return AbortCode.LENGTH_TOO_LOW if too_low else AbortCode.LENGTH_TOO_HIGH
        return data


@final
class BlockUpload:
    """A value is handed out in blocks."""

    def __init__(self, data: bytes, block_size: int, has_crc: bool) -> None:
        """In blocks of so many segments; with a CRC at its end or not."""
        self._data = data
        self._block_size = block_size
        self._has_crc = has_crc
        self._begun = 0  # where in the data the block begins that is not confirmed
        self._sent = 0  # segments of it

    def block(self) -> list[tuple[int, bytes]]:
        """The segments of the next block: head and up to 7 bytes each."""
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
        """So many segments of the block came; the next block has so many. None: all is right."""
        if good > self._sent:
            return AbortCode.INVALID_SEQUENCE_NUMBER
        if not 1 <= block_size <= BLOCK_MAX:
            return AbortCode.INVALID_BLOCK_SIZE
        self._begun += good * SEGMENT_BYTES
        self._block_size = block_size
        return None

    def is_over(self) -> bool:
        """Whether all has been confirmed."""
        return self._begun >= len(self._data) and self._begun > 0

    def end(self) -> tuple[int, int]:
        """(how many bytes of the last segment are none, CRC or 0)."""
        return -len(self._data) % SEGMENT_BYTES if self._data else SEGMENT_BYTES, (
            block_crc(self._data) if self._has_crc else 0
        )
