"""The objects of interpolated position mode: sub-mode, data record, buffer (CiA 402-2)."""

from typing import Final, final

from emulators.canopen.abort_code import OK, AbortCode
from emulators.canopen.object_dictionary import DataType, ObjectDictionary
from emulators.cia402.units import FactorGroup
from emulators.cia402.written import IP_DATA, Choice, Written

BUFFER_MAX: Final = 64
_BUFFER: Final = 16
_FIFO: Final = 0
_RING: Final = 1
_LINEAR: Final = frozenset((0,))
_D = DataType


@final
class IpObjects:
    """60C0h, 60C1h:1 and 60C4h; records are converted with the units valid when they are taken."""

    def __init__(self, od: ObjectDictionary, factors: FactorGroup, written: Written) -> None:
        ensure = od.ensure
        self._factors = factors
        self._written = written
        self._records: list[int] = []
        refused = int(AbortCode.INVALID_VALUE)
        ensure(0x60C0, 0, _D.INTEGER16, 0).writer = Choice(written, 0, _LINEAR, refused).write
        ensure(0x60C1, 1, _D.INTEGER32, 0).writer = self._write_record
        ensure(0x60C4, 1, _D.UNSIGNED32, BUFFER_MAX)
        self._size = ensure(0x60C4, 2, _D.UNSIGNED32, _BUFFER)
        self._size.writer = self._write_size
        self._organisation = ensure(0x60C4, 3, _D.UNSIGNED8, _FIFO)
        self._organisation.writer = Choice(written, 0, frozenset((_FIFO, _RING)), refused).write
        position = od.get(0x60C4, 4)
        if position is not None:
            position.reader = self._free_place
        length = ensure(0x60C4, 5, _D.UNSIGNED8, 1)
        length.writer = Choice(written, 0, frozenset((1,)), refused).write
        self._access = ensure(0x60C4, 6, _D.UNSIGNED8, 1)
        self._access.writer = self._write_access

    def reload(self) -> None:
        """Clear the buffer after the objects were reset to their defaults (reset node)."""
        self._records.clear()

    def is_empty(self) -> bool:
        """Return True if the buffer is empty."""
        return not self._records

    def take_inc(self) -> int:
        """Remove and return the oldest record [increments].

        Raises:
            IndexError: the buffer is empty.
        """
        return self._factors.units.position_inc(self._records.pop(0))

    def _write_record(self, value: int) -> int:
        if self._access.integer() == 0:
            return AbortCode.NOT_STORED_DEVICE_STATE
        if len(self._records) >= self._room():
            if self._organisation.integer() != _RING:
                return AbortCode.NOT_STORED_DEVICE_STATE
            self._records.pop(0)
        self._records.append(value)
        self._written.kinds |= IP_DATA
        return OK

    def _write_size(self, value: int) -> int:
        if not 1 <= value <= BUFFER_MAX:
            return AbortCode.INVALID_VALUE
        del self._records[value:]
        return OK

    def _write_access(self, value: int) -> int:
        if value not in (0, 1):
            return AbortCode.INVALID_VALUE
        if value == 0:
            self._records.clear()
        return OK

    def _room(self) -> int:
        return max(1, min(BUFFER_MAX, self._size.integer()))

    def _free_place(self) -> int:
        """Return 60C4h:4, the next free place in the buffer."""
        return len(self._records)
