"""L2: commands beyond a limit or capability are refused before any motion."""

from collections.abc import Callable, Mapping
from contextlib import suppress
from functools import partial
from itertools import product
from math import inf, sqrt
from typing import TYPE_CHECKING, Any

from motorhil.harness.conformance.bench import Ability, RigProtocol
from motorhil.harness.conformance.clause import Level, NotApplicable, Violated, clause, expect
from motorhil.harness.conformance.clauses.helpers import (
    aim,
    cubic_step,
    elapsed_s,
    expect_at,
    expect_moved,
    expect_outside,
    expect_raises,
    expect_unmoved,
    failure_of,
    finish,
    follow,
    long_move,
    position_of,
    rest_for,
    shortest_s,
    smooth_move,
)
from motorhil.harness.rig.config.conformance import Capability
from motorhil.harness.rig.config.toml import RigError
from motorhil.motorapi import (
    ComplexTrajectory,
    ControlMode,
    ControlVariable,
    DerivativeLimits,
    LimitError,
    Motor,
    PeerError,
    TrapezoidalTrajectory,
    UnsupportedError,
    UsageError,
)

if TYPE_CHECKING:
    from motorhil.motorapi.functions import Function

_WATCHED_S = 0.2
_BLIP_S = 0.002
_FAR = 12.0  # long moves
_SAME = 1e-3  # of the distance: positions before a move are measured
_OBJECTS = "objects"
_SLOWER = 0.5
_NEAR, _WITHIN = 0.3, 20.0  # long moves
_JUST_WITHIN = 1.0 - 1e-6  # of the end of a range
_OUT_OF_REACH = 1e9  # long moves: it would take years
_NOT_FINITE = (float("nan"), float("inf"), float("-inf"))


def _expect_refused(
    bench: RigProtocol, motor: Motor, what: str, command: Callable[[], None], *, quantity: str
) -> None:
    """Check that the command raises a complete LimitError, and that the motor does not move."""
    before = position_of(bench, motor)
    try:
        command()
    except LimitError as error:
        facts = (error.motor, quantity in error.quantity, (error.low, error.high) != (None, None))
        is_told = any(f"{error.value:.{digits}g}" in f"{error}" for digits in range(6, 18))
        expect(
            facts == (motor.name, True, True) and is_told,
            f"{what}: the error lacks motor, {quantity}, value or limit: {error}",
        )
        expect_outside(error)
        expect_unit(error, motor)
    else:
        raise Violated(f"{what} was not refused")
    rest_for(bench, _WATCHED_S)
    expect_unmoved(bench, motor, before, f"{what} was refused")


def expect_unit(error: LimitError, motor: Motor) -> None:
    """Check that this error is in the unit of its quantity, for this motor's model."""
    model, quantity = motor.model, error.quantity
    units = {
        "change of velocity": f"{model.unit}/s²",
        "acceleration": f"{model.unit}/s²",
        "velocity": f"{model.unit}/s",
        "jerk": f"{model.unit}/s³",
        "position": model.unit,
        "distance": model.unit,
        "duration": "s",
        "current": "A",
    }
    unit = next((unit for name, unit in units.items() if name in quantity), error.unit)
    expect(error.unit == unit, f"{quantity} in {error.unit}, not in {unit}: {error}")


def _expect_of_target(error: LimitError, motor: Motor, before: float, way: float) -> None:
    """Check that an error about a target is about this one, in units of the motor's model."""
    if "position" not in error.quantity and "distance" not in error.quantity:
        return
    unit = motor.model.unit
    off = min(abs(error.value - before - way), abs(error.value - way))
    expect(
        error.motor == motor.name and error.unit == unit and off <= _SAME * abs(way),
        f"a move from {before:g} by {way:g} {unit} of {motor.name} was refused as: {error};"
        f" expected the motor, and its target in {unit}",
    )
    here = 0.0 if "distance" in error.quantity else before
    little = _SAME * max(1.0, abs(here))
    low = -inf if error.low is None else error.low
    high = inf if error.high is None else error.high
    expect(low - little <= here <= high + little, f"no move at all is outside of it, too: {error}")


