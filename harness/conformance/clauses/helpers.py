"""Common actions of clauses: move a motor, wait, measure its position.

U is the unit of the motor's position, rad or m. Expected profiles are computed here from a
textbook, independently of the interface under test.

All kinds of motion, for clauses that hold in each.

Groups of two motors, and the true times of each member's motion.

Where instants are compared, both distances have the same length. Then both motors make the same
profile, and reach each share of it at the same time.
"""

from collections.abc import Callable, Iterator, Sequence
from contextlib import AbstractContextManager
from dataclasses import dataclass
from math import sqrt
from typing import Final, final

from motorhil.harness.conformance.bench import Ability, Lost, RigProtocol
from motorhil.harness.conformance.clause import NotApplicable, Violated, expect
from motorhil.harness.rig.config.conformance import Capability
from motorhil.motorapi import (
    ComplexTrajectory,
    ControlMode,
    ControlVariable,
    DerivativeLimits,
    Motor,
    MotorError,
    MotorGroup,
    PluginError,
    TrapezoidalTrajectory,
    UnsupportedError,
)

SAMPLE_S: Final = 0.005
_REST_S: Final = 0.05
_SPARE_S: Final = 5.0

Sample = tuple[float, float]
"""(time since the first sample [s], position [U])."""


def long_move(bench: RigProtocol) -> float:
    """Return a distance that takes about a second [U]."""
    if bench.facts.long_move is not None:
        return bench.facts.long_move
    model = bench.motor.model
    return 0.5 * model.velocity_max + model.velocity_max**2 / model.acceleration_max


def shortest_s(motor: Motor, way: float) -> float:
    """Return the shortest time of a rest-to-rest move within the model's limits [s]."""
    model = motor.model
    return least_s(way, model.velocity_max, model.acceleration_max, model.deceleration)


def midway_s(motor: Motor, way: float, share: float) -> float:
    """Return a share of the shortest move's time [s], less for a motor that brakes gently.

    The motor can then still stop within half of the distance. A motor that brakes more slowly than
    it accelerates spends most of a move on braking.
    """
    model = motor.model
    return share * shortest_s(motor, way) * min(1.0, model.deceleration / model.acceleration_max)


def least_s(way: float, velocity: float, acceleration: float, deceleration: float) -> float:
    """Return the shortest time of a rest-to-rest move within these limits [s]."""
    peak = min(velocity, sqrt(2.0 * abs(way) / (1.0 / acceleration + 1.0 / deceleration)))
    if peak == 0.0:
        return 0.0
    return abs(way) / peak + 0.5 * peak * (1.0 / acceleration + 1.0 / deceleration)


def trapezoid(
    way: float, duration_s: float, acceleration: float, deceleration: float
) -> Callable[[float], float]:
    """Return a trapezoidal profile's position over time (Biagiotti & Melchiorri, 2008, 3.2.3)."""
    lost_s = 0.5 * (1.0 / acceleration + 1.0 / deceleration)
    peak = (duration_s - sqrt(max(0.0, duration_s**2 - 4.0 * lost_s * abs(way)))) / (2.0 * lost_s)
    up_s, down_s = peak / acceleration, peak / deceleration

    def position(at_s: float) -> float:
        at_s = min(max(at_s, 0.0), duration_s)
        if at_s < up_s:
            made = 0.5 * acceleration * at_s**2
        elif at_s <= duration_s - down_s:
            made = peak * (at_s - 0.5 * up_s)
        else:
            made = abs(way) - 0.5 * deceleration * (duration_s - at_s) ** 2
        return made if way >= 0.0 else -made

    return position


def rest_for(bench: RigProtocol, duration_s: float) -> None:
    """Let this time pass [s]."""
    bench.runtime.wait_until(_never, duration_s)


def _never() -> bool:
    return False


def place(bench: RigProtocol, motor: Motor) -> float:
    """Return the motor's position [U]: the true one if the bench can see it."""
    if Ability.TRUTH in bench.abilities:
        return bench.true_position(motor)
    return motor.position()


def follow(motor: Motor, trajectory: TrapezoidalTrajectory) -> None:
    """Start a position trajectory."""
    motor.set_control_mode(ControlMode.TRAJECTORY)
    motor.set_trajectory(trajectory)
    motor.start()


