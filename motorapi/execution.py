"""Execution of commands: the start of one motor or many, and the wait for its end.

    acquire all (in one global order) -> plan -> enable -> plan again -> reserve the triggers
    -> arm all -> fire each trigger once -> confirm all

If a step before firing fails, no motor has moved and all armed motors are disarmed. If a later step
fails, every motor of the start is stopped. A start of one motor is the start of a group of one. A
wait for several motors has one deadline.
"""

import warnings
from collections.abc import Callable, Sequence
from contextlib import ExitStack
from typing import Final, final

from motorhil.frozen import frozen
from motorhil.motorapi.commands import ControlMode, ControlVariable, Setpoint
from motorhil.motorapi.errors import (
    DeadlineExceeded,
    MotionInterrupted,
    MotorError,
    StateError,
)
from motorhil.motorapi.logical_motor import LogicalMotor, check_timeout
from motorhil.motorapi.motion import Motion
from motorhil.motorapi.ownership.claim import use_leases
from motorhil.motorapi.ownership.physical_motor import ActiveMotion, RunStatus
from motorhil.motorapi.ownership.queue import FifoQueue, trigger_turns
from motorhil.motorapi.planning import single_axis as planning
from motorhil.motorapi.planning.functions import model_of_profile
from motorhil.motorapi.planning.groups import TIME, Common, synchronised
from motorhil.motorapi.runtime.api import Awaited, Waiting, wait_until
from motorhil.motorapi.state import MotorState
from motorhil.motorapi.synchronization.offer import Trigger
from motorhil.motorapi.synchronization.quality import SyncLevel
from motorhil.motorapi.trajectory import (
    Argument,
    ComplexTrajectory,
    MotorPosition,
    Trajectory,
    TrapezoidalTrajectory,
)

Answer = Callable[[LogicalMotor, ActiveMotion | None, Exception], Exception]
"""The reaction to a failure: motor, its motion and the error; returns the error to be raised."""


def wait_for_all(
    motors: Sequence[LogicalMotor], timeout_s: float | None, answer: Answer | None = None
) -> None:
    """Wait until the last command of all motors has ended; react to the first failure.

    Args:
        motors: motors of one runtime.
        timeout_s: [s]; None: no timeout.
        answer: called with the failed motor, its motion and the error; returns the error to be
            raised. None: raise the original error.

    Raises:
        DeadlineExceeded: not within `timeout_s` [s]; names the motors that are not done. Nothing is
            stopped.
        MotorError: the failure of a motion.

    A motor that has a command, which was not started, and no motion is the subject of a warning.
    """
    timeout_s = check_timeout(timeout_s)
    for motor in motors:
        if (motor.run is None or motor.run.is_over) and (text := motor.forgotten()):
            warnings.warn(f"{text}, and this wait has nothing to wait for", stacklevel=3)
    members = [_Member(motor) for motor in motors]
    awaited = [Awaited(one.motor.physical.news, one.is_over) for one in members]
    waiting = Waiting(awaited)

    def going() -> list[_Member]:
        return [m for m, one in zip(members, awaited, strict=True) if one in waiting.going]

    runtime = motors[0].runtime
    deadline_ns: int | None = None
    if timeout_s is not None:
        deadline_ns = runtime.now_ns() + round(min(timeout_s, 1e9) * 1e9)
    while True:
        again_s = [one.motor.refresh() for one in going() if one.run is not None]
        again_s += [one.motor.physical.ownership.use(one.motor) for one in going()]
        again_s.append(use_leases())
        pauses_s = [pause_s for pause_s in again_s if pause_s is not None]
        if deadline_ns is not None:
            pauses_s.append(max(0, deadline_ns - runtime.now_ns()) / 1e9)
        try:
            if wait_until(runtime, waiting.all_over, min(pauses_s) if pauses_s else None):
                for motor in motors:
                    motor.physical.ownership.look()
                    motor.raise_callback_error()
                return
        except _MemberFailed as failed:
            error = failed.error
            if answer is not None:
                error = answer(failed.motor, failed.run, error)
            raise error from error.__cause__
        if deadline_ns is not None and runtime.now_ns() >= deadline_ns:
            break
    raise DeadlineExceeded(
        awaited=f"end of motion of {', '.join(one.motor.name for one in going())}",
        timeout_s=0.0 if timeout_s is None else timeout_s,
        last_heard="; ".join(_last_heard(one.motor) for one in going()),
    )


