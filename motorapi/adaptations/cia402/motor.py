"""Logical motors on CiA 402 drives on CANopen.

    hw = Cia402HwMotor(bus, node_id=3)
    motor = Cia402Motor(hw, model=MotorModel.load("wheel.toml"))

`DriveMotions` chooses the mode of operation for each motion; homing uses hm. A position set-point
has no profile of its own, but a drive in pp makes one. It has the model's maximum accelerations,
and the velocity limit of the command or else of the model. A torque set-point without a slope limit
is a step. A function (a complex trajectory, or a velocity ramp with bounded jerk) is streamed in
csp, one set-point per SYNC.

Several motors of one bus start together at a SYNC: their RPDOs (transmission type 1) hold the
set-point until then. A single motor starts by an RPDO that acts at once, or by its own SYNC.

*Simultaneous stops* of several drives of one bus are latched by one SYNC. Frames that act at once
act one after another: on a full bus, the last of many drives would move on for a millisecond or
more. So each drive gets its halt in the RPDO that SYNC latches, and SYNC follows when all of these
were on the wire. Everything is sent from callbacks, without waiting. There are cases without a SYNC
of ours: a start is being armed, a cyclic SYNC runs, or the bus does not report own frames. Then, or
if SYNC does not come in time, each drive is halted by a frame that acts at once. The same frame
also follows SYNC, as a frame may be lost.
"""

from collections.abc import Callable, Mapping
from contextlib import AbstractContextManager, suppress
from typing import TYPE_CHECKING, Final, final

from motorhil.motorapi.adaptations.canopen.bus import CanopenBus
from motorhil.motorapi.adaptations.canopen.errors import SdoAborted
from motorhil.motorapi.adaptations.cia402.bringup import Cia402Table, HwOptions
from motorhil.motorapi.adaptations.cia402.hardware import Cia402HwMotor
from motorhil.motorapi.adaptations.cia402.measurements import DriveReader
from motorhil.motorapi.adaptations.cia402.motion import POLL_S, DriveMotions
from motorhil.motorapi.adaptations.cia402.motion_status import (
    HomingWatch,
    RestWatch,
    SetpointWatch,
    StreamWatch,
)
from motorhil.motorapi.adaptations.cia402.objects import (
    DISABLE_VOLTAGE,
    ENABLE_OPERATION,
    FAULT_BIT,
    HALT,
    NEW_SET_POINT,
    QUICK_STOP,
    Mode,
    PdsState,
)
from motorhil.motorapi.adaptations.cia402.parameters import Cia402Parameters
from motorhil.motorapi.adaptations.cia402.units import DriveUnits
from motorhil.motorapi.api.registration import Shared, read_settings
from motorhil.motorapi.commands import ControlMode, ControlVariable, Setpoint
from motorhil.motorapi.errors import (
    LinkError,
    MotionInterrupted,
    MotorError,
    PeerError,
    UnsupportedError,
    UsageError,
)
from motorhil.motorapi.model import MotorModel
from motorhil.motorapi.motion import Motion
from motorhil.motorapi.motor import Motor
from motorhil.motorapi.runtime.api import Registration
from motorhil.motorapi.runtime.can_link import Transmission
from motorhil.motorapi.state import Fault, Measurement, MotorState
from motorhil.motorapi.synchronization.offer import SyncOffer, Trigger
from motorhil.motorapi.synchronization.quality import MotionTimes
from motorhil.motorapi.trajectory import (
    ComplexTrajectory,
    Trajectory,
    TrapezoidalTrajectory,
    asks_for_smoothness,
    has_moving_ends,
)

if TYPE_CHECKING:
    import can

    from motorhil.motorapi.runtime.api import Runtime

_LOOK_S: Final = 0.0005
_LOOKS_MAX: Final = 10
"""The number of checks, 5 ms in total, after which SYNC is not awaited any longer.

A late halt is worse than separate halts.
"""


@final
class HomingFailed(PeerError):  # noqa: N818 -- the name says what happened, as in errors
    """The drive reports a homing error (CiA 402-2, homing mode, statusword bit 13).

    Attributes: motor (name), method (None: the drive's own), statusword.
    """

    def __init__(self, *, motor: str, method: int | None, statusword: int) -> None:
        self.motor = motor
        self.method = method
        self.statusword = statusword
        by = "its own method" if method is None else f"method {method}"
        super().__init__(
            f"{motor}: homing by {by} ended with an error (statusword {statusword:04X}h)"
        )


