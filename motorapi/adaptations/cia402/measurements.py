"""State, fault, measurements and limits of a drive, in SI units."""

from copy import copy
from dataclasses import replace
from typing import TYPE_CHECKING, Final, final

from motorhil.motorapi.adaptations.canopen.emcy import error_text
from motorhil.motorapi.adaptations.cia402.bringup import DriveFacts
from motorhil.motorapi.adaptations.cia402.hardware import Cia402HwMotor
from motorhil.motorapi.adaptations.cia402.objects import (
    FAULT_BIT,
    STATE_BITS,
    PdsState,
    decode_state,
)
from motorhil.motorapi.adaptations.cia402.parameters import HALT_OPTION, HOME_OFFSET
from motorhil.motorapi.adaptations.cia402.profile import DriveLimits, TorqueUnit, torque_unit
from motorhil.motorapi.adaptations.cia402.units import DriveUnits, drive_units, velocity_direction
from motorhil.motorapi.commands import ControlVariable
from motorhil.motorapi.errors import DeadlineExceeded, UnsupportedError
from motorhil.motorapi.state import Fault, Measurement, MotorState

if TYPE_CHECKING:
    from motorhil.motorapi.model import MotorModel

_WINDOW_OFF: Final = 0xFFFF_FFFF
_STATES: Final = {
    PdsState.OPERATION_ENABLED: MotorState.ENABLED,
    PdsState.QUICK_STOP_ACTIVE: MotorState.STOPPED,
    PdsState.FAULT: MotorState.FAULT,
    PdsState.FAULT_REACTION_ACTIVE: MotorState.FAULT,
}
_STATE_OF_BITS: Final = tuple(
    _STATES.get(state, MotorState.DISABLED) if state is not None else MotorState.DISABLED
    for state in map(decode_state, range(STATE_BITS + 1))
)


