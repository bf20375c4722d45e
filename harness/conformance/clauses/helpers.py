"""Common steps of clauses: move motors and groups, measure them, check their state.

U is the unit of the motor's position, rad or m.
"""

from collections.abc import Callable, Iterator, Sequence
from contextlib import AbstractContextManager, contextmanager
from functools import partial
from math import cbrt, inf, sqrt
from typing import TYPE_CHECKING, Final, final

from motorhil.frozen import frozen
from motorhil.harness.conformance.bench import Ability, Lost, RigProtocol, Stated
from motorhil.harness.conformance.clause import NotApplicable, Violated, expect
from motorhil.harness.conformance.clauses.demands import jerk_of, least_s
from motorhil.harness.rig.config.conformance import Capability
from motorhil.motorapi import (
    ComplexTrajectory,
    ControlMode,
    ControlVariable,
    DerivativeLimits,
    LimitError,
    MotionInterrupted,
    Motor,
    MotorError,
    MotorGroup,
    MotorState,
    Outcome,
    PluginError,
    Synchronization,
    TrapezoidalTrajectory,
    UnsupportedError,
)

if TYPE_CHECKING:
    from hypothesis import settings

    from motorhil.motorapi.functions import Function
    from motorhil.motorapi.functions.base import FloatArray

SAMPLE_S: Final = 0.005
FINE_S: Final = 0.001
MOVING_S: Final = 0.4
"""Time until a motion that began here is at full speed [s]."""
_REST_S: Final = 0.05
_SPARE_S: Final = 5.0
_BACK_S: Final = 1.0
_POLL_S: Final = 0.02
_GROUP_TIMEOUT_S: Final = 10.0
_LONG_MOVES: Final = 2.0  # long enough to be interrupted
_SPEED: Final = 0.5  # of the model's maximum
_TORQUE: Final = 0.06  # of the model's maximum: the motor must not run away
_SPEED_SHARE: Final = 0.05  # allowed
_CALM: Final = 0.5  # of the model's acceleration

Sample = tuple[float, float]
"""(time since the first sample [s], position [U])."""
_C: Final = Capability


def long_move(bench: RigProtocol) -> float:
    """Return a distance that takes about a second [U]."""
    if bench.facts.long_move is not None:
        return bench.facts.long_move
    model = bench.motor.model
    return 0.5 * model.velocity_max + model.velocity_max**2 / model.acceleration_max


def shortest_s(motor: Motor, way: float) -> float:
    """Return the shortest time of a rest-to-rest move within the model's limits [s]."""
    model = motor.model
    ramps = model.acceleration_max, model.deceleration
    return least_s(way, model.velocity_max, *ramps, jerk_of(motor))


def midway_s(motor: Motor, way: float, share: float) -> float:
    """Return a share of the shortest move's time [s], less for a motor that brakes gently.

    The motor can then still stop within half of the distance. A motor that brakes more slowly than
    it accelerates spends most of a move on braking.
    """
    model = motor.model
    return share * shortest_s(motor, way) * min(1.0, model.deceleration / model.acceleration_max)


def rest_for(bench: RigProtocol, duration_s: float) -> None:
    """Let this time pass [s]."""
    bench.runtime.wait_until(lambda: False, duration_s)


def later(bench: RigProtocol, time_s: float, command: Callable[[], object]) -> None:
    """Carry out a command in some time [s]; for another party."""
    rest_for(bench, time_s)
    command()


def position_of(bench: RigProtocol, motor: Motor) -> float:
    """Return the motor's position [U]: the true one if the bench can see it."""
    if Ability.TRUTH in bench.abilities:
        return bench.true_position(motor)
    return motor.position()


def prepare(motor: Motor, way: float, duration_s: float | None = None) -> None:
    """Set up the trajectory of the next start."""
    motor.set_control_mode(ControlMode.TRAJECTORY)
    motor.set_trajectory(TrapezoidalTrajectory(way, duration_s=duration_s))


def follow(
    motor: Motor,
    trajectory: TrapezoidalTrajectory | ComplexTrajectory,
    variable: ControlVariable = ControlVariable.POSITION,
) -> None:
    """Start a trajectory."""
    motor.set_control_mode(ControlMode.TRAJECTORY, variable)
    motor.set_trajectory(trajectory)
    motor.start()


