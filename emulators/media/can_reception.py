"""What a receiver makes of the levels of one frame: fields, stuff and form errors, CRC.

A recessive FDF bit is a form error to a classical controller.

Source: ISO 11898-1, frame formats, error detection, frame validation.
"""

from typing import Final, final

from emulators.media.can_frame import EFF_FLAG, pack, pack_remote
from emulators.media.can_wire import RECESSIVE, STUFF_RUN, crc_of, place_of, tail_place

# What a bit may mean to a receiver.
NOTHING: Final = 0
ACK_NEXT: Final = 1  # the next bit is the ACK slot, and the CRC was right
ACKNOWLEDGED: Final = 2  # this one was the ACK slot
ACCEPTED: Final = 3  # the last but one bit of end of frame: the frame is valid
COMPLETE: Final = 4  # the last bit of end of frame
OVERLOAD: Final = 5  # the last bit of end of frame was dominant
STUFF: Final = 6  # from here on: errors
FORM: Final = 7
CRC: Final = 8

_IDE: Final = 13  # numbers of bits, stuff bits not counted; the start of frame is 0
_FDF: Final = 14
_EXTENDED_FDF: Final = 33
_DLC_END: Final = 18
_EXTENDED_DLC_END: Final = 38
_CRC_BITS: Final = 15
_UNKNOWN: Final = 1 << 30

# of the tail
_CRC_DELIMITER: Final = 0
_ACK_SLOT: Final = 1
_ACK_DELIMITER: Final = 2
_LAST_BUT_ONE: Final = 8
_LAST: Final = 9


@final
class Reception:
    """One frame as a receiver hears it. `hear` is called for each bit from start of frame on."""

    def __init__(self) -> None:
        self._last = RECESSIVE
        self._run = 0
        self._value = 0
        self._number = -1  # of the last bit heard, stuff bits not counted
        self._stop = _IDE  # the next number at which something is decided
        self._extended = False
        self._crc_start = _UNKNOWN
        self._crc_end = _UNKNOWN
        self._crc_right = False
        self._tail = -1  # number of the last bit heard after the CRC sequence
        self._in_tail = False

    def hear(self, level: int) -> int:
        """What the next bit means; after an error, nothing more may be heard."""
        if self._in_tail:
            return self._hear_tail(level)
        if self._run == STUFF_RUN:
            if level == self._last:
                return STUFF
            self._last = level
            self._run = 1
            self._in_tail = self._number == self._crc_end
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
        """Where the last bit heard is (`error_message`)."""
        if self._in_tail and self._tail >= 0:
            return tail_place(self._tail)
        return place_of(self._number, self._extended, self._crc_start)

    def frame(self) -> bytes:
        """The frame, once it is accepted (16-byte can_frame)."""
        header = self._value >> self._crc_end - self._dlc_end()
        dlc = min(header & 0xF, 8)
        if self._extended:
            can_id = EFF_FLAG | (header >> 27 & 0x7FF) << 18 | header >> 7 & 0x3FFFF
            remote = header >> 6 & 1
        else:
            can_id = header >> 7 & 0x7FF
            remote = header >> 6 & 1
        if remote:
            return pack_remote(can_id, dlc)
        data = self._value >> _CRC_BITS & (1 << 8 * dlc) - 1
        return pack(can_id, data.to_bytes(dlc, "big"))

    def _dlc_end(self) -> int:
        return _EXTENDED_DLC_END if self._extended else _DLC_END

    def _decide(self, level: int) -> int:
        """A bit on which the rest of the frame depends."""
        number = self._number
        if number == _IDE:
            self._extended = level == RECESSIVE
            self._stop = _EXTENDED_FDF if self._extended else _FDF
        elif number == self._crc_end:
            self._crc_right = not crc_of(self._value, number + 1)
            self._in_tail = self._run < STUFF_RUN
        elif number == self._dlc_end():
            remote = self._value >> 6 & 1
            length = 0 if remote else min(self._value & 0xF, 8)
            self._crc_start = number + 1 + 8 * length
            self._crc_end = self._stop = number + 8 * length + _CRC_BITS
        elif level == RECESSIVE:
            return FORM  # FDF: a CAN FD frame
        else:
            self._stop = self._dlc_end()
        return NOTHING

    def _hear_tail(self, level: int) -> int:
        self._tail += 1
        tail = self._tail
        if tail == _ACK_SLOT:
            return ACKNOWLEDGED
        if tail == _LAST:
            return COMPLETE if level == RECESSIVE else OVERLOAD
        if level != RECESSIVE:
            return FORM
        if tail == _CRC_DELIMITER:
            return ACK_NEXT if self._crc_right else NOTHING
        if tail == _ACK_DELIMITER:
            return NOTHING if self._crc_right else CRC
        return ACCEPTED if tail == _LAST_BUT_ONE else NOTHING
