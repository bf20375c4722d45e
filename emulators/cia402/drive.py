"""A CiA 402 drive: CANopen node, power drive and axis; sans-I/O.

The drive updates itself on input, when the node has work to do, and at the exact tick at which the
axis' flags change. In between, and at rest, it costs nothing.

`build` makes a drive of its rig table (`motorhil.controllers` entry point `cia402`). Actual values
have readers, bound to the objects in the EDS. Every reader returns the value at the last `axis.at`.

Protective functions switch the torque off. The axis reports winding temperature, I2t and DC link in
its flags, at the exact tick, and the power drive evaluates them. All other conditions are stimuli.
An input keeps its value until it is changed, and the fault that it caused cannot be reset
meanwhile. `sto` switches the torque off without the firmware; the vendor decides if that is a fault
(table `protection`).

A lost incremental encoder stops counting. The position that a host reads then stays constant,
whatever the motor does. Once the encoder is back it counts on from there, and the drive's reference
is lost.
"""

from collections.abc import Mapping, Sequence
from typing import Final, final

from motorhil.emulators.canopen.files.eds import EdsError, read_eds
from motorhil.emulators.canopen.lss import UNCONFIGURED
from motorhil.emulators.canopen.nmt import NmtState
from motorhil.emulators.canopen.node import CanopenNode
from motorhil.emulators.canopen.object_dictionary import (
    DataType,
    ObjectDictionary,
    Reader,
    Value,
    Variable,
    is_integer,
    length_bits,
)
from motorhil.emulators.canopen.outbox import NEVER, NodeTiming
from motorhil.emulators.cia402.faults import (
    COMMUNICATION_LOST,
    DEVICE_TEMPERATURE,
    ENCODER,
    ERROR_PASSIVE,
    HEARTBEAT_LOST,
    MAINS_OVER_VOLTAGE,
    MAINS_UNDER_VOLTAGE,
    SHORT_CIRCUIT,
    WARNED_BY_INPUT,
    error_register,
    told,
)
from motorhil.emulators.cia402.objects.dictionary import DriveObjects
from motorhil.emulators.cia402.objects.units import Units, limited
from motorhil.emulators.cia402.power_drive import NO_FAULT, PowerDrive
from motorhil.emulators.cia402.quirks import QuirkyWire, deviate, wire_quirks
from motorhil.emulators.cia402.settings import (
    EMULATED_MODES,
    MODES,
    OWN_EDS,
    DriveSettings,
    out_of_reach,
    read_settings,
)
from motorhil.emulators.cia402.settings import told as told_of_quirk_catalogue
from motorhil.emulators.cia402.state_machine import PdsState
from motorhil.emulators.controller import (
    Controller,
    ControllerContext,
    NonvolatileMemory,
    SettingError,
)
from motorhil.emulators.firmware.axis import Axis
from motorhil.emulators.firmware.clock import on_own_time
from motorhil.emulators.firmware.digital_inputs import STIMULI as INPUT_STIMULI
from motorhil.emulators.firmware.digital_inputs import DigitalInputs
from motorhil.emulators.plant.dc_motor import RANGES
from motorhil.emulators.settings.motor import axis_of
from motorhil.emulators.settings.protection import TEMPERATURE_RANGE_C, ProtectionSettings

# Inputs whose value 1 is the cause of a fault.
CAUSES: Final[dict[str, int]] = {
    "short_circuit": SHORT_CIRCUIT,
    "mains_over_voltage": MAINS_OVER_VOLTAGE,
    "mains_under_voltage": MAINS_UNDER_VOLTAGE,
}
_SWITCHES: Final = ("sto", "encoder", *CAUSES, "error_passive", "bus_off")
PROTECTION_STIMULI: Final = (*_SWITCHES, "device_temperature_c", "supply_v")

# Objects derived from the encoder.
_POSITIONS: Final = (0x6063, 0x6064)
_VELOCITIES: Final = (0x6069, 0x606C, 0x60F4)

STIMULI: Final = (
    *("load_torque_n_m", "fault", "power"),
    *PROTECTION_STIMULI,
    *INPUT_STIMULI,
)

_ABSENT: Final = -(1 << 70)

