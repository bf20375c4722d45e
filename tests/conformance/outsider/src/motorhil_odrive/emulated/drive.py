"""An emulated ODrive: axis states, cyclic messages and answers.

The drive updates itself when a frame comes, when a cyclic message is due, and at each edge of its
switch while homing. In between it needs no computation.

Not emulated, with a warning where a host uses it: access to endpoints (04h), sensorless control,
lock-in, the input modes POS_FILTER, MIX_CHANNELS, MIRROR and TUNING, voltage control. Choices of
this emulator, where the documentation leaves room: an axis that was disarmed by an error does not
arm before Clear_Errors, and after an emergency stop nothing else is needed; the watchdog runs in
all states but IDLE.
"""

from collections.abc import Mapping, Sequence
from math import isfinite
from typing import Final, final

from motorhil.emulators.api import (
    EFF_FLAG,
    ERR_FLAG,
    RTR_FLAG,
    ControllerContext,
    MotorDrive,
    can_id_of,
    data_of,
    ns,
    pack,
)

from motorhil_odrive.emulated import messages as m
from motorhil_odrive.emulated.commands import COMMANDS
from motorhil_odrive.emulated.control import Control, Parameters
from motorhil_odrive.emulated.homing import Homing
from motorhil_odrive.emulated.messages import AxisState, Error, ProcedureResult
from motorhil_odrive.emulated.settings import OdriveTable
from motorhil_odrive.emulated.told import told

_CALIBRATIONS: Final = (
    AxisState.STARTUP_SEQUENCE,
    AxisState.FULL_CALIBRATION_SEQUENCE,
    AxisState.MOTOR_CALIBRATION,
    AxisState.ENCODER_INDEX_SEARCH,
    AxisState.ENCODER_OFFSET_CALIBRATION,
    AxisState.ENCODER_DIR_FIND,
    AxisState.ENCODER_HALL_POLARITY_CALIBRATION,
    AxisState.ENCODER_HALL_PHASE_CALIBRATION,
    AxisState.ANTICOGGING_CALIBRATION,
)
_ERRORS: Final = range(1, 1 << 32)