@final
class JointStop:
    """The joint halt of several drives of one bus in one group; a `Trigger`."""

    def __init__(self, bus: CanopenBus, turn: AbstractContextManager[bool]) -> None:
        self._bus = bus
        self._turn = turn  # SYNC is ours until this context is left
        self._armed: list[tuple[Cia402HwMotor, RestWatch, Transmission]] = []
        self._timer: Registration | None = None
        self._looks = 0
        self._sync: Transmission | None = None

    def add(self, hardware: Cia402HwMotor) -> bool:
        """Send the drive its halt for the next SYNC; return False if it cannot be halted so."""
        control, node = hardware.control, hardware.node
        is_running = node.state is PdsState.OPERATION_ENABLED
        if not is_running or not control.is_in(Mode.PROFILE_POSITION):
            return False
        watch = RestWatch(commanded_ns=hardware.runtime.now_ns(), needs_bit=True)
        transmission = control.send_armed_halt()
        if transmission is None:
            return False
        hardware.follow(watch)
        self._armed.append((hardware, watch, transmission))
        return True

    def fire(self) -> None:
        """Send SYNC when all frames were on the wire, without waiting."""
        self._bus.parts.drop(self)
        if self._armed:
            self._timer = self._bus.link.runtime.every(_LOOK_S, self._look)
        else:
            self._turn.__exit__(None, None, None)

    def _look(self) -> None:
        self._looks += 1
        if self._sync is None and all(sent.time_ns is not None for _, _, sent in self._armed):
            try:
                self._sync = self._bus.sync.send()
            except LinkError:
                self._looks = _LOOKS_MAX
        is_latched = self._sync is not None and self._sync.time_ns is not None
        if is_latched or self._looks >= _LOOKS_MAX:
            self._halt_at_once()

    def _halt_at_once(self) -> None:
        timer, self._timer = self._timer, None
        if timer is None:
            return
        timer.cancel()
        try:
            for hardware, watch, _ in self._armed:
                if hardware.node.watch is watch:  # else it received another command meanwhile
                    if self._sync is not None:
                        hardware.control.has_started()
                    with suppress(LinkError):  # repeated once the bus has recovered
                        hardware.control.send_halt(watch)
        finally:
            self._turn.__exit__(None, None, None)


def joint_stop_of(bus: CanopenBus) -> JointStop | None:
    """Return the joint stop for a drive of this bus, or None if SYNC is not ours to send now."""
    stop = bus.parts.find(JointStop)
    if stop is not None:
        return stop
    link, sync = bus.link, bus.sync
    if not link.confirms or link.status.is_off or sync.latching or sync.cyclic() is not None:
        return None
    turn = sync.turns.at_once(link.runtime, f"a stop of several on {link.name}")
    if not turn.__enter__():
        turn.__exit__(None, None, None)
        return None
    return bus.parts.part(JointStop, lambda: JointStop(bus, turn))


_MODES: Final = {
    ControlVariable.POSITION: Mode.PROFILE_POSITION,
    ControlVariable.VELOCITY: Mode.PROFILE_VELOCITY,
    ControlVariable.TORQUE: Mode.PROFILE_TORQUE,
}
_SHOWS_REST: Final = (*_MODES.values(), Mode.HOMING)
_STREAMED: Final = (ControlVariable.POSITION, ControlVariable.VELOCITY)


def is_function(variable: ControlVariable, command: Setpoint | Trajectory) -> bool:
    """Return whether the command is a function, which no profile of a drive can follow."""
    if isinstance(command, Setpoint):
        return False
    if isinstance(command, ComplexTrajectory):
        return True
    return has_moving_ends(command) or asks_for_smoothness(variable, command)