# Communication objects that a rig can configure although the EDS lacks them.
_COMMUNICATION: Final[dict[tuple[int, int], DataType]] = {
    (0x1005, 0): DataType.UNSIGNED32,
    (0x1006, 0): DataType.UNSIGNED32,
    (0x1007, 0): DataType.UNSIGNED32,
    (0x100C, 0): DataType.UNSIGNED16,
    (0x100D, 0): DataType.UNSIGNED8,
    (0x1014, 0): DataType.UNSIGNED32,
    (0x1015, 0): DataType.UNSIGNED16,
    (0x1016, 1): DataType.UNSIGNED32,
    (0x1017, 0): DataType.UNSIGNED16,
    (0x1019, 0): DataType.UNSIGNED8,
    (0x1029, 1): DataType.UNSIGNED8,
    (0x1029, 2): DataType.UNSIGNED8,
}


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


@final
class Cia402Drive:
    """A drive that implements the `Controller` and `NodeHost` protocols."""

    def __init__(
        self,
        od: ObjectDictionary,
        settings: DriveSettings,
        events: Sequence[tuple[str, str]] = (),
        memory: NonvolatileMemory | None = None,
    ) -> None:
        self.od = od
        self.settings = settings
        self.axis: Axis = axis_of(settings, settings.oscillator.rate())
        self._objects = DriveObjects(od, settings)
        inputs = DigitalInputs(
            self.axis,
            settings.switches,
            settings.index_count,
            settings.plant.encoder_increments_rev,
        )
        self._power_drive = PowerDrive(
            self.axis, self._objects, inputs, settings.tick_ns, settings.enable_ns
        )
        deviate(self._power_drive, self._objects, od, settings.quirks)
        Readings(self.axis, self._objects, self._power_drive).bind(od)
        self._node = CanopenNode(
            od,
            UNCONFIGURED if settings.node_id_by_lss else settings.node_id,
            NodeTiming(boot_up_ns=settings.boot_up_ns, sdo_reply_ns=settings.sdo_reply_ns),
            self,
            memory,
        )
        self._protection = Protection(
            self.axis, od, self._node, self._power_drive, settings.protection
        )
        self._outbox = self._node.outbox
        self._events: list[tuple[str, str]] = list(events)
        self._events += [("warning", line) for line in self._objects.torque.doubts()]
        self._statusword: int = 0  # as last reported to the node's TPDOs
        self._mode: int = 0
        self._inputs: int = self._power_drive.inputs.bits
        self._probes: int = 0
        self._error_code: int = NO_FAULT
        self._errors: int = 0  # the classes (1001h) of all errors since the last fault reset
        self._touched: bool = False  # True if an input other than time may have changed the outputs
        self._is_settled: bool = False  # True if all outputs are reported and unchanged since
        self._deadline_ns: int = NEVER
        self._motor_due_ns: int = NEVER  # the deadline without the node's
        self._power_due_ns: int = NEVER  # the power drive's deadline; recomputed after a change
        self._flags_matter: bool = False
        self._power_moved: bool = True
        self._deadline_moved: bool = True
        self._has_extras: bool = settings.plant.extras.is_any()
        self._truth: dict[
            str, float
        ] = {}  # the last snapshot, for this state, mode, rest and inputs:
        self._truth_of: tuple[int, int, int, int] = (0, 0, -1, 0)

    def units(self) -> Units:
        """Return the present units of its objects."""
        return self._objects.units

    def is_homed(self) -> bool:
        """Return whether a homing has attained its home position since power-on."""
        return self._power_drive.is_homed()

    # --- Controller

    def start(self, now_ns: int) -> None:
        """Power the drive on."""
        self._node.start(now_ns)
        self._power_moved = True
        self._deadline_moved = True

    def receive(self, data: bytes, now_ns: int) -> None:
        """Handle a frame received from the bus."""
        self._node.receive(data, now_ns)
        if self._touched:
            self._publish(now_ns)
        elif self._outbox.deadlines_moved:
            self._deadline_moved = True

    def sent(self, data: bytes, now_ns: int) -> bool:
        """Report that an own frame has left the bus; return True if the drive has more to do."""
        self._node.sent(data, now_ns)
        outbox = self._outbox
        if self._touched or outbox.deadlines_moved or outbox.frames or outbox.events:
            self._deadline_moved = True
            return True
        return False

    def wants_sent(self) -> bool:
        """Return True if the node waits for its TPDOs to leave."""
        return self._node.wants_sent()

    def next_deadline_ns(self) -> int | None:
        """Return when `expire` must be called at the latest [ns]."""
        if self._deadline_moved:
            self._find_deadline()
        return None if self._deadline_ns == NEVER else self._deadline_ns

    def expire(self, now_ns: int) -> None:
        """Do everything that is due: first the motor's part, then the node's."""
        if now_ns >= self._motor_due_ns or self._deadline_moved:
            self.axis.at(now_ns)
            self._power_drive.settle(now_ns)
            self._publish(now_ns)
            self._is_settled = True
        if self._node.deadline_ns() <= now_ns:
            self._node.expire(now_ns)
        self._is_settled = False
        if self._touched:
            self._publish(now_ns)
        elif self._outbox.deadlines_moved:
            self._deadline_moved = True

    def take_output(self) -> Sequence[bytes]:
        """Return the frames to send now."""
        return self._node.take_output() if self._outbox.frames else ()

    def take_events(self) -> Sequence[tuple[str, str]]:
        """Return the events since the last call as (level, text)."""
        if not self._outbox.events and not self._events:
            return ()
        own = self._events
        self._events = []
        return [*self._node.take_events(), *own]

    def stimulate(self, name: str, value: float, now_ns: int) -> None:
        """Set a physical input of the drive.

        The names are "load_torque_n_m" (load at the output [N m]), "fault" (an error code), "power"
        (the power stage's supply, 0 or 1), the stimuli of `Protection`, and the digital inputs.

        Raises:
            ValueError: the stimulus does not exist, or the value is invalid.
        """
        self.axis.at(now_ns)
        self._power_drive.settle(now_ns)
        if name == "load_torque_n_m":
            low, high = RANGES[name]
            if not low <= value <= high:
                raise ValueError(f"load_torque_n_m is {low:g}..{high:g} N m, not {value}")
            self.axis.set_load(value)
        elif name == "fault":
            if not (1 <= value <= 0xFFFF and value == int(value)):
                raise ValueError(f"fault takes an error code 0001h..FFFFh, not {value}")
            self._power_drive.fault(int(value), now_ns)
        elif name == "power":
            if value not in (0, 1):
                raise ValueError(f"power is 0 or 1, not {value}")
            self._power_drive.set_voltage(value == 1, now_ns)
        elif name in PROTECTION_STIMULI:
            self._protection.stimulate(name, value, now_ns)
        elif name in INPUT_STIMULI:
            self._power_drive.saw(self._power_drive.inputs.stimulate(name, value))
        else:
            raise ValueError(f"there is no stimulus {name!r}; known: {', '.join(STIMULI)}")
        self._publish(now_ns)

    def snapshot(self, now_ns: int) -> Mapping[str, float]:
        """Return the true state at `now_ns`; values in rad and N m are at the gear's output."""
        axis = self.axis
        axis.at(now_ns)
        state, mode, rest = int(self._power_drive.fsa.state), self._power_drive.mode, axis.rest()
        bits = self._power_drive.inputs.bits
        what = (state, mode, rest, bits)
        if rest >= 0 and what == self._truth_of:
            return self._truth
        self._truth_of = what
        self._truth = axis.truth()
        self._truth["following_error_inc"] = float(axis.following_error_inc())
        self._truth["state"] = float(state)
        self._truth["mode"] = float(mode)
        if self._has_extras:
            self._truth.update(axis.truth_of_extras())
        if self.settings.switches:
            self._truth["inputs"] = float(bits)
        return self._truth

    def identifiers(self) -> Sequence[int] | None:
        """Return the CAN identifiers that the drive listens to."""
        return self._node.identifiers()

    def identifiers_revision(self) -> int:
        """Return a number that increases whenever `identifiers` changes."""
        return self._node.identifiers_revision()

    def tell(self, events: Sequence[tuple[str, str]]) -> None:
        """Add events of the drive's making to those of `take_events`."""
        self._events += events

    # --- NodeHost

    def on_nmt(self, state: int, now_ns: int) -> None:
        """Initialise the power drive with the node; treat STOPPED as a lost connection."""
        self._happens()
        if state == NmtState.PRE_OPERATIONAL:
            self.axis.at(now_ns)
            self._power_drive.initialised(now_ns)
        elif state == NmtState.STOPPED:
            self._abort(COMMUNICATION_LOST, now_ns)

    def on_reset(self, whole: bool, now_ns: int) -> None:
        """Restart the firmware on reset node; treat reset communication as a lost connection."""
        if not whole:
            self._abort(COMMUNICATION_LOST, now_ns)
            return
        self._happens()
        self.axis.at(now_ns)
        self._objects.reload()
        self._power_drive.power_on()

    def on_write(self, now_ns: int) -> None:
        """Apply the objects that were written."""
        objects = self._objects
        changes = objects.changes.pending
        if not changes:
            return
        objects.changes.pending = 0
        self._happens()
        self.axis.at(now_ns)
        self._power_drive.settle(now_ns)
        self._power_drive.written(changes, now_ns)

    def on_sync(self, now_ns: int) -> None:
        """Handle SYNC; `on_write` has already applied the synchronous RPDOs."""
        if self._power_drive.synced(now_ns):
            self._happens()

    def before_read(self, now_ns: int) -> None:
        """Advance the drive so that readers answer as of now."""
        self.axis.at(now_ns)
        if self._is_settled or (now_ns < self._motor_due_ns and not self._touched):
            return  # only the motor's position has changed
        self._touched = True
        self._power_moved = True
        self._power_drive.settle(now_ns)

    def on_heartbeat_lost(self, node_id: int, now_ns: int) -> None:
        """Apply 6007h (abort connection option code)."""
        self._abort(HEARTBEAT_LOST, now_ns)

    def on_bus_off(self, now_ns: int) -> None:
        """Apply 6007h (abort connection option code)."""
        self._abort(COMMUNICATION_LOST, now_ns)

    # --- internals

    def _happens(self) -> None:
        """Record that an input other than time may change the outputs."""
        self._touched = True
        self._power_moved = True
        self._is_settled = False

    def _abort(self, code: int, now_ns: int) -> None:
        self._happens()
        self.axis.at(now_ns)
        self._power_drive.abort_connection(code, now_ns)

    def _publish(self, now_ns: int) -> None:
        """Report all changes: first by EMCY, then to the TPDOs that map them."""
        self._touched = False
        self._power_moved = True
        self._deadline_moved = True
        power_drive = self._power_drive
        node = self._node
        if power_drive.told:
            for code in power_drive.told:
                self._errors = self._with_class(code)
                node.emergency(code, self._errors, b"", now_ns)
                self._tell(code)
            power_drive.told.clear()
        if power_drive.error_code != self._error_code:
            self._error_code = power_drive.error_code
            errors = self._with_class(self._error_code)
            if (
                errors != self._errors
            ):  # a lost connection, whose EMCY was not sent or was sent by the node
                self._errors = errors
                node.errors_stand(errors, now_ns)
            node.object_changed(0x603F, 0, now_ns)
        if power_drive.mode != self._mode:
            self._mode = power_drive.mode
            node.object_changed(0x6061, 0, now_ns)
        if power_drive.inputs.moved:
            power_drive.inputs.moved = False
            self._tell_inputs(now_ns)
        statusword = power_drive.statusword()
        if statusword != self._statusword:
            self._statusword = statusword
            node.object_changed(0x6041, 0, now_ns)

    def _tell_inputs(self, now_ns: int) -> None:
        """Report 60FDh and 60B9h to the TPDOs that map them."""
        inputs, probes = self._power_drive.inputs.bits, self._power_drive.touch_probe.status
        if inputs != self._inputs:
            self._inputs = inputs
            self._node.object_changed(0x60FD, 0, now_ns)
        if probes != self._probes:
            self._probes = probes
            self._node.object_changed(0x60B9, 0, now_ns)

    def _with_class(self, code: int) -> int:
        """Return the present errors with this code's class added; 0000h clears them all."""
        return self._errors | error_register(code) if code else 0

    def _tell(self, code: int) -> None:
        if code == NO_FAULT:
            self._events.append(("info", "fault reset"))
            return
        self._events.append(("error", told(code)))

    def _find_deadline(self) -> None:
        """Find the earliest event of the node, the power drive and the axis."""
        self._deadline_moved = False
        if self._power_moved:
            self._power_moved = False
            self._power_due_ns = self._power_drive.deadline_ns()
            self._flags_matter = self._power_drive.flags_matter()
        motor_ns = self._power_due_ns
        node_ns = self._node.deadline_ns()
        if self._flags_matter:
            event_ns = self.axis.event_ns(node_ns if node_ns < motor_ns else motor_ns)
            if event_ns < motor_ns:
                motor_ns = event_ns
        self._motor_due_ns = motor_ns
        self._deadline_ns = node_ns if node_ns < motor_ns else motor_ns


