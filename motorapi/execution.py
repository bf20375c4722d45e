"""Execution of commands: one motor or many, started as one operation.

    acquire all (in one global order) -> plan -> enable -> plan again -> reserve the triggers
    -> arm all -> fire each trigger once -> confirm all

If a step before firing fails, no motor has moved and all armed motors are disarmed. If a later step
fails, every motor of the start is stopped. A start of one motor is the start of a group of one.
"""

# ruff: noqa: SLF001 -- it works the hooks of motors, as Motor does its own

from collections.abc import Callable, Sequence
from contextlib import ExitStack
from dataclasses import dataclass
from typing import TYPE_CHECKING, Final, final

from motorapi import planning
from motorapi.arguments import Argument, MotorPosition
from motorapi.commands import ControlMode, ControlVariable, Motion, Setpoint, as_number
from motorapi.errors import (
    DeviceFault,
    LinkError,
    MotionInterrupted,
    MotorBusyError,
    StateError,
)
from motorapi.group_planning import TIME, Common, synchronised
from motorapi.motion_waits import check_timeout
from motorapi.sharing import Run, RunStatus
from motorapi.state import Fault, MotorState
from motorapi.synchronization import SyncLevel, Trigger
from motorapi.trajectory import ComplexTrajectory, Trajectory
from motorapi.turns import Turns, trigger_turns

if TYPE_CHECKING:
    from motorapi.motor import Motor


_RING_MAX: Final = 100
"""The maximum number of motors followed in a chain of leaders."""


@final
@dataclass(frozen=True, slots=True)
class Started:
    """One motor of a start, with its requested motion and the motion that its hardware makes."""

    motor: "Motor"
    motion: Motion
    quantised: Motion


