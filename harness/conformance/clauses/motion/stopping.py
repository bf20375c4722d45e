"""L2: stops of every kind, from every motion."""

from collections.abc import Callable, Sequence
from functools import partial
from math import copysign
from typing import Final

from motorhil.harness.conformance.bench import Ability, RigProtocol
from motorhil.harness.conformance.clause import Level, clause, expect
from motorhil.harness.conformance.clauses.demands import jerk_of, least_s, ramp_s
from motorhil.harness.conformance.clauses.helpers import (
    aim,
    begin_move,
    braking_distance,
    coast,
    expect_at,
    expect_raises,
    expect_rest,
    expect_state,
    expect_unmoved,
    fastest,
    finish,
    follow,
    long_move,
    midway_s,
    move,
    move_exactly,
    position_of,
    quiet_settings,
    reached,
    rest_for,
    sample_positions,
    shortest_s,
    smooth_move,
    speed,
    turn,
)
from motorhil.harness.rig.config.conformance import Capability
from motorhil.motorapi import (
    ControlMode,
    DerivativeLimits,
    MotionInterrupted,
    Motor,
    MotorState,
    StateError,
    TrapezoidalTrajectory,
    UnsupportedError,
)

_EXAMPLES: Final = 6
_COAST_S: Final = 30.0
_JITTER_S: Final = 0.002
_SPARE: Final = 0.15  # of a move
_AFTER_S: Final = 0.3
_LOOK_S: Final = 0.02
_GENTLE: Final = 0.2  # of the limits


@clause(
    "STOP-12",
    Level.L2,
    needs={Capability.POSITION_SET_POINT, Capability.POSITION_TRAJECTORY},
    bench={Ability.TRUTH},
    source="Motor.stop: at the deceleration of the motion; Motor.disable: the motor coasts",
)
def stop_at_rest_moves_nothing(bench: RigProtocol) -> None:
    """A stop at rest moves nothing, also of a motor that was switched off in its last motion."""
    motor, way, window = bench.motor, long_move(bench), bench.facts.window
    for sign in (1.0, -1.0):
        begin_move(bench, motor, sign * way, 0.5 * shortest_s(motor, way))
        motor.disable()
        coast(bench, motor)
        held = bench.true_position(motor)
        motor.enable()
        aim(motor, 0.0, relative=True)
        motor.stop()
        finish(bench, motor)
        moved = abs(bench.true_position(motor) - held)
        expect(
            moved <= 2.0 * window,
            "switched off in a motion, enabled at rest, and stopped in a set-point of 0: it moved"
            f" by {moved:g} {motor.model.unit}",
        )


def _stop_halfway(
    bench: RigProtocol, stop: Callable[[Motor], None], name: str
) -> tuple[float, float]:
    """Stop a motion half-way, check the stop, and return the start and end positions."""
    motor, way = bench.motor, 1.5 * long_move(bench)
    begin = begin_move(bench, motor, way, 0.4 * shortest_s(motor, way))
    stopped_at = position_of(bench, motor)
    reached(abs(stopped_at - begin) > 0.1 * way, "a motion before the stop")
    stop(motor)
    braking_s = motor.model.velocity_max / motor.model.deceleration
    finish(bench, motor, braking_s)
    expect_rest(bench, motor, f"{name} was reported done")
    found = position_of(bench, motor)
    made, room, unit = found - stopped_at, _room(motor, way), motor.model.unit
    expect(
        -_SPARE * way <= made <= room,
        f"{name}, {stopped_at - begin:.4g} {unit} into a move of {way:g} {unit}, ended"
        f" {made:.4g} {unit} from there; expected at most {room:.3g} {unit}",
    )
    fault = motor.fault()
    expect(fault is None, f"{name} left a fault: {fault}")
    return begin, found


def _room(motor: Motor, way: float) -> float:
    """Return the largest distance of a motor from where it is stopped in a move by `way` [U]."""
    return braking_distance(motor, motor.model.velocity_max) + _SPARE * abs(way)


@clause(
    "STOP-01",
    Level.L2,
    needs={Capability.POSITION_TRAJECTORY},
    source="Motor.stop: slows down, and the motion is over; CiA 402-2, halt",
)
def stop_ends_at_rest_short_of_target(bench: RigProtocol) -> None:
    """During a motion, a stop ends at rest, short of the target, enabled; the next start works."""
    _, found = _stop_halfway(bench, Motor.stop, "stop()")
    _expect_next_move(bench, found, "stop()")