def build(settings: Mapping[str, object], context: ControllerContext) -> Controller:
    """Build the drive that a rig describes.

    Args:
        settings: the controller's table without `kind` and `bus`.
        context: the controller's name, the folder of relative paths, the seed.

    Raises:
        SettingError: a key or value is wrong, or the EDS cannot be read; names the keys.
    """
    read = read_settings(settings, context.folder, context.stream())
    drive: Controller = build_drive(read, context.memory(read.nonvolatile_memory))
    wire = wire_quirks(read.quirks)
    if wire.are_any():
        drive = QuirkyWire(drive, wire, context.stream())
    return on_own_time(drive, read.oscillator)


def build_drive(settings: DriveSettings, memory: NonvolatileMemory | None = None) -> Cia402Drive:
    """Build the drive with these settings; all times passed to it must be by its own clock.

    Raises:
        SettingError: the EDS cannot be read, or an object of `settings.objects` cannot be set.
    """
    try:
        description = read_eds(settings.eds, settings.node_id)
    except EdsError as error:
        place = f"{error.path}:{error.line}" if error.line else str(error.path)
        raise SettingError(("eds",), f"{place}: {error.text}", error.remedy) from error
    od = description.dictionary()
    if od.get(0x6040) is None or od.get(0x6041) is None:
        raise SettingError(
            ("eds",),
            f"{settings.eds} has no 6040h and 6041h: it is not the EDS of a CiA 402 drive",
            "use the drive's own EDS, or omit eds for ours",
        )
    events = [("warning", f"{path}:{line}: {text}") for path, line, text in description.warnings]
    if not settings.oscillator.is_ideal():
        events.append(("info", settings.oscillator.told()))
    events += [("info", line) for line in told_of_quirk_catalogue(settings.quirks)]
    events += [("warning", line) for line in out_of_reach(settings.switches, settings.plant)]
    modes = od.integer(0x6502, 0, 0)
    _set_objects(od, settings)
    if settings.supported_modes is None:
        left_out = [
            name
            for name, mode in MODES.items()
            if modes >> (mode - 1) & 1 and name not in EMULATED_MODES
        ]
        if left_out:
            text = f"6502h of {settings.eds.name} also names {', '.join(left_out)}: not emulated"
            events.append(("info", text))
    try:
        drive = Cia402Drive(od, settings, events, memory)
    except ValueError as error:
        raise SettingError(
            ("servo",), str(error), "reduce the gains of the current loop"
        ) from error
    if settings.eds != OWN_EDS:
        stated = [(wanted.index, wanted.subindex) for wanted in settings.objects]
        drive.tell([("info", line) for line in description.supplied(od, stated)])
    return drive


