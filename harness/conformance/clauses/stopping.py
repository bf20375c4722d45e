"""L2: stops of every kind, from every motion."""

from collections.abc import Callable, Sequence
from typing import Final

from motorhil.harness.conformance.bench import Ability, RigProtocol
from motorhil.harness.conformance.clause import Level, Violated, clause, expect
from motorhil.harness.conformance.clauses.helpers import (
    aim,
    expect_at,
    expect_rest,
    expect_unmoved,
    fastest,
    finish,
    follow,
    long_move,
    midway_s,
    place,
    reached,
    rest_for,
    shortest_s,
    turn,
    watched,
    way_of_stopping,
)
from motorhil.harness.rig.config.conformance import Capability
from motorhil.motorapi import (
    ControlMode,
    MotionInterrupted,
    Motor,
    MotorState,
    StateError,
    TrapezoidalTrajectory,
)

_EXAMPLES: Final = 6
_SHARE: Final = 0.5


def _stopped_half_way(
    bench: RigProtocol, stop: Callable[[Motor], None], name: str
) -> tuple[float, float]:
    """Stop a motion half-way, check the stop, and return the start and end positions."""
    motor, way = bench.motor, 1.5 * long_move(bench)
    motor.enable()
    begin = place(bench, motor)
    follow(motor, TrapezoidalTrajectory(way))
    rest_for(bench, 0.4 * shortest_s(motor, way))
    told_at = place(bench, motor)
    reached(abs(told_at - begin) > 0.1 * way, "a motion before the stop")
    stop(motor)
    braking_s = motor.model.velocity_max / motor.model.deceleration
    finish(bench, motor, braking_s)
    expect_rest(bench, motor, f"{name} was reported done")
    found = place(bench, motor)
    room = way_of_stopping(motor, motor.model.velocity_max)
    spare = 0.15 * way
    unit = motor.model.unit
    expect(
        told_at - begin - spare <= found - begin <= told_at - begin + room + spare,
        f"{name}, {told_at - begin:.4g} {unit} into a move of {way:g} {unit}, ended"
        f" at {found - begin:.4g} {unit}; the braking distance is {room:.3g} {unit}",
    )
    fault = motor.fault()
    expect(fault is None, f"{name} left a fault: {fault}")
    return begin, found


@clause(
    "STOP-01",
    Level.L2,
    needs={Capability.POSITION_TRAJECTORY},
    source="Motor.stop: slows down, and the motion is over; CiA 402-2, halt",
)
def a_stop_ends_at_rest_short_of_the_target(bench: RigProtocol) -> None:
    """During a motion, a stop ends at rest, short of the target, enabled; the next start works."""
    _, found = _stopped_half_way(bench, Motor.stop, "stop()")
    _expect_goes_on(bench, found, "stop()")


def _expect_goes_on(bench: RigProtocol, found: float, name: str) -> None:
    motor, way = bench.motor, 0.2 * long_move(bench)
    state = motor.state()
    expect(state is MotorState.ENABLED, f"after {name}: state is {state.value}")
    rest_for(bench, 0.3)
    expect_unmoved(bench, motor, found, f"after {name}")
    before = motor.position()
    follow(motor, TrapezoidalTrajectory(way))
    finish(bench, motor, shortest_s(motor, way))
    expect_at(bench, motor, before + way, f"moved {way:g} after {name}")


@clause(
    "STOP-02",
    Level.L2,
    needs={Capability.POSITION_TRAJECTORY},
    source="Motor.halt: stops as the drive's halt option says; CiA 402-2, 605Dh",
)
def a_halt_ends_at_rest_and_the_next_start_lifts_it(bench: RigProtocol) -> None:
    """During a motion, a halt ends at rest, short of the target; the next start lifts it."""
    _, found = _stopped_half_way(bench, Motor.halt, "halt()")
    _expect_goes_on(bench, found, "halt()")


