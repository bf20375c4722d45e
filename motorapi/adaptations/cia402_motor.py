"""The adaptation of the motor interface to CiA 402 drives on CANopen.

| command              | mode of the drive | how it starts                                      |
| -------------------- | ----------------- | -------------------------------------------------- |
| set-point, position  | pp                | new set-point, changed immediately                 |
| trajectory, position | pp                | the same, with 6081h, 6083h, 6084h for the duration |
| set-point, velocity  | pv                | target velocity 60FFh                              |
| homing               | hm                | homing operation start                             |

A position set-point has no profile of its own; a drive in pp makes one all the same: with the
model's maximum accelerations, and the velocity limit of the command, else of the model.
Several motors of one bus start together at a SYNC: their RPDOs (transmission type 1) hold the
set-point until then. One motor alone starts by an RPDO that acts at once.
"""

from collections.abc import Callable
from typing import TYPE_CHECKING, Final, final

from motorapi.adaptations.canopen_errors import HomingFailed, SdoAborted
from motorapi.adaptations.cia402_hardware import Cia402HwMotor
from motorapi.adaptations.cia402_objects import (
    ENABLE_OPERATION,
    FAULT_BIT,
    NEW_SET_POINT,
    Mode,
    PdsState,
)
from motorapi.adaptations.cia402_triggers import SetPointTrigger, SyncTrigger, VelocityTrigger
from motorapi.adaptations.cia402_units import DriveUnits
from motorapi.adaptations.drive_profile import (
    DriveProfile,
    as_motion,
    check_limits,
    check_target,
    expected_s,
    profile_of,
)
from motorapi.adaptations.drive_reader import DriveReader
from motorapi.adaptations.motion_watch import HomingWatch, MotionWatch, RestWatch, SetpointWatch
from motorapi.commands import ControlMode, ControlVariable, Motion
from motorapi.errors import DeadlineExceeded, UnsupportedError
from motorapi.motor import Motor
from motorapi.state import Fault, Measurement, MotorState
from motorapi.synchronization import MotionTimes, SyncLevel, SyncOffer, Trigger

if TYPE_CHECKING:
    from motorapi.model import MotorModel

_CONFIRM_TIMEOUT_S: Final = 0.5
_RESEND_S: Final = 0.1
_POLL_S: Final = 0.01
_TARGETS: Final = {ControlVariable.POSITION: 0x607A, ControlVariable.VELOCITY: 0x60FF}