def _set_objects(od: ObjectDictionary, settings: DriveSettings) -> None:
    """Set the power-on values of the rig; absent objects can have one if the drive uses them."""
    if not settings.objects:
        return
    behind = ObjectDictionary()
    DriveObjects(behind, settings)
    for wanted in settings.objects:
        path = ("objects", wanted.key)
        variable = od.get(wanted.index, wanted.subindex)
        if variable is None:
            variable = _hidden(od, behind, wanted.index, wanted.subindex)
        if variable is None:
            raise SettingError(
                path,
                f"{settings.eds.name} has no such object, and the drive does not use it internally",
                "remove it, or use an EDS that has it",
            )
        try:
            variable.set_default(_value(variable, wanted.value))
        except (TypeError, ValueError) as error:
            raise SettingError(path, str(error)) from error


def _hidden(
    od: ObjectDictionary, behind: ObjectDictionary, index: int, subindex: int
) -> Variable | None:
    data_type: int | None = _COMMUNICATION.get((index, subindex))
    if data_type is None and behind.integer(index, subindex, _ABSENT) != _ABSENT:
        data_type = behind.ensure(index, subindex, DataType.UNSIGNED32, 0).data_type
    return None if data_type is None else od.ensure(index, subindex, data_type, 0)


def _value(variable: Variable, value: int | float | str) -> Value:
    """Return the rig's value in the Python type that the variable holds."""
    if isinstance(value, str):
        if length_bits(variable.data_type):
            raise TypeError(f"{value!r} is not a number")
        return value.encode("utf-8")
    if not is_integer(variable.data_type):
        return float(value)
    if isinstance(value, float):
        raise TypeError(f"{value} is not a whole number")
    low, high = variable.low, variable.high
    if (low is not None and value < low) or (high is not None and value > high):
        raise ValueError(f"{value} is outside {low}..{high}")
    return value
