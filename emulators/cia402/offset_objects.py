"""Offsets of the cyclic modes, added to a set-point or fed forward."""

from typing import Final, final

from emulators.canopen.object_dictionary import DataType, ObjectDictionary
from emulators.cia402.torque_objects import TorqueObjects
from emulators.cia402.units import FactorGroup

_D: Final = DataType


@final
class OffsetObjects:
    """60B0h, 60B1h and 60B2h (CiA 402-2, cyclic synchronous modes)."""

    def __init__(self, od: ObjectDictionary, factors: FactorGroup, torque: TorqueObjects) -> None:
        self._factors = factors
        self._torque = torque
        self._position = od.ensure(0x60B0, 0, _D.INTEGER32, 0)
        self._velocity = od.ensure(0x60B1, 0, _D.INTEGER32, 0)
        self._torque_offset = od.ensure(0x60B2, 0, _D.INTEGER16, 0)

    def are_set(self) -> bool:
        """Return True if any offset is not 0."""
        return (
            self._position.integer() != 0
            or self._velocity.integer() != 0
            or self._torque_offset.integer() != 0
        )

    def position_inc(self) -> int:
        """Return 60B0h [increments]."""
        return self._factors.units.position_inc(self._position.integer())

    def velocity_inc_s(self) -> float:
        """Return 60B1h [increments/s]."""
        units = self._factors.units
        return self._velocity.integer() * units.velocity_unit_inc_s * units.velocity_sign

    def current_a(self) -> float:
        """Return 60B2h as the current that causes this torque [A]."""
        return self._torque.current_of_a(self._torque_offset.integer())
