"""The adaptation of the motor interface to an ODrive.

| command                                  | command to the drive                                |
| ---------------------------------------- | --------------------------------------------------- |
| set-point or simple trajectory, position | TRAP_TRAJ: a trapezoid of its own, to a position    |
| set-point or ramp, velocity and torque   | PASSTHROUGH, in steps of the host's (`stream`)      |
| stop, halt, quick stop                   | TRAP_TRAJ to where it can come to rest              |
| homing                                   | here (35, 37), or by its minimum end stop (17)      |

Commands contain positions, never distances, so that a repeated frame does no harm. Trajectories
that are functions are refused. Motors start one after another: CANSimple has no common signal.
"""

from typing import Final, final

from motorhil.motorapi.api import (
    CanMotor,
    ControlMode,
    ControlVariable,
    Fault,
    Measurement,
    Motion,
    MotionInterrupted,
    MotionTimes,
    MotorModel,
    MotorState,
    PeerError,
    StateError,
    Trigger,
    UnsupportedError,
)

from motorhil_odrive.host import messages as m
from motorhil_odrive.host.braking import brake
from motorhil_odrive.host.hardware import OdriveHwMotor
from motorhil_odrive.host.heard import Heartbeat
from motorhil_odrive.host.start import Start, prepare
from motorhil_odrive.host.units import Units
from motorhil_odrive.host.watch import Armed, Arrival, Called, Homed, Rest

_STATE_S: Final = 1.0
_ANSWER_S: Final = 0.5
_REFRESH_S: Final = 0.02
_HERE: Final = (None, 35, 37)
_NEGATIVE_SWITCH: Final = 17
_SUPPORTED: Final = (ControlVariable.POSITION, ControlVariable.VELOCITY, ControlVariable.TORQUE)