@final
class _Member:
    """A motor with its motion at the beginning of the wait."""

    def __init__(self, motor: LogicalMotor) -> None:
        self.motor = motor
        self.run = motor.run

    def is_over(self) -> bool:
        try:
            return self.motor.look(self.run)
        except Exception as error:
            raise _MemberFailed(self.motor, self.run, error) from error


@final
class _MemberFailed(MotorError):  # noqa: N818 -- never leaves this module
    def __init__(self, motor: LogicalMotor, run: ActiveMotion | None, error: Exception) -> None:
        super().__init__()
        self.motor = motor
        self.run = run
        self.error = error


def stop_others(motors: Sequence[LogicalMotor], failed: LogicalMotor, error: Exception) -> None:
    """Stop all motors except the failed one; a note on the error reports this."""
    if len(motors) == 1:
        return
    error.add_note(f"from {failed.name}; the others of its group were stopped")
    for motor in motors:
        if motor is not failed and not motor.physical.ownership.is_lost_by(motor):
            try:
                motor.stop()
            except Exception as further:
                error.add_note(f"but {motor.name} could not be stopped: {further}")


def _last_heard(motor: LogicalMotor) -> str:
    latest = motor.hooks.latest()
    if latest is None:
        return f"{motor.name}: nothing"
    text = f"{motor.name}: {latest.state.value} at {latest.time_ns / 1e9:.6f} s"
    if latest.position is not None:
        text += f", {latest.position:g} {motor.model.unit}"
    if latest.velocity is not None:
        text += f", {latest.velocity:g} {motor.model.unit}/s"
    return text


_RING_MAX: Final = 100
"""The maximum number of motors followed in a chain of leaders."""


@final
@frozen
class Started:
    """One motor of a start, with its requested motion and the motion that its hardware makes."""

    motor: LogicalMotor
    motion: Motion
    quantised: Motion


def start_together(
    motors: Sequence[LogicalMotor],
    timeout_s: float | None = None,
    common: Common = TIME,
    check: Callable[[], None] | None = None,
) -> tuple[Started, ...]:
    """Start the commands of all motors; trajectories end together.

    Args:
        motors: motors of one runtime.
        timeout_s: timeout until all are free [s]; None: do not wait.
        common: the common properties of their motions.
        check: called when all motors are acquired, before any is enabled; it may raise.

    Raises:
        MotorError: as `Motor.start`; a note names the motor, if there are several.
    """
    timeout_s = check_timeout(timeout_s)
    for motor in motors:
        motor.asked = _require_command(motor)
    asked_ns = motors[0].runtime.now_ns()
    with ExitStack() as held:
        for motor in sorted(motors, key=lambda motor: motor.physical.order):
            left_s: float | None = None
            if timeout_s is not None:
                left_s = max(0.0, timeout_s - (motor.runtime.now_ns() - asked_ns) / 1e9)
            held.enter_context(motor.operation("start", left_s))
        seen = [motor.physical.interruptions for motor in motors]
        disabled = [motor for motor in motors if _require_movable(motor) is MotorState.DISABLED]
        motions = plan(motors, common)
        if check is not None:
            check()
        if disabled:
            for motor in disabled:
                motor.enable()
            _check_not_interrupted(motors, seen)
            motions = plan(motors, common)  # enabling may have changed the reference positions
        started = tuple(
            Started(motor, motion, motor.hooks.quantise(motion))
            for motor, motion in zip(motors, motions, strict=True)
        )
        for turns in _trigger_turns(motors):
            held.enter_context(turns.turn(motors[0].runtime, f"start() of {motors[0].name}"))
        _fire(started, _arm(started, seen), seen)
        return started