def begin_move(bench: RigProtocol, motor: Motor, way: float, time_s: float) -> float:
    """Enable the motor, begin a move by this distance, and let this time [s] of it pass.

    Returns:
        The position before [U].
    """
    motor.enable()
    before = position_of(bench, motor)
    follow(motor, TrapezoidalTrajectory(way))
    rest_for(bench, time_s)
    return before


def aim(
    motor: Motor, target: float, relative: bool = False, limits: DerivativeLimits | None = None
) -> None:
    """Start a move to a position set-point."""
    motor.set_control_mode(ControlMode.SETPOINT)
    motor.set_setpoint(target, relative, limits)
    motor.start()


def drive(motor: Motor, variable: ControlVariable, value: float) -> None:
    """Start a set-point of velocity [U/s], torque [N·m or N] or current [A]."""
    motor.set_control_mode(ControlMode.SETPOINT, variable)
    motor.set_setpoint(value)
    motor.start()


def turn(motor: Motor, velocity: float) -> None:
    """Start a velocity set-point [U/s]."""
    drive(motor, ControlVariable.VELOCITY, velocity)


def coast(bench: RigProtocol, motor: Motor) -> None:
    """Wait until a motor without current rests by its friction (Ability.TRUTH)."""
    for _ in range(100):
        before = bench.true_position(motor)
        rest_for(bench, 0.1)
        if abs(bench.true_position(motor) - before) <= 0.01 * bench.facts.window:
            return


def elapsed_s(bench: RigProtocol, since_ns: int) -> float:
    """Return the time that has passed since then [s]."""
    return (bench.runtime.now_ns() - since_ns) / 1e9


def finish(bench: RigProtocol, motor: Motor, expected_s: float = 0.0) -> float:
    """Wait until the motion is over, well beyond its expected duration; return the wait [s]."""
    begun_ns = bench.runtime.now_ns()
    motor.wait_until_done(expected_s + bench.facts.time_tolerance_s + _SPARE_S)
    return elapsed_s(bench, begun_ns)


def move(bench: RigProtocol, motor: Motor, way: float) -> None:
    """Move by this distance as fast as possible, and wait until done."""
    follow(motor, TrapezoidalTrajectory(way))
    finish(bench, motor, shortest_s(motor, way))


def failure_of(*operations: Callable[[], object]) -> MotorError | None:
    """Return the error that ends these operations, or None if they return.

    Raises:
        PluginError: the adaptation itself failed.
    """
    try:
        for operation in operations:
            operation()
    except PluginError:
        raise
    except MotorError as error:
        return error
    return None


def expect_taken_over(wait: Callable[[], object], what: str) -> None:
    """Expect the wait for a motion to end because another user took the motor over on demand."""
    error = failure_of(wait)
    is_told = isinstance(error, MotionInterrupted) and "on demand" in error.by
    expect(is_told, f"{what}: the wait ended with {error!r}; expected the takeover")


def braking_distance(motor: Motor, velocity: float) -> float:
    """Return the braking distance from this velocity at the model's deceleration [U]."""
    return velocity**2 / (2.0 * motor.model.deceleration)


def distance_to_top_speed(motor: Motor) -> float:
    """Return the shortest move with a tenth of a second at the largest velocity [U]."""
    top = motor.model.velocity_max
    ramps_s = 0.5 * top * (1.0 / motor.model.acceleration_max + 1.0 / motor.model.deceleration)
    return top * (ramps_s + 0.1)


def sample_positions(bench: RigProtocol, motor: Motor, duration_s: float) -> list[Sample]:
    """Sample the position every `SAMPLE_S` for this duration, from now on."""
    begun_ns = bench.runtime.now_ns()
    samples: list[Sample] = []
    while True:
        at_s = elapsed_s(bench, begun_ns)
        samples.append((at_s, position_of(bench, motor)))
        if at_s >= duration_s:
            return samples
        rest_for(bench, SAMPLE_S)