def _expect_next_move(bench: RigProtocol, found: float, name: str) -> None:
    motor, way = bench.motor, 0.2 * long_move(bench)
    expect_state(motor, MotorState.ENABLED, f"after {name}")
    rest_for(bench, 0.3)
    expect_unmoved(bench, motor, found, f"after {name}")
    move_exactly(bench, motor, way, f"moved {way:g} after {name}")


@clause(
    "STOP-02",
    Level.L2,
    needs={Capability.POSITION_TRAJECTORY},
    source="Motor.halt; CiA 402-2, controlword bit 8 (halt)",
)
def halt_ends_at_rest_until_next_start(bench: RigProtocol) -> None:
    """During a motion, a halt ends at rest, short of the target; the next start lifts it."""
    _, found = _stop_halfway(bench, Motor.halt, "halt()")
    _expect_next_move(bench, found, "halt()")


@clause(
    "STOP-03",
    Level.L2,
    needs={Capability.POSITION_TRAJECTORY},
    source="Motor.quick_stop: moves again only after enable(); CiA 402-2, 605Ah",
)
def quick_stop_holds_until_enable(bench: RigProtocol) -> None:
    """After a quick stop, the motor is at rest, short of the target, until the next enable()."""
    motor = bench.motor
    _stop_halfway(bench, Motor.quick_stop, "quick_stop()")
    expect_state(motor, MotorState.STOPPED, "after quick_stop()")
    before = position_of(bench, motor)
    motor.set_trajectory(TrapezoidalTrajectory(0.2 * long_move(bench)))
    expect_raises(
        StateError, motor.start, "start() after quick_stop() was accepted without enable()"
    )
    rest_for(bench, 0.3)
    expect_unmoved(bench, motor, before, "start() refused after quick_stop()")
    motor.enable()
    rest_for(bench, 0.3)
    expect_unmoved(bench, motor, before, "enabled after quick_stop()")
    _expect_next_move(bench, before, "quick_stop() and enable()")


@clause(
    "STOP-04",
    Level.L2,
    needs={Capability.POSITION_TRAJECTORY},
    bench={Ability.TRUTH},
    source="MotorHooks._stop: slows down at the motion's deceleration; paper 3.2, the model",
)
def stop_uses_deceleration_of_motion(bench: RigProtocol) -> None:
    """On a stop, the braking distance is that of the motion's deceleration."""
    motor, model = bench.motor, bench.motor.model
    motor.enable()
    velocity = model.velocity_max
    rise_s = ramp_s(velocity, model.acceleration_max, jerk_of(motor))
    way = 2.0 * velocity * rise_s + velocity
    for _ in range(2):
        follow(motor, TrapezoidalTrajectory(way))
        rest_for(bench, 1.5 * rise_s)
        stopped_at = bench.true_position(motor)
        motor.stop()
        samples = sample_positions(bench, motor, 2.0 * velocity / model.deceleration)
        finish(bench, motor)
        made = samples[-1][1] - stopped_at
        wanted = braking_distance(motor, velocity)
        late = velocity * (bench.facts.latency_s[1] + 0.02)
        expect(
            0.8 * wanted <= made <= 1.2 * wanted + late,
            f"stopped from {velocity:g} {model.unit}/s in {made:.4g} {model.unit};"
            f" expected {wanted:.4g} {model.unit} at {model.deceleration:g} {model.unit}/s²",
        )
    _expect_own_ramp(bench, way)


