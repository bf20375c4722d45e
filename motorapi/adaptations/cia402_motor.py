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
    error_text,
)
from motorapi.adaptations.cia402_triggers import SetPointTrigger, SyncTrigger, VelocityTrigger
from motorapi.adaptations.cia402_units import DriveUnits, drive_units
from motorapi.adaptations.drive_profile import (
    DriveLimits,
    DriveProfile,
    as_motion,
    check_limits,
    check_target,
    expected_s,
    profile_of,
)
from motorapi.adaptations.drive_setup import DriveFacts
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
_WINDOW_OFF: Final = 0xFFFF_FFFF
_STATES: Final = {
    PdsState.OPERATION_ENABLED: MotorState.ENABLED,
    PdsState.QUICK_STOP_ACTIVE: MotorState.STOPPED,
    PdsState.FAULT: MotorState.FAULT,
    PdsState.FAULT_REACTION_ACTIVE: MotorState.FAULT,
}


@final
class Cia402Motor(Motor):
    """A logical motor on a CiA 402 drive. Any number of them may share one hardware object.

    Args:
        hardware: speaks for the drive.
        model: what is constant of the motor; its units where the drive does not tell its own.
        name: what messages and records call it; None: the model's.
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
            name=model.name if name is None else name,
            model=model,
            runtime=hardware.runtime,
            physical=hardware.physical,
        )
        self._hardware = hardware
        self._node = hardware.node
        self._control = hardware.control
        self._objects = hardware.objects
        self._on_close = on_close
        self._facts: DriveFacts | None = None
        self._units: DriveUnits | None = None
        self._limits: DriveLimits | None = None
        self._setpoint: SetpointWatch | None = None
        self._before: MotionWatch | None = None
        self._held: tuple[int | None, float] = (None, 0.0)  # the last target, in increments and U
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
        velocity = self.control_variable is ControlVariable.VELOCITY
        armed = facts.velocity_id if velocity else facts.position_id
        if armed is None:
            reason = "; ".join(facts.limitations) or "it has no RPDO latched by SYNC"
            return SyncOffer(SyncLevel.SEQUENTIAL, id(self._hardware), None, reason)
        reason = f"RPDO {armed:03X}h is latched by SYNC"
        tick_ms = self._hardware.options.servo_period_ms
        latency_s = None if tick_ms is None else (0.0, tick_ms / 1e3)
        if tick_ms is None:
            reason += "; servo_period_ms, from the latch to the profile, is not told"
        return SyncOffer(SyncLevel.TRIGGERED, self._node.link.name, latency_s, reason)

    def _quantise(self, motion: Motion) -> Motion:
        units, limits = self._known()
        return as_motion(motion, profile_of(motion, self.model, units, limits), units)

    # --- connecting ------------------------------------------------------------------------

    def _connect(self) -> None:
        self._hardware.connect()

    def _known(self) -> tuple[DriveUnits, DriveLimits]:
        """Units and limits, read from the drive once after each time it was brought up.

        Not in `_connect`: any logical motor may stop the drive, at any time, without waiting.
        """
        facts = self._hardware.connect()
        if self._units is None or self._limits is None or facts is not self._facts:
            self._units = drive_units(self.name, self.model, self._objects.read_optional)
            self._limits = _read_limits(self._hardware)
            self._facts = facts
        return self._units, self._limits

    @property
    def units(self) -> DriveUnits:
        """What 1 means in the drive's objects, and where that is known from."""
        return self._known()[0]

    # --- state and measurements --------------------------------------------------------------

    def _state(self) -> MotorState:
        node = self._node
        if self._hardware.facts is None or node.lost_since_ns is not None or node.status_ns < 0:
            return MotorState.OFFLINE
        state = node.state
        known = MotorState.DISABLED if state is None else _STATES.get(state, MotorState.DISABLED)
        if known is MotorState.DISABLED and self._hardware.quick_stopped:
            return MotorState.STOPPED  # 605Ah may switch off at the end of a quick stop
        return known

    def _read_state(self) -> MotorState:
        if self._hardware.facts is not None and self._node.lost_since_ns is None:
            self._node.refresh()
        return self._state()

    def _read_fault(self) -> Fault | None:
        node = self._node
        if self._hardware.facts is None:
            return None
        node.refresh()
        if not node.statusword & FAULT_BIT:
            return None
        code = node.error_code or self._objects.read_optional(0x603F) or 0
        since_ns = node.status_ns if node.fault_since_ns is None else node.fault_since_ns
        return Fault(code, error_text(code), since_ns)

    def _read_referenced(self) -> bool:
        return self._hardware.is_homed

    def _read_position(self) -> float:
        self._node.check_heard()
        self._node.refresh()
        return self.units.position(self._node.position_inc)

    def _read_velocity(self) -> float:
        return self.units.velocity(self._objects.read_int(0x606C))

    def _read_reference(self) -> float:
        self.units.require_all()  # a motion is planned: what is missing is told before it is begun
        self._node.check_link()
        self._node.refresh()
        if self._node.state is PdsState.OPERATION_ENABLED:
            demand = self._objects.read_optional(0x6062)
            if demand is not None:
                # What was asked for, where that is what it holds: rounding must not add up.
                return self._held[1] if demand == self._held[0] else self.units.position(demand)
        return self._read_position()

    def _read_torque(self) -> float:
        permille = self._objects.read_optional(0x6077)
        rated = self._objects.read_optional(0x6076)
        if permille is None or not rated:
            missing = "6077h" if permille is None else "6076h, rated torque"
            raise UnsupportedError(motor=self.name, feature=f"measuring torque (no {missing})")
        return permille / 1e3 * rated / 1e3  # per mille of the rated torque [mN·m]

    def _read_following_error(self) -> float:
        error = self._objects.read_optional(0x60F4)
        if error is None:
            return self._read_reference() - self.units.position(self._objects.read_int(0x6064))
        return self.units.position(error)

    def _latest(self) -> Measurement | None:
        node, units = self._node, self._units
        if node.status_ns < 0:
            return None
        position = velocity = None
        if units is not None and units.increments_per_unit is not None:
            position = units.position(node.position_inc)
            raw = node.values.get((0x606C, 0))
            if raw is not None and units.velocity_unit is not None:
                velocity = units.velocity(raw)
        return Measurement(node.status_ns, self._state(), position, velocity)

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
        self._control.write_controlword(ENABLE_OPERATION | NEW_SET_POINT)

    # --- motion -----------------------------------------------------------------------------

    def _arm(self, motion: Motion, *, together: bool) -> Trigger:
        units, limits = self._known()
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
        self._held = (profile.target, motion.target)
        if self._can_arm(velocity=False):
            self._control.arm(profile.target, fired=watch.begin)
            return SyncTrigger(self._node.link)
        self._objects.push(0x607A, profile.target)
        return SetPointTrigger(self._hardware, watch)

    def _arm_velocity(self, motion: Motion, profile: DriveProfile) -> Trigger:
        if not self._control.is_in(Mode.PROFILE_VELOCITY):
            self._objects.write(0x60FF, 0)  # whatever was there would count at once
            self._control.set_mode(Mode.PROFILE_VELOCITY)
        self._push_profile(profile)
        change = abs(motion.target - self._read_velocity())
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
        if self._can_arm(velocity=True):
            self._control.arm(profile.target, velocity=True, fired=watch.begin)
            return SyncTrigger(self._node.link)
        return VelocityTrigger(self._hardware, watch, profile.target)

    def _can_arm(self, *, velocity: bool) -> bool:
        facts = self._hardware.connect()
        can_id = facts.velocity_id if velocity else facts.position_id
        return self._together and can_id is not None

    def _push_profile(self, profile: DriveProfile) -> None:
        limits = self._known()[1]
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
            return
        self._await_acknowledge(watch)
        if not self._control.is_halted:
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
        units, limits = self._known()
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
        now_ns = self.runtime.now_ns()
        self._hardware.follow(RestWatch(commanded_ns=now_ns, needs_bit=True))
        if self._node.state is PdsState.OPERATION_ENABLED:
            self._control.send_halt()

    def _quick_stop(self) -> None:
        now_ns = self.runtime.now_ns()
        self._hardware.follow(RestWatch(commanded_ns=now_ns, needs_bit=False))
        if self._node.state is PdsState.OPERATION_ENABLED:
            self._hardware.quick_stopped = True
            self._control.send_quick_stop()

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


def _read_limits(hardware: Cia402HwMotor) -> DriveLimits:
    read = hardware.objects.read_optional
    low, high = read(0x607D, 1), read(0x607D, 2)
    position = None if low is None or high is None or low == high == 0 else (low, high)
    window = read(0x6067)
    return DriveLimits(
        position=position,
        speed=read(0x607F),
        acceleration=read(0x60C5),
        deceleration=read(0x60C6),
        window=None if window == _WINDOW_OFF else window,
        has_deceleration=read(0x6084) is not None,
    )
