"""L1: set-points of all control variables."""

from dataclasses import replace
from functools import partial

from motorhil.harness.conformance.bench import Ability, RigProtocol
from motorhil.harness.conformance.clause import Level, NotApplicable, clause, expect
from motorhil.harness.conformance.clauses.demands import least_s
from motorhil.harness.conformance.clauses.helpers import (
    aim,
    distance_to_top_speed,
    drive,
    expect_at,
    expect_rest,
    expect_speed,
    expect_unmoved,
    failure_of,
    fastest,
    finish,
    long_move,
    move,
    position_of,
    rest_for,
    sample_positions,
    shortest_s,
    speed,
    torque_of,
    turn,
)
from motorhil.harness.rig.config.conformance import Capability
from motorhil.motorapi import (
    ControlMode,
    ControlVariable,
    DeadlineExceeded,
    DerivativeLimits,
    LimitError,
    Motor,
    MotorState,
    UsageError,
)

_NEARLY = 0.9
_PUSH_S = 0.25
_SLOWEST = 5e-5  # of the model's velocity
_CREPT = 0.05
_CREEP_S = 6.0
_SLOW_SHARE = 5e-4  # of the model's velocity
_SLIP_S = 0.3
_PUSHED = 0.3  # of the largest torque
_WRAPPED_S = 1.0
_LIGHT = 0.1  # of the largest torque
_READINGS = 10
_READ_S = 0.01
_TORQUE_SHARE = 0.3


@clause(
    "SET-01",
    Level.L1,
    needs={Capability.POSITION_SET_POINT, Capability.POSITION_TRAJECTORY},
    source="paper, Algorithm 1, and 3.3",
)
def algorithm_1_ends_at_1_then_2(bench: RigProtocol) -> None:
    """Algorithm 1 of the paper, from a quarter, ends at 1 by its set-point and then at 2."""
    motor, one = bench.motor, 0.5 * long_move(bench)
    origin = motor.position()
    aim(motor, origin + 0.25 * one)
    finish(bench, motor, shortest_s(motor, one))
    aim(motor, origin + one)
    finish(bench, motor, shortest_s(motor, one))
    expect_at(bench, motor, origin + one, "after its set-point")
    move(bench, motor, one)
    expect_at(bench, motor, origin + 2.0 * one, "after its trajectory")


@clause(
    "SET-02",
    Level.L1,
    needs={Capability.POSITION_SET_POINT},
    source="paper 3.3, control variables; Motor.set_setpoint: relative",
)
def relative_setpoint_is_distance(bench: RigProtocol) -> None:
    """Relative set-points are distances from the held position, in both directions."""
    motor, way = bench.motor, 0.2 * long_move(bench)
    begin = motor.position()
    wanted = begin
    for share in (1.0, 1.0, -0.5, -2.0):
        aim(motor, share * way, relative=True)
        finish(bench, motor, shortest_s(motor, way))
        wanted += share * way
        expect_at(bench, motor, wanted, f"after a relative set-point of {share * way:g}")


@clause(
    "SET-03",
    Level.L1,
    needs={Capability.VELOCITY_SET_POINT},
    source="paper 3.3, Figure 4; Motor.wait_until_done: done when reached, and continues",
)
def velocity_setpoint_is_reached_and_kept(bench: RigProtocol) -> None:
    """Velocity set-points are done when reached, and keep the velocity, in both directions."""
    motor = bench.motor
    for share in (0.4, -0.3):
        asked = share * motor.model.velocity_max
        turn(motor, asked)
        finish(bench, motor, 2.0 * motor.model.velocity_max / motor.model.acceleration_max)
        for when in ("when reached", "later"):
            rest_for(bench, 0.3)
            expect_speed(bench, motor, asked, 0.3, when)
        motor.stop()
        finish(bench, motor)