def aim(
    motor: Motor, target: float, relative: bool = False, limits: DerivativeLimits | None = None
) -> None:
    """Start a move to a position set-point."""
    motor.set_control_mode(ControlMode.SETPOINT)
    motor.set_setpoint(target, relative, limits)
    motor.start()


def turn(motor: Motor, velocity: float) -> None:
    """Start a velocity set-point [U/s]."""
    motor.set_control_mode(ControlMode.SETPOINT, ControlVariable.VELOCITY)
    motor.set_setpoint(velocity)
    motor.start()


def finish(bench: RigProtocol, motor: Motor, expected_s: float = 0.0) -> None:
    """Wait until the motion is over, well beyond its expected duration."""
    motor.wait_until_done(expected_s + bench.facts.time_tolerance_s + _SPARE_S)


def move(bench: RigProtocol, motor: Motor, way: float) -> None:
    """Move by this distance as fast as possible, and wait until done."""
    follow(motor, TrapezoidalTrajectory(way))
    finish(bench, motor, shortest_s(motor, way))


def way_of_stopping(motor: Motor, velocity: float) -> float:
    """Return the braking distance from this velocity at the model's deceleration [U]."""
    return velocity**2 / (2.0 * motor.model.deceleration)


def way_to_top_speed(motor: Motor) -> float:
    """Return the shortest move with a tenth of a second at the largest velocity [U]."""
    top = motor.model.velocity_max
    ramps_s = 0.5 * top * (1.0 / motor.model.acceleration_max + 1.0 / motor.model.deceleration)
    return top * (ramps_s + 0.1)


def watched(bench: RigProtocol, motor: Motor, duration_s: float) -> list[Sample]:
    """Sample the position every `SAMPLE_S` for this duration, from now on."""
    runtime = bench.runtime
    begun_ns = runtime.now_ns()
    taken: list[Sample] = []
    while True:
        at_s = (runtime.now_ns() - begun_ns) / 1e9
        taken.append((at_s, place(bench, motor)))
        if at_s >= duration_s:
            return taken
        rest_for(bench, SAMPLE_S)


def fastest(taken: Sequence[Sample], over_s: float = 0.05) -> float:
    """Return the largest mean speed over any window of this length [U/s]."""
    top = 0.0
    first = 0
    for at_s, position in taken:
        while at_s - taken[first][0] > over_s:
            first += 1
        since_s = at_s - taken[first][0]
        if since_s >= 0.9 * over_s:
            top = max(top, abs(position - taken[first][1]) / since_s)
    return top


def speed(bench: RigProtocol, motor: Motor, over_s: float) -> float:
    """Return the mean velocity over the given time from now [U/s]."""
    begun_ns, before = bench.runtime.now_ns(), place(bench, motor)
    rest_for(bench, over_s)
    return (place(bench, motor) - before) / ((bench.runtime.now_ns() - begun_ns) / 1e9)


def worst_deviation(
    bench: RigProtocol, taken: Sequence[Sample], wanted: Callable[[float], float]
) -> float:
    """Return the largest deviation from `wanted`, for any start within the declared latency [U]."""
    early_s, late_s = bench.facts.latency_s
    worst = 0.0
    for at_s, position in taken:
        ends = wanted(at_s - late_s), wanted(at_s - early_s)
        worst = max(worst, min(ends) - position, position - max(ends))
    return worst


def expect_tracks(
    bench: RigProtocol, taken: Sequence[Sample], wanted: Callable[[float], float], what: str
) -> None:
    """Check that every sample is within the declared following distance of `wanted`."""
    worst, unit = worst_deviation(bench, taken, wanted), bench.motor.model.unit
    expect(
        worst <= bench.facts.following,
        f"{what}: {worst:.6g} {unit} off the demand; at most {bench.facts.following:g} {unit} "
        "declared",
    )


def expect_at(bench: RigProtocol, motor: Motor, target: float, what: str) -> None:
    """Check that the motor reports the target position."""
    unit, window = motor.model.unit, bench.facts.window
    told = motor.position()
    expect(
        abs(told - target) <= window,
        f"{what}: reports position {told:.6g} {unit}; expected {target:.6g} {unit} within "
        f"{window:g}",
    )


