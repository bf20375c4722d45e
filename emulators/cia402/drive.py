"""A CiA 402 drive on a CAN bus: one CANopen node, one power drive, one axis; sans-I/O.

The drive looks at itself when something comes in, when the node has something to do, and at the
exact tick at which the axis' flags change; in between, and at rest, it costs nothing.
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
    """Implements `emulators.controller.Controller` and `emulators.canopen.node.NodeHost`."""

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
        self._statusword: int = 0  # as last told to the node's TPDOs
        self._mode: int = 0
        self._inputs: int = self._power_drive.inputs.bits
        self._probes: int = 0
        self._error_code: int = NO_FAULT
        self._errors: int = 0  # the classes (1001h) of all errors since the last fault reset
        self._touched: bool = False  # something other than time may have changed what shows
        self._is_settled: bool = False  # all that shows is told, and nothing has happened since
        self._deadline_ns: int = NEVER
        self._motor_due_ns: int = NEVER  # the same without the node's
        self._power_due_ns: int = NEVER  # the power drive's alone; found again when it has moved
        self._flags_matter: bool = False
        self._power_moved: bool = True
        self._deadline_moved: bool = True
        self._has_extras: bool = settings.plant.extras.is_any()
        self._truth: dict[str, float] = {}  # as last shown, of this state, mode, rest, inputs:
        self._truth_of: tuple[int, int, int, int] = (0, 0, -1, 0)

    # --- Controller

    def start(self, now_ns: int) -> None:
        """Power comes on."""
        self._node.start(now_ns)
        self._power_moved = True
        self._deadline_moved = True

    def receive(self, data: bytes, now_ns: int) -> None:
        """A frame was on the bus."""
        self._node.receive(data, now_ns)
        if self._touched:
            self._publish(now_ns)
        elif self._outbox.deadlines_moved:
            self._deadline_moved = True

    def sent(self, data: bytes, now_ns: int) -> bool:
        """An own frame left the bus; False: nothing comes of it."""
        self._node.sent(data, now_ns)
        outbox = self._outbox
        if self._touched or outbox.deadlines_moved or outbox.frames or outbox.events:
            self._deadline_moved = True
            return True
        return False

    def wants_sent(self) -> bool:
        """The node waits for its TPDOs to leave."""
        return self._node.wants_sent()

    def next_deadline_ns(self) -> int | None:
        """When `expire` must be called at the latest [ns]."""
        if self._deadline_moved:
            self._find_deadline()
        return None if self._deadline_ns == NEVER else self._deadline_ns

    def expire(self, now_ns: int) -> None:
        """What is due is done: first the motor's, then the node's."""
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
        """The frames to send now."""
        return self._node.take_output() if self._outbox.frames else ()

    def take_events(self) -> Sequence[tuple[str, str]]:
        """(level, text) of what happened since last asked."""
        if not self._outbox.events and not self._events:
            return ()
        own = self._events
        self._events = []
        return [*self._node.take_events(), *own]

    def stimulate(self, name: str, value: float, now_ns: int) -> None:
        """The load at the output [N m], an error code to fail with, the power stage's supply.

        Or one of `emulators.cia402.protection`, or a digital input.

        Raises:
            ValueError: there is no such stimulus, or the value is none.
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
        """The truth at `now_ns`, behind the gear where it says rad and N m."""
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
        """The CAN identifiers it listens to."""
        return self._node.identifiers()

    def identifiers_revision(self) -> int:
        """Grows whenever `identifiers` would answer something new."""
        return self._node.identifiers_revision()

    # --- NodeHost

    def on_nmt(self, state: int, now_ns: int) -> None:
        """Once initialised, the power drive is too; in STOPPED nobody controls it."""
        self._happens()
        if state == NmtState.PRE_OPERATIONAL:
            self.axis.at(now_ns)
            self._power_drive.initialised(now_ns)
        elif state == NmtState.STOPPED:
            self._abort(COMMUNICATION_LOST, now_ns)

    def on_reset(self, whole: bool, now_ns: int) -> None:
        """Reset node starts the firmware afresh; reset communication takes the host away."""
        if not whole:
            self._abort(COMMUNICATION_LOST, now_ns)
            return
        self._happens()
        self.axis.at(now_ns)
        self._objects.reload()
        self._power_drive.power_on()

    def on_write(self, now_ns: int) -> None:
        """Objects were written."""
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
        """What synchronous RPDOs brought into force has come by `on_write`."""
        if self._power_drive.synced(now_ns):
            self._happens()

    def before_read(self, now_ns: int) -> None:
        """Readers answer as of now."""
        self.axis.at(now_ns)
        if self._is_settled or (now_ns < self._motor_due_ns and not self._touched):
            return  # nothing shows but where the motor is
        self._touched = True
        self._power_moved = True
        self._power_drive.settle(now_ns)

    def on_heartbeat_lost(self, node_id: int, now_ns: int) -> None:
        """6007h."""
        self._abort(HEARTBEAT_LOST, now_ns)

    def on_bus_off(self, now_ns: int) -> None:
        """6007h."""
        self._abort(COMMUNICATION_LOST, now_ns)

    # --- inside

    def _happens(self) -> None:
        """Something other than time may change what shows."""
        self._touched = True
        self._power_moved = True
        self._is_settled = False

    def _abort(self, code: int, now_ns: int) -> None:
        self._happens()
        self.axis.at(now_ns)
        self._power_drive.abort_connection(code, now_ns)

    def _publish(self, now_ns: int) -> None:
        """What has changed is told: EMCY first, then to the TPDOs that map it."""
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
            if errors != self._errors:  # of a lost connection nobody was told, or the node has told
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
        """60FDh and 60B9h, to the TPDOs that map them."""
        inputs, probes = self._power_drive.inputs.bits, self._power_drive.touch_probe.status
        if inputs != self._inputs:
            self._inputs = inputs
            self._node.object_changed(0x60FD, 0, now_ns)
        if probes != self._probes:
            self._probes = probes
            self._node.object_changed(0x60B9, 0, now_ns)

    def _with_class(self, code: int) -> int:
        """The standing errors with this one; 0000h ends them all."""
        return self._errors | error_register(code) if code else 0

    def _tell(self, code: int) -> None:
        if code == NO_FAULT:
            self._events.append(("info", "fault reset"))
            return
        self._events.append(("error", told(code)))

    def _find_deadline(self) -> None:
        """The earliest of the node's, the power drive's and the axis' next event."""
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