@clause(
    "STOP-03",
    Level.L2,
    needs={Capability.POSITION_TRAJECTORY},
    source="Motor.quick_stop: moves again only after enable(); CiA 402-2, 605Ah",
)
def after_a_quick_stop_it_moves_only_when_enabled(bench: RigProtocol) -> None:
    """After a quick stop, the motor is at rest, short of the target, until the next enable()."""
    motor = bench.motor
    _stopped_half_way(bench, Motor.quick_stop, "quick_stop()")
    state = motor.state()
    expect(state is MotorState.STOPPED, f"after quick_stop(): state is {state.value}")
    before = place(bench, motor)
    motor.set_trajectory(TrapezoidalTrajectory(0.2 * long_move(bench)))
    try:
        motor.start()
    except StateError:
        pass
    else:
        raise Violated("start() after quick_stop() was accepted without enable()")
    rest_for(bench, 0.3)
    expect_unmoved(bench, motor, before, "start() refused after quick_stop()")
    motor.enable()
    rest_for(bench, 0.3)
    expect_unmoved(bench, motor, before, "enabled after quick_stop()")
    _expect_goes_on(bench, before, "quick_stop() and enable()")


@clause(
    "STOP-04",
    Level.L2,
    needs={Capability.POSITION_TRAJECTORY},
    bench={Ability.TRUTH},
    source="MotorHooks._stop: slows down at the motion's deceleration; paper 3.2, the model",
)
def a_stop_slows_down_as_the_model_allows(bench: RigProtocol) -> None:
    """On a stop, the braking distance is that of the motion's deceleration."""
    motor, model = bench.motor, bench.motor.model
    motor.enable()
    velocity = model.velocity_max
    ramp_s = velocity / model.acceleration_max
    way = 2.0 * velocity * ramp_s + velocity
    for _ in range(2):
        follow(motor, TrapezoidalTrajectory(way))
        rest_for(bench, 1.5 * ramp_s)
        told_at = bench.true_position(motor)
        motor.stop()
        taken = watched(bench, motor, 2.0 * velocity / model.deceleration)
        finish(bench, motor)
        made = taken[-1][1] - told_at
        wanted = way_of_stopping(motor, velocity)
        late = velocity * (bench.facts.latency_s[1] + 0.02)
        expect(
            0.8 * wanted <= made <= 1.2 * wanted + late,
            f"stopped from {velocity:g} {model.unit}/s in {made:.4g} {model.unit};"
            f" expected {wanted:.4g} {model.unit} at {model.deceleration:g} {model.unit}/s²",
        )


@clause(
    "STOP-05",
    Level.L2,
    needs={Capability.VELOCITY_SET_POINT},
    source="Motor.stop; paper 3.3, Figure 4: every control variable",
)
def a_stop_ends_a_velocity(bench: RigProtocol) -> None:
    """During a velocity set-point, a stop, halt or quick stop ends at rest."""
    motor = bench.motor
    ramp_s = motor.model.velocity_max / motor.model.acceleration_max
    for stop, sign in ((Motor.stop, 1.0), (Motor.halt, -1.0), (Motor.quick_stop, 1.0)):
        turn(motor, 0.4 * sign * motor.model.velocity_max)
        finish(bench, motor, 2.0 * ramp_s)
        stop(motor)
        finish(bench, motor, ramp_s)
        expect_rest(bench, motor, f"after {stop.__name__}() of a velocity set-point")
        held = place(bench, motor)
        rest_for(bench, 0.3)
        expect_unmoved(bench, motor, held, f"after {stop.__name__}() of a velocity set-point")
        motor.enable()