def _expect_own_ramp(bench: RigProtocol, way: float) -> None:
    """Check that a stop of a stream does not brake as gently as the motion before it."""
    motor, model = bench.motor, bench.motor.model
    gentle = _GENTLE * min(model.acceleration_max, model.deceleration)
    limits = DerivativeLimits(first=_GENTLE * model.velocity_max, second=gentle)
    back = -0.5 * way
    follow(motor, TrapezoidalTrajectory(back, limits=limits))
    finish(bench, motor, least_s(back, _GENTLE * model.velocity_max, gentle, gentle))
    try:
        stream = smooth_move(motor, 0.5 * way)
        follow(motor, stream)
    except UnsupportedError:
        return
    rest_for(bench, 0.5 * stream.function.domain[1])
    velocity, stopped_at = speed(bench, motor, _LOOK_S), bench.true_position(motor)
    motor.stop()
    finish(bench, motor, velocity / gentle)
    made = bench.true_position(motor) - stopped_at
    late = velocity * (bench.facts.latency_s[1] + _LOOK_S)
    # A set-point that misses its drive cycle makes the next one a fifth faster: 1.2 squared.
    most = 1.5 * braking_distance(motor, velocity) + late
    expect(
        made <= most,
        f"stopped from {velocity:g} {model.unit}/s in {made:.4g} {model.unit}, after a motion that"
        f" brakes at {gentle:g} {model.unit}/s²; expected at most {most:.4g} {model.unit}",
    )


@clause(
    "STOP-05",
    Level.L2,
    needs={Capability.VELOCITY_SET_POINT},
    source="Motor.stop; paper 3.3, Figure 4: every control variable",
)
def stop_ends_velocity_setpoint(bench: RigProtocol) -> None:
    """During a velocity set-point, a stop, halt or quick stop ends at rest."""
    motor = bench.motor
    rise_s = motor.model.velocity_max / motor.model.acceleration_max
    for stop, sign in ((Motor.stop, 1.0), (Motor.halt, -1.0), (Motor.quick_stop, 1.0)):
        turn(motor, 0.4 * sign * motor.model.velocity_max)
        finish(bench, motor, 2.0 * rise_s)
        stop(motor)
        finish(bench, motor, rise_s)
        expect_rest(bench, motor, f"after {stop.__name__}() of a velocity set-point")
        held = position_of(bench, motor)
        rest_for(bench, 0.3)
        expect_unmoved(bench, motor, held, f"after {stop.__name__}() of a velocity set-point")
        motor.enable()


@clause(
    "STOP-06",
    Level.L2,
    needs={Capability.POSITION_TRAJECTORY},
    source="Motor.stop needs no ownership; wait_until_done returns at once",
)
def stop_at_rest_is_done_at_once(bench: RigProtocol) -> None:
    """If the motor is at rest, off or stopped, a stop is done at once; the next move works."""
    motor, way = bench.motor, 0.2 * long_move(bench)
    begin = motor.position()
    for stop in (Motor.quick_stop, Motor.halt, Motor.stop):  # not even enabled
        stop(motor)
        finish(bench, motor)
    motor.enable()
    for stop in (Motor.stop, Motor.halt, Motor.stop):
        stop(motor)
        taken_s = finish(bench, motor)
        expect(
            taken_s <= 0.2 + bench.facts.time_tolerance_s,
            f"{stop.__name__}() of a motor at rest took {taken_s:.3f} s",
        )
        expect_at(bench, motor, begin, f"stopped at rest by {stop.__name__}()")
        move(bench, motor, way)
        begin += way
        expect_at(bench, motor, begin, f"moved {way:g} after {stop.__name__}()")
    long_way = 1.5 * long_move(bench)
    begin_move(bench, motor, long_way, midway_s(motor, long_way, 0.3))
    motor.stop()
    rest_for(bench, 0.05)
    motor.stop()
    finish(bench, motor)
    expect_rest(bench, motor, "stopped twice during a motion")
    stopped = motor.position()
    rest_for(bench, shortest_s(motor, long_way))
    expect_at(bench, motor, stopped, "stopped twice during a motion")
    made = abs(stopped - begin)
    expect(made < 0.9 * long_way, "stopped twice during a motion, but moved to the target")


@clause(
    "STOP-07",
    Level.L2,
    needs={Capability.POSITION_SET_POINT},
    bench={Ability.AFRESH},
    source="requirement 1; Motor.start, Motor.stop: the last command counts",
)
def last_command_of_any_sequence_counts(bench: RigProtocol) -> None:
    """After any sequence of settings, starts and stops, the last command is carried out."""
    from hypothesis import example, given, seed
    from hypothesis import strategies as st

    way = 0.5 * long_move(bench)
    step = st.tuples(
        st.sampled_from(("go", "go", "stop", "halt", "off", "set")),
        st.sampled_from((0.0, 0.03, 0.15, 0.4)),
        st.floats(-way, way),
    )

    @seed(bench.seed)
    @quiet_settings(_EXAMPLES)
    @given(st.lists(step, min_size=2, max_size=5))
    @example([("go", 0.15, way), ("stop", 0.0, 0.0), ("go", 0.03, way)])
    def run_steps(steps: Sequence[tuple[str, float, float]]) -> None:
        bench.afresh()
        _command(bench, steps, shortest_s(bench.motor, 2.0 * way))

    run_steps()