def expect_rest(bench: RigProtocol, motor: Motor, what: str) -> None:
    """Check that the motor does not move."""
    before = place(bench, motor)
    rest_for(bench, _REST_S)
    moved = place(bench, motor) - before
    unit = motor.model.unit
    expect(
        abs(moved) <= bench.facts.window,
        f"{what}: not at rest, moved {moved:.6g} {unit} in {_REST_S:g} s",
    )


def expect_unmoved(bench: RigProtocol, motor: Motor, before: float, what: str) -> None:
    """Check that the motor is still at its former position."""
    moved, unit = place(bench, motor) - before, motor.model.unit
    expect(
        abs(moved) <= bench.facts.window, f"{what}: moved by {moved:.6g} {unit}; expected no motion"
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
    from motorhil.motorapi.functions import Polynomial

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


FINE_S: Final = 0.001
BEGUN: Final = 0.05  # share of the distance
_PATIENCE_S: Final = 10.0


def pair_of(bench: RigProtocol, *ways: float) -> MotorGroup:
    """Return a group of the bench's first motors, with a trajectory set for each distance."""
    group = MotorGroup(*bench.motors[: len(ways)])
    group.for_each(Motor.set_control_mode, ControlMode.TRAJECTORY)
    group.set_trajectory(*(TrapezoidalTrajectory(way) for way in ways))
    return group


def places(bench: RigProtocol, group: MotorGroup) -> list[float]:
    """Return the positions of all members [U]."""
    return [place(bench, motor) for motor in group]


class Course:
    """Records the positions of a group's members from its creation; times are in ns."""

    def __init__(self, bench: RigProtocol, group: MotorGroup, period_s: float = FINE_S) -> None:
        self._bench, self._group = bench, group
        self.seen: list[tuple[int, list[float]]] = []
        self._timer = bench.runtime.every(period_s, self._look)
        self._look()

    def _look(self) -> None:
        self.seen.append((self._bench.runtime.now_ns(), places(self._bench, self._group)))

    def end(self) -> None:
        """Stop recording."""
        self._timer.cancel()
        self._look()

    def when(self, member: int, share: float, way: float) -> float | None:
        """Return the interpolated time when a member had made a share of its way [ns], or None."""
        goal = share * way
        begin = self.seen[0][1][member]
        before_ns, before = self.seen[0][0], 0.0
        for now_ns, positions in self.seen:
            made = positions[member] - begin
            if (made - goal) * (1.0 if way > 0.0 else -1.0) >= 0.0:
                part = 1.0 if made == before else (goal - before) / (made - before)
                return before_ns + part * (now_ns - before_ns)
            before_ns, before = now_ns, made
        return None

    def skew_s(self, share: float, ways: Sequence[float]) -> float | None:
        """Return the time between the first and the last member at this share of its way [s]."""
        times = [self.when(member, share, way) for member, way in enumerate(ways)]
        known = [time for time in times if time is not None]
        return (max(known) - min(known)) / 1e9 if len(known) == len(times) else None


def looking_error_s(bench: RigProtocol, way: float, share: float) -> float:
    """Return the largest error of the difference of two times from `Course.when` [s]."""
    model = bench.motor.model
    slowest = min(model.acceleration_max, model.deceleration)
    speed = min(sqrt(2.0 * slowest * share * abs(way)), model.velocity_max)
    return 2.0 * bench.facts.following / speed + 2.0 * FINE_S


def run_to_the_end(bench: RigProtocol, group: MotorGroup) -> None:
    """Wait until the group is done, and until the motors have settled."""
    group.wait_until_done(_PATIENCE_S)
    rest_for(bench, 10.0 * SAMPLE_S)


def half(bench: RigProtocol) -> float:
    """Return half the distance of a long move [U]."""
    return 0.5 * long_move(bench)


def ways_of(*ways: float) -> list[TrapezoidalTrajectory]:
    """Return a trajectory for each distance."""
    return [TrapezoidalTrajectory(way) for way in ways]


def expect_made(
    bench: RigProtocol,
    group: MotorGroup,
    before: list[float],
    ways: tuple[float, ...],
    what: str,
) -> None:
    """Check that each member has moved by its distance."""
    for motor, was, way in zip(group, before, ways, strict=True):
        moved, unit = place(bench, motor) - was, motor.model.unit
        expect(
            abs(moved - way) <= bench.facts.window,
            f"{what}: {motor.name} moved {moved:g} {unit} of {way:g} {unit}",
        )
