"""EMCY messages as a host receives them (CiA 301, 7.2.7).

Selects which of several errors is reported as the drive's fault.
"""

from collections.abc import Iterable
from dataclasses import dataclass
from typing import Final, final

_ERROR_CLASS: Final = 0xFF00  # 00xxh: an error is reset
_COMMUNICATION: Final = 0x8100
_OF_COMMUNICATION: Final = 0x11  # 1001h: generic, and communication
# Errors of frames and the bus do not end a motion. Some drives repeat the first two endlessly.
_MINOR: Final = (0x8210, 0x8220, 0x8120, 0x8140)


# EMCY and 603Fh error codes (CiA 301; CiA 402-1, error codes)
_ERRORS: Final = (
    (0xFFFF, 0x2310, "continuous over-current"),
    (0xFFFF, 0x2320, "short circuit or earth leakage"),
    (0xFFFF, 0x3110, "mains over-voltage"),
    (0xFFFF, 0x3120, "mains under-voltage"),
    (0xFFFF, 0x3210, "DC link over-voltage"),
    (0xFFFF, 0x3220, "DC link under-voltage"),
    (0xFFFF, 0x4210, "device temperature"),
    (0xFFFF, 0x4310, "drive temperature"),
    (0xFFFF, 0x7121, "motor blocked"),
    (0xFFFF, 0x7122, "motor error or commutation"),
    (0xFFFF, 0x7300, "sensor"),
    (0xFFFF, 0x7305, "incremental sensor 1"),
    (0xFFFF, 0x8110, "CAN overrun"),
    (0xFFFF, 0x8120, "CAN in error passive mode"),
    (0xFFFF, 0x8130, "heartbeat or life guard error: the host was not heard"),
    (0xFFFF, 0x8140, "recovered from bus-off"),
    (0xFFFF, 0x8210, "PDO not processed due to length error"),
    (0xFFFF, 0x8611, "following error"),
    (0xFF00, 0x1000, "generic error"),
    (0xF000, 0x2000, "current"),
    (0xF000, 0x3000, "voltage"),
    (0xF000, 0x4000, "temperature"),
    (0xF000, 0x5000, "device hardware"),
    (0xF000, 0x6000, "device software"),
    (0xF000, 0x7000, "additional modules"),
    (0xF000, 0x8000, "monitoring"),
    (0xFF00, 0x9000, "external error"),
    (0xFF00, 0xFF00, "device specific"),
)


def error_text(code: int) -> str:
    """Return the text of an error code, from the most specific line of the standard's table."""
    if code == 0:
        return "error code not told"
    for mask, value, text in _ERRORS:
        if code & mask == value:
            return text
    return "unknown"


@final
@dataclass(frozen=True, slots=True)
class Emergency:
    """One EMCY: error code (603Fh), error register (1001h), 5 vendor bytes, time received [ns]."""

    code: int
    register: int
    vendor: bytes
    time_ns: int

    def __str__(self) -> str:
        gone = "no error, or one is gone"
        text = error_text(self.code) if self.code & _ERROR_CLASS else gone
        return f"EMCY {self.code:04X}h at {self.time_ns / 1e9:.6f} s: {text}"


def last_error(heard: Iterable[Emergency], from_ns: int) -> Emergency | None:
    """Return the last EMCY with an error, reset or not, received at `from_ns` or later."""
    errors = [one for one in heard if one.code & _ERROR_CLASS and one.time_ns >= from_ns]
    return errors[-1] if errors else None


def standing_error(before: Emergency | None, heard: Emergency) -> Emergency | None:
    """Return the error that persists after this EMCY, or None.

    An error of a frame or the bus yields to an error of the drive.
    """
    if heard.code & _ERROR_CLASS:
        return heard if before is None or heard.code not in _MINOR else before
    if before is None or not heard.register:
        return None
    is_of_drive = before.code & _ERROR_CLASS != _COMMUNICATION and before.code not in _MINOR
    return None if is_of_drive and not heard.register & ~_OF_COMMUNICATION else before
