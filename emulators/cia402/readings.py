"""Readers of actual values, bound to the objects in the EDS.

Every reader returns the value at the last `axis.at`.
"""

from typing import final

from emulators.canopen.object_dictionary import ObjectDictionary
from emulators.cia402.objects import DriveObjects
from emulators.cia402.power_drive import PowerDrive
from emulators.cia402.units import limited
from emulators.firmware.axis import Axis


@final
class Readings:
    """Actual values in the drive's units."""

    def __init__(self, axis: Axis, objects: DriveObjects, power_drive: PowerDrive) -> None:
        self._axis = axis
        self._objects = objects
        self._power_drive = power_drive

    def bind(self, od: ObjectDictionary) -> None:
        """Bind the readers to the visible objects."""
        for index, reader in (
            (0x603F, self.error_code),
            (0x6041, self.statusword),
            (0x6061, self.mode),
            (0x6062, self.position_demand),
            (0x6063, self.position_internal),
            (0x6064, self.position),
            (0x6069, self.velocity_sensor),
            (0x606B, self.velocity_demand),
            (0x606C, self.velocity),
            (0x6074, self.torque_demand),
            (0x6077, self.torque),
            (0x6078, self.current),
            (0x6079, self.supply),
            (0x60F4, self.following_error),
            (0x60FC, self.position_demand_internal),
            (0x60FD, self.digital_inputs),
        ):
            variable = od.get(index)
            if variable is not None:
                variable.reader = reader

    def error_code(self) -> int:
        """Return 603Fh: the present fault; 0 after its reset."""
        return self._power_drive.error_code

    def statusword(self) -> int:
        """Return 6041h."""
        return self._power_drive.statusword()

    def mode(self) -> int:
        """Return 6061h."""
        return self._power_drive.mode

    def position_demand(self) -> int:
        """Return 6062h [position unit]."""
        return self._objects.units.position_raw(self._axis.demand_inc())

    def position_internal(self) -> int:
        """Return 6063h [increments], signed 32 bit, wrapping."""
        return _wrapped(self._axis.position_inc())

    def position(self) -> int:
        """Return 6064h [position unit]."""
        return self._objects.units.position_raw(self._axis.position_inc())

    def velocity_sensor(self) -> int:
        """Return 6069h [inc/s]."""
        return limited(self._axis.velocity_inc_s(), 0x7FFF_FFFF)

    def velocity_demand(self) -> int:
        """Return 606Bh [velocity unit]."""
        return self._objects.units.velocity_raw(self._axis.demand_velocity_inc_s())

    def velocity(self) -> int:
        """Return 606Ch [velocity unit]."""
        return self._objects.units.velocity_raw(self._axis.velocity_inc_s())

    def torque_demand(self) -> int:
        """Return 6074h [1/1000 of 6076h]."""
        return self._objects.torque.torque_raw(self._axis.current_demand_a())

    def torque(self) -> int:
        """Return 6077h [1/1000 of 6076h]."""
        return self._objects.torque.torque_raw(self._axis.current_a())

    def current(self) -> int:
        """Return 6078h [1/1000 of 6075h]."""
        return self._objects.torque.current_raw(self._axis.current_a())

    def supply(self) -> int:
        """Return 6079h [mV]."""
        volts = self._axis.dc_link_v() if self._power_drive.voltage else 0.0
        return int(volts * 1000.0)

    def following_error(self) -> int:
        """Return 60F4h [position unit]."""
        return self._objects.units.length_raw(self._axis.following_error_inc())

    def position_demand_internal(self) -> int:
        """Return 60FCh [increments], signed 32 bit, wrapping."""
        return _wrapped(self._axis.demand_inc())

    def digital_inputs(self) -> int:
        """Return 60FDh."""
        return self._power_drive.inputs.bits


def _wrapped(value: int) -> int:
    return (value + 0x8000_0000 & 0xFFFF_FFFF) - 0x8000_0000