@clause(
    "LIM-01",
    Level.L2,
    needs={Capability.POSITION_SET_POINT, Capability.POSITION_TRAJECTORY},
    source="paper 3.2, limits on position; 3.3.1, derivative limits: ranges of the value",
)
def position_limit_is_kept_in_every_mode(bench: RigProtocol) -> None:
    """In every mode, targets beyond a position limit are refused; the limit itself is reached."""
    motor, limit = bench.motor, 0.3 * long_move(bench)
    expected_s = shortest_s(motor, 2.0 * limit)
    origin = motor.position()
    limits = DerivativeLimits(value=(origin - limit, origin + limit))
    little = max(1e-6 * limit, 4e-9 * abs(origin))  # beyond the rounding that is allowed
    for sign in (1.0, -1.0):
        on, beyond = origin + sign * limit, origin + sign * (limit + little)
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
            _expect_refused(bench, motor, f"{what} beyond {on:g}", command, quantity="position")
        to_setpoint(on - sign * little)
        finish(bench, motor, expected_s)
        to_setpoint(on)
        finish(bench, motor, expected_s)
        expect_at(bench, motor, on, f"on its limit of {on:g}")
        follow(motor, TrapezoidalTrajectory(-0.5 * sign * limit, limits=limits))
        finish(bench, motor, expected_s)


@clause(
    "LIM-02",
    Level.L2,
    source="paper 3.2, limits on velocity and acceleration are the model's, and constant",
)
def command_beyond_model_limit_is_expect_refused(bench: RigProtocol) -> None:
    """In every supported mode, settings that exceed the model's limits are refused."""
    motor, model = bench.motor, bench.motor.model
    tops = {
        ControlVariable.VELOCITY: model.velocity_max,
        ControlVariable.TORQUE: model.torque_max,
        ControlVariable.CURRENT: model.current_max,
    }
    found = 0
    for variable, top in tops.items():
        for mode in ControlMode:
            if top is None or not _set_mode(motor, mode, variable):
                continue
            found += 1
            for value in (1.001 * top, -1.001 * top):
                what = f"a {mode.value} of {variable.value} of {value:g}"
                _expect_refused(
                    bench, motor, what, partial(_start_value, motor, value), quantity=variable.value
                )
    if not _set_mode(motor, ControlMode.TRAJECTORY, ControlVariable.POSITION):
        expect(found > 0, "no mode of this motor has a limit to test")
        return
    way = 0.2 * long_move(bench)
    for quantity, limits in (
        ("velocity", DerivativeLimits(first=1.001 * model.velocity_max)),
        ("acceleration", DerivativeLimits(second=1.001 * _largest_ramp(motor))),
    ):
        trajectory = TrapezoidalTrajectory(way, limits=limits)
        what = f"a limit of {quantity} above the model's"
        _expect_refused(
            bench, motor, what, partial(motor.set_trajectory, trajectory), quantity=quantity
        )
    short_s = 0.9 * shortest_s(motor, way)
    hasty = TrapezoidalTrajectory(way, duration_s=short_s)
    what = f"a duration of {short_s:g} s"
    _expect_refused(bench, motor, what, lambda: motor.set_trajectory(hasty), quantity="duration")


def _largest_ramp(motor: Motor) -> float:
    return max(motor.model.acceleration_max, motor.model.deceleration)


def _set_mode(motor: Motor, mode: ControlMode, variable: ControlVariable) -> bool:
    """Set this control mode; return whether the motor supports it."""
    try:
        motor.set_control_mode(mode, variable)
    except UnsupportedError:
        return False
    return True


def _start_value(motor: Motor, value: float) -> None:
    if motor.control_mode is ControlMode.SETPOINT:
        motor.set_setpoint(value)
    else:
        motor.set_trajectory(TrapezoidalTrajectory(value, duration_s=10.0))
    motor.start()


@clause(
    "LIM-03",
    Level.L2,
    source="paper 3.3: any control variable supported by the motor; UnsupportedError",
)
def unsupported_mode_is_refused_with_list(bench: RigProtocol) -> None:
    """Every mode either works, or is refused with the list of supported modes."""
    motor = bench.motor
    untyped: Any = motor
    motor.enable()
    for variable in ControlVariable:
        for mode in ControlMode:
            asked = f"{mode.value} of {variable.value}"
            try:
                motor.set_control_mode(mode, variable)
            except UnsupportedError as error:
                expect(
                    error.motor == motor.name and bool(error.supported),
                    f"the refusal of {asked} does not list supported modes: {error}",
                )
                continue
            value = 0.05 * _usual(bench, variable)
            try:
                if mode is ControlMode.SETPOINT:
                    wrong = partial(untyped.set_setpoint, value, limits=1.0)
                    expect_raises(UsageError, wrong, f"{asked} with limits = 1.0 was accepted")
                    motor.set_setpoint(value, relative=variable is ControlVariable.POSITION)
                else:
                    motor.set_trajectory(TrapezoidalTrajectory(value, duration_s=1.0))
                motor.start()
            except UnsupportedError as error:  # this drive lacks what its kind has
                expect(error.motor == motor.name, f"the refusal of {asked} names {error.motor}")
                continue
            finish(bench, motor, 1.0)
            motor.stop()
            finish(bench, motor)
    refusal = failure_of(partial(follow, motor, smooth_move(motor, 0.1 * long_move(bench))))
    if isinstance(refusal, UnsupportedError):
        told = f"the refusal of a function lists what is not: {refusal}"
        expect("None" not in f"{refusal}".replace(motor.name, ""), told)
    elif refusal is None:
        finish(bench, motor, 1.0)