@final
class OdriveController(MotorDrive):
    """Implements `motorhil.emulators.controller.Controller`.

    Attributes:
        control: the control of its motor.
        state, result: the axis state, and the result of the last requested state.
        active_errors, disarm_reason: bits of `Error`.
    """

    def __init__(self, settings: OdriveTable, context: ControllerContext) -> None:
        self.settings: Final = settings
        self.motor: Final = settings.motor(context.stream())
        super().__init__(self.motor, _ERRORS)
        self.control: Final = Control(self.axis, self.motor, settings)
        self.state = AxisState.UNDEFINED
        self.result = ProcedureResult.SUCCESS
        self.active_errors = 0
        self.disarm_reason = 0
        self.node_id = settings.node_id
        self._saved = Parameters()
        self._homing: Homing | None = None

    # --- Controller ------------------------------------------------------------------------------

    def boot(self, now_ns: int) -> None:
        """Begin anew with power."""
        self.reboot()

    def receive(self, data: bytes, now_ns: int) -> None:
        """Handle a frame from the bus."""
        can_id = can_id_of(data)
        if can_id & (EFF_FLAG | ERR_FLAG) or not self.is_powered or self._boot in self.due_ns:
            return
        command, node_id = can_id & m.COMMAND_MASK, (can_id & 0x7FF) >> m.COMMAND_BITS
        is_remote = bool(can_id & RTR_FLAG)
        if node_id != self.node_id and command != m.ADDRESS:
            return
        self.advance(now_ns)
        self._feed_watchdog()
        payload = data_of(data)
        if command == m.ADDRESS:
            self._address(payload, is_remote)
        elif is_remote:
            self.tell(command)
        elif command in COMMANDS:
            layout, _ = m.HEARD[command]
            if len(payload) < layout.size:
                self.warn(f"message {command:02X}h of {len(payload)} bytes is too short")
                return
            values = layout.unpack_from(payload)
            if all(isfinite(value) for value in values):
                COMMANDS[command](self, *values)
            else:
                self.warn(f"message {command:02X}h with {values} is ignored")
        elif command == m.RX_SDO:
            self.warn("access to endpoints (04h) is not emulated")

    def watches(self) -> bool:
        """Return whether the edges of its switch must be noticed."""
        return self._homing is not None

    def _miss_messages(self) -> None:
        self.active_errors |= Error.WATCHDOG_TIMER_EXPIRED
        self.fail(Error.WATCHDOG_TIMER_EXPIRED)

    def _end_calibration(self) -> None:
        self._rest(ProcedureResult.SUCCESS)

    def _tell_estimates(self) -> None:
        self.wake(self._tell_estimates, ns(self.settings.timing.encoder_s))
        self.tell(m.GET_ENCODER_ESTIMATES)

    def _tell_heartbeat(self) -> None:
        self.wake(self._tell_heartbeat, ns(self.settings.timing.heartbeat_s))
        self.tell(m.HEARTBEAT)

    def stimulate(self, name: str, value: float, now_ns: int) -> None:
        """Connect or disconnect the encoder (1, 0), or set an input of every drive.

        Raises:
            ValueError: there is no such input, or the value is out of range.
        """
        if name != "encoder":
            super().stimulate(name, value, now_ns)
            return
        if value not in (0, 1):
            raise ValueError(f"{name} = {value}: out of range; expected 0 or 1")
        self.advance(now_ns)
        self.active_errors &= ~Error.MISSING_ESTIMATE
        if not value:
            self.active_errors |= Error.MISSING_ESTIMATE
            self.fail(Error.MISSING_ESTIMATE)

    def inject(self, fault: int) -> None:
        """Cause an error for an instant."""
        self.fail(fault)

    def go_dark(self) -> None:
        """Lose the power."""
        self.fall_silent()

    def truth(self) -> Mapping[str, float]:
        """Return the following error, the axis state and its errors."""
        return {
            "following_error_inc": float(self.axis.following_error_inc()),
            "axis_state": float(self.state),
            "axis_error": float(self.active_errors | self.disarm_reason),
        }

    def identifiers(self) -> Sequence[int] | None:
        """Return all identifiers of its node-ID, remote or not, and 06h to unaddressed nodes."""
        first = self.node_id << m.COMMAND_BITS
        everybody = m.UNADDRESSED << m.COMMAND_BITS | m.ADDRESS
        own = [first | command for command in range(1 << m.COMMAND_BITS)]
        own += [] if everybody in own else [everybody]
        return [can_id | flag for flag in (0, RTR_FLAG) for can_id in own]

    # --- axis states -----------------------------------------------------------------------------

    def request(self, state: AxisState) -> None:
        """Handle Set_Axis_State (07h)."""
        if state is AxisState.IDLE:
            was_at_rest = self.state is AxisState.IDLE
            self._rest(self.result if was_at_rest else ProcedureResult.CANCELLED)
        elif self.active_errors or self.disarm_reason:
            self.result = ProcedureResult.INVALID_STATE
            self.warn(f"{state.name} refused: errors {self.errors():08X}h")
        elif state is AxisState.CLOSED_LOOP_CONTROL:
            self._enter(state)
            self.control.arm()
        elif state is AxisState.HOMING:
            self._home()
        elif state in _CALIBRATIONS:
            self._enter(state)
            self.wake(self._end_calibration, ns(self.settings.timing.calibration_s))
        else:
            self._rest(ProcedureResult.INVALID_STATE)
            self.warn(f"{state.name} is not emulated")

    def fail(self, bits: int) -> None:
        """Disarm the axis with an error."""
        self.disarm_reason |= bits
        self.note("error", f"disarmed: {_names(bits)}")
        self._rest(ProcedureResult.DISARMED)

    def clear_errors(self) -> None:
        """Clear the errors (18h); those whose cause remains stay active."""
        self.disarm_reason = 0
        self.result = ProcedureResult.SUCCESS

    def errors(self) -> int:
        """Return the error bits of a heartbeat."""
        return self.active_errors | self.disarm_reason

    def save(self) -> None:
        """Save the parameters for the next boot."""
        self._saved = self.control.parameters

    def erase(self) -> None:
        """Restore the default parameters for the next boot."""
        self._saved = Parameters()

    def reboot(self) -> None:
        """Restart, as at power-on."""
        self.fall_silent()
        self.due_ns[self._boot] = self.now_ns + ns(self.settings.timing.boot_up_s)

    def fall_silent(self) -> None:
        """Send nothing more; the motor has no current."""
        self._rest(ProcedureResult.SUCCESS)
        self.state = AxisState.UNDEFINED
        self.cancel_times()

    def tell(self, command: int) -> None:
        """Queue a message, if the drive has one of this kind."""
        if command in m.TOLD:
            data = m.TOLD[command][0].pack(*told(self, command))
            self.queue(pack(self.node_id << m.COMMAND_BITS | command, data))

    # --- helpers ---------------------------------------------------------------------------------

    def _boot(self) -> None:
        self.control.power_on(self._saved)
        self.state, self.result = AxisState.IDLE, ProcedureResult.SUCCESS
        self.disarm_reason = 0
        self.active_errors &= Error.MISSING_ESTIMATE
        timing = self.settings.timing
        if timing.encoder_s:
            self._tell_estimates()
        if timing.heartbeat_s:
            self._tell_heartbeat()

    def advance(self, now_ns: int) -> None:
        """Update the drive to this time."""
        super().advance(now_ns)
        control = self.control
        control.settle()
        if self._homing is not None and self._homing.settle():
            self._homing = None
            self.result, self.state = ProcedureResult.SUCCESS, AxisState.CLOSED_LOOP_CONTROL
        if control.is_armed and control.is_too_fast():
            self.fail(Error.VELOCITY_LIMIT_VIOLATION)

    def _feed_watchdog(self) -> None:
        self.active_errors &= ~Error.WATCHDOG_TIMER_EXPIRED
        if self.state is not AxisState.IDLE:
            self.wake(self._miss_messages, ns(self.settings.watchdog_s))

    def _home(self) -> None:
        plant = self.motor.plant
        endstop_rad = self.settings.min_endstop_rad
        if endstop_rad is None:
            self._rest(ProcedureResult.HOMING_WITHOUT_ENDSTOP)
            return
        self._enter(AxisState.HOMING)
        self.control.arm()
        inc_rad = plant.gear_ratio * plant.increments_per_rad()
        self._homing = Homing(self.control, int(endstop_rad * inc_rad // 1.0))

    def _enter(self, state: AxisState) -> None:
        self._rest(ProcedureResult.BUSY)
        self.state = state
        self._feed_watchdog()

    def _rest(self, result: ProcedureResult) -> None:
        """Enter IDLE and end whatever was active."""
        if self._homing is not None:
            self._homing.abandon()
            self._homing = None
        self.wake(self._end_calibration, 0)
        self.wake(self._miss_messages, 0)
        self.control.disarm()
        self.state, self.result = AxisState.IDLE, result

    def _address(self, payload: bytes, is_remote: bool) -> None:
        """Handle Address (06h): report the address, or assign a node-ID."""
        serial = self.settings.serial_number.to_bytes(6, "little")
        if is_remote or len(payload) < m.ADDRESSING.size:
            data = m.ADDRESSING.pack(self.node_id, serial)
            self.queue(pack(self.node_id << m.COMMAND_BITS | m.ADDRESS, data))
            return
        node_id, wanted = m.ADDRESSING.unpack_from(payload)
        if wanted in (serial, bytes(6)):
            self._call_it(node_id & m.UNADDRESSED)
        elif node_id == self.node_id:
            self._call_it(m.UNADDRESSED)

    def _call_it(self, node_id: int) -> None:
        self.node_id = node_id
        self.renumber()
        self.note("info", f"its node-ID is {node_id} now")


def _names(bits: int) -> str:
    names = [error.name for error in Error if error and bits & error]
    return " | ".join(names) or f"{bits:08X}h"