@clause(
    "SET-12",
    Level.L1,
    needs={Capability.VELOCITY_SET_POINT},
    bench={Ability.TRUTH, Ability.LOAD},
    source="paper 3.3, Figure 4; Motor.set_setpoint: UsageError, the hardware cannot make it",
)
def slow_velocity_is_controlled_or_refused(bench: RigProtocol) -> None:
    """A very small velocity set-point is refused, or a load slips the motor as at a larger one."""
    motor, slips = bench.motor, []
    for share in (0.3, _SLOW_SHARE):
        asked = share * motor.model.velocity_max
        try:
            turn(motor, asked)
        except UsageError:
            return
        rest_for(bench, _SLIP_S)
        bench.load(motor, torque_of(motor, _PUSHED))
        slipped = asked - speed(bench, motor, _SLIP_S)
        bench.load(motor, 0.0)
        slips.append(abs(slipped))
        motor.stop()
        finish(bench, motor)
    usual, slow = slips
    most = 2.0 * usual + 2.0 * bench.facts.window / _SLIP_S
    expect(
        slow <= most,
        f"a velocity of {_SLOW_SHARE * motor.model.velocity_max:g} per s was accepted, but a load"
        f" of {_PUSHED:.0%} changed it by {slow:g}; expected at most {most:g}, as at a larger one",
    )


@clause(
    "SET-13",
    Level.L1,
    needs={Capability.VELOCITY_SET_POINT},
    bench={Ability.SETTINGS, Ability.TRUTH},
    source="LimitError: the drive would clip; Motor.wait_until_done: done when reached",
)
def velocity_beyond_numbers_of_drive_is_not_done(bench: RigProtocol) -> None:
    """A velocity that no number of a drive has is refused, or nothing smaller is made of it."""
    stated = bench.stated()
    model, unit = bench.motor.model, bench.motor.model.velocity_unit
    if stated is None or unit is None:
        raise NotApplicable("the settings, or the model's unit of velocity, are not known")
    asked = 2.0**32 * unit + 0.2 * model.velocity_max
    motor = bench.build(stated.values, replace(model, velocity_max=2.0 * asked))
    try:
        for velocity in (asked, -asked):
            motor.enable()
            begin = partial(turn, motor, velocity)
            error = failure_of(begin, partial(motor.wait_until_done, _WRAPPED_S))
            expect(error is not None, f"a velocity of {velocity:g} per s was reported as reached")
            if isinstance(error, DeadlineExceeded):
                made, least = speed(bench, motor, _SLIP_S), 0.5 * model.velocity_max
                is_fast = made >= least if velocity > 0.0 else made <= -least
                expect(is_fast, f"a velocity of {velocity:g} per s was accepted, and made {made:g}")
            failure_of(motor.stop, partial(finish, bench, motor))  # it may fail to follow, too
            motor.reset_fault()
    finally:
        motor.close()


@clause(
    "SET-14",
    Level.L1,
    needs={Capability.TORQUE_SET_POINT, Capability.MEASURED_TORQUE},
    source="paper 3.3, Figure 4; Motor.torque: measured torque [N·m], or force [N]",
)
def torque_set_point_is_measured(bench: RigProtocol) -> None:
    """During a torque set-point, the measured torque is that of the set-point."""
    motor, unit = bench.motor, bench.motor.model.unit_of(ControlVariable.TORQUE)
    for share in (_LIGHT, -_LIGHT):
        asked, found = torque_of(motor, share), 0.0
        drive(motor, ControlVariable.TORQUE, asked)
        for _ in range(_READINGS):
            rest_for(bench, _READ_S)
            found += motor.torque() / _READINGS
        motor.stop()
        finish(bench, motor)
        expect(
            abs(found - asked) <= _TORQUE_SHARE * abs(asked),
            f"a torque set-point of {asked:g} {unit}: {found:g} {unit} measured",
        )


@clause(
    "SET-04",
    Level.L1,
    needs={Capability.TORQUE_SET_POINT},
    bench={Ability.LOAD, Ability.TRUTH},
    source="paper 3.3, Figure 4",
)
def torque_setpoint_overcomes_smaller_load(bench: RigProtocol) -> None:
    """Torque set-points overcome a smaller load, and give way to a larger one."""
    motor = bench.motor
    motor.enable()
    for asked in (torque_of(motor, 0.5), torque_of(motor, -0.4)):
        for share in (0.6, 1.4):
            motor.set_control_mode(ControlMode.SETPOINT, ControlVariable.TORQUE)
            motor.set_setpoint(asked)
            bench.load(motor, share * asked)
            motor.start()
            finish(bench, motor)
            moved = speed(bench, motor, _PUSH_S)
            expect(
                (moved * asked > 0.0) is (share < 1.0),
                f"{asked:g} N·m against a load of {share * asked:g} N·m moved the motor"
                f" at {moved:g} {motor.model.unit}/s",
            )
            bench.load(motor, 0.0)
            motor.stop()
            finish(bench, motor)


