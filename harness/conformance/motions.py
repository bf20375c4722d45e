"""Common actions of clauses: move a motor, wait, measure its position.

U is the unit of the motor's position, rad or m. Expected profiles are computed here from a
textbook, independently of the interface under test.
"""

from collections.abc import Callable, Sequence
from math import sqrt
from typing import Final

from harness.conformance.bench import RigProtocol
from harness.conformance.capability import Ability
from harness.conformance.clause import NotApplicable, Violated, expect
from motorapi import (
    ControlMode,
    ControlVariable,
    DerivativeLimits,
    Motor,
    TrapezoidalTrajectory,
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
