"""All kinds of motion, for clauses that hold in each."""

from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager
from dataclasses import dataclass
from math import sqrt
from typing import Final, final

from harness.conformance.bench import Lost, RigProtocol
from harness.conformance.capability import Capability
from harness.conformance.clause import expect
from harness.conformance.motions import (
    aim,
    expect_unmoved,
    finish,
    follow,
    long_move,
    move,
    place,
    rest_for,
    shortest_s,
    torque_of,
    turn,
)
from motorapi import (
    ComplexTrajectory,
    ControlMode,
    ControlVariable,
    Motor,
    MotorError,
    PluginError,
    TrapezoidalTrajectory,
    UnsupportedError,
)

MOVING_S: Final = 0.4
"""Time until a motion that began here is at full speed [s]."""
_WAYS: Final = 2.0  # in long moves: long enough to be interrupted
_SPEED: Final = 0.5  # of the model's maximum
_TORQUE: Final = 0.06  # of the model's maximum: the motor must not run away
_CALM: Final = 0.5  # of the model's acceleration
_LOOK_S: Final = 0.02
_BACK_S: Final = 1.0


@final
@dataclass(frozen=True, slots=True)
class Mode:
    """One kind of motion.

    Attributes:
        words: its name in messages.
        capability: the capability that it needs; None: every motor can do it.
        begin: begins the motion with a motor of the bench.
        moves: whether the motor moves.
        ends: whether the motion ends by itself.
        is_a_way: whether its duration is that of a distance of some long moves.
    """

    words: str
    capability: Capability | None
    begin: Callable[[RigProtocol, Motor], None]
    moves: bool = True
    ends: bool = True
    is_a_way: bool = False


def modes_of(bench: RigProtocol) -> Iterator[Mode]:
    """Yield each mode that the motor supports, already begun on new motors.

    Modes in the rig's `without` table are left out.

    Raises:
        MotorError: a supported mode cannot be begun.
    """
    for mode in _MODES:
        if mode.capability in bench.facts.without or not _is_known(bench, mode):
            continue
        if mode.is_a_way and is_over_soon(bench):
            continue
        bench.afresh()
        try:
            mode.begin(bench, bench.motor)
        except UnsupportedError:
            continue
        rest_for(bench, MOVING_S)
        yield mode


def is_over_soon(bench: RigProtocol) -> bool:
    """Return whether position limits make the motion too short to be interrupted."""
    return shortest_s(bench.motor, _WAYS * long_move(bench)) < 2.0 * MOVING_S


def _is_known(bench: RigProtocol, mode: Mode) -> bool:
    """Return whether the rig and the model give the facts that this mode needs."""
    if mode.capability is Capability.HOMING:
        return bench.facts.seeking_method is not None
    needs_torque = mode.capability is Capability.TORQUE_SET_POINT
    return not needs_torque or bench.motor.model.torque_max is not None


def ending(bench: RigProtocol, motor: Motor, mode: Mode, within_s: float) -> MotorError | None:
    """Return the error that ended a motion, or None if none came within `within_s` [s].

    Raises:
        PluginError: the adaptation itself failed.
    """
    end_ns = bench.runtime.now_ns() + round(within_s * 1e9)
    while True:
        left_s = (end_ns - bench.runtime.now_ns()) / 1e9
        try:
            motor.wait_until_done(max(left_s, 0.0))
        except PluginError:
            raise
        except MotorError as error:
            return error
        if mode.ends or left_s <= 0.0:
            return None
        rest_for(bench, min(_LOOK_S, left_s))


def smooth_way(motor: Motor, way: float) -> ComplexTrajectory:
    """Return a cubic trajectory of this distance, from rest to rest, within the model's limits."""
    from motorapi.functions import Polynomial

    model = motor.model
    slowest = _CALM * min(model.acceleration_max, model.deceleration)
    # way (3 s^2 - 2 s^3) over a time T: at most 6 way / T^2 and 1.5 way / T
    time_s = max(sqrt(6.0 * abs(way) / slowest), 1.5 * abs(way) / (0.8 * model.velocity_max))
    cubic = Polynomial((0.0, 0.0, 3.0 * way / time_s**2, -2.0 * way / time_s**3))
    return ComplexTrajectory(cubic.restricted(0.0, time_s), relative=True)


def until_rest_s(bench: RigProtocol, motor: Motor) -> float:
    """Return the longest time from the loss of a motor until it is at rest [s]."""
    facts, model = bench.facts, motor.model
    brake_s = facts.brake_s
    if brake_s is None:
        brake_s = model.velocity_max / model.deceleration
    return facts.dead_man_s + brake_s + facts.time_tolerance_s