@clause(
    "SET-10",
    Level.L1,
    needs={Capability.TORQUE_SET_POINT},
    bench={Ability.LOAD, Ability.TRUTH},
    source="paper 3.3, Figure 4; CiA 402-2, 6072h, 60E0h, 60E1h; LimitError: the drive would clip",
)
def large_torque_is_made_or_refused(bench: RigProtocol) -> None:
    """Up to the model's limit, a torque set-point is made or refused, but never made smaller."""
    motor = bench.motor
    motor.enable()
    for share in (0.8, -0.9, 1.0):
        asked = torque_of(motor, share)
        motor.set_control_mode(ControlMode.SETPOINT, ControlVariable.TORQUE)
        motor.set_setpoint(asked)
        bench.load(motor, _NEARLY * asked)
        try:
            motor.start()
        except LimitError:
            bench.load(motor, 0.0)
            continue
        finish(bench, motor)
        moved = speed(bench, motor, _PUSH_S)
        bench.load(motor, 0.0)
        motor.stop()
        finish(bench, motor)
        yielded = -moved * _PUSH_S if asked > 0.0 else moved * _PUSH_S
        expect(
            yielded <= bench.facts.window,  # friction may hold it
            f"{asked:g} N·m was accepted, but a load of {_NEARLY * asked:g} N·m moved the motor at"
            f" {moved:g} {motor.model.unit}/s",
        )


@clause(
    "SET-05",
    Level.L1,
    needs={Capability.POSITION_SET_POINT, Capability.LIMITED_SET_POINT},
    source="paper 3.3: limits on the first derivative make a velocity-bounded motion",
)
def setpoint_velocity_limit_is_kept(bench: RigProtocol) -> None:
    """Each set-point's own velocity limit is kept, even between two steps of the hardware."""
    motor, model = bench.motor, bench.motor.model
    for share in (0.5, 0.0017, 0.0023):
        limit = max(share * model.velocity_max, (1.3 + share) * (model.velocity_unit or 0.0))
        way = min(0.3 * long_move(bench), 2.0 * limit)
        aim(motor, way, relative=True, limits=DerivativeLimits(first=limit))
        samples = sample_positions(bench, motor, 1.0)
        finish(bench, motor, 2.0 * way / limit)
        over_s = 0.2 if share == 0.5 else 0.9
        found = fastest(samples, over_s)
        spare = 2.0 * (model.resolution or 0.0) / over_s + 0.03 * limit
        expect(
            found <= limit + spare,
            f"velocity {found:.6g} {model.unit}/s exceeds {limit:.6g} {model.unit}/s",
        )
        least = way / max(over_s, least_s(way, limit, model.acceleration_max, model.deceleration))
        expect(
            found > 0.3 * least, f"limited to {limit:.6g} {model.unit}/s, the motor hardly moved"
        )
    _expect_slow_or_refused(bench, _SLOWEST * model.velocity_max)
    low, high = model.position_min, model.position_max
    if abs(motor.position()) <= long_move(bench) and (low or 0.0) <= 0.0 <= (high or 0.0):
        aim(motor, 0.0)  # all numbers of the drive may be 0 there
        finish(bench, motor, shortest_s(motor, motor.position()))
        _expect_slow_or_refused(bench, _SLOWEST * model.velocity_max)


def _expect_slow_or_refused(bench: RigProtocol, limit: float) -> None:
    """Expect a limit that may be below the smallest step of the hardware to be kept, or refused."""
    motor = bench.motor
    slowly = partial(
        aim, motor, _CREPT * long_move(bench), relative=True, limits=DerivativeLimits(first=limit)
    )
    before = motor.position()
    error = failure_of(slowly)
    if error is not None:
        is_refused = isinstance(error, UsageError)
        expect(is_refused, f"limited to {limit:.6g} per s: {error}; expected a refusal")
        return
    rest_for(bench, _CREEP_S)
    went, most = abs(motor.position() - before), limit * _CREEP_S + 2.0 * bench.facts.window
    motor.stop()
    finish(bench, motor)
    expect(
        went <= most,
        f"limited to {limit:.6g} {motor.model.unit}/s, it went {went:.6g} {motor.model.unit} in"
        f" {_CREEP_S:g} s; expected at most {most:.6g} {motor.model.unit}",
    )


