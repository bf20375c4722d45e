"""SDO abort codes and COB-IDs (CiA 301, SDO abort transfer protocol and 7.3.5)."""

from enum import IntEnum, unique
from typing import Final, final

OK: Final = 0

INVALID: Final = 1 << 31  # the communication object does not exist
UPPER_BITS: Final = 0x3FFF_F800  # the 29-bit frame flag and the bits of 29-bit identifiers only


@final
@unique
class AbortCode(IntEnum):
    """The reason of an aborted SDO transfer. Writers of a device return one of these, or `OK`."""

    OK = 0  # no error; never on the wire
    TOGGLE_BIT_NOT_ALTERNATED = 0x0503_0000
    PROTOCOL_TIMED_OUT = 0x0504_0000
    COMMAND_SPECIFIER_UNKNOWN = 0x0504_0001
    INVALID_BLOCK_SIZE = 0x0504_0002
    INVALID_SEQUENCE_NUMBER = 0x0504_0003
    CRC_ERROR = 0x0504_0004
    OUT_OF_MEMORY = 0x0504_0005
    UNSUPPORTED_ACCESS = 0x0601_0000
    WRITE_ONLY = 0x0601_0001
    READ_ONLY = 0x0601_0002
    NO_SUCH_OBJECT = 0x0602_0000
    NOT_MAPPABLE = 0x0604_0041
    PDO_TOO_LONG = 0x0604_0042
    PARAMETER_INCOMPATIBLE = 0x0604_0043
    HARDWARE_ERROR = 0x0606_0000
    LENGTH_MISMATCH = 0x0607_0010
    LENGTH_TOO_HIGH = 0x0607_0012
    LENGTH_TOO_LOW = 0x0607_0013
    NO_SUCH_SUBINDEX = 0x0609_0011
    INVALID_VALUE = 0x0609_0030
    VALUE_TOO_HIGH = 0x0609_0031
    VALUE_TOO_LOW = 0x0609_0032
    GENERAL_ERROR = 0x0800_0000
    NOT_STORED = 0x0800_0020
    NOT_STORED_LOCAL_CONTROL = 0x0800_0021
    NOT_STORED_DEVICE_STATE = 0x0800_0022
    NO_DATA = 0x0800_0024


def is_restricted(identifier: int) -> bool:
    """Return whether PDO, SYNC, TIME and EMCY may not use this identifier (CiA 301, table 40)."""
    return (
        identifier <= 0x07F
        or 0x101 <= identifier <= 0x180
        or 0x581 <= identifier <= 0x5FF
        or 0x601 <= identifier <= 0x67F
        or 0x6E0 <= identifier <= 0x6FF
        or identifier >= 0x701
    )


def predefined_bases(index: int, subindex: int) -> tuple[int, ...]:
    """Return the function codes that identify a node's own COB-IDs in this object; (): none do.

    Source: CiA 301, 7.3.5, pre-defined connection set. A PDO of any number may have any of its PDO
    identifiers.
    """
    if (index, subindex) == (0x1014, 0):
        return (0x080,)
    if index == 0x1200:
        return {1: (0x600,), 2: (0x580,)}.get(subindex, ())
    is_pdo = 0x1400 <= index <= 0x15FF or 0x1800 <= index <= 0x19FF
    return tuple(range(0x180, 0x580, 0x80)) if is_pdo and subindex == 1 else ()
