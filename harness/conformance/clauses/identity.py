"""L0: motors match their models; identity, state and measured values are right."""

from motorhil.harness.conformance.bench import Ability, RigProtocol
from motorhil.harness.conformance.clause import Level, NotApplicable, clause, expect
from motorhil.harness.conformance.clauses.helpers import (
    elapsed_s,
    expect_state,
    expect_unmoved,
    finish,
    follow,
    least_s,
    long_move,
    move,
    position_of,
    reached,
    rest_for,
    torque_of,
)
from motorhil.harness.rig.config.conformance import Capability
from motorhil.motorapi import (
    ControlVariable,
    DerivativeLimits,
    Motor,
    MotorState,
    TrapezoidalTrajectory,
)

_HOLDS = 0.3  # of the largest torque
_VELOCITY_SHARE = 0.05
_TORQUE_SHARE = 0.1
_SAMPLE_S = 0.01
_SAMPLES = 10


@clause(
    "UNIT-01",
    Level.L0,
    needs={Capability.POSITION_TRAJECTORY},
    bench={Ability.TRUTH},
    source="paper 3.2, the motor model; 3.1, the adaptation maps logical to physical operations",
)
def motor_moves_commanded_distance(bench: RigProtocol) -> None:
    """Each motor moves, and reports, the commanded distance in its model's units and direction."""
    for motor in bench.motors:
        for share in (0.25, -0.4):
            _move_and_compare(bench, motor, share * long_move(bench))