def plan(motors: Sequence[LogicalMotor], common: Common = TIME) -> list[Motion]:
    """Return the motion of each motor from its present position, with the common properties.

    Raises:
        UsageError: a motion is impossible; only read requests were sent.
    """
    _require_no_ring(motors)
    motions = [_plan_one(motor) for motor in motors]
    if len(motors) > 1:
        motions = synchronised(motors, motions, common)
    return motions


def _require_no_ring(motors: Sequence[LogicalMotor]) -> None:
    """Raise StateError if a motor would follow itself, directly or through other motors."""
    starting = {id(motor.physical): _argument(motor) for motor in motors}
    for motor in motors:
        led_by, way = starting[id(motor.physical)], [motor.name]
        while isinstance(led_by, MotorPosition) and len(way) <= len(starting) + _RING_MAX:
            way.append(led_by.leader.name)
            leader = getattr(led_by.leader, "logical", None)
            physical = getattr(leader, "physical", None)
            if physical is motor.physical:
                raise StateError(
                    motor=motor.name,
                    operation="start",
                    state=f"its position would lead itself: {' follows '.join(way)}"
                    + ("" if way[-1] == motor.name else ", the same motor"),
                    remedy="lead it by a motor that does not follow it",
                )
            run: ActiveMotion | None = getattr(physical, "run", None)
            goes_on = None if run is None or run.finished else run.motion
            led_by = starting.get(id(physical), None if goes_on is None else goes_on.argument)


def _argument(motor: LogicalMotor) -> Argument | None:
    """Return the argument of the motion to be started, or None for time."""
    return motor.argument if isinstance(motor.command, ComplexTrajectory) else None


def _plan_one(motor: LogicalMotor) -> Motion:
    command = _require_command(motor)
    _require_startable(motor)
    absolute = not (command.relative if isinstance(command, Setpoint) else command.is_relative)
    absolute = absolute and motor.variable is ControlVariable.POSITION
    if absolute and motor.model.requires_referencing and not motor.hooks.read_referenced():
        raise StateError(
            motor=motor.name,
            operation="start",
            state="its position is not referenced, and the target is absolute",
            remedy="call home() first",
        )
    variable = motor.variable
    if isinstance(command, Setpoint):
        reference = motor.hooks.read_reference()
        return planning.plan_setpoint(motor.name, motor.model, variable, command, reference)
    velocity: float | None = None
    if _begins_moving(motor, command):
        velocity = motor.hooks.read_velocity()
    model = model_of_profile(motor.model, limits_jerk=motor.hooks.limits_jerk(variable))
    return planning.plan_trajectory(
        *(motor.name, model, variable, command, _reference(motor)),
        argument=motor.argument,
        velocity=velocity,
    )


def _begins_moving(motor: LogicalMotor, command: Setpoint | Trajectory) -> bool:
    """Return True for a trajectory of position with an initial velocity."""
    if motor.variable is not ControlVariable.POSITION:
        return False
    return isinstance(command, TrapezoidalTrajectory) and command.initial_velocity != 0.0


def _reference(motor: LogicalMotor) -> float:
    """Return the present initial value for a trajectory of the motor's control variable."""
    if motor.variable is ControlVariable.POSITION:
        return motor.hooks.read_reference()
    run = motor.physical.run
    before = None if run is None or run.finished else run.motion
    if before is None or before.variable is not motor.variable:
        return 0.0
    if motor.variable is ControlVariable.VELOCITY and not motor.hooks.is_done():
        return motor.hooks.read_velocity()
    return before.target


def _require_command(motor: LogicalMotor) -> Setpoint | Trajectory:
    if motor.command is None:
        raise StateError(
            motor=motor.name,
            operation="start",
            state="there is nothing to start",
            remedy="call set_control_mode(), then set_setpoint() or set_trajectory()",
        )
    return motor.command


