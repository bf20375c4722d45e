"""Reception of one CAN frame: fields, stuff and form errors, CRC.

Interpretations taken from the standard's own tests (ISO 16845-1):
- A classical controller that does not tolerate CAN FD takes a recessive FDF bit for a reserved bit.
  The controller reads on as in a classical frame until the format is violated (7.1.4, 7.1.5). To a
  tolerant one it is a protocol exception; a recessive res bit is one to all others (7.1.6).
- In a CAN FD frame the CRC delimiter, or the ACK slot, may have a second bit (8.2.7). After a
  recessive ACK slot, or before a dominant ACK delimiter, another bit belongs to it (7.6.7, 7.6.10).

Left open, decided here: a fixed stuff bit that equals the bit before it is a form error, a wrong
stuff count a CRC error.

Source: ISO 11898-1:2015, frame formats, error detection, frame validation.
"""

from typing import Final, final

from motorhil.emulators.can.bitlevel.encoder import (
    DOMINANT,
    FIXED_EVERY,
    RECESSIVE,
    STUFF_RUN,
    bits_of,
    crc_of,
    fd_check_bits,
    fd_field_bits,
    place_of,
    stuff,
    tail_place,
)
from motorhil.emulators.can.controller_config import FrameSupport
from motorhil.emulators.can.frame import BRS, EFF_FLAG, ESI, FD_LENGTHS, pack, pack_fd, pack_remote

# Possible meanings of a bit to a receiver.
NOTHING: Final = 0
ACK_NEXT: Final = 1  # the next bit is the ACK slot, and the CRC was right
ACKNOWLEDGED: Final = 2  # this bit was the ACK slot
ACCEPTED: Final = 3  # the last but one bit of end of frame: the frame is valid
COMPLETE: Final = 4  # the last bit of end of frame
OVERLOAD: Final = 5  # the last bit of end of frame was dominant
EXCEPTION: Final = 6  # unknown frame format: the node waits for an idle bus
STUFF: Final = 7  # from here on: errors
FORM: Final = 8
CRC: Final = 9

_IDE: Final = 13  # bit numbers, stuff bits not counted; the start of frame is 0
_FDF: Final = 14
_EXTENDED_FDF: Final = 33
_RES_AFTER_FDF: Final = 1
_BRS_AFTER_FDF: Final = 2
_FD_DLC_AFTER_FDF: Final = 7  # its last bit
_DLC_AFTER_FDF: Final = 4
_EXTENDED_DLC_AFTER_FDF: Final = 5
_CRC_BITS: Final = 15
_UNKNOWN: Final = 1 << 30

# bit numbers of the tail
_CRC_DELIMITER: Final = 0
_ACK_SLOT: Final = 1
_ACK_DELIMITER: Final = 2
_LAST_BUT_ONE: Final = 8
_LAST: Final = 9

# part of the frame
_STUFFED: Final = 0
_FIXED: Final = 1  # stuff count and CRC of CAN FD
_TAIL: Final = 2


_checks: Final[dict[tuple[int, int, int], int]] = {}