def _usual(bench: RigProtocol, variable: ControlVariable) -> float:
    """Return a value of the size that this motor is made for; 1 if its model states none."""
    model = bench.motor.model
    most = {
        ControlVariable.POSITION: long_move(bench),
        ControlVariable.VELOCITY: model.velocity_max,
        ControlVariable.TORQUE: model.torque_max,
        ControlVariable.CURRENT: model.current_max,
    }[variable]
    return 1.0 if most is None else most


@clause(
    "LIM-04",
    Level.L2,
    needs={Capability.POSITION_SET_POINT},
    source="errors: UsageError is the caller's mistake, and nothing was sent",
)
def invalid_command_is_expect_refused(bench: RigProtocol) -> None:
    """Invalid commands raise UsageError and discard the one before; the motor does not move."""
    motor, way = bench.motor, 0.2 * long_move(bench)
    origin, before = motor.position(), position_of(bench, motor)
    motor.set_control_mode(ControlMode.SETPOINT)
    nonsense: list[Callable[[], object]] = [
        motor.start,
        *(lambda value=value: motor.set_setpoint(value) for value in _NOT_FINITE),
        lambda: motor.set_trajectory(TrapezoidalTrajectory(way)),
        lambda: motor.wait_until_done(-1.0),
        lambda: motor.home(1000),
    ]
    for number, command in enumerate(nonsense):
        expect_raises(UsageError, command, f"invalid command {number + 1} was not refused")
    for value in (*_NOT_FINITE, 1e300):
        motor.set_control_mode(ControlMode.SETPOINT)
        motor.set_setpoint(origin + way)
        limits = DerivativeLimits(value=(origin - way, origin + way))
        expect_raises(
            UsageError,
            partial(motor.set_setpoint, value, limits=limits),
            f"a set-point of {value:g} was not refused",
        )
        what = f"the set-point before was started after one of {value:g} was refused"
        expect_raises(UsageError, motor.start, what)
    rest_for(bench, _WATCHED_S)
    expect_unmoved(bench, motor, before, "after invalid commands")
    aim(motor, origin + way)
    finish(bench, motor, shortest_s(motor, way))
    expect_at(bench, motor, origin + way, "after invalid commands")


@clause(
    "LIM-05",
    Level.L2,
    needs={Capability.COMPLEX_POSITION},
    source="paper 3.3.1, complex trajectories and derivative limits: at every argument",
)
def complex_trajectory_keeps_limits_everywhere(bench: RigProtocol) -> None:
    """Complex trajectories that exceed a limit anywhere, however briefly, are refused."""
    motor, model = bench.motor, bench.motor.model
    if model.jerk_max is not None:
        raise NotApplicable("the model limits the jerk: no trajectory exceeds acceleration briefly")
    gentle = min(model.acceleration_max, model.deceleration)
    top = model.velocity_max
    far, near = 3.0 * top**2 / gentle, 0.1 * top**2 / gentle
    calm_s = sqrt(12.0 * near / gentle)  # half of the acceleration
    calm = cubic_step(near, calm_s)
    motor.set_control_mode(ControlMode.TRAJECTORY)
    before = position_of(bench, motor)
    for begins in (True, False):
        started = partial(follow, motor, _not_at_rest(motor, begins=begins))
        what = f"a complex trajectory with a velocity at its {'beginning' if begins else 'end'}"
        expect_raises(UsageError, started, f"{what} was not refused")
    rest_for(bench, _WATCHED_S)
    expect_unmoved(bench, motor, before, "trajectories that begin or end in motion")
    for share in (0.99, 1.01):
        jerk = DerivativeLimits(third=12.0 * near / calm_s**3 / share)
        for quantity, function, limits in (
            ("velocity", cubic_step(far, 1.5 * far / (share * top)), None),
            ("acceleration", cubic_step(near, sqrt(6.0 * near / (share * gentle))), None),
            ("acceleration", calm + _blip(motor, calm_s, share), None),
            ("jerk", calm, jerk),
        ):
            what = f"a complex trajectory with, at one instant, {share:.0%} of a limit, {quantity},"
            trajectory = ComplexTrajectory(function, relative=True, limits=limits)
            if share < 1.0:
                motor.set_trajectory(trajectory)
            else:
                command = partial(follow, motor, trajectory)
                _expect_refused(bench, motor, what, command, quantity=quantity)