def _command(
    bench: RigProtocol, steps: Sequence[tuple[str, float, float]], longest_s: float
) -> None:
    motor = bench.motor
    done, origin = "", motor.position()
    for what, pause_s, target in steps:
        done += f" {what} {target:.3g}, {pause_s:g} s;" if what in ("go", "set") else f" {what};"
        if what == "go":
            aim(motor, origin + target)
        elif what == "set":
            motor.set_control_mode(ControlMode.SETPOINT)
            motor.set_setpoint(origin + target)
        else:
            {"stop": Motor.stop, "halt": Motor.halt, "off": Motor.disable}[what](motor)
            if what != "off":
                finish(bench, motor, longest_s)
                expect_rest(bench, motor, f"after{done}")
        rest_for(bench, pause_s)
    last = steps[-1][2]
    aim(motor, origin + last)
    finish(bench, motor, longest_s)
    expect_at(bench, motor, origin + last, f"after{done} go {last:.3g}")


@clause(
    "STOP-08",
    Level.L2,
    needs={Capability.POSITION_TRAJECTORY},
    bench={Ability.TRUTH},
    source="Motor.disable: the motion is over, a moving motor coasts; Motor.enable: not moved",
)
def disable_ends_motion(bench: RigProtocol) -> None:
    """After disable() the motion is over: when enabled again, the motor stays at its position."""
    motor, way = bench.motor, 2.0 * long_move(bench)
    begin = begin_move(bench, motor, way, 0.3 * shortest_s(motor, way))
    motor.disable()
    expect_state(motor, MotorState.DISABLED, "after disable() during a motion")
    expect_raises(
        MotionInterrupted,
        partial(finish, bench, motor),
        "after disable() during a motion, done was reported",
    )
    for _ in range(100):
        if fastest(sample_positions(bench, motor, 0.1), 0.08) < 1e-3 * motor.model.velocity_max:
            break
    held = position_of(bench, motor)
    reached(held - begin > 0.05 * way, "a motion before disable()")
    expect(
        abs(held - begin - way) > 0.01 * way,
        f"after disable(), the motor still made its way of {way:g} {motor.model.unit}",
    )
    motor.enable()
    rest_for(bench, 0.5)
    expect_unmoved(bench, motor, held, "enabled again after disable() during a motion")
    move_exactly(bench, motor, 0.1 * way, "moved after disable() and enable()")


@clause(
    "STOP-09",
    Level.L2,
    needs={Capability.VELOCITY_SET_POINT},
    source="Motor.stop: wait_until_done waits for rest; paper 3.3.3: blocks until it finished",
)
def stop_without_power_is_done_at_rest(bench: RigProtocol) -> None:
    """A stop of a motor that coasts without power is done when it is at rest, and not before."""
    motor = bench.motor
    for share in (0.6, -0.6):
        turn(motor, share * motor.model.velocity_max)
        finish(bench, motor, 2.0 * motor.model.velocity_max / motor.model.acceleration_max)
        motor.disable()
        motor.stop()
        finish(bench, motor, _COAST_S)
        expect_rest(bench, motor, "stop() after disable() was reported done")
        expect_state(motor, MotorState.DISABLED, "after disable() and stop()")


@clause(
    "STOP-10",
    Level.L2,
    needs={Capability.POSITION_TRAJECTORY},
    source="Motor.stop: it may be called from a callback, as may quick_stop and halt",
)
def stop_in_callback_works(bench: RigProtocol) -> None:
    """Stops of every kind work in a callback, too: they end at rest, short of the target."""
    motor, way = bench.motor, 2.0 * long_move(bench)
    motor.enable()
    for stop in (Motor.stop, Motor.halt, Motor.quick_stop):
        begin = position_of(bench, motor)
        follow(motor, TrapezoidalTrajectory(way))
        errors = _in_callback(bench, midway_s(motor, way, 0.3), partial(stop, motor))
        rest_for(bench, midway_s(motor, way, 0.35))
        what = f"{stop.__name__}() in a callback"
        expect(not errors, f"{what} raised {', '.join(errors)}; expected no error")
        finish(bench, motor, motor.model.velocity_max / motor.model.deceleration)
        expect_rest(bench, motor, what)
        made, unit = abs(position_of(bench, motor) - begin), motor.model.unit
        expect(
            0.02 * way < made < 0.9 * way,
            f"{what}: moved {made:g} {unit} of {way:g} {unit}; expected a part of it",
        )
        motor.enable()
        move_exactly(bench, motor, -0.1 * way, f"moved after {what}")