@final
class Cia402Motor(Motor):
    """A logical motor on a CiA 402 drive; any number of them may share one hardware object.

    Args:
        hardware: the hardware object of the drive.
        model: the constants of the motor, and its units where the drive does not report them.
        name: the name in messages and records. None: the model's name and the place.
        on_close: called once, when the motor is closed. The maker of the hardware object closes it.
    """

    def __init__(
        self,
        hardware: Cia402HwMotor,
        model: MotorModel,
        *,
        name: str | None = None,
        on_close: Callable[[], None] | None = None,
    ) -> None:
        _check_parts(hardware, model)
        super().__init__(
            name=name,
            model=model,
            runtime=hardware.runtime,
            physical=hardware.physical,
            on_close=on_close,
        )
        self._hardware = hardware
        self._node = hardware.node
        self._control = hardware.control
        self._objects = hardware.objects
        self._reader = DriveReader(hardware, model, self.name)
        self._motions = DriveMotions(hardware, model, self._reader, self.name)

    @property
    def hardware(self) -> Cia402HwMotor:
        """The hardware object of the drive."""
        return self._hardware

    # --- capabilities ----------------------------------------------------------------------

    def _supports(self, mode: ControlMode, variable: ControlVariable) -> bool:
        drive_mode = _MODES.get(variable)
        return drive_mode is not None and self._control.supports(drive_mode)

    def _check_command(self, variable: ControlVariable, command: Setpoint | Trajectory) -> None:
        if variable is ControlVariable.TORQUE:
            self._reader.check_torque()
        if not is_function(variable, command):
            return
        if variable not in _STREAMED or not self._control.supports(Mode.CYCLIC_SYNC_POSITION):
            raise UnsupportedError(
                motor=self.name,
                feature=f"a trajectory of {variable.value} other than a ramp at a constant rate",
                supported="such trajectories of position and velocity, where the drive has csp",
            )

    def _limits_jerk(self, variable: ControlVariable) -> bool:
        """Return True for positions, if the drive can be streamed to; ramps of pv stay its own."""
        facts = self._control.facts
        can_stream = facts is None or 0x607A in facts.latched_ids
        is_position = variable is ControlVariable.POSITION
        return is_position and can_stream and self._control.supports(Mode.CYCLIC_SYNC_POSITION)

    def _sync_offer(self) -> SyncOffer:
        command, variable = self.logical.command, self.control_variable
        streamed = command is not None and is_function(variable, command)
        if isinstance(command, TrapezoidalTrajectory) and self._limits_jerk(variable):
            streamed = streamed or self.model.jerk_max is not None
        return self._motions.offer(self.control_variable, streamed=streamed)

    def _quantise(self, motion: Motion) -> Motion:
        return self._motions.quantise(motion)

    @property
    def parameters(self) -> Cia402Parameters:
        """The gains and windows of this motor; None leaves the drive's own value."""
        return self._motions.parameters

    def set_parameters(self, parameters: Cia402Parameters) -> None:
        """Set the parameters that are written to the drive from the next `start` on.

        Raises:
            UsageError: `parameters` is not a Cia402Parameters.
        """
        if not isinstance(parameters, Cia402Parameters):
            raise UsageError(f"{self.name}: {parameters!r} is not a Cia402Parameters")
        self._motions.parameters = parameters

    # --- connecting, state and measurements -----------------------------------------------------

    def _connect(self) -> None:
        self._node.link.status.check()
        self._hardware.connect()
        control, bus_sync = self._control, self._node.bus.sync
        if self._physical.ownership.is_orphan:
            control.may_be_armed = not bus_sync.clear(own=self._node.node_id)
        elif control.holds_halt and bus_sync.take_out():
            control.holds_halt = False

    @property
    def units(self) -> DriveUnits:
        """The units of the drive's objects, and their sources."""
        return self._reader.units

    def _read_state(self) -> MotorState:
        return self._reader.fresh_state()

    def _read_fault(self) -> Fault | None:
        return self._reader.fault()

    def _read_referenced(self) -> bool:
        return self._hardware.is_homed

    def _read_position(self) -> float:
        return self._reader.position()

    def _read_velocity(self) -> float:
        return self._reader.velocity()

    def _read_reference(self) -> float:
        return self._reader.reference()

    def _read_torque(self) -> float:
        return self._reader.torque()

    def _read_following_error(self) -> float:
        return self._reader.following_error()

    def _latest(self) -> Measurement | None:
        return self._reader.latest()

    def _position_source(self) -> str:
        return self._reader.position_source()

    def _refresh(self) -> float | None:
        node = self._node
        if node.status_is_cyclic and not node.is_missed:
            return node.patience_s
        if not node.is_lost:
            node.poll_status()
        return POLL_S

    # --- power, fault, reference --------------------------------------------------------------

    def _enable(self) -> None:
        if self._control.supports(Mode.PROFILE_POSITION):
            # In pp nothing moves before a new set-point; in other modes an old target might count.
            self._objects.push(0x6060, Mode.PROFILE_POSITION)
        elif self._control.supports(Mode.PROFILE_VELOCITY):
            self._objects.write(0x60FF, 0)
        self._control.enable()
        self._hardware.quick_stopped = False

    def _disable(self) -> None:
        self._hardware.end_stream(DISABLE_VOLTAGE)
        self._control.disable()
        self._hardware.quick_stopped = False
        self._hardware.follow(None)
        self._restore_parameters()

    def _restore_parameters(self) -> None:
        """Give the drive its own parameters back, if it is heard; else the next start does so."""
        if self._hardware.facts is not None and self._node.is_up:
            with suppress(MotorError):
                self._hardware.parameters.apply(self.name, {})

    def _reset_fault(self) -> None:
        self._control.reset_fault()

    def _home(self, method: int | None) -> None:
        self._motions.before_homing(method)
        self._control.set_mode(Mode.HOMING)
        if method is not None:
            try:
                self._objects.push(0x6098, method)
            except SdoAborted as error:
                raise UnsupportedError(
                    motor=self.name, feature=f"homing by method {method} ({error})"
                ) from error
        self._control.release()  # starting is a rising edge
        watch = HomingWatch(
            commanded_ns=self.runtime.now_ns(), method=method, on_success=self._hardware.was_homed
        )
        self._hardware.follow(watch)
        self._reader.held = (None, 0.0)
        self._control.write_controlword(ENABLE_OPERATION | NEW_SET_POINT)

    # --- motion -----------------------------------------------------------------------------

    def _arm(self, motion: Motion, *, together: bool) -> Trigger:
        return self._motions.arm(motion, together=together)

    def _disarm(self) -> None:
        self._motions.disarm()

    def _confirm(self, motion: Motion) -> None:
        self._motions.confirm(motion)

    def _is_done(self) -> bool:
        node = self._node
        watch = node.watch
        if watch is None:
            return True
        if isinstance(watch, RestWatch):
            node.check_link()
            if node.statusword & FAULT_BIT:
                raise node.fault_error(self.name)
            return watch.ended_ns is not None
        node.check_motion(self.name)
        if watch.failed and isinstance(watch, HomingWatch):
            raise HomingFailed(motor=self.name, method=watch.method, statusword=node.statusword)
        if watch.failed and isinstance(watch, SetpointWatch):
            by = "the drive, which stands short of its target and shows target reached; was it"
            by += " halted by an input or another master, or its target limited (607Dh)?"
            raise MotionInterrupted(motor=self.name, by=by, at_ns=watch.ended_ns or 0)
        if watch.ended_ns is not None and isinstance(watch, StreamWatch) and watch.error:
            raise watch.error
        return watch.ended_ns is not None

    def _stop(self) -> None:
        # In csp no bit shows the standstill of a halted drive; another process may have left that
        # mode.
        needs_bit = any(self._control.is_in(mode) for mode in _SHOWS_REST)
        watch = self._watch_rest(needs_bit=needs_bit)
        if self._node.state is PdsState.OPERATION_ENABLED:
            try:
                self._control.send_halt(watch)
            finally:
                self._hardware.end_stream(ENABLE_OPERATION | HALT)
        else:
            self._stop_if_enabled(ENABLE_OPERATION | HALT, watch)

    def _stop_if_enabled(self, word: int, watch: RestWatch) -> None:
        """Stop a drive that was last seen without power, in case it has been enabled since."""
        if self._node.status_is_cyclic:
            self._control.stop_once_enabled(word, watch)
        else:  # its status was not read lately; a quick stop enables no drive
            self._control.send_quick_stop(watch)

    def _watch_rest(self, *, needs_bit: bool) -> RestWatch:
        """Follow the motor until it is at rest."""
        watch = RestWatch(
            commanded_ns=self.runtime.now_ns(),
            needs_bit=needs_bit,
            stands=self._node.stands_without_power,
        )
        self._hardware.follow(watch)
        return watch

    def _stop_with_others(self) -> Trigger | None:
        stop = joint_stop_of(self._node.bus)
        if stop is not None and stop.add(self._hardware):
            return stop
        self._stop()
        return stop

    def _quick_stop(self) -> None:
        watch = self._watch_rest(needs_bit=False)
        if self._node.state is PdsState.OPERATION_ENABLED:
            self._hardware.quick_stopped = True
            try:
                self._control.send_quick_stop(watch)
            finally:
                self._hardware.end_stream(QUICK_STOP)
        else:
            self._stop_if_enabled(QUICK_STOP, watch)

    def _open_low_level(self) -> Cia402HwMotor:
        self._restore_parameters()
        self._hardware.fall_silent()
        return self._hardware

    def _close_low_level(self) -> None:
        self._hardware.doubt()

    def _motion_times(self) -> MotionTimes | None:
        return self._motions.times()