def _not_at_rest(motor: Motor, *, begins: bool) -> ComplexTrajectory:
    """Return a parabola within the limits that begins, or ends, with a velocity."""
    from motorhil.motorapi.functions import Polynomial

    gentle = 0.4 * min(motor.model.acceleration_max, motor.model.deceleration)
    time_s = 0.5 * motor.model.velocity_max / gentle
    linear = gentle * time_s if begins else 0.0
    curve = -0.5 * gentle if begins else 0.5 * gentle
    return ComplexTrajectory(
        Polynomial((0.0, linear, curve)).restricted(0.0, time_s), relative=True
    )


def _blip(motor: Motor, time_s: float, share: float) -> "Function":
    """Return a function that is 0 but for a hump of 2 ms, with this share of an acceleration.

    The hump h 16 s² (1 - s)² over a time T has 32 h/T² at its ends and half of that, the other way,
    in between. So its ends have the smaller limit.
    """
    from motorhil.motorapi.functions import Piecewise

    model = motor.model
    up, down = model.acceleration_max, model.deceleration
    lean = 0.5 * share * (up if up < down else -down)  # 16 h/T²
    begin_s, end_s = 0.5003 * time_s, 0.5003 * time_s + _BLIP_S
    hump = (0.0, 0.0, lean, -2.0 * lean / _BLIP_S, lean / _BLIP_S**2)
    return Piecewise.of_polynomials((0.0, begin_s, end_s, time_s), ((0.0,), hump, (0.0,)))


@clause(
    "LIM-06",
    Level.L2,
    needs={Capability.POSITION_TRAJECTORY},
    source="CiA 402-2, 607Dh: software position limit; LimitError: the drive would clip",
)
def far_target_is_refused_or_reached(bench: RigProtocol) -> None:
    """Whatever limits a drive itself has, a far target is refused or reached, never in part."""
    motor, way = bench.motor, long_move(bench)
    for share in (_FAR, -_FAR, _OUT_OF_REACH, -_OUT_OF_REACH, 1.0):
        before = motor.position()
        target = share * way
        try:
            follow(motor, TrapezoidalTrajectory(target))
        except (UsageError, PeerError) as error:  # in advance, or by the drive
            if isinstance(error, LimitError):
                expect_at(
                    bench, motor, before, f"a move of {target:g} {motor.model.unit} was refused"
                )
                expect_outside(error)
                expect_unit(error, motor)
                _expect_of_target(error, motor, before, target)
                _expect_end_is_taken(bench, motor, error, before + target)
                continue
            expect_at(bench, motor, before, f"a move of {target:g} {motor.model.unit} was refused")
            continue
        if abs(share) == _OUT_OF_REACH:
            motor.stop()
            finish(bench, motor)
            continue
        finish(bench, motor, shortest_s(motor, target))
        expect_at(bench, motor, before + target, f"a move of {target:g} {motor.model.unit}")


def _expect_end_is_taken(
    bench: RigProtocol, motor: Motor, error: LimitError, target: float
) -> None:
    """Expect that the drive does not refuse the end of the range that an error allows."""
    limit = error.high if error.value > 0.0 else error.low
    if error.quantity != "position" or not limit:
        return
    end = _JUST_WITHIN * target * limit / error.value
    refused = failure_of(partial(follow, motor, TrapezoidalTrajectory(end - motor.position())))
    is_right = refused is None or isinstance(refused, UsageError)
    expect(is_right, f"{error}; but {end:g} {motor.model.unit} is refused with {refused!r}")
    motor.stop()
    finish(bench, motor)


