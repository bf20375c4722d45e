"""L0: motors match their models, and report their identity and state.

L0: measured values are right in sign and size.
"""

from motorhil.harness.conformance.bench import RigProtocol
from motorhil.harness.conformance.clause import (
    Ability,
    Capability,
    Level,
    NotApplicable,
    clause,
    expect,
)
from motorhil.harness.conformance.clauses.helpers import (
    expect_unmoved,
    finish,
    follow,
    least_s,
    long_move,
    place,
    reached,
    rest_for,
    shortest_s,
    torque_of,
)
from motorhil.motorapi import DerivativeLimits, Motor, MotorState, TrapezoidalTrajectory

_HOLDS = 0.3  # of the largest torque


@clause(
    "UNIT-01",
    Level.L0,
    needs={Capability.POSITION_TRAJECTORY},
    bench={Ability.TRUTH},
    source="paper 3.2, the motor model; 3.1, the adaptation maps logical to physical operations",
)
def it_moves_as_far_and_to_the_side_that_its_model_says(bench: RigProtocol) -> None:
    """Each motor moves, and reports, the commanded distance in its model's units and direction."""
    for motor in bench.motors:
        for share in (0.25, -0.4):
            _move_and_compare(bench, motor, share * long_move(bench))


def _move_and_compare(bench: RigProtocol, motor: Motor, way: float) -> None:
    before, told = bench.true_position(motor), motor.position()
    follow(motor, TrapezoidalTrajectory(way))
    finish(bench, motor, shortest_s(motor, way))
    unit, window = motor.model.unit, bench.facts.window
    for what, moved in (
        ("moved", bench.true_position(motor) - before),
        ("reported", motor.position() - told),
    ):
        expect(
            abs(moved - way) <= window,
            f"{motor.name}: commanded {way:g} {unit}, {what} {moved:g} {unit};"
            f" window {window:g} {unit}",
        )


@clause(
    "ID-01",
    Level.L0,
    needs={Capability.POSITION_TRAJECTORY},
    bench={Ability.TRUTH, Ability.SECOND_MOTOR},
    source="paper 3.5, no more than one physical motor object for any motor in the system",
)
def it_moves_and_no_other_does(bench: RigProtocol) -> None:
    """Only the commanded motor moves."""
    way = 0.25 * long_move(bench)
    for motor in bench.motors:
        before = [bench.true_position(one) for one in bench.motors]
        follow(motor, TrapezoidalTrajectory(way))
        finish(bench, motor, shortest_s(motor, way))
        for one, was in zip(bench.motors, before, strict=True):
            if one is motor:
                moved = abs(bench.true_position(one) - was)
                reached(moved > 0.5 * abs(way), f"a move of {motor.name}")
            else:
                expect_unmoved(bench, one, was, f"{one.name}, during a move of {motor.name}")


@clause(
    "ID-02",
    Level.L0,
    needs={Capability.POSITION_TRAJECTORY},
    source="requirement 1; Motor.latest: nothing is sent, so callbacks may call it",
)
def what_it_is_and_was_heard_of_it_is_told_at_once(bench: RigProtocol) -> None:
    """Name, text and last known state are returned at once, also in callbacks, and agree."""
    names = [motor.name for motor in bench.motors]
    expect(len(set(names)) == len(names), f"two motors have one name: {', '.join(names)}")
    motor = bench.motor
    expect(motor.name in repr(motor), f"repr() is {motor!r}; expected the name {motor.name} in it")
    heard = []
    timer = bench.runtime.every(0.02, lambda: heard.append((motor.latest(), repr(motor))))
    way = 0.25 * long_move(bench)
    follow(motor, TrapezoidalTrajectory(way))
    finish(bench, motor, shortest_s(motor, way))
    timer.cancel()
    reached(len(heard) > 3, "a call of latest() during the motion")
    told, before_ns = motor.position(), bench.runtime.now_ns()
    latest = motor.latest()
    took_s = (bench.runtime.now_ns() - before_ns) / 1e9
    most_s = bench.facts.time_tolerance_s  # a wall clock advances by itself
    expect(took_s <= most_s, f"latest() took {took_s:g} s; limit {most_s:g} s")
    if latest is None:
        return
    expect(latest.time_ns <= before_ns, "latest() has a time in the future")
    where, state = latest.position, motor.state()
    expect(latest.state is state, f"latest() has {latest.state.value}, state() is {state.value}")
    expect(
        where is None or abs(where - told) <= bench.facts.window,
        f"latest() has position {where}, position() is {told:g} {motor.model.unit}",
    )


@clause(
    "STATE-01",
    Level.L0,
    source="paper 3.1, the base class; CiA 402-2, PDS FSA",
)
def enabling_and_disabling_are_told(bench: RigProtocol) -> None:
    """After enable() the motor is enabled, and after disable() disabled, also when repeated."""
    motor = bench.motor
    before = motor.state()
    expect(before is not MotorState.ENABLED, "state is enabled before the first enable()")
    for _ in range(2):
        motor.enable()
        state = motor.state()
        expect(state is MotorState.ENABLED, f"after enable(): state is {state.value}")
    for _ in range(2):
        motor.disable()
        state = motor.state()
        expect(state is MotorState.DISABLED, f"after disable(): state is {state.value}")


