"""L2: what a limit forbids, or a motor can never do, is refused before anything moves."""

from collections.abc import Callable
from functools import partial

from harness.conformance.bench import RigProtocol
from harness.conformance.capability import Capability
from harness.conformance.clause import Level, Violated, clause, expect
from harness.conformance.motions import (
    aim,
    expect_at,
    expect_unmoved,
    finish,
    follow,
    long_move,
    place,
    rest_for,
    shortest_s,
)
from motorapi import (
    ControlMode,
    ControlVariable,
    DerivativeLimits,
    LimitError,
    Motor,
    TrapezoidalTrajectory,
    UnsupportedError,
    UsageError,
)

_LOOK_S = 0.2


def _refused(
    bench: RigProtocol, motor: Motor, what: str, command: Callable[[], None], *, quantity: str
) -> None:
    """It is a LimitError that tells everything, and the motor has not moved."""
    before = place(bench, motor)
    try:
        command()
    except LimitError as error:
        facts = (error.motor, quantity in error.quantity, (error.low, error.high) != (None, None))
        expect(
            facts == (motor.name, True, True) and f"{error.value:g}" in f"{error}",
            f"{what}: the error does not tell motor, {quantity}, value and limit: {error}",
        )
    else:
        raise Violated(f"{what} was not refused")
    rest_for(bench, _LOOK_S)
    expect_unmoved(bench, motor, before, f"{what} was refused, and")


@clause(
    "LIM-01",
    Level.L2,
    needs={Capability.POSITION_SET_POINT, Capability.POSITION_TRAJECTORY},
    source="paper 3.2, limits on position; 3.3.1, derivative limits: ranges of the value",
)
def limits_of_position_are_kept_in_every_mode(bench: RigProtocol) -> None:
    """A target beyond a limit of position is refused in every mode; one on the limit is reached."""
    motor, limit = bench.motor, 0.3 * long_move(bench)
    expected_s = shortest_s(motor, 2.0 * limit)
    limits = DerivativeLimits(value=(-limit, limit))
    little = 1e-6 * limit
    for sign in (1.0, -1.0):
        on, beyond = sign * limit, sign * (limit + little)
        way = beyond - motor.position()

        def to_setpoint(target: float, relative: bool = False) -> None:
            aim(motor, target, relative, limits)

        def along(way: float, initial: float | None = None) -> None:
            follow(motor, TrapezoidalTrajectory(way, initial, limits=limits))

        for what, command in (
            ("a set-point", partial(to_setpoint, beyond)),
            ("a relative set-point", partial(to_setpoint, 1.01 * way, relative=True)),
            ("a trajectory", partial(along, 1.01 * way)),
        ):
            _refused(bench, motor, f"{what} beyond {on:g}", command, quantity="position")
        to_setpoint(on - sign * little)
        finish(bench, motor, expected_s)
        to_setpoint(on)
        finish(bench, motor, expected_s)
        expect_at(bench, motor, on, f"on its limit of {on:g}")
        follow(motor, TrapezoidalTrajectory(-0.5 * on, limits=limits))
        finish(bench, motor, expected_s)