@final
class Reception:
    """One frame as a receiver hears it. `hear` is called for each bit from start of frame on.

    Attributes (read only):
        fast: the next bit is at the data rate.
    """

    def __init__(self, support: FrameSupport) -> None:
        self.fast: bool = False
        self._support = support
        self._part = _STUFFED
        self._last = RECESSIVE
        self._run = 0
        self._value = 0
        self._number = -1  # of the last bit heard, stuff bits not counted
        self._stop = _IDE  # the next number with a decision
        self._extended = False
        self._fdf = _FDF
        self._fd = False
        self._dlc_end = _UNKNOWN
        self._length = 0
        self._crc_start = _UNKNOWN
        self._crc_end = _UNKNOWN
        self._crc_right = False
        self._checks = 0  # stuff count and CRC
        self._position = -1  # of the last bit heard in this part, except the first part
        self._acknowledged = False
        self._long_ack = False  # the second bit of the ACK slot of a CAN FD frame has passed

    def hear(self, level: int) -> int:
        """Process the next bit and return its meaning; do not call again after an error."""
        if self._part == _TAIL:
            return self._hear_tail(level)
        if self._part == _FIXED:
            return self._hear_fixed(level)
        if self._run == STUFF_RUN:
            if level == self._last:
                return STUFF
            self._last = level
            self._run = 1
            if self._number == self._crc_end:
                self._part = _TAIL
            return NOTHING
        if level == self._last:
            self._run += 1
        else:
            self._last = level
            self._run = 1
        self._value = self._value << 1 | level
        self._number += 1
        if self._number == self._stop:
            return self._decide(level)
        return NOTHING

    def place(self) -> int:
        """Return the place of the last bit heard (`error_message`)."""
        if self._part == _TAIL and self._position >= 0:
            return tail_place(self._position)
        if self._part == _FIXED:
            return place_of(self._crc_start, self._extended, self._crc_start, True)
        return place_of(self._number, self._extended, self._crc_start, self._fd)

    def frame(self) -> bytes:
        """Return the accepted frame (16-byte can_frame or 72-byte canfd_frame)."""
        header = self._value >> self._number - self._dlc_end
        after_rtr = header >> self._dlc_end - self._fdf + (1 if self._extended else 2)
        remote = after_rtr & 1
        can_id = after_rtr >> 1 & 0x7FF
        if self._extended:
            can_id = EFF_FLAG | (after_rtr >> 21 & 0x7FF) << 18 | after_rtr >> 1 & 0x3FFFF
        if remote and not self._fd:
            return pack_remote(can_id, self._length)
        bits = 8 * self._length
        data = self._value >> self._number + 1 - self._crc_start & (1 << bits) - 1
        octets = data.to_bytes(self._length, "big")
        if not self._fd:
            return pack(can_id, octets)
        flags = (BRS if header >> 5 & 1 else 0) | (ESI if header >> 4 & 1 else 0)
        return pack_fd(can_id, octets, flags)

    def _decide(self, level: int) -> int:
        """Process a bit on which the rest of the frame depends."""
        number = self._number
        if number == _IDE:
            self._extended = level == RECESSIVE
            self._fdf = self._stop = _EXTENDED_FDF if self._extended else _FDF
        elif number == self._fdf:
            return self._decide_format(level)
        elif number == self._crc_end:
            self._crc_right = not crc_of(self._value, number + 1)
            if self._run < STUFF_RUN:
                self._part = _TAIL
        elif number == self._dlc_end:
            self._read_dlc()
        elif number == self._crc_start - 1:
            self._part = _FIXED
        elif number == self._fdf + _RES_AFTER_FDF:
            if level == RECESSIVE:
                return EXCEPTION
            self._stop = self._fdf + _BRS_AFTER_FDF
        else:
            self.fast = level == RECESSIVE
            self._stop = self._dlc_end
        return NOTHING

    def _decide_format(self, level: int) -> int:
        """Decide between classical CAN and CAN FD."""
        if level == DOMINANT or self._support is FrameSupport.CLASSICAL:
            after = _EXTENDED_DLC_AFTER_FDF if self._extended else _DLC_AFTER_FDF
            self._dlc_end = self._stop = self._fdf + after
            return NOTHING
        if self._support is FrameSupport.FD_TOLERANT:
            return EXCEPTION
        self._fd = True
        self._dlc_end = self._fdf + _FD_DLC_AFTER_FDF
        self._stop = self._fdf + _RES_AFTER_FDF
        return NOTHING

    def _read_dlc(self) -> None:
        """Compute the frame's length from the complete DLC."""
        number = self._number
        dlc = self._value & 0xF
        if self._fd:
            self._length = FD_LENGTHS[dlc]
            self._crc_start = number + 1 + 8 * self._length
            self._stop = self._crc_start - 1
            if not self._length:
                self._part = _FIXED
            return
        self._length = min(dlc, 8)
        remote = self._value >> 6 & 1
        data_bits = 0 if remote else 8 * self._length
        self._crc_start = number + 1 + data_bits
        self._crc_end = self._stop = number + data_bits + _CRC_BITS

    def _hear_fixed(self, level: int) -> int:
        """Process a bit of the stuff count or CRC of a CAN FD frame."""
        self._position += 1
        last = self._last
        self._last = level
        if not self._position % FIXED_EVERY:
            return FORM if level == last else NOTHING
        self._checks = self._checks << 1 | level
        if self._position == fd_field_bits(self._length) - 1:
            self._crc_right = self._checks == self._expected_checks()
            self._part = _TAIL
            self._position = -1
        return NOTHING

    def _expected_checks(self) -> int:
        """Return stuff count and CRC of the bits heard; equal receivers share the result."""
        key = (self._value, self._number, self._length)
        expected = _checks.get(key)
        if expected is None:
            levels, stuffed = stuff(bits_of(self._value, self._number + 1))
            _checks.clear()
            expected = _checks[key] = fd_check_bits(levels, sum(stuffed), self._length)[0]
        return expected

    def _hear_tail(self, level: int) -> int:
        self._position += 1
        position = self._position
        if position == _ACK_SLOT:
            self._acknowledged = level == DOMINANT
            return ACKNOWLEDGED
        if position == _LAST:
            return COMPLETE if level == RECESSIVE else OVERLOAD
        may_last = self._fd and position == _ACK_DELIMITER and not self._long_ack
        if may_last and (level == DOMINANT or not self._acknowledged):
            self._long_ack = True
            self._position -= 1
            return NOTHING
        if level != RECESSIVE:
            return FORM
        if position == _CRC_DELIMITER:
            self.fast = False
            return ACK_NEXT if self._crc_right else NOTHING
        if position == _ACK_DELIMITER:
            return NOTHING if self._crc_right else CRC
        return ACCEPTED if position == _LAST_BUT_ONE else NOTHING