@clause(
    "STOP-06",
    Level.L2,
    needs={Capability.POSITION_TRAJECTORY},
    source="Motor.stop needs no ownership; wait_until_done returns at once",
)
def stopping_what_stands_is_right(bench: RigProtocol) -> None:
    """If the motor is at rest, off or stopped, a stop is done at once; the next move works."""
    motor, way = bench.motor, 0.2 * long_move(bench)
    begin = motor.position()
    motor.stop()  # not even enabled
    finish(bench, motor)
    motor.enable()
    for stop in (Motor.stop, Motor.halt, Motor.stop):
        stop(motor)
        begun_ns = bench.runtime.now_ns()
        finish(bench, motor)
        taken_s = (bench.runtime.now_ns() - begun_ns) / 1e9
        expect(
            taken_s <= 0.2 + bench.facts.time_tolerance_s,
            f"{stop.__name__}() of a motor at rest took {taken_s:.3f} s",
        )
        expect_at(bench, motor, begin, f"stopped at rest by {stop.__name__}()")
        follow(motor, TrapezoidalTrajectory(way))
        finish(bench, motor, shortest_s(motor, way))
        begin += way
        expect_at(bench, motor, begin, f"moved {way:g} after {stop.__name__}()")
    long_way = 1.5 * long_move(bench)
    follow(motor, TrapezoidalTrajectory(long_way))
    rest_for(bench, midway_s(motor, long_way, 0.3))
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
def any_sequence_ends_where_its_last_command_says(bench: RigProtocol) -> None:
    """After any sequence of settings, starts and stops, the last command is carried out."""
    from hypothesis import Phase, example, given, seed, settings
    from hypothesis import strategies as st

    way = 0.5 * long_move(bench)
    step = st.tuples(
        st.sampled_from(("go", "go", "stop", "halt", "off", "set")),
        st.sampled_from((0.0, 0.03, 0.15, 0.4)),
        st.floats(-way, way),
    )

    @seed(bench.seed)
    @settings(
        max_examples=_EXAMPLES,
        deadline=None,
        database=None,
        print_blob=False,
        report_multiple_bugs=False,
        phases=(Phase.explicit, Phase.generate, Phase.shrink),
    )
    @given(st.lists(step, min_size=2, max_size=5))
    @example([("go", 0.15, way), ("stop", 0.0, 0.0), ("go", 0.03, way)])
    def any_list(steps: Sequence[tuple[str, float, float]]) -> None:
        bench.afresh()
        _do(bench, steps, shortest_s(bench.motor, 2.0 * way))

    any_list()


def _do(bench: RigProtocol, steps: Sequence[tuple[str, float, float]], longest_s: float) -> None:
    motor = bench.motor
    done = ""
    for what, pause_s, target in steps:
        done += f" {what} {target:.3g}, {pause_s:g} s;" if what in ("go", "set") else f" {what};"
        if what == "go":
            aim(motor, target)
        elif what == "set":
            motor.set_control_mode(ControlMode.SETPOINT)
            motor.set_setpoint(target)
        else:
            {"stop": Motor.stop, "halt": Motor.halt, "off": Motor.disable}[what](motor)
            if what != "off":
                finish(bench, motor, longest_s)
                expect_rest(bench, motor, f"after{done}")
        rest_for(bench, pause_s)
    last = steps[-1][2]
    aim(motor, last)
    finish(bench, motor, longest_s)
    expect_at(bench, motor, last, f"after{done} go {last:.3g}")


@clause(
    "STOP-08",
    Level.L2,
    needs={Capability.POSITION_TRAJECTORY},
    bench={Ability.TRUTH},
    source="Motor.disable: the motion is over, a moving motor coasts; Motor.enable: not moved",
)
def what_was_switched_off_is_over(bench: RigProtocol) -> None:
    """After disable() the motion is over: when enabled again, the motor stays at its position."""
    motor, way = bench.motor, 2.0 * long_move(bench)
    motor.enable()
    begin = place(bench, motor)
    follow(motor, TrapezoidalTrajectory(way))
    rest_for(bench, 0.3 * shortest_s(motor, way))
    motor.disable()
    state = motor.state()
    expect(state is MotorState.DISABLED, f"after disable() during a motion: state is {state.value}")
    try:
        finish(bench, motor)
    except MotionInterrupted:
        pass
    else:
        raise Violated("after disable() during a motion, done was reported")
    for _ in range(100):
        if fastest(watched(bench, motor, 0.1), 0.08) < 1e-3 * motor.model.velocity_max:
            break
    held = place(bench, motor)
    reached(held - begin > 0.05 * way, "a motion before disable()")
    motor.enable()
    rest_for(bench, 0.5)
    expect_unmoved(bench, motor, held, "enabled again after disable() during a motion")
    before = motor.position()
    follow(motor, TrapezoidalTrajectory(0.1 * way))
    finish(bench, motor, shortest_s(motor, 0.1 * way))
    expect_at(bench, motor, before + 0.1 * way, "moved after disable() and enable()")