def fastest(samples: Sequence[Sample], over_s: float = 0.05) -> float:
    """Return the largest mean speed over any window of this length [U/s]."""
    top = 0.0
    first = 0
    for at_s, position in samples:
        while at_s - samples[first][0] > over_s:
            first += 1
        since_s = at_s - samples[first][0]
        if since_s >= 0.9 * over_s:
            top = max(top, abs(position - samples[first][1]) / since_s)
    return top


def speed(bench: RigProtocol, motor: Motor, over_s: float) -> float:
    """Return the mean velocity over the given time from now [U/s]."""
    begun_ns, before = bench.runtime.now_ns(), position_of(bench, motor)
    rest_for(bench, over_s)
    return (position_of(bench, motor) - before) / elapsed_s(bench, begun_ns)


def worst_deviation(
    bench: RigProtocol, samples: Sequence[Sample], wanted: Callable[[float], float]
) -> float:
    """Return the largest deviation from `wanted`, for any start within the declared latency [U]."""
    early_s, late_s = bench.facts.latency_s
    worst = 0.0
    for at_s, position in samples:
        ends = wanted(at_s - late_s), wanted(at_s - early_s)
        worst = max(worst, min(ends) - position, position - max(ends))
    return worst


def expect_tracks(
    bench: RigProtocol, samples: Sequence[Sample], wanted: Callable[[float], float], what: str
) -> None:
    """Check that every sample is within the declared following distance of `wanted`."""
    worst, unit = worst_deviation(bench, samples, wanted), bench.motor.model.unit
    expect(
        worst <= bench.facts.following,
        f"{what}: {worst:.6g} {unit} off the demand; at most {bench.facts.following:g} {unit} "
        "declared",
    )


def expect_same_end(motor: Motor, what: str) -> None:
    """Check that progress() and on_done(), which do not ask the drive, agree on the end."""
    shown = motor.progress()
    ended: list[Outcome] = []
    motor.on_done(ended.append).cancel()
    expect(
        (shown is None) is bool(ended),
        f"{what}: progress() is {shown}, but on_done() reports {ended or 'no end'}",
    )


def expect_state(motor: Motor, wanted: MotorState, when: str) -> None:
    """Check that the motor reports this state."""
    state = motor.state()
    expect(state is wanted, f"{when}: state is {state.value}; expected {wanted.value}")


def expect_raises(
    errors: type[Exception] | tuple[type[Exception], ...],
    operation: Callable[[], object],
    what: str,
) -> None:
    """Check that the operation raises one of these errors; others pass through."""
    try:
        operation()
    except errors:
        return
    raise Violated(what)


def expect_at(bench: RigProtocol, motor: Motor, target: float, what: str) -> None:
    """Check that the motor reports the target position."""
    unit, window = motor.model.unit, bench.facts.window
    reported = motor.position()
    expect(
        abs(reported - target) <= window,
        f"{what}: reports position {reported:.6g} {unit}; expected {target:.6g} {unit} within "
        f"{window:g}",
    )


def move_exactly(bench: RigProtocol, motor: Motor, way: float, what: str) -> None:
    """Move by this distance; check that the motor reports its target."""
    before = motor.position()
    move(bench, motor, way)
    expect_at(bench, motor, before + way, what)


def expect_moved(
    bench: RigProtocol, motor: Motor, before: float, way: float, what: str, windows: float = 1.0
) -> None:
    """Check that the motor has moved by this distance, within so many position windows."""
    moved, unit = position_of(bench, motor) - before, motor.model.unit
    expect(
        abs(moved - way) <= windows * bench.facts.window,
        f"{what}: {motor.name} moved {moved:g} {unit}; expected {way:g} {unit}",
    )


def expect_speed(bench: RigProtocol, motor: Motor, wanted: float, over_s: float, what: str) -> None:
    """Check the mean velocity over the given time from now [U/s]."""
    found, unit = speed(bench, motor, over_s), motor.model.unit
    expect(
        abs(found - wanted) <= _SPEED_SHARE * abs(wanted),
        f"{what}: velocity {found:g} {unit}/s; expected {wanted:g} {unit}/s",
    )