def _move_and_compare(bench: RigProtocol, motor: Motor, way: float) -> None:
    before, reported = bench.true_position(motor), motor.position()
    move(bench, motor, way)
    unit, window = motor.model.unit, bench.facts.window
    for what, moved in (
        ("moved", bench.true_position(motor) - before),
        ("reported", motor.position() - reported),
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
def only_commanded_motor_moves(bench: RigProtocol) -> None:
    """Only the commanded motor moves."""
    way = 0.25 * long_move(bench)
    for motor in bench.motors:
        before = [bench.true_position(one) for one in bench.motors]
        move(bench, motor, way)
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
def latest_state_is_returned_at_once(bench: RigProtocol) -> None:
    """Name, text and last known state are returned at once, also in callbacks, and agree."""
    names = [motor.name for motor in bench.motors]
    expect(len(set(names)) == len(names), f"two motors have one name: {', '.join(names)}")
    motor = bench.motor
    expect(motor.name in repr(motor), f"repr() is {motor!r}; expected the name {motor.name} in it")
    seen = []
    timer = bench.runtime.every(0.02, lambda: seen.append((motor.latest(), repr(motor))))
    way = 0.25 * long_move(bench)
    move(bench, motor, way)
    timer.cancel()
    reached(len(seen) > 3, "a call of latest() during the motion")
    position, before_ns = motor.position(), bench.runtime.now_ns()
    latest = motor.latest()
    took_s = elapsed_s(bench, before_ns)
    most_s = bench.facts.time_tolerance_s  # a wall clock advances by itself
    expect(took_s <= most_s, f"latest() took {took_s:g} s; limit {most_s:g} s")
    if latest is None:
        return
    expect(latest.time_ns <= before_ns, "latest() has a time in the future")
    expect_state(motor, latest.state, "compared with latest()")
    expect(
        latest.position is None or abs(latest.position - position) <= bench.facts.window,
        f"latest() has position {latest.position}, position() is {position:g} {motor.model.unit}",
    )


@clause(
    "STATE-01",
    Level.L0,
    source="paper 3.1, the base class; CiA 402-2, PDS FSA",
)
def enable_and_disable_set_state(bench: RigProtocol) -> None:
    """After enable() the motor is enabled, and after disable() disabled, also when repeated."""
    motor = bench.motor
    before = motor.state()
    expect(before is not MotorState.ENABLED, "state is enabled before the first enable()")
    for _ in range(2):
        motor.enable()
        expect_state(motor, MotorState.ENABLED, "after enable()")
    for _ in range(2):
        motor.disable()
        expect_state(motor, MotorState.DISABLED, "after disable()")


@clause(
    "STATE-02",
    Level.L0,
    bench={Ability.TRUTH, Ability.LOAD},
    source="Motor.enable: the power stage is on and the motor holds its position; Motor.disable",
)
def enabled_holds_load_and_disabled_gives_way(bench: RigProtocol) -> None:
    """When enabled, the motor holds its position against a load; when disabled, it gives way."""
    motor = bench.motor
    before = position_of(bench, motor)
    motor.enable()
    rest_for(bench, 0.2)
    expect_unmoved(bench, motor, before, "when enabled")
    bench.load(motor, torque_of(motor, _HOLDS))
    rest_for(bench, 1.0)
    expect_unmoved(bench, motor, before, f"enabled, with a load of {_HOLDS:.0%} of its torque")
    motor.disable()
    rest_for(bench, 0.5)
    moved = abs(position_of(bench, motor) - before)
    expect(
        moved > 10.0 * bench.facts.window,
        f"disabled, the motor still holds {_HOLDS:.0%} of its torque: the power stage is on",
    )


@clause(
    "MEAS-01",
    Level.L0,
    needs={Capability.POSITION_TRAJECTORY},
    bench={Ability.TRUTH},
    source="Motor.velocity: measured velocity [U/s]; paper 3.2",
)
def measured_velocity_is_true_velocity(bench: RigProtocol) -> None:
    """Measured velocity is the velocity of the output, in sign and size."""
    motor, model = bench.motor, bench.motor.model
    for share in (0.5, -0.25):
        asked = share * model.velocity_max
        ramps = 0.5 * asked * abs(asked) * (1 / model.acceleration_max + 1 / model.deceleration)
        way = 1.5 * asked * _SAMPLES * 0.1 + ramps
        limits = DerivativeLimits(first=abs(asked))
        duration_s = least_s(way, abs(asked), model.acceleration_max, model.deceleration)
        follow(motor, TrapezoidalTrajectory(way, limits=limits))
        rest_for(bench, abs(asked) / model.acceleration_max + 0.1)
        begun_ns, before = bench.runtime.now_ns(), bench.true_position(motor)
        measured = []
        for _ in range(_SAMPLES):
            measured.append(motor.velocity())
            rest_for(bench, _SAMPLE_S)
        since_s = elapsed_s(bench, begun_ns)
        true = (bench.true_position(motor) - before) / since_s
        mean = sum(measured) / len(measured)
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
def measured_torque_holds_load(bench: RigProtocol) -> None:
    """Measured torque is the torque that holds the load, in sign and size."""
    motor = bench.motor
    motor.enable()
    most = torque_of(motor, 1.0)
    measured = []
    for share in (0.4, -0.3):
        from_both_sides = []  # friction holds a part of the load, once with and once against it
        for aside in (0.3, -0.3):
            bench.load(motor, (share + aside) * most)
            rest_for(bench, 1.0)
            bench.load(motor, share * most)
            rest_for(bench, 1.0)
            from_both_sides.append(motor.torque())
        measured.append(sum(from_both_sides) / 2.0)
    unit = motor.model.unit_of(ControlVariable.TORQUE)
    found, wanted = measured[0] - measured[1], 0.7 * most
    expect(
        abs(found - wanted) <= _TORQUE_SHARE * most,
        f"torque: loads differ by {wanted:g} {unit}, measured values by {found:g} {unit},"
        f" {measured[0]:g} and {measured[1]:g} {unit}",
    )


@clause(
    "MEAS-03",
    Level.L0,
    needs={Capability.MEASURED_FOLLOWING_ERROR},
    bench={Ability.LOAD, Ability.TRUTH},
    source="Motor.following_error: demand minus actual position [U]",
)
def following_error_is_demand_minus_actual(bench: RigProtocol) -> None:
    """Following error is the distance from demand to actual position, in sign and size."""
    motor, unit = bench.motor, bench.motor.model.unit
    motor.enable()
    rest_for(bench, 0.2)
    held, held_truly = motor.position(), bench.true_position(motor)
    bench.load(motor, torque_of(motor, 0.5))
    off, off_truly, reported = 0.0, 0.0, 0.0
    for _ in range(60):
        reported = max(reported, motor.following_error(), key=abs)
        off = max(off, held - motor.position(), key=abs)  # at the encoder: the gear may yield
        off_truly = max(off_truly, held_truly - bench.true_position(motor), key=abs)
        rest_for(bench, 0.002)
    if abs(off) < 10.0 * (motor.model.resolution or 0.0) or off == 0.0:
        raise NotApplicable(f"the load moves the motor by {off:.3g} {unit}, too little to measure")
    expect(
        0.5 <= reported / off <= 2.0 and off * off_truly > 0.0,
        f"following error: {reported:.4g} {unit} reported at a distance of {off:.4g} {unit};"
        f" the true distance is {off_truly:.4g} {unit}",
    )
