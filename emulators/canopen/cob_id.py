"""COB-IDs (CiA 301, 7.3.5): the identifiers allowed for communication objects."""

from typing import Final

INVALID: Final = 1 << 31  # the communication object does not exist
UPPER_BITS: Final = 0x3FFF_F800  # the 29-bit frame flag and the bits of 29-bit identifiers only


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