@clause(
    "LIM-02",
    Level.L2,
    source="paper 3.2, limits on velocity and acceleration are the model's, and constant",
)
def no_command_may_exceed_the_model(bench: RigProtocol) -> None:
    """Nothing may be set that exceeds the model's limits, in any mode that the motor has."""
    motor, model = bench.motor, bench.motor.model
    tops = {
        ControlVariable.VELOCITY: model.velocity_max,
        ControlVariable.TORQUE: model.torque_max,
        ControlVariable.CURRENT: model.current_max,
    }
    found = 0
    for variable, top in tops.items():
        for mode in ControlMode:
            if top is None or not _can(motor, mode, variable):
                continue
            found += 1
            for value in (1.001 * top, -1.001 * top):
                what = f"a {mode.value} of {variable.value} of {value:g}"
                _refused(bench, motor, what, partial(_set, motor, value), quantity=variable.value)
    if not _can(motor, ControlMode.TRAJECTORY, ControlVariable.POSITION):
        expect(found > 0, "no mode of this motor has a limit")
        return
    way = 0.2 * long_move(bench)
    for quantity, limits in (
        ("velocity", DerivativeLimits(first=1.001 * model.velocity_max)),
        ("acceleration", DerivativeLimits(second=1.001 * _steepest(motor))),
    ):
        trajectory = TrapezoidalTrajectory(way, limits=limits)
        what = f"a limit of {quantity} above the model's"
        _refused(bench, motor, what, partial(motor.set_trajectory, trajectory), quantity=quantity)
    short_s = 0.9 * shortest_s(motor, way)
    hasty = TrapezoidalTrajectory(way, duration_s=short_s)
    what = f"a duration of {short_s:g} s"
    _refused(bench, motor, what, lambda: motor.set_trajectory(hasty), quantity="duration")


def _steepest(motor: Motor) -> float:
    return max(motor.model.acceleration_max, motor.model.deceleration)


def _can(motor: Motor, mode: ControlMode, variable: ControlVariable) -> bool:
    """It takes commands of that kind, and is set to them."""
    try:
        motor.set_control_mode(mode, variable)
    except UnsupportedError:
        return False
    return True


def _set(motor: Motor, value: float) -> None:
    if motor.control_mode is ControlMode.SETPOINT:
        motor.set_setpoint(value)
    else:
        motor.set_trajectory(TrapezoidalTrajectory(value, duration_s=10.0))
    motor.start()


@clause(
    "LIM-03",
    Level.L2,
    source="paper 3.3: any control variable supported by the motor; UnsupportedError: it never can",
)
def what_it_cannot_do_is_refused(bench: RigProtocol) -> None:
    """Every mode is either refused by the name of what there is instead, or goes when started."""
    motor = bench.motor
    motor.enable()
    for variable in ControlVariable:
        for mode in ControlMode:
            asked = f"{mode.value} of {variable.value}"
            try:
                motor.set_control_mode(mode, variable)
            except UnsupportedError as error:
                expect(
                    error.motor == motor.name and bool(error.supported),
                    f"the refusal of {asked} does not say what there is instead: {error}",
                )
                continue
            value = 0.05 * (long_move(bench) if variable is ControlVariable.POSITION else 1.0)
            if mode is ControlMode.SETPOINT:
                motor.set_setpoint(value)
            else:
                motor.set_trajectory(TrapezoidalTrajectory(value, duration_s=1.0))
            motor.start()
            finish(bench, motor, 1.0)
            motor.stop()
            finish(bench, motor)


@clause(
    "LIM-04",
    Level.L2,
    needs={Capability.POSITION_SET_POINT},
    source="errors: UsageError is the caller's mistake, and nothing was sent",
)
def nonsense_is_refused(bench: RigProtocol) -> None:
    """What is no command is refused as the caller's mistake, and neither moves nor breaks it."""
    motor, way = bench.motor, 0.2 * long_move(bench)
    before = place(bench, motor)
    motor.set_control_mode(ControlMode.SETPOINT)
    nonsense: list[Callable[[], object]] = [
        motor.start,
        *(lambda value=value: motor.set_setpoint(value) for value in _NO_NUMBERS),
        lambda: motor.set_trajectory(TrapezoidalTrajectory(way)),
        lambda: motor.wait_until_done(-1.0),
        lambda: motor.home(1000),
    ]
    for number, command in enumerate(nonsense):
        try:
            command()
        except UsageError:
            continue
        raise Violated(f"nonsense number {number + 1} was not refused")
    rest_for(bench, _LOOK_S)
    expect_unmoved(bench, motor, before, "after nothing but nonsense")
    aim(motor, way)
    finish(bench, motor, shortest_s(motor, way))
    expect_at(bench, motor, way, "after nonsense")


_NO_NUMBERS = (float("nan"), float("inf"), float("-inf"))