def expect_usable(bench: RigProtocol, motor: Motor, what: str) -> None:
    """Check that the motor can be reset, stopped and enabled, and makes its next move."""
    motor.reset_fault()
    motor.stop()  # a motor without a dead-man is still moving
    finish(bench, motor)
    before = place(bench, motor)
    motor.enable()
    rest_for(bench, 0.1)
    expect_unmoved(bench, motor, before, f"{what}: when enabled again")
    way, begun_ns = 0.25 * long_move(bench), bench.runtime.now_ns()
    move(bench, motor, way)
    took_s = (bench.runtime.now_ns() - begun_ns) / 1e9
    moved, unit = place(bench, motor) - before, motor.model.unit
    least_s = shortest_s(motor, way) - bench.facts.time_tolerance_s
    expect(
        took_s >= least_s,
        f"{what}: the next move took {took_s:.3f} s; expected at least {least_s:.3f} s",
    )
    expect(
        abs(moved - way) <= 2.0 * bench.facts.window,
        f"{what}: the next move was {moved:g} {unit}; expected {way:g} {unit}",
    )


def move_through(
    bench: RigProtocol, motor: Motor, trouble: AbstractContextManager[Lost], what: str
) -> int:
    """Move once through the trouble: check that the move is done or fails with an error.

    After an error, the motor must be usable.

    Returns:
        How often the trouble struck.
    """
    before, way = place(bench, motor), 0.25 * long_move(bench)
    told: MotorError | None = None
    with trouble as struck:
        try:
            aim(motor, way, relative=True)
            finish(bench, motor, shortest_s(motor, way))
        except PluginError:
            raise
        except MotorError as error:
            told = error
        hit = struck()
    if told is not None:
        rest_for(
            bench, shortest_s(motor, way) + _BACK_S
        )  # the drive may have received the command all the same
    moved, unit, window = place(bench, motor) - before, motor.model.unit, bench.facts.window
    low, high = sorted((0.0, way))
    expect(
        low - window <= moved <= high + window,
        f"{what}: moved {moved:g} {unit}; one move of {way:g} {unit} was commanded",
    )
    expect(
        told is not None or abs(moved - way) <= window,
        f"{what}: done was reported after {moved:g} {unit} of a move of {way:g} {unit}",
    )
    if told is not None:
        expect_usable(bench, motor, what)
    return hit


def _aim(bench: RigProtocol, motor: Motor) -> None:
    aim(motor, _WAYS * long_move(bench), relative=True)


def _turn(bench: RigProtocol, motor: Motor) -> None:
    turn(motor, _SPEED * motor.model.velocity_max)


def _push(bench: RigProtocol, motor: Motor) -> None:
    motor.set_control_mode(ControlMode.SETPOINT, ControlVariable.TORQUE)
    motor.set_setpoint(torque_of(motor, _TORQUE))
    motor.start()


def _follow(bench: RigProtocol, motor: Motor) -> None:
    follow(motor, TrapezoidalTrajectory(_WAYS * long_move(bench)))


def _speed_up(bench: RigProtocol, motor: Motor) -> None:
    motor.set_control_mode(ControlMode.TRAJECTORY, ControlVariable.VELOCITY)
    motor.set_trajectory(TrapezoidalTrajectory(_SPEED * motor.model.velocity_max))
    motor.start()


def _stream(bench: RigProtocol, motor: Motor) -> None:
    motor.set_control_mode(ControlMode.TRAJECTORY)
    motor.set_trajectory(smooth_way(motor, _WAYS * long_move(bench)))
    motor.start()


def _seek(bench: RigProtocol, motor: Motor) -> None:
    motor.home(bench.facts.seeking_method, wait=False)


def _hold(bench: RigProtocol, motor: Motor) -> None:
    motor.enable()


_C: Final = Capability
_MODES: Final = (
    Mode("a position set-point", _C.POSITION_SET_POINT, _aim, is_a_way=True),
    Mode("a velocity set-point", _C.VELOCITY_SET_POINT, _turn, ends=False),
    Mode("a torque set-point", _C.TORQUE_SET_POINT, _push, ends=False),
    Mode("a position trajectory", _C.POSITION_TRAJECTORY, _follow, is_a_way=True),
    Mode("a velocity trajectory", _C.VELOCITY_TRAJECTORY, _speed_up, ends=False),
    Mode("a complex position trajectory", _C.COMPLEX_POSITION, _stream, is_a_way=True),
    Mode("homing", _C.HOMING, _seek),
    Mode("holding, enabled", None, _hold, moves=False, ends=False),
)
