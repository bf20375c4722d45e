"""Protective functions of the drive: inputs that switch the torque off.

The axis reports winding temperature, I2t and DC link in its flags, at the exact tick, and the power
drive evaluates them. All other conditions are stimuli. An input keeps its value until it is
changed, and the fault that it caused cannot be reset meanwhile. `sto` switches the torque off
without the firmware; the vendor decides if that is a fault (table `protection`).

A lost incremental encoder stops counting. The position that a host reads then stays constant,
whatever the motor does. Once the encoder is back it counts on from there, and the drive's reference
is lost.
"""

from typing import Final, final

from emulators.canopen.node import CanopenNode
from emulators.canopen.object_dictionary import ObjectDictionary, Reader, Variable
from emulators.cia402.faults import (
    COMMUNICATION_LOST,
    DEVICE_TEMPERATURE,
    ENCODER,
    ERROR_PASSIVE,
    MAINS_OVER_VOLTAGE,
    MAINS_UNDER_VOLTAGE,
    SHORT_CIRCUIT,
    WARNED_BY_INPUT,
)
from emulators.cia402.pds_fsa import PdsState
from emulators.cia402.power_drive import PowerDrive
from emulators.firmware.axis import Axis
from emulators.plant.dc_motor import RANGES
from emulators.protection_settings import TEMPERATURE_RANGE_C, ProtectionSettings

# Inputs whose value 1 is the cause of a fault.
CAUSES: Final[dict[str, int]] = {
    "short_circuit": SHORT_CIRCUIT,
    "mains_over_voltage": MAINS_OVER_VOLTAGE,
    "mains_under_voltage": MAINS_UNDER_VOLTAGE,
}
_SWITCHES: Final = ("sto", "encoder", *CAUSES, "error_passive", "bus_off")
STIMULI: Final = (*_SWITCHES, "device_temperature_c", "supply_v")

# Objects derived from the encoder.
_POSITIONS: Final = (0x6063, 0x6064)
_VELOCITIES: Final = (0x6069, 0x606C, 0x60F4)


@final
class Held:
    """A reader that always returns the same value."""

    def __init__(self, value: int) -> None:
        self._value = value

    def read(self) -> int:
        """Return the value."""
        return self._value


@final
class Protection:
    """The physical inputs of one drive. Call its methods after `axis.at(now_ns)`."""

    def __init__(
        self,
        axis: Axis,
        od: ObjectDictionary,
        node: CanopenNode,
        power_drive: PowerDrive,
        settings: ProtectionSettings,
    ) -> None:
        self._axis = axis
        self._od = od
        self._node = node
        self._power_drive = power_drive
        self._settings = settings
        self._has_encoder: bool = True
        self._position_inc: int = 0  # the position at which the encoder was lost
        self._held: list[tuple[Variable, Reader]] = []  # with their original readers
        self._is_passive: bool = False
        self._is_off: bool = False
        if power_drive.is_watched:
            axis.set_thresholds(
                over_voltage_v=settings.over_voltage_v,
                under_voltage_v=settings.under_voltage_v,
                over_temperature_c=settings.winding_temperature_max_c,
                temperature_warning_c=settings.winding_temperature_warning_c,
                i2t_warning=settings.i2t_warning,
            )

    def stimulate(self, name: str, value: float, now_ns: int) -> None:
        """Set an input of STIMULI.

        Raises:
            ValueError: the value is invalid.
        """
        if name == "device_temperature_c":
            self._heat(value, now_ns)
            return
        if name == "supply_v":
            self._supply(value)
            return
        if value not in (0, 1):
            raise ValueError(f"{name} is 0 or 1, not {value}")
        is_set = value == 1
        if name == "sto":
            self._take_torque_off(is_set, now_ns)
        elif name == "encoder":
            self._connect(is_set, now_ns)
        elif name == "error_passive":
            self._be_passive(is_set, now_ns)
        elif name == "bus_off":
            self._be_off(is_set, now_ns)
        else:
            self._stand(CAUSES[name], is_set, now_ns)

    def _stand(self, code: int, stands: bool, now_ns: int) -> None:
        """Set or remove the cause of a fault; a starting drive reports it later."""
        drive = self._power_drive
        if not stands:
            drive.standing.remove(code)
        elif drive.standing.add(code) and drive.fsa.state is not PdsState.NOT_READY_TO_SWITCH_ON:
            drive.fault(code, now_ns)

    def _take_torque_off(self, off: bool, now_ns: int) -> None:
        drive, code = self._power_drive, self._settings.sto_error_code
        standing = drive.standing
        if off == standing.torque_off:
            return
        standing.torque_off = off
        if not off:
            standing.remove(code)
            return
        drive.take_torque_off(code, now_ns)
        if drive.error_code == code != 0:
            standing.add(code)

    def _heat(self, celsius: float, now_ns: int) -> None:
        low, high = TEMPERATURE_RANGE_C
        if not low <= celsius <= high:
            raise ValueError(f"device_temperature_c is {low:g}..{high:g} C, not {celsius}")
        settings = self._settings
        is_warm = celsius >= settings.device_temperature_warning_c
        self._power_drive.standing.warn(WARNED_BY_INPUT, is_warm)
        self._stand(DEVICE_TEMPERATURE, celsius >= settings.device_temperature_max_c, now_ns)

    def _supply(self, volts: float) -> None:
        low, high = RANGES["supply_v"]
        if not low <= volts <= high:
            raise ValueError(f"supply_v is {low:g}..{high:g} V, not {volts}")
        self._axis.set_supply(volts)

    def _connect(self, there: bool, now_ns: int) -> None:
        if there == self._has_encoder:
            return
        self._has_encoder = there
        if there:
            for held, reader in self._held:
                held.reader = reader
            self._held.clear()
            self._axis.set_position(self._position_inc)
            self._power_drive.lose_reference()
            self._stand(ENCODER, False, now_ns)
            return
        self._position_inc = self._axis.position_inc()
        for index in (*_POSITIONS, *_VELOCITIES):
            variable = self._od.get(index)
            read = None if variable is None else variable.reader
            if variable is not None and read is not None:
                self._held.append((variable, read))
                variable.reader = Held(read() if index in _POSITIONS else 0).read
        self._stand(ENCODER, True, now_ns)

    def _be_passive(self, passive: bool, now_ns: int) -> None:
        if passive != self._is_passive:
            self._is_passive = passive
            if passive:
                self._node.can.find(ERROR_PASSIVE, now_ns)
            else:
                self._node.can.repair(now_ns)

    def _be_off(self, off: bool, now_ns: int) -> None:
        """Set bus-off; the drive reports it only after its recovery (CiA 301: 8140h)."""
        if off == self._is_off:
            return
        self._is_off = off
        if off:
            self._power_drive.abort_connection(COMMUNICATION_LOST, now_ns)
        else:
            self._node.can.recover(now_ns)