def expect_rest(bench: RigProtocol, motor: Motor, what: str) -> None:
    """Check that the motor does not move."""
    before = position_of(bench, motor)
    rest_for(bench, _REST_S)
    moved = position_of(bench, motor) - before
    unit = motor.model.unit
    expect(
        abs(moved) <= bench.facts.window,
        f"{what}: not at rest, moved {moved:.6g} {unit} in {_REST_S:g} s",
    )


def expect_unmoved(bench: RigProtocol, motor: Motor, before: float, what: str) -> None:
    """Check that the motor is still at its former position."""
    moved, unit = position_of(bench, motor) - before, motor.model.unit
    expect(
        abs(moved) <= bench.facts.window, f"{what}: moved by {moved:.6g} {unit}; expected no motion"
    )


def quiet_settings(max_examples: int) -> "settings":
    """Return Hypothesis settings that keep no database and report one example."""
    from hypothesis import Phase, settings

    return settings(
        max_examples=max_examples,
        deadline=None,
        database=None,
        print_blob=False,
        report_multiple_bugs=False,
        phases=(Phase.explicit, Phase.generate, Phase.shrink),
    )


def reached(happened: bool, what: str) -> None:
    """Raise Violated if the event that puts the promise to the test did not happen."""
    if not happened:
        raise Violated(f"{what} did not happen, so that this promise was not tested")


def torque_of(motor: Motor, share: float) -> float:
    """Return a share of the largest torque [N·m], or force [N] of a linear motor.

    Raises:
        NotApplicable: the motor's model has no largest torque.
    """
    if motor.model.torque_max is None:
        raise NotApplicable("the motor's model has no torque_max")
    return share * motor.model.torque_max


@final
@frozen
class Mode:
    """One kind of motion.

    Attributes:
        name: its name in messages.
        capability: the capability that it needs; None: every motor can do it.
        begin: begins the motion with a motor of the bench.
        moves: whether the motor moves.
        ends: whether the motion ends by itself.
        is_distance: whether its duration is that of a distance of some long moves.
    """

    name: str
    capability: Capability | None
    begin: Callable[[RigProtocol, Motor], None]
    moves: bool = True
    ends: bool = True
    is_distance: bool = False


def modes_of(bench: RigProtocol) -> Iterator[Mode]:
    """Yield each mode that the motor supports, already begun on new motors.

    Modes in the rig's `without` table are left out.

    Raises:
        MotorError: a supported mode cannot be begun.
    """
    for mode in _MODES:
        if mode.capability in bench.facts.without:
            continue
        bench.afresh()  # which costs nothing as long as no motor was asked for
        if not _is_known(bench, mode) or (mode.is_distance and is_over_soon(bench)):
            continue
        try:
            mode.begin(bench, bench.motor)
        except UnsupportedError:
            continue
        rest_for(bench, MOVING_S)
        yield mode


def is_over_soon(bench: RigProtocol) -> bool:
    """Return whether position limits make the motion too short to be interrupted."""
    return shortest_s(bench.motor, _LONG_MOVES * long_move(bench)) < 2.0 * MOVING_S


def _is_known(bench: RigProtocol, mode: Mode) -> bool:
    """Return whether the rig and the model give the facts that this mode needs."""
    if mode.capability is Capability.HOMING:
        return bench.facts.seeking_method is not None
    needs_torque = mode.capability is Capability.TORQUE_SET_POINT
    return not needs_torque or bench.motor.model.torque_max is not None


def error_ending(
    bench: RigProtocol, motor: Motor, mode: Mode, within_s: float
) -> MotorError | None:
    """Return the error that ended a motion, or None if none came within `within_s` [s].

    Raises:
        PluginError: the adaptation itself failed.
    """
    end_ns = bench.runtime.now_ns() + round(within_s * 1e9)
    while True:
        left_s = (end_ns - bench.runtime.now_ns()) / 1e9
        error = failure_of(partial(motor.wait_until_done, max(left_s, 0.0)))
        if error is not None or mode.ends or left_s <= 0.0:
            return error
        rest_for(bench, min(_POLL_S, left_s))