@clause(
    "STATE-02",
    Level.L0,
    bench={Ability.TRUTH, Ability.LOAD},
    source="Motor.enable: the power stage is on and the motor holds its position; Motor.disable",
)
def an_enabled_motor_holds_and_a_disabled_one_gives_way(bench: RigProtocol) -> None:
    """When enabled, the motor holds its position against a load; when disabled, it gives way."""
    motor = bench.motor
    before = place(bench, motor)
    motor.enable()
    rest_for(bench, 0.2)
    expect_unmoved(bench, motor, before, "when enabled")
    bench.load(motor, torque_of(motor, _HOLDS))
    rest_for(bench, 1.0)
    expect_unmoved(bench, motor, before, f"enabled, with a load of {_HOLDS:.0%} of its torque")
    motor.disable()
    rest_for(bench, 0.5)
    moved = abs(place(bench, motor) - before)
    expect(
        moved > 10.0 * bench.facts.window,
        f"disabled, the motor still holds {_HOLDS:.0%} of its torque: the power stage is on",
    )


_VELOCITY_SHARE = 0.05
_TORQUE_SHARE = 0.1
_LOOK_S = 0.01
_LOOKS = 10


@clause(
    "MEAS-01",
    Level.L0,
    needs={Capability.POSITION_TRAJECTORY},
    bench={Ability.TRUTH},
    source="Motor.velocity: measured velocity [U/s]; paper 3.2",
)
def velocity_is_how_fast_its_position_changes(bench: RigProtocol) -> None:
    """Measured velocity is the velocity of the output, in sign and size."""
    motor, model = bench.motor, bench.motor.model
    for share in (0.5, -0.25):
        asked = share * model.velocity_max
        ramps = 0.5 * asked * abs(asked) * (1 / model.acceleration_max + 1 / model.deceleration)
        way = 1.5 * asked * _LOOKS * 0.1 + ramps
        limits = DerivativeLimits(first=abs(asked))
        duration_s = least_s(way, abs(asked), model.acceleration_max, model.deceleration)
        follow(motor, TrapezoidalTrajectory(way, limits=limits))
        rest_for(bench, abs(asked) / model.acceleration_max + 0.1)
        begun_ns, before = bench.runtime.now_ns(), bench.true_position(motor)
        told = []
        for _ in range(_LOOKS):
            told.append(motor.velocity())
            rest_for(bench, _LOOK_S)
        since_s = (bench.runtime.now_ns() - begun_ns) / 1e9
        true = (bench.true_position(motor) - before) / since_s
        mean = sum(told) / len(told)
        expect(
            abs(mean - true) <= _VELOCITY_SHARE * abs(asked),
            f"velocity: measured {mean:g} {model.unit}/s at {true:g} {model.unit}/s",
        )
        finish(bench, motor, duration_s)


@clause(
    "MEAS-02",
    Level.L0,
    needs={Capability.MEASURED_TORQUE},
    bench={Ability.LOAD},
    source="Motor.torque: measured torque [N·m], or force [N]; paper 3.2",
)
def torque_is_what_it_holds(bench: RigProtocol) -> None:
    """Measured torque is the torque that holds the load, in sign and size."""
    motor = bench.motor
    motor.enable()
    most = torque_of(motor, 1.0)
    told = []
    for share in (0.4, -0.3):
        bench.load(motor, share * most)
        rest_for(bench, 1.0)
        told.append(motor.torque())
    found, wanted = told[0] - told[1], 0.7 * most  # friction may hold a part of each load
    expect(
        abs(found - wanted) <= _TORQUE_SHARE * most,
        f"torque: loads differ by {wanted:g} N·m, measured values by {found:g} N·m,"
        f" {told[0]:g} and {told[1]:g} N·m",
    )


@clause(
    "MEAS-03",
    Level.L0,
    needs={Capability.MEASURED_FOLLOWING_ERROR},
    bench={Ability.LOAD, Ability.TRUTH},
    source="Motor.following_error: demand minus actual position [U]",
)
def following_error_is_what_is_left_of_the_way(bench: RigProtocol) -> None:
    """Following error is the distance from demand to actual position, in sign and size."""
    motor, unit = bench.motor, bench.motor.model.unit
    motor.enable()
    rest_for(bench, 0.2)
    held = bench.true_position(motor)
    bench.load(motor, torque_of(motor, 0.5))
    off, told = 0.0, 0.0
    for _ in range(60):
        told = max(told, motor.following_error(), key=abs)
        off = max(off, held - bench.true_position(motor), key=abs)
        rest_for(bench, 0.002)
    if abs(off) < 10.0 * (motor.model.resolution or 0.0) or off == 0.0:
        raise NotApplicable(f"the load moves the motor by {off:.3g} {unit}, too little to measure")
    expect(
        0.5 <= told / off <= 2.0,
        f"following error: {told:.4g} {unit} reported at a distance of {off:.4g} {unit}",
    )