@final
class DriveReader:
    """One logical motor's view of a drive: the drive's values in the units of the motor model.

    Attributes:
        held: the last target position commanded, in increments and in U.
    """

    def __init__(self, hardware: Cia402HwMotor, model: "MotorModel", motor: str) -> None:
        self.held: tuple[int | None, float] = (None, 0.0)
        self._hardware = hardware
        self._node = hardware.node
        self._objects = hardware.objects
        self._model = model
        self._motor = motor
        self._facts: DriveFacts | None = None
        self._units: DriveUnits | None = None
        self._limits: DriveLimits | None = None
        self._home_changes = 0
        self._is_directed = False
        self._torque: TorqueUnit | None = None
        self._no_torque: UnsupportedError | None = None

    def known(self) -> tuple[DriveUnits, DriveLimits]:
        """Return units and limits, read from the drive once after each bring-up.

        They are not read when it is connected: a logical motor may stop the drive at any time,
        without waiting for them.
        """
        facts = self._hardware.connect()
        units, limits = self._units, self._limits
        if units is None or limits is None or facts is not self._facts:
            units = drive_units(self._motor, self._model, self._objects.read_optional)
            limits = _read_limits(self._hardware)
            self._torque = self._no_torque = None
            self._is_directed = False
        elif self._home_changes != self._hardware.home_changes and limits.position is not None:
            limits = replace(limits, position=_read_position_limits(self._hardware))
        self._facts, self._home_changes = facts, self._hardware.home_changes
        self._units, self._limits = units, limits
        if self._hardware.options.velocity_period_ms:
            units = self._direct(units)
        return units, limits

    def known_of(self, variable: ControlVariable) -> tuple[DriveUnits, DriveLimits]:
        """Return units and limits for a motion of `variable`."""
        units, limits = self.known()
        return self._direct(units) if variable is ControlVariable.VELOCITY else units, limits

    def _direct(self, units: DriveUnits) -> DriveUnits:
        """Return the units with the direction of velocities, read once after each bring-up.

        Only motions and measurements of velocity need it.
        """
        if self._is_directed:
            return units
        direction = velocity_direction(self._objects.read_optional)
        self._units = units = replace(units, velocity_direction=direction)
        self._is_directed = True
        return units

    def torque_unit(self) -> TorqueUnit:
        """Return the units of the drive's torque objects, read once per bring-up.

        Raises:
            UnsupportedError: neither the drive nor the model defines them.
        """
        units = self.known()[0]
        unit = self._torque
        if unit is None:
            read = self._objects.read_optional
            try:
                unit = torque_unit(self._motor, self._model, units.increments(1.0), read)
            except UnsupportedError as error:
                self._no_torque = error
                raise
            self._torque = unit
        return unit

    def check_torque(self) -> None:
        """Raise the error of `torque_unit` again, without asking the drive."""
        if self._no_torque is not None:
            raise copy(self._no_torque)

    @property
    def units(self) -> DriveUnits:
        """The units of the drive's objects."""
        return self.known()[0]

    def state(self) -> MotorState:
        """Return the last state received, without waiting."""
        node = self._node
        if self._hardware.facts is None or node.is_lost or node.status_ns < 0:
            return MotorState.OFFLINE
        known = _STATE_OF_BITS[node.statusword & STATE_BITS]
        if known is MotorState.DISABLED and self._hardware.quick_stopped:
            return MotorState.STOPPED  # 605Ah may switch off at the end of a quick stop
        return known

    def fresh_state(self) -> MotorState:
        """Return the state, polled if the drive does not send it cyclically.

        A drive that has left OPERATIONAL sends no PDOs: its last status is no longer valid.
        """
        node = self._node
        if self._hardware.facts is None or node.is_lost:
            return MotorState.OFFLINE
        if node.is_up:
            node.refresh()
            return self.state()
        try:
            node.poll_status()
        except DeadlineExceeded:
            return MotorState.OFFLINE
        return self.state()

    def fault(self) -> Fault | None:
        """Return the fault that the drive reports, or None."""
        node = self._node
        if self._hardware.facts is None or node.is_lost:
            return None
        node.refresh()
        if not node.statusword & FAULT_BIT:
            return None
        code = node.error_code or self._objects.read_optional(0x603F) or 0
        since_ns = node.status_ns if node.fault_since_ns is None else node.fault_since_ns
        return Fault(code, error_text(code), since_ns)

    def position(self) -> float:
        """Return the measured position [U]."""
        self._node.check_heard()
        self._node.refresh()
        return self.units.position(self._node.position_inc)

    def velocity(self) -> float:
        """Return the measured velocity [U/s]."""
        units, _ = self.known_of(ControlVariable.VELOCITY)
        return units.velocity(self._objects.read_int(0x606C))

    def reference(self) -> float:
        """Return the position demand, or the measured position if there is none [U].

        Raises:
            UsageError: a unit is not known. A motion is planned from this value, so a missing unit
                is reported before the motion begins.
        """
        self.units.require_all()
        self._node.check_link()
        self._node.refresh()
        if self._node.state is PdsState.OPERATION_ENABLED:
            demand = self._objects.read_optional(0x6062)
            if demand is not None:
                # Return the target as commanded while the drive holds it: rounding must not
                # accumulate.
                demand = self._node.on_from(demand)
                return self.held[1] if demand == self.held[0] else self.units.position(demand)
        return self.position()

    def torque(self) -> float:
        """Return the measured torque [N·m] or force [N] of the output, behind the gear."""
        unit = self.torque_unit()
        permille = self._objects.read_optional(0x6077)
        if permille is None:
            raise UnsupportedError(motor=self._motor, feature="measuring torque (no 6077h)")
        return unit.torque(permille)

    def following_error(self) -> float:
        """Return the following error, demand minus actual position [U]."""
        error = self._objects.read_optional(0x60F4)
        if error is None:
            position_inc = self._node.on_from(self._objects.read_int(0x6064))
            return self.reference() - self.units.position(position_inc)
        return self.units.position(error)

    def position_source(self) -> str:
        """Return the source of the position in `latest`."""
        facts = self._hardware.control.facts
        if facts is None or facts.status is None:
            return "6064h, asked for by SDO"
        found = facts.status
        every = f" every {found.event_ms} ms" if found.event_ms else ""
        return f"6064h in TPDO {found.cob_id & 0x7FF:03X}h{every}, when it was heard"

    def latest(self) -> Measurement | None:
        """Return the last measurement received, without waiting or sending."""
        node, units = self._node, self._units
        if node.status_ns < 0:
            return None
        position = velocity = None
        if units is not None and units.increments_per_unit is not None:
            position = units.position(node.position_inc)
            raw = node.values.get((0x606C, 0))
            if raw is not None and units.velocity_unit is not None and self._is_directed:
                velocity = units.velocity(raw)
        state = MotorState.OFFLINE if node.is_old else self.state()
        # The constructor of a named tuple is an interpreted function around this one.
        return tuple.__new__(Measurement, (node.status_ns, state, position, velocity, None, None))


def _read_limits(hardware: Cia402HwMotor) -> DriveLimits:
    read = hardware.objects.read_optional
    position = _read_position_limits(hardware)
    window = read(0x6067)
    return DriveLimits(
        position=position,
        speed=read(0x607F),
        acceleration=read(0x60C5),
        deceleration=read(0x60C6),
        window=None if window == _WINDOW_OFF else window,
        has_deceleration=read(0x6084) is not None,
        halt_option=read(HALT_OPTION),
    )


def _read_position_limits(hardware: Cia402HwMotor) -> tuple[int, int] | None:
    """Return 607Dh, counted from zero; the object counts from home (CiA 402-2, 607Dh)."""
    read = hardware.objects.read_optional
    low, high = read(0x607D, 1), read(0x607D, 2)
    if low is None or high is None or low == high == 0:
        return None
    offset = read(HOME_OFFSET) or 0
    return low - offset, high - offset