@final
class Cia402Motor(Motor):
    """A logical motor on a CiA 402 drive. Any number of them may share one hardware object.

    Args:
        hardware: speaks for the drive.
        model: what is constant of the motor; its units where the drive does not tell its own.
        name: what messages and records call it; None: the model's name and where it is.
        on_close: is called once, when the motor is closed. The hardware object is its maker's.
    """

    def __init__(
        self,
        hardware: Cia402HwMotor,
        model: "MotorModel",
        *,
        name: str | None = None,
        on_close: Callable[[], None] | None = None,
    ) -> None:
        super().__init__(
            name=f"{model.name} at {hardware.label}" if name is None else name,
            model=model,
            runtime=hardware.runtime,
            physical=hardware.physical,
        )
        self._hardware = hardware
        self._node = hardware.node
        self._control = hardware.control
        self._objects = hardware.objects
        self._reader = DriveReader(hardware, model, self.name)
        self._on_close = on_close
        self._setpoint: SetpointWatch | None = None
        self._before: MotionWatch | None = None
        self._together = False

    def close(self) -> None:
        """It is no longer used; closing again does nothing."""
        on_close, self._on_close = self._on_close, None
        if on_close is not None:
            on_close()

    @property
    def hardware(self) -> Cia402HwMotor:
        """The drive, with all it is able to do."""
        return self._hardware

    # --- what it can do --------------------------------------------------------------------

    def _supports(self, mode: ControlMode, variable: ControlVariable) -> bool:
        if variable is ControlVariable.POSITION:
            return self._control.supports(Mode.PROFILE_POSITION)
        if variable is ControlVariable.VELOCITY and mode is ControlMode.SETPOINT:
            return self._control.supports(Mode.PROFILE_VELOCITY)
        return False

    def _sync_offer(self) -> SyncOffer:
        facts = self._hardware.connect()
        armed = facts.latched_ids.get(_TARGETS[self.control_variable])
        if armed is None:
            reason = "; ".join(facts.limitations) or "it has no RPDO latched by SYNC"
            return SyncOffer(SyncLevel.SEQUENTIAL, self._hardware.label, None, reason)
        reason = f"RPDO {armed:03X}h is latched by SYNC"
        tick_ms = self._hardware.options.servo_period_ms
        latency_s = None if tick_ms is None else (0.0, tick_ms / 1e3)
        if tick_ms is None:
            reason += "; servo_period_ms, from the latch to the profile, is not told"
        return SyncOffer(SyncLevel.TRIGGERED, self._node.link.name, latency_s, reason)

    def _quantise(self, motion: Motion) -> Motion:
        units, limits = self._reader.known()
        return as_motion(motion, profile_of(motion, self.model, units, limits), units)

    # --- connecting, state and measurements -----------------------------------------------------

    def _connect(self) -> None:
        self._hardware.connect()

    @property
    def units(self) -> DriveUnits:
        """What 1 means in the drive's objects, and where that is known from."""
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

    def _refresh(self) -> float | None:
        if self._node.status_is_cyclic:
            return None
        if self._node.lost_since_ns is None:
            self._node.poll_status()
        return _POLL_S

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
        self._control.disable()
        self._hardware.quick_stopped = False
        self._hardware.follow(None)

    def _reset_fault(self) -> None:
        self._control.reset_fault()

    def _home(self, method: int | None) -> None:
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
        units, limits = self._reader.known()
        profile = profile_of(motion, self.model, units, limits)
        check_limits(self.name, profile, units, limits)
        self._together = together
        if motion.variable is ControlVariable.VELOCITY:
            return self._arm_velocity(motion, profile)
        check_target(self.name, profile.target, units, limits)
        self._control.set_mode(Mode.PROFILE_POSITION)
        self._push_profile(profile)
        self._objects.push(0x6081, profile.speed)
        self._control.take_set_points()
        watch = SetpointWatch(
            commanded_ns=None,
            expected_ns=round(expected_s(motion, profile, units) * 1e9),
            acknowledged=True,
            target_inc=profile.target,
            tolerance_inc=limits.window,
            distance_inc=profile.target - self._node.position_inc,
        )
        self._follow(watch)
        self._reader.held = (profile.target, motion.target)
        if self._can_arm(0x607A):
            self._control.arm(0x607A, profile.target, fired=watch.begin)
            return SyncTrigger(self._node.link)
        self._objects.push(0x607A, profile.target)
        return SetPointTrigger(self._hardware, watch)

    def _arm_velocity(self, motion: Motion, profile: DriveProfile) -> Trigger:
        if not self._control.is_in(Mode.PROFILE_VELOCITY):
            self._objects.write(0x60FF, 0)  # whatever was there would count at once
            self._control.set_mode(Mode.PROFILE_VELOCITY)
        self._push_profile(profile)
        change = abs(motion.target - self._reader.velocity())
        slowest = min(motion.acceleration, motion.deceleration)
        self._control.keep_halt()
        watch = SetpointWatch(
            commanded_ns=None,
            expected_ns=round(change / slowest * 1e9),
            acknowledged=False,
            target_inc=None,
            tolerance_inc=None,
        )
        self._follow(watch)
        if self._can_arm(0x60FF):
            self._control.arm(0x60FF, profile.target, fired=watch.begin)
            return SyncTrigger(self._node.link)
        return VelocityTrigger(self._hardware, watch, profile.target)

    def _can_arm(self, index: int) -> bool:
        return self._together and index in self._hardware.connect().latched_ids

    def _push_profile(self, profile: DriveProfile) -> None:
        limits = self._reader.known()[1]
        self._objects.push(0x6083, profile.acceleration)
        if limits.has_deceleration:
            self._objects.push(0x6084, profile.deceleration)

    def _follow(self, watch: SetpointWatch) -> None:
        self._before = self._node.watch
        self._setpoint = watch
        self._hardware.follow(watch)

    def _disarm(self) -> None:
        watch = self._setpoint
        if watch is not None and watch is self._node.watch and watch.commanded_ns is None:
            self._hardware.follow(self._before)  # a stop that came while it was being armed, say
        self._control.disarm()

    def _confirm(self, motion: Motion) -> None:
        watch = self._setpoint
        if watch is None or self._control.is_halted:
            return
        if motion.variable is ControlVariable.VELOCITY:
            self._confirm_velocity(motion)
        else:
            self._await_acknowledge(watch)
        if not self._control.is_halted:
            self._control.has_started()
            if motion.variable is ControlVariable.POSITION:
                self._control.send_holding_word()

    def _await_acknowledge(self, watch: SetpointWatch) -> None:
        """The set-point was acknowledged; a controlword that was lost is sent again.

        Sending it again is safe: the drive looks for an edge of bit 4, and there is none if it has
        the controlword already.
        """
        node = self._node
        deadline_ns = self.runtime.now_ns() + round(_CONFIRM_TIMEOUT_S * 1e9)

        def is_over() -> bool:
            ends = watch.started_ns is not None or self._control.is_halted
            return ends or node.statusword & FAULT_BIT != 0 or node.lost_since_ns is not None

        while True:
            node.refresh()
            pause_s = _RESEND_S if node.status_is_cyclic else _POLL_S
            if self.runtime.wait_until(is_over, pause_s):
                if not self._control.is_halted:
                    node.check_motion(self.name)
                return
            if self.runtime.now_ns() >= deadline_ns:
                raise DeadlineExceeded(
                    awaited=f"{self.name}: set-point acknowledge",
                    timeout_s=_CONFIRM_TIMEOUT_S,
                    last_heard=node.describe_status(),
                )
            if not self._together:
                self._control.send_set_point()

    def _confirm_velocity(self, motion: Motion) -> None:
        """There is no acknowledge in pv: the target velocity is read back."""
        units, limits = self._reader.known()
        target = profile_of(motion, self.model, units, limits).target
        found = self._objects.read_int(0x60FF)
        if found != target and not self._control.is_halted:
            raise DeadlineExceeded(
                awaited=f"{self.name}: target velocity {target} in the drive",
                timeout_s=0.0,
                last_heard=f"60FFh = {found}",
            )
        self._node.check_motion(self.name)

    def _is_done(self) -> bool:
        node = self._node
        watch = node.watch
        if watch is None:
            return True
        if isinstance(watch, RestWatch):
            node.check_link()
            if node.statusword & FAULT_BIT:
                raise node.fault_error(self.name)
            state = node.state
            if state in (PdsState.OPERATION_ENABLED, PdsState.QUICK_STOP_ACTIVE):
                return watch.ended_ns is not None
            return True  # the power stage is off: nothing slows down any more
        node.check_motion(self.name)
        if watch.failed and isinstance(watch, HomingWatch):
            method = 0 if watch.method is None else watch.method
            raise HomingFailed(motor=self.name, method=method, statusword=node.statusword)
        return watch.ended_ns is not None

    def _stop(self) -> None:
        watch = RestWatch(commanded_ns=self.runtime.now_ns(), needs_bit=True)
        self._hardware.follow(watch)
        if self._node.state is PdsState.OPERATION_ENABLED:
            self._control.send_halt(watch)

    def _quick_stop(self) -> None:
        watch = RestWatch(commanded_ns=self.runtime.now_ns(), needs_bit=False)
        self._hardware.follow(watch)
        if self._node.state is PdsState.OPERATION_ENABLED:
            self._hardware.quick_stopped = True
            self._control.send_quick_stop(watch)

    def _open_low_level(self) -> Cia402HwMotor:
        self._hardware.fall_silent()
        return self._hardware

    def _close_low_level(self) -> None:
        self._hardware.doubt()

    def _motion_times(self) -> MotionTimes | None:
        watch = self._setpoint
        if watch is None:
            return None
        if self._together:
            return MotionTimes(
                watch.commanded_ns, watch.ended_ns, "SYNC on the wire; target reached in a TPDO"
            )
        source = "set-point acknowledge and target reached in a TPDO"
        return MotionTimes(watch.started_ns, watch.ended_ns, source)