def start_together(
    motors: Sequence["Motor"],
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
    check_timeout(timeout_s)
    common.check()
    for motor in motors:
        _require_command(motor)
    asked_ns = motors[0].runtime.now_ns()
    with ExitStack() as held:
        for motor in sorted(motors, key=lambda motor: motor._physical.order):
            left_s: float | None = None
            if timeout_s is not None:
                left_s = max(0.0, as_number(timeout_s) - (motor.runtime.now_ns() - asked_ns) / 1e9)
            held.enter_context(motor._operation("start", left_s))
        seen = [motor._physical.interruptions for motor in motors]
        disabled = [motor for motor in motors if _require_movable(motor) is MotorState.DISABLED]
        motions = plan(motors, common)
        if check is not None:
            check()
        if disabled:
            for motor in disabled:
                motor._call(motor._enable)
            _check_not_interrupted(motors, seen)
            motions = plan(motors, common)  # enabling may have changed the reference positions
        started = tuple(
            Started(motor, motion, motor._call(motor._quantise, motion))
            for motor, motion in zip(motors, motions, strict=True)
        )
        for turns in _trigger_turns(motors):
            held.enter_context(turns.turn(motors[0].runtime, f"start() of {motors[0].name}"))
        _fire(started, _arm(started, seen), seen)
        return started


def plan(motors: Sequence["Motor"], common: Common = TIME) -> list[Motion]:
    """Return the motion of each motor from its present position, with the common properties.

    Raises:
        UsageError: a motion is impossible; only read requests were sent.
    """
    _require_no_ring(motors)
    motions = [_plan_one(motor) for motor in motors]
    if len(motors) > 1:
        motions = synchronised(motors, motions, common)
    return motions


def _require_no_ring(motors: Sequence["Motor"]) -> None:
    """Raise StateError if a motor would follow itself, directly or through other motors."""
    starting = {id(motor._physical): _argument(motor) for motor in motors}
    for motor in motors:
        led_by, way = starting[id(motor._physical)], [motor.name]
        while isinstance(led_by, MotorPosition) and len(way) <= len(starting) + _RING_MAX:
            way.append(led_by.leader.name)
            physical = getattr(led_by.leader, "_physical", None)
            if physical is motor._physical:
                raise StateError(
                    motor=motor.name,
                    operation="start",
                    state=f"its position would lead itself: {' follows '.join(way)}"
                    + ("" if way[-1] == motor.name else ", the same motor"),
                    remedy="lead it by a motor that does not follow it",
                )
            run: Run | None = getattr(physical, "run", None)
            goes_on = None if run is None or run.finished else run.motion
            led_by = starting.get(id(physical), None if goes_on is None else goes_on.argument)


def _argument(motor: "Motor") -> Argument | None:
    """Return the argument of the motion to be started, or None for time."""
    return motor._argument if isinstance(motor._command, ComplexTrajectory) else None


def _plan_one(motor: "Motor") -> Motion:
    command = _require_command(motor)
    _require_startable(motor)
    absolute = not (command.relative if isinstance(command, Setpoint) else command.is_relative)
    absolute = absolute and motor.control_variable is ControlVariable.POSITION
    if absolute and motor.model.requires_referencing and not motor._call(motor._read_referenced):
        raise StateError(
            motor=motor.name,
            operation="start",
            state="its position is not referenced, and the target is absolute",
            remedy="call home() first",
        )
    variable = motor.control_variable
    if isinstance(command, Setpoint):
        reference = motor._call(motor._read_reference)
        return planning.plan_setpoint(motor.name, motor.model, variable, command, reference)
    return planning.plan_trajectory(
        motor.name, motor.model, variable, command, _reference(motor), argument=motor._argument
    )


def _reference(motor: "Motor") -> float:
    """Return the present initial value for a trajectory of the motor's control variable."""
    if motor.control_variable is ControlVariable.POSITION:
        return motor._call(motor._read_reference)
    run = motor._physical.run
    before = None if run is None or run.finished else run.motion
    if before is None or before.variable is not motor.control_variable:
        return 0.0
    if motor.control_variable is ControlVariable.VELOCITY and not motor._call(motor._is_done):
        return motor._call(motor._read_velocity)
    return before.target


def _require_command(motor: "Motor") -> Setpoint | Trajectory:
    if motor._command is None:
        raise StateError(
            motor=motor.name,
            operation="start",
            state="there is nothing to start",
            remedy="call set_control_mode(), then set_setpoint() or set_trajectory()",
        )
    return motor._command


def _require_startable(motor: "Motor") -> None:
    """Require rest, unless the new command may replace the active motion."""
    run = motor._physical.run
    before = None if run is None else run.motion
    replaceable = before is not None and before.variable is motor.control_variable
    if replaceable and motor.control_variable is ControlVariable.POSITION:
        setpoints = (ControlMode.SETPOINT, ControlMode.SETPOINT)
        replaceable = before is not None and (before.mode, motor.control_mode) == setpoints
    if not replaceable:
        require_rest(motor, "start")


def _require_movable(motor: "Motor") -> MotorState:
    state = require_no_fault(motor)
    if state is MotorState.STOPPED:
        raise StateError(
            motor=motor.name,
            operation="start",
            state="it was brought to a quick stop",
            remedy="call enable() when it is safe to move",
        )
    return state


def require_no_fault(motor: "Motor") -> MotorState:
    """Return the state of the motor, which is neither FAULT nor OFFLINE.

    Raises:
        DeviceFault: the drive reports a fault.
        LinkError: the motor does not respond.
    """
    state = motor._call(motor._read_state)
    if state is MotorState.OFFLINE:
        reason, remedy = f"{motor.name} does not respond", "check its power, its cable and the bus"
        raise LinkError(link=motor._physical.label, reason=reason, remedy=remedy)
    if state is MotorState.FAULT:
        fault = motor._call(motor._read_fault)
        if fault is None:
            fault = Fault(0, "not told", motor.runtime.now_ns())
        raise DeviceFault(
            motor=motor.name, code=fault.code, text=fault.text, since_ns=fault.since_ns
        )
    return state


def require_rest(motor: "Motor", operation: str) -> None:
    """Require that an acquired motor is at rest.

    Raises:
        StateError: a motion is active.
        MotorBusyError: another logical motor has stopped it since, and it still slows down.
    """
    run = motor._physical.run
    if run is None or not motor._goes_on(run):
        return
    if run.owner is not motor:
        raise MotorBusyError(motor=motor.name, holder=run.name, since_ns=run.since_ns)
    raise StateError(
        motor=motor.name,
        operation=operation,
        state=f"{run.name} is active since {run.since_ns / 1e9:.6f} s",
        remedy="wait_until_done() or stop() first" if run.ends else "stop() first",
    )


def _trigger_turns(motors: Sequence["Motor"]) -> list[Turns]:
    """Return the turns for triggers of several motors, exclusive from arming to firing."""
    if len(motors) == 1:
        return []
    offers = [motor._call(motor._sync_offer) for motor in motors]
    shared = [offer.group for offer in offers if offer.level is not SyncLevel.SEQUENTIAL]
    return trigger_turns(motors[0].runtime, shared)


def _arm(started: Sequence[Started], seen: Sequence[int]) -> list[Trigger]:
    """Arm and confirm all motors. Return their triggers, each once, in the order of motors."""
    armed: list[Started] = []
    triggers: list[Trigger] = []
    try:
        for one in started:
            armed.append(one)
            trigger = one.motor._call(one.motor._arm, one.motion, together=len(started) > 1)
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
    runs = [one.motor._begin("start", one.motion) for one in started]
    current = started[0]
    try:
        for trigger in triggers:
            current.motor._call(trigger.fire)
        for current in started:
            current.motor._call(current.motor._confirm, current.motion)
        _check_not_interrupted([one.motor for one in started], seen)
    except BaseException as error:
        _note_member(error, current, started)
        _abandon(started, runs, error)
        raise


def _check_not_interrupted(motors: Sequence["Motor"], seen: Sequence[int]) -> None:
    for motor, count in zip(motors, seen, strict=True):
        physical = motor._physical
        physical.ownership.require(motor)
        if physical.interruptions != count:
            by = "a stop" if physical.run is None else physical.run.name
            raise MotionInterrupted(motor=motor.name, by=by, at_ns=motor.runtime.now_ns())


def _disarm(armed: Sequence[Started], error: BaseException) -> None:
    for one in reversed(armed):
        try:
            one.motor._call(one.motor._disarm)
        except Exception as further:
            error.add_note(f"and {one.motor.name} could not be disarmed: {further}")


def _abandon(started: Sequence[Started], runs: Sequence[Run], error: BaseException) -> None:
    """Stop and disarm every motor of a start that failed after firing.

    Motors that another owner has taken over meanwhile are left alone.
    """
    for one, run in zip(started, runs, strict=True):
        try:
            if not one.motor._physical.ownership.is_lost_by(one.motor):
                one.motor._call(one.motor._stop)
        except Exception as further:
            error.add_note(f"and {one.motor.name} could not be stopped: {further}")
        if one.motor._physical.run is run:
            now_ns = one.motor.runtime.now_ns()
            one.motor._physical.end(f"a failed start ({error})", now_ns, RunStatus.FAILED)
    _disarm(started, error)


def _note_member(error: BaseException, one: Started, started: Sequence[Started]) -> None:
    if len(started) > 1:
        place = next(place for place, other in enumerate(started) if other is one)
        error.add_note(f"from {one.motor.name}, motor {place + 1} of {len(started)}")