def _check_parts(hardware: object, model: object) -> None:
    if not isinstance(hardware, Cia402HwMotor) or not isinstance(model, MotorModel):
        wanted = "Cia402Motor(Cia402HwMotor(bus, node_id=...), MotorModel(...))"
        raise UsageError(f"Cia402Motor({hardware!r}, {model!r}): give {wanted}")


_SHARED: Final[Shared[Cia402HwMotor]] = Shared("drive")


def build(
    bus: "can.BusABC", settings: Mapping[str, object], model: "MotorModel", runtime: "Runtime"
) -> Cia402Motor:
    """Return the motor described by a settings table (entry point `motorhil.adaptations`, cia402).

    Motors that name the same drive share one hardware object, made by the first of them.

    Args:
        bus: the bus of the drive.
        settings: `node_id`; `name` (None: the model's); and any field of HwOptions.
        model: the motor model.
        runtime: the runtime to wait with.

    Raises:
        UsageError: a setting is unknown, missing or invalid.
    """
    own = read_settings(Cia402Table, settings)
    hardware, give_back = _SHARED.on_can(
        Cia402HwMotor, bus, own.node_id, runtime, own.part(HwOptions)
    )
    return Cia402Motor(
        hardware,
        model,
        name=own.name,
        on_close=give_back,
    )
