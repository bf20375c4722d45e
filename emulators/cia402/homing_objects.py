"""The objects of homing: 6098h, 607Ch."""

from typing import Final, final

from emulators.canopen.abort_code import AbortCode
from emulators.canopen.object_dictionary import DataType, ObjectDictionary
from emulators.cia402.units import FactorGroup
from emulators.cia402.written import Choice, Written

HOMING_METHODS: Final = (35, 37)  # on the present position; 35 is the old number of 37
_D = DataType


@final
class HomingObjects:
    """How to home, and what the home position is called."""

    def __init__(self, od: ObjectDictionary, factors: FactorGroup, written: Written) -> None:
        self._factors = factors
        self._home_offset = od.ensure(0x607C, 0, _D.INTEGER32, 0)
        self._method = od.ensure(0x6098, 0, _D.INTEGER8, 37)
        methods = frozenset(HOMING_METHODS)
        self._method.writer = Choice(written, 0, methods, int(AbortCode.INVALID_VALUE)).write

    def home_offset_inc(self) -> int:
        """607Ch."""
        return self._factors.units.position_inc(self._home_offset.integer())

    def method(self) -> int:
        """6098h."""
        return self._method.integer()