def smooth_move(motor: Motor, way: float) -> ComplexTrajectory:
    """Return a cubic trajectory of this distance, from rest to rest, within the model's limits."""
    model = motor.model
    slowest = _CALM * min(model.acceleration_max, model.deceleration)
    time_s = max(sqrt(6.0 * abs(way) / slowest), 1.5 * abs(way) / (0.8 * model.velocity_max))
    if model.jerk_max is not None:
        time_s = max(time_s, cbrt(12.0 * abs(way) / (0.8 * model.jerk_max)))
    return ComplexTrajectory(cubic_step(way, time_s), relative=True)


def cubic_step(way: float, time_s: float) -> "Function":
    """Return way (3 s² - 2 s³) over a time T: at most 1.5 way/T fast and 6 way/T² steep."""
    from motorhil.motorapi.functions import Polynomial

    cubic = Polynomial((0.0, 0.0, 3.0 * way / time_s**2, -2.0 * way / time_s**3))
    return cubic.restricted(0.0, time_s)


def failing_function(inner: "Function", problem: str) -> "tuple[Function, Callable[[], None]]":
    """Return `inner` as a function of an application, and what makes it raise from then on."""
    from motorhil.motorapi.functions import Function

    calls: list[bool] = []

    class Failing(Function):
        """A function of an application, with a defect that shows late."""

        @property
        def domain(self) -> tuple[float, float]:
            return inner.domain

        def value(self, argument: float) -> float:
            if calls:
                raise ValueError(problem)
            return inner.value(argument)

        def _values(self, arguments: "FloatArray") -> "FloatArray":
            return inner(arguments)

        def _derivative(self, order: int) -> Function:
            return inner.derivative(order)

        def integral(self) -> Function:
            return inner.integral()

        def _bounds(self, low: float, high: float) -> tuple[float, float]:
            return inner.bounds(low, high)

        def _parameters(self) -> tuple[object, ...]:
            return (inner,)

    return Failing(), lambda: calls.append(True)


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
    before = position_of(bench, motor)
    motor.enable()
    rest_for(bench, 0.1)
    expect_unmoved(bench, motor, before, f"{what}: when enabled again")
    way, begun_ns = 0.25 * long_move(bench), bench.runtime.now_ns()
    move(bench, motor, way)
    took_s = elapsed_s(bench, begun_ns)
    least_s = shortest_s(motor, way) - bench.facts.time_tolerance_s
    expect(
        took_s >= least_s,
        f"{what}: the next move took {took_s:.3f} s; expected at least {least_s:.3f} s",
    )
    expect_moved(bench, motor, before, way, f"{what}: in the next move", 2.0)


def move_through(
    bench: RigProtocol,
    motor: Motor,
    trouble: AbstractContextManager[Lost],
    what: str,
    *,
    is_brief: bool = False,
) -> int:
    """Move once through the trouble: check that the move is done or fails with an error.

    After an error, the motor must be usable. A motion that start() has begun moves the motor, if
    the trouble `is_brief`.

    Returns:
        How often the trouble struck.
    """
    before, way = position_of(bench, motor), 0.25 * long_move(bench)
    duration_s = shortest_s(motor, way)
    with trouble as struck:
        refusal = failure_of(partial(aim, motor, way, relative=True))
        error = refusal or failure_of(partial(finish, bench, motor, duration_s))
        hit = struck()
    if error is None:
        expect_moved(bench, motor, before, way, f"{what}: done was reported")
        return hit
    rest_for(bench, duration_s + _BACK_S)  # the drive may have received the command all the same
    moved, unit, window = position_of(bench, motor) - before, motor.model.unit, bench.facts.window
    low, high = sorted((0.0, way))
    expect(
        low - window <= moved <= high + window,
        f"{what}: moved {moved:g} {unit}; one move of {way:g} {unit} was commanded",
    )
    expect(
        not is_brief or refusal is not None or abs(moved) > window,
        f"{what}: start() returned, but the motor did not move: {error}",
    )
    expect_usable(bench, motor, what)
    return hit


def _aim(bench: RigProtocol, motor: Motor) -> None:
    aim(motor, _LONG_MOVES * long_move(bench), relative=True)


def _turn(bench: RigProtocol, motor: Motor) -> None:
    turn(motor, _SPEED * motor.model.velocity_max)


def _push(bench: RigProtocol, motor: Motor) -> None:
    drive(motor, ControlVariable.TORQUE, torque_of(motor, _TORQUE))


