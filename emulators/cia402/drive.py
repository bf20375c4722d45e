"""A CiA 402 drive: one CANopen node, one power drive, one axis; sans-I/O.

The drive updates itself on input, when the node has work to do, and at the exact tick at which the
axis' flags change. In between, and at rest, it costs nothing.
"""

from collections.abc import Mapping, Sequence
from typing import Final, final

from emulators.canopen.lss import UNCONFIGURED
from emulators.canopen.nmt import NmtState
from emulators.canopen.node import CanopenNode, NodeTiming
from emulators.canopen.object_dictionary import ObjectDictionary
from emulators.canopen.shared import NEVER
from emulators.cia402.faults import COMMUNICATION_LOST, HEARTBEAT_LOST, error_register, told
from emulators.cia402.objects import DriveObjects
from emulators.cia402.power_drive import NO_FAULT, PowerDrive
from emulators.cia402.protection import STIMULI as PROTECTION_STIMULI
from emulators.cia402.protection import Protection
from emulators.cia402.quirks import deviate
from emulators.cia402.readings import Readings
from emulators.cia402.settings import DriveSettings
from emulators.controller import NonvolatileMemory
from emulators.firmware.axis import Axis
from emulators.firmware.digital_inputs import STIMULI as INPUT_STIMULI
from emulators.firmware.digital_inputs import DigitalInputs
from emulators.motor_settings import axis_of
from emulators.plant.dc_motor import RANGES

STIMULI: Final = (
    *("load_torque_n_m", "fault", "power"),
    *PROTECTION_STIMULI,
    *INPUT_STIMULI,
)


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
        self._truth = {
            "position_rad": axis.output_position_rad(),
            "velocity_rad_s": axis.output_velocity_rad_s(),
            "position_inc": float(axis.position_inc()),
            "demand_inc": float(axis.demand_inc()),
            "current_a": axis.current_a(),
            "torque_n_m": axis.torque_n_m(),
            "following_error_inc": float(axis.following_error_inc()),
            "state": float(state),
            "mode": float(mode),
        }
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
        written = objects.written.kinds
        if not written:
            return
        objects.written.kinds = 0
        self._happens()
        self.axis.at(now_ns)
        self._power_drive.settle(now_ns)
        self._power_drive.written(written, now_ns)

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