def _in_callback(
    bench: RigProtocol, after_s: float, operation: Callable[[], object]
) -> Sequence[str]:
    """Call the operation once in a callback, after this time; return its errors, in words."""
    errors: list[str] = []

    def call() -> None:
        timer.cancel()
        try:
            operation()
        except Exception as error:  # the runtime would not say which call failed
            errors.append(repr(error))

    timer = bench.runtime.every(after_s, call)
    return errors


@clause(
    "STOP-11",
    Level.L2,
    needs={Capability.POSITION_TRAJECTORY},
    bench={Ability.TRUTH},
    source="Motor.stop: slows down and ends the motion; Motor.start: the commanded motion alone",
)
def path_after_stop_forgets_old_target(bench: RigProtocol) -> None:
    """After a stop, the motor neither turns round nor creeps on; the next start begins there."""
    motor, way = bench.motor, 2.0 * long_move(bench)
    motor.enable()
    for name, begin in (
        ("a trajectory", _follow),
        ("a replaced set-point", _aim_twice),
        ("a complex trajectory", _stream),
    ):
        for stop in (Motor.stop, Motor.halt, Motor.quick_stop):
            try:
                begin(motor, way)
            except UnsupportedError:
                continue
            rest_for(bench, midway_s(motor, way, 0.3))
            stop(motor)
            _expect_short_path(bench, motor, way, f"{stop.__name__}() of {name}")
            way = -way


def _expect_short_path(bench: RigProtocol, motor: Motor, way: float, what: str) -> None:
    """Check the path of a motor that was just stopped, and that of its next move, back."""
    braking_s = motor.model.velocity_max / motor.model.deceleration
    samples = sample_positions(bench, motor, braking_s + _AFTER_S)
    finish(bench, motor)
    turned = _reach(samples, way) - samples[-1][1] * copysign(1.0, way)
    window, unit = bench.facts.window, motor.model.unit
    made, room = abs(samples[-1][1] - samples[0][1]), _room(motor, way)
    expect(made <= room, f"{what}: moved on by {made:.4g} {unit}; expected at most {room:.4g}")
    # It may turn above the place where it is held, and settle below. A host that makes this place
    # from measurements does not know when, to the millisecond, they were made.
    most = 2.0 * window + motor.model.velocity_max * _JITTER_S
    expect(
        turned <= most,
        f"{what}: the motor turned round, by {turned:.5g} {unit}; expected at most {most:g}",
    )
    held = bench.true_position(motor)
    motor.enable()
    rest_for(bench, _AFTER_S)
    expect_unmoved(bench, motor, held, f"enabled after {what}")
    back = -0.1 * way
    follow(motor, TrapezoidalTrajectory(back))
    samples = sample_positions(bench, motor, shortest_s(motor, back))
    finish(bench, motor)
    forth = _reach(samples, way) - held * copysign(1.0, way)
    expect(
        forth <= window,
        f"moved by {back:g} {unit} after {what}: it first went {forth:.5g} {unit} towards the old"
        f" target; expected at most {window:g}",
    )


def _reach(samples: Sequence[tuple[float, float]], way: float) -> float:
    """Return the farthest position in the direction of `way`, counted in that direction [U]."""
    return max(at * copysign(1.0, way) for _, at in samples)


def _follow(motor: Motor, way: float) -> None:
    follow(motor, TrapezoidalTrajectory(way))


def _stream(motor: Motor, way: float) -> None:
    follow(motor, smooth_move(motor, way))


def _aim_twice(motor: Motor, way: float) -> None:
    aim(motor, -0.5 * way, relative=True)
    aim(motor, way, relative=True)
