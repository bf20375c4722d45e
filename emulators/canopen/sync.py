"""SYNC consumer (CiA 301, 7.2.5): which identifier is SYNC. Without 1005h it is 080h."""

from typing import Final, final

from emulators.canopen.abort_code import AbortCode
from emulators.canopen.object_dictionary import DataType, ObjectDictionary

_GENERATE: Final = 1 << 30
_UPPER_BITS: Final = 0x3FFF_F800


def is_restricted(identifier: int) -> bool:
    """Whether no PDO, SYNC or EMCY may take this identifier (CiA 301, table 40)."""
    return (
        identifier <= 0x07F
        or 0x101 <= identifier <= 0x180
        or 0x581 <= identifier <= 0x5FF
        or 0x601 <= identifier <= 0x67F
        or 0x6E0 <= identifier <= 0x6FF
        or identifier >= 0x701
    )


@final
class SyncConsumer:
    """Knows the identifier of SYNC. The counter, 1006h, 1007h and producing it are not built."""

    def __init__(self, od: ObjectDictionary) -> None:
        self._cob_id = od.ensure(0x1005, 0, DataType.UNSIGNED32, 0x80)
        self._cob_id.writer = self.check
        self.can_id = 0x80

    def configure(self) -> None:
        """The identifier is what the dictionary says now."""
        self.can_id = self._cob_id.integer() & 0x7FF

    def check(self, value: int) -> int:
        """What is wrong with a new 1005h; 0 if nothing."""
        if value & (_GENERATE | _UPPER_BITS) or is_restricted(value & 0x7FF):
            return AbortCode.INVALID_VALUE  # neither producing nor 29-bit identifiers
        return 0