@final
class OdriveMotor(CanMotor[OdriveHwMotor]):
    """A logical motor on an ODrive; several of them may share one hardware object."""

    def _units_of(self, model: MotorModel) -> float:
        self._scale = Units(model)
        return self._scale.rev

    # --- capabilities ----------------------------------------------------------------------

    def _supports(self, mode: ControlMode, variable: ControlVariable) -> bool:
        return variable in _SUPPORTED

    def _quantise(self, motion: Motion) -> Motion:
        return self._scale.rounded(motion)

    # --- state and measurements -------------------------------------------------------------

    def _latest_fault(self) -> Fault | None:
        return self.hardware.heard.fault()

    def _read_referenced(self) -> bool:
        return self.hardware.heard.is_homed

    def _read_reference(self) -> float:
        hardware = self.hardware
        watch, held = hardware.heard.watch, hardware.held
        rests = watch is None or watch.is_over()
        if held is None or not rests or not hardware.heard.is_in(m.CLOSED_LOOP):
            return self._read_position()
        return held / self._units

    def _read_torque(self) -> float:
        return self.hardware.ask(m.TORQUES)[1] / self._scale.n_m

    def _latest(self) -> Measurement | None:
        heartbeat, estimate = self.hardware.heard.heartbeat, self.hardware.heard.estimate
        if heartbeat is None or estimate is None:
            return None
        state = MotorState.DISABLED
        if heartbeat.error:
            state = MotorState.FAULT
        elif self.hardware.heard.is_in(m.CLOSED_LOOP, m.HOMING):
            state = MotorState.ENABLED
        position, velocity = estimate.position / self._units, estimate.velocity / self._units
        return Measurement(estimate.time_ns, state, position, velocity)

    def _position_source(self) -> str:
        return "encoder estimate, message 09h"

    def _refresh(self) -> float | None:
        """Request a heartbeat during a command, so that it comes sooner than by itself."""
        watch = self.hardware.heard.watch
        if watch is not None and not watch.is_over() and not self.hardware.drive.is_lost:
            self.hardware.ask_for_heartbeat()
        return _REFRESH_S

    # --- power, fault, reference ------------------------------------------------------------

    def _enable(self) -> None:
        hardware = self.hardware
        if hardware.heard.is_in(m.CLOSED_LOOP):  # after a quick stop
            return
        hardware.heard.follow(None)
        hardware.tell(m.CONTROLLER_MODE, m.POSITION_CONTROL, m.TRAPEZOID)
        sent_ns = hardware.drive.confirm(hardware.tell(m.AXIS_STATE, m.CLOSED_LOOP))
        denied: set[int] = set()

        def is_answered(heard: Heartbeat) -> bool:
            if heard.state != m.CLOSED_LOOP and heard.time_ns > sent_ns:
                denied.add(heard.time_ns)  # the first one may have been queued before the command
            return heard.state == m.CLOSED_LOOP or len(denied) > 1

        heartbeat = hardware.await_heartbeat(is_answered, _STATE_S)
        self._check_fault()
        if heartbeat.state != m.CLOSED_LOOP:
            raise PeerError(
                f"{self.name}: closed loop was refused: {m.result_text(heartbeat.result)}"
            )

    def _disable(self) -> None:
        hardware = self.hardware
        hardware.end_stream()
        hardware.heard.follow(None)
        hardware.tell(m.AXIS_STATE, m.IDLE)
        hardware.await_heartbeat(lambda heard: heard.state == m.IDLE, _STATE_S)

    def _reset_fault(self) -> None:
        hardware = self.hardware
        hardware.end_stream()
        hardware.heard.follow(None)
        hardware.tell(m.AXIS_STATE, m.IDLE)
        sent_ns = hardware.drive.confirm(hardware.tell(m.CLEAR_ERRORS, 0))
        # One heartbeat may have been queued before the command: its errors are old.
        hardware.await_heartbeat(lambda heard: heard.time_ns > sent_ns, _STATE_S)
        hardware.await_heartbeat(lambda heard: True, _STATE_S)
        self._check_fault()

    def _home(self, method: int | None) -> None:
        hardware = self.hardware
        hardware.end_stream()
        if method in _HERE:
            window = hardware.options.position_window_rev
            hardware.heard.follow(Called(hardware.tell(m.ABSOLUTE_POSITION, 0.0), window))
        elif method == _NEGATIVE_SWITCH:
            hardware.heard.follow(Homed(hardware.tell(m.AXIS_STATE, m.HOMING)))
            hardware.doubt()  # the drive changes modes by itself
        else:
            feature = f"homing by method {method}"
            raise UnsupportedError(motor=self.name, feature=feature, supported="17, 35, 37")

    # --- motion -----------------------------------------------------------------------------

    def _arm(self, motion: Motion, *, together: bool) -> Trigger:
        hardware = self.hardware
        start = Start(hardware, self._scale, self._scale.rounded(motion), self.model)
        prepare(start)
        hardware.heard.follow(Armed(hardware.heard.watch))
        return start

    def _disarm(self) -> None:
        watch = self.hardware.heard.watch
        if isinstance(watch, Armed):
            self.hardware.heard.follow(watch.before)

    def _confirm(self, motion: Motion) -> None:
        hardware, heard = self.hardware, self.hardware.heard
        watch = heard.watch
        if not isinstance(watch, Arrival):
            return

        def is_settled() -> bool:
            return watch.is_answered() or heard.watch is not watch or heard.fault() is not None

        hardware.await_heartbeat(lambda _: is_settled(), _ANSWER_S)
        estimate = heard.estimate
        if heard.watch is not watch or heard.fault() is not None or estimate is None:
            return  # stopped or failed: the wait reports it
        if watch.was_ignored(estimate):
            raise PeerError(f"{self.name}: the drive did not take the set-point; it did not move")

    def _is_done(self) -> bool:
        hardware = self.hardware
        hardware.drive.check()
        watch = hardware.heard.watch
        self._check_fault()
        if watch is None:
            return True
        stream = hardware.stream
        if stream is not None and stream.error is not None and watch.moves:
            raise stream.error
        if not hardware.heard.is_in(m.CLOSED_LOOP, m.HOMING):
            if isinstance(watch, Rest):
                return True  # no active deceleration
            if watch.needs_power:
                raise self._switched_off()
        if watch.is_over() and watch.failed:
            raise PeerError(f"{self.name}: homing failed: {watch.failed}")
        return watch.is_over()

    def _switched_off(self) -> MotionInterrupted:
        heartbeat = self.hardware.heard.heartbeat
        assert heartbeat is not None  # a motion has begun
        told = m.result_text(heartbeat.result)
        by = f"the drive, now in axis state {heartbeat.state} ({told})"
        return MotionInterrupted(motor=self.name, by=by, at_ns=heartbeat.time_ns)

    def _stop(self) -> None:
        size = self._physical.stop_deceleration(self.model.deceleration)
        brake(self.hardware, size, self._scale)

    # --- the hardware itself ----------------------------------------------------------------

    def _open_low_level(self) -> OdriveHwMotor:
        stream = self.hardware.stream
        if stream is not None and stream.is_going:
            raise StateError(
                motor=self.name,
                operation="low_level()",
                state="set-points are being streamed to it",
                remedy="stop() first",
            )
        self.hardware.heard.follow(None)
        return self.hardware

    def _motion_times(self) -> MotionTimes | None:
        watch = self.hardware.heard.watch
        if watch is None or isinstance(watch, Rest | Armed):
            return None
        source = "its set-point on the bus; trajectory done in its heartbeat"
        return MotionTimes(watch.started_ns, watch.ended_ns, source)