@clause(
    "SET-06",
    Level.L1,
    needs={Capability.POSITION_SET_POINT},
    source="paper 3.3.3, setting up is separate from enacting; 3.5, settings are cached locally",
)
def setting_has_no_effect_before_start(bench: RigProtocol) -> None:
    """Before start(), new settings do nothing: the motor does not move and is not enabled."""
    motor, way = bench.motor, 0.25 * long_move(bench)
    origin, state = motor.position(), motor.state()
    before = position_of(bench, motor)
    motor.set_control_mode(ControlMode.SETPOINT)
    motor.set_setpoint(origin + way)
    rest_for(bench, 0.3)
    expect_unmoved(bench, motor, before, "after set_setpoint()")
    found = motor.state()
    expect(
        found is state or found is not MotorState.ENABLED,
        f"set_setpoint() changed the state from {state.value} to {found.value}",
    )
    motor.start()
    finish(bench, motor, shortest_s(motor, way))
    motor.set_setpoint(origin)
    rest_for(bench, 0.3)
    expect_at(bench, motor, origin + way, "with a new set-point, not started")


@clause(
    "SET-07",
    Level.L1,
    needs={Capability.CURRENT_SET_POINT},
    bench={Ability.LOAD, Ability.TRUTH},
    source="paper 3.3, Figure 4",
)
def current_setpoint_sets_side_and_strength(bench: RigProtocol) -> None:
    """Positive current set-points push to the positive side, and a larger one pushes more."""
    motor, most = bench.motor, bench.motor.model.current_max
    expect(most is not None, "current set-points are supported, but the model has no current_max")
    made = []
    for share in (0.3, 0.6, -0.3):
        drive(motor, ControlVariable.CURRENT, share * (most or 0.0))
        finish(bench, motor)
        made.append(speed(bench, motor, _PUSH_S))
        motor.stop()
        finish(bench, motor)
    little, more, other = made
    expect(
        0.0 < little < more and other < 0.0,
        "30 %, 60 % and -30 % of the largest current moved the motor at"
        f" {little:g}, {more:g} and {other:g} {motor.model.unit}/s",
    )


@clause(
    "SET-08",
    Level.L1,
    needs={Capability.POSITION_SET_POINT},
    bench={Ability.TRUTH},
    source="paper 3.2: the model's limits of velocity; 3.3.1, never exceeds a certain range",
)
def setpoint_velocity_is_that_of_model(bench: RigProtocol) -> None:
    """Without limits of their own, set-points use the model's velocity, and do not exceed it."""
    motor, model = bench.motor, bench.motor.model
    way, least_way = 2.0 * long_move(bench), distance_to_top_speed(motor)
    if way < least_way:
        raise NotApplicable(f"top speed needs a distance of {least_way:g} {model.unit}")
    aim(motor, way, relative=True)
    samples = sample_positions(bench, motor, shortest_s(motor, way))
    finish(bench, motor)
    found = fastest(samples)
    expect(
        0.8 * model.velocity_max <= found <= 1.1 * model.velocity_max,
        f"top speed {found:g} {model.unit}/s; the model's is {model.velocity_max:g}",
    )
    expect_rest(bench, motor, "after its set-point")


@clause(
    "SET-09",
    Level.L1,
    needs={Capability.POSITION_SET_POINT},
    source="Motor.set_setpoint: relative; MotorHooks._read_reference",
)
def relative_setpoint_in_motion_counts_from_present(bench: RigProtocol) -> None:
    """A relative set-point that replaces another in motion counts from where the motor then is."""
    long = long_move(bench)
    for way in (long, -long):
        expect_counts_from_present(bench, bench.motor, way)


def expect_counts_from_present(bench: RigProtocol, motor: Motor, way: float) -> None:
    """Expect a fifth of a distance, set in the middle of it, to count from where the motor is."""
    long, begin = abs(way), position_of(bench, motor)
    aim(motor, way, relative=True)
    for _ in range(200):
        rest_for(bench, 0.01 * shortest_s(motor, long))
        before = position_of(bench, motor)
        if abs(before - begin) > 0.3 * long:
            break
    aim(motor, 0.2 * way, relative=True)
    after = position_of(bench, motor)
    finish(bench, motor, shortest_s(motor, long))
    end = position_of(bench, motor)
    low, high = sorted((before, after))
    expect(
        low - 0.1 * long <= end - 0.2 * way <= high + 0.1 * long,
        f"{0.2 * way:g} from {before:g} to {after:g}, in motion, ended at {end:g}",
    )