@clause(
    "LIM-08",
    Level.L2,
    source="paper 3.3.1, boundary conditions: derivatives at both ends; UnsupportedError",
)
def derivatives_at_ends_of_ramps_are_refused(bench: RigProtocol) -> None:
    """Derivatives at the ends of a ramp of velocity, torque or current are refused by value."""
    motor = bench.motor
    found = False
    for variable in ControlVariable:
        if variable is ControlVariable.POSITION:
            continue
        if not _set_mode(motor, ControlMode.TRAJECTORY, variable):
            continue
        found = True
        unit, value = motor.model.unit_of(variable), 0.05 * _usual(bench, variable)
        rate, curve = (f"{unit}/s", f"{unit}/s²")
        if unit.endswith("/s"):
            rate, curve = f"{unit}²", f"{unit}³"
        for end, (derivatives, text) in product(
            ("initial", "final"),
            (((0.125,), f"0.125 {rate}"), ((0.0, 0.25), f"0.25 {curve}")),
        ):
            stated: dict[str, Any] = {f"{end}_derivatives": derivatives}
            ramp = TrapezoidalTrajectory(value, duration_s=1.0, **stated)
            what = f"a ramp of {variable.value} with {end} derivatives of {derivatives}"
            error = _error_of(partial(motor.set_trajectory, ramp))
            expect(
                isinstance(error, UnsupportedError) and text in f"{error}",
                f"{what}: {error}; expected UnsupportedError with {text}",
            )
        zeros = TrapezoidalTrajectory(
            value, duration_s=1.0, initial_derivatives=(0.0, 0.0), final_derivatives=(0.0,)
        )
        motor.set_trajectory(zeros)
    if not found:
        raise NotApplicable("the motor has no trajectories but those of position")


def _error_of(operation: Callable[[], object]) -> Exception | None:
    """Return the UsageError that ends this operation, or None."""
    try:
        operation()
    except UsageError as error:
        return error
    return None


@clause(
    "LIM-09",
    Level.L2,
    needs={Capability.POSITION_TRAJECTORY},
    bench={Ability.TRUTH, Ability.SETTINGS},
    source="CiA 402-2, 607Fh, 60C5h, 60C6h; LimitError: the drive would clip",
)
def limits_of_the_drive_are_known(bench: RigProtocol) -> None:
    """With lower limits in a CiA 402 drive itself, a fast move is refused, or is as fast."""
    stated, model = bench.stated(of_drive=True), bench.motor.model
    if stated is None or _OBJECTS not in stated.declaration.keys:
        raise NotApplicable("the drive has no objects of CiA 402")
    if model.velocity_unit is None or model.acceleration_unit is None:
        raise NotApplicable("the motor's model does not state the drive's units")
    before = stated.values.get(_OBJECTS)
    known = before if isinstance(before, Mapping) else {}
    for name, most in (
        ("607Fh", model.velocity_max / model.velocity_unit),
        ("60C5h", model.acceleration_max / model.acceleration_unit),
        ("60C6h", model.deceleration / model.acceleration_unit),
    ):
        limited = {_OBJECTS: {**known, name: max(1, round(_SLOWER * most))}}
        with suppress(RigError), bench.altered({}, limited):  # it may lack the object
            _expect_refused_or_fast(bench, f"with {name} at {_SLOWER:g} of the model's limit")
    if model.increments_per_unit is not None:
        reach = abs(bench.motor.position()) + _NEAR * long_move(bench)
        most = round(reach * abs(model.increments_per_unit))
        limited = {_OBJECTS: {**known, "607Dh:1": -most, "607Dh:2": most}}
        with suppress(RigError), bench.altered({}, limited):
            _expect_ends_reached(bench, 2.0 * reach)


def _expect_ends_reached(bench: RigProtocol, beyond: float) -> None:
    """Check that the limits of a drive are reached, which the refusals of targets beyond name."""
    motor = bench.motor
    for target in (beyond, -beyond):
        error = failure_of(partial(aim, motor, target))
        if not isinstance(error, LimitError) or error.low is None or error.high is None:
            return
        end = error.high if target > 0.0 else error.low
        way = end - motor.position()
        if abs(way) > _WITHIN * long_move(bench):
            continue
        aim(motor, end)
        finish(bench, motor, shortest_s(motor, way))
        expect_at(bench, motor, end, f"at {end:g}, the limit of the drive")


def _expect_refused_or_fast(bench: RigProtocol, what: str) -> None:
    """Check that the fastest move, both ways, is refused, or takes its shortest time."""
    motor, way = bench.motor, long_move(bench)
    motor.enable()
    for one in (way, -way):
        before, least_s = position_of(bench, motor), shortest_s(motor, one)
        begun_ns = bench.runtime.now_ns()
        try:
            follow(motor, TrapezoidalTrajectory(one))
        except (UsageError, PeerError):
            expect_unmoved(bench, motor, before, f"{what}: a move was refused")
            continue
        finish(bench, motor, 2.0 * least_s)
        took_s = elapsed_s(bench, begun_ns)
        expect_moved(bench, motor, before, one, what)
        expect(
            took_s <= least_s + bench.facts.time_tolerance_s,
            f"{what}: a move took {took_s:.3f} s, that was accepted as one of {least_s:.3f} s",
        )