def _follow(bench: RigProtocol, motor: Motor) -> None:
    follow(motor, TrapezoidalTrajectory(_LONG_MOVES * long_move(bench)))


def _speed_up(bench: RigProtocol, motor: Motor) -> None:
    final = _SPEED * motor.model.velocity_max
    follow(motor, TrapezoidalTrajectory(final), ControlVariable.VELOCITY)


def _stream(bench: RigProtocol, motor: Motor) -> None:
    follow(motor, smooth_move(motor, _LONG_MOVES * long_move(bench)))


def _seek(bench: RigProtocol, motor: Motor) -> None:
    motor.home(bench.facts.seeking_method, wait=False)


def _hold(bench: RigProtocol, motor: Motor) -> None:
    motor.enable()


_MODES: Final = (
    Mode("a position set-point", _C.POSITION_SET_POINT, _aim, is_distance=True),
    Mode("a velocity set-point", _C.VELOCITY_SET_POINT, _turn, ends=False),
    Mode("a torque set-point", _C.TORQUE_SET_POINT, _push, ends=False),
    Mode("a position trajectory", _C.POSITION_TRAJECTORY, _follow, is_distance=True),
    Mode("a velocity trajectory", _C.VELOCITY_TRAJECTORY, _speed_up, ends=False),
    Mode("a complex position trajectory", _C.COMPLEX_POSITION, _stream, is_distance=True),
    Mode("homing", _C.HOMING, _seek),
    Mode("holding, enabled", None, _hold, moves=False, ends=False),
)


def expect_outside(error: LimitError) -> None:
    """Check that the value of this error is outside of its limits."""
    low = -inf if error.low is None else error.low
    high = inf if error.high is None else error.high
    is_outside = low <= high and not low <= error.value <= high
    expect(is_outside, f"refused, though its value is within its limits: {error}")


def pair_of(bench: RigProtocol, *ways: float) -> MotorGroup:
    """Return a group of the bench's first motors, with a trajectory set for each distance."""
    group = MotorGroup(*bench.motors[: len(ways)])
    group.for_each(Motor.set_control_mode, ControlMode.TRAJECTORY)
    group.set_trajectory(*(TrapezoidalTrajectory(way) for way in ways))
    return group


def limits_jerk(group: MotorGroup) -> bool:
    """Return whether a member limits the jerk of its moves, so that PHASE is refused."""
    return any(jerk_of(motor) != inf for motor in group)


@contextmanager
def in_phase(group: MotorGroup) -> Iterator[None]:
    """Synchronise the members by phase, which members with limited jerk may refuse in the block.

    Raises:
        NotApplicable: they do.
    """
    group.synchronization = Synchronization.PHASE
    try:
        yield
    except UnsupportedError as error:
        if not limits_jerk(group):
            raise
        raise NotApplicable(f"its motors limit the jerk: {error}") from None


def finish_group(bench: RigProtocol, group: MotorGroup) -> float:
    """Wait until the group is done [s, returned], and until the motors have settled."""
    begun_ns = bench.runtime.now_ns()
    group.wait_until_done(_GROUP_TIMEOUT_S)
    took_s = elapsed_s(bench, begun_ns)
    rest_for(bench, 10.0 * SAMPLE_S)
    return took_s


def half_move(bench: RigProtocol) -> float:
    """Return half the distance of a long move [U]."""
    return 0.5 * long_move(bench)


def trajectories_of(*ways: float) -> list[TrapezoidalTrajectory]:
    """Return a trajectory for each distance."""
    return [TrapezoidalTrajectory(way) for way in ways]


def expect_group_moved(
    bench: RigProtocol,
    group: MotorGroup,
    before: list[float],
    ways: tuple[float, ...],
    what: str,
) -> None:
    """Check that each member has moved by its distance."""
    for motor, was, way in zip(group, before, ways, strict=True):
        expect_moved(bench, motor, was, way, what)


def stated_settings(bench: RigProtocol) -> Stated:
    """Return what the adaptation declares of the motor's settings.

    Raises:
        NotApplicable: it declares none.
    """
    found = bench.stated()
    if found is None:
        raise NotApplicable("the adaptation declares no settings")
    return found