def _require_startable(motor: LogicalMotor) -> None:
    """Require rest, unless the new command may replace the active motion."""
    run = motor.physical.run
    before = None if run is None else run.motion
    replaceable = before is not None and before.variable is motor.variable
    if before is not None and motor.command is not None and _begins_moving(motor, motor.command):
        return  # the velocity is checked instead
    if replaceable and motor.variable is ControlVariable.POSITION:
        setpoints = (ControlMode.SETPOINT, ControlMode.SETPOINT)
        replaceable = before is not None and (before.mode, motor.mode) == setpoints
    if not replaceable:
        motor.require_rest("start")


def _require_movable(motor: LogicalMotor) -> MotorState:
    state = motor.require_no_fault()
    if state is MotorState.STOPPED:
        raise StateError(
            motor=motor.name,
            operation="start",
            state="it was brought to a quick stop",
            remedy="call enable() when it is safe to move",
        )
    return state


def _trigger_turns(motors: Sequence[LogicalMotor]) -> list[FifoQueue]:
    """Return the turns for triggers of several motors, exclusive from arming to firing."""
    if len(motors) == 1:
        return []
    offers = [motor.hooks.sync_offer() for motor in motors]
    shared = [offer.group for offer in offers if offer.level is not SyncLevel.SEQUENTIAL]
    return trigger_turns(motors[0].runtime, shared)


def _arm(started: Sequence[Started], seen: Sequence[int]) -> list[Trigger]:
    """Arm and confirm all motors. Return their triggers, each once, in the order of motors."""
    armed: list[Started] = []
    triggers: list[Trigger] = []
    try:
        for one in started:
            armed.append(one)
            trigger = one.motor.hooks.arm(one.motion, together=len(started) > 1)
            if trigger not in triggers:
                triggers.append(trigger)
        _check_not_interrupted([one.motor for one in started], seen)
    except BaseException as error:
        _note_member(error, armed[-1], started)
        _disarm(armed, error)
        raise
    return triggers


def _fire(started: Sequence[Started], triggers: Sequence[Trigger], seen: Sequence[int]) -> None:
    """Fire the triggers and confirm that all motors have begun."""
    runs = [one.motor.begin("start", one.motion) for one in started]
    current = started[0]
    try:
        for trigger in triggers:
            current.motor.hooks.fire(trigger)
        for current in started:
            current.motor.hooks.confirm(current.motion)
        _check_not_interrupted([one.motor for one in started], seen)
    except BaseException as error:
        _note_member(error, current, started)
        _abandon(started, runs, error)
        raise


def _check_not_interrupted(motors: Sequence[LogicalMotor], seen: Sequence[int]) -> None:
    for motor, count in zip(motors, seen, strict=True):
        physical = motor.physical
        physical.ownership.require(motor)
        if physical.interruptions != count:
            by = "a stop" if physical.run is None else physical.run.name
            raise MotionInterrupted(motor=motor.name, by=by, at_ns=motor.runtime.now_ns())


def _disarm(armed: Sequence[Started], error: BaseException) -> None:
    for one in reversed(armed):
        try:
            one.motor.hooks.disarm()
        except Exception as further:
            error.add_note(f"and {one.motor.name} could not be disarmed: {further}")


def _abandon(
    started: Sequence[Started], runs: Sequence[ActiveMotion], error: BaseException
) -> None:
    """Stop and disarm every motor of a start that failed after firing.

    Motors that another owner has taken over meanwhile are left alone.
    """
    for one, run in zip(started, runs, strict=True):
        try:
            if not one.motor.physical.ownership.is_lost_by(one.motor):
                one.motor.hooks.stop()
        except Exception as further:
            error.add_note(f"and {one.motor.name} could not be stopped: {further}")
        if one.motor.physical.run is run:
            now_ns = one.motor.runtime.now_ns()
            one.motor.physical.end(f"a failed start ({error})", now_ns, RunStatus.FAILED)
    _disarm(started, error)


def _note_member(error: BaseException, one: Started, started: Sequence[Started]) -> None:
    if len(started) > 1:
        place = next(place for place, other in enumerate(started) if other is one)
        error.add_note(f"from {one.motor.name}, motor {place + 1} of {len(started)}")
