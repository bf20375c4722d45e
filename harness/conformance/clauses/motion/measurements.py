"""L0: measured position, velocity, torque and following error are those of the motor."""

from motorhil.harness.conformance.bench import Ability, RigProtocol
from motorhil.harness.conformance.clause import Level, NotApplicable, clause, expect
from motorhil.harness.conformance.clauses.demands import jerk_of, least_s, ramp_s
from motorhil.harness.conformance.clauses.helpers import (
    elapsed_s,
    expect_moved,
    expect_unmoved,
    finish,
    follow,
    long_move,
    move_exactly,
    rest_for,
    shortest_s,
    torque_of,
)
from motorhil.harness.conformance.clauses.tracks import PositionWatch
from motorhil.harness.rig.config.conformance import Capability
from motorhil.motorapi import ControlVariable, DerivativeLimits, Motor, TrapezoidalTrajectory

_VELOCITY_SHARE = 0.05
_TORQUE_SHARE = 0.1
_SAMPLE_S = 0.01
_SAMPLES = 10
_SETTLED_S = 0.2
_PUSH = 0.2  # of the largest torque
_READINGS = 40


@clause(
    "MEAS-01",
    Level.L0,
    needs={Capability.POSITION_TRAJECTORY},
    bench={Ability.TRUTH},
    source="Motor.velocity: measured velocity [U/s]; paper 3.2",
)
def measured_velocity_is_true_velocity(bench: RigProtocol) -> None:
    """Measured velocity is the velocity of the output, in sign and size, also at rest."""
    for share in (0.5, -0.25):
        asked = share * bench.motor.model.velocity_max
        expect_true_velocity(bench, asked)
        at_rest = bench.motor.velocity()
        unit = bench.motor.model.unit
        expect(
            abs(at_rest) <= _VELOCITY_SHARE * abs(asked),
            f"velocity: measured {at_rest:g} {unit}/s at rest, {_SETTLED_S:g} s after a motion at"
            f" {asked:g} {unit}/s; expected 0",
        )


def expect_true_velocity(bench: RigProtocol, asked: float) -> None:
    """Move at this velocity [U/s]; check the measured one against the true one; settle."""
    motor, model = bench.motor, bench.motor.model
    ramps = model.acceleration_max, model.deceleration
    up_s, down_s = (ramp_s(abs(asked), one, jerk_of(motor)) for one in ramps)
    way = 1.5 * asked * _SAMPLES * 0.1 + 0.5 * asked * (up_s + down_s)
    limits = DerivativeLimits(first=abs(asked))
    duration_s = least_s(way, abs(asked), *ramps, jerk_of(motor))
    follow(motor, TrapezoidalTrajectory(way, limits=limits))
    rest_for(bench, up_s + 0.1)
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
    rest_for(bench, _SETTLED_S)


@clause(
    "MEAS-02",
    Level.L0,
    needs={Capability.MEASURED_TORQUE},
    bench={Ability.LOAD},
    source="Motor.torque: measured torque [N·m], or force [N]; paper 3.2",
)
def measured_torque_holds_load(bench: RigProtocol) -> None:
    """Measured torque is the torque that holds the load, in sign and size."""
    bench.motor.enable()
    expect_true_torque(bench, 1.0)


def expect_true_torque(bench: RigProtocol, settle_s: float) -> None:
    """Load the enabled motor, which then settles; check the measured torque against the load."""
    motor = bench.motor
    most = torque_of(motor, 1.0)
    measured = []
    for share in (0.4, -0.3):
        from_both_sides = []  # friction holds a part of the load, once with and once against it
        for aside in (0.3, -0.3):
            bench.load(motor, (share + aside) * most)
            rest_for(bench, settle_s)
            bench.load(motor, share * most)
            rest_for(bench, settle_s)
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
    found, true = 0.0, 0.0
    for torque in (torque_of(motor, 0.5), torque_of(motor, -0.5)):
        rest_for(bench, _SETTLED_S)
        held, held_truly = motor.position(), bench.true_position(motor)
        bench.load(motor, torque)
        off, off_truly, reported = 0.0, 0.0, 0.0
        for _ in range(60):
            reported = max(reported, motor.following_error(), key=abs)
            off = max(off, held - motor.position(), key=abs)  # at the encoder: the gear may yield
            off_truly = max(off_truly, held_truly - bench.true_position(motor), key=abs)
            rest_for(bench, 0.002)
        bench.load(motor, 0.0)
        if abs(off) < 10.0 * (motor.model.resolution or 0.0) or off == 0.0:
            raise NotApplicable(
                f"the load moves the motor by {off:.3g} {unit}, too little to measure"
            )
        found, true = found + abs(reported), true + abs(off)
        expect(
            reported * off > 0.0 and off * off_truly > 0.0,
            f"following error: {reported:.4g} {unit} reported at a distance of {off:.4g} {unit};"
            f" the true distance is {off_truly:.4g} {unit}, with a load of {torque:g}",
        )
    expect(
        0.5 <= found / true <= 2.0,
        f"following error: {found / 2.0:.4g} {unit} reported at distances of {true / 2.0:.4g}"
        f" {unit}, mean of both directions",
    )


@clause(
    "MEAS-04",
    Level.L0,
    needs={Capability.POSITION_TRAJECTORY},
    bench={Ability.TRUTH},
    source="Motor.position: measured position [U], fresh whenever it is read",
)
def position_in_motion_is_true(bench: RigProtocol) -> None:
    """In motion, the reported position is that of the output a moment ago, in both directions."""
    motor = bench.motor
    motor.enable()
    for way in (long_move(bench), -long_move(bench)):
        expected_s = shortest_s(motor, way)
        watch = PositionWatch(bench, motor)
        follow(motor, TrapezoidalTrajectory(way))
        for _ in range(_READINGS):
            watch.read(f"in a move by {way:g} {motor.model.unit}")
            rest_for(bench, expected_s / _READINGS)
        finish(bench, motor, expected_s)
        watch.end(0.5 * abs(way))


@clause(
    "MEAS-05",
    Level.L0,
    needs={Capability.POSITION_TRAJECTORY},
    bench={Ability.TRUTH, Ability.LOAD},
    source="Motor.position: measured position; Motor.enable: the motor holds its position",
)
def pushed_motor_reports_its_place(bench: RigProtocol) -> None:
    """A motor that was pushed while off reports its place, holds it, and moves on from there."""
    motor = bench.motor
    move_exactly(bench, motor, 0.1 * long_move(bench), "before it was pushed")
    for torque in (torque_of(motor, _PUSH), torque_of(motor, -_PUSH)):
        motor.disable()
        watch = PositionWatch(bench, motor)
        bench.load(motor, torque)
        for _ in range(10):
            rest_for(bench, 0.02)
            watch.read(f"disabled, pushed by {torque:g}")
        bench.load(motor, 0.0)
        _coast(bench, motor)
        watch.read("pushed, at rest again")
        watch.end(10.0 * bench.facts.window)
        held = bench.true_position(motor)
        motor.enable()
        rest_for(bench, _SETTLED_S)
        expect_unmoved(bench, motor, held, "enabled after it was pushed")
        way = 0.1 * long_move(bench)
        move_exactly(bench, motor, way, "moved after it was pushed")
        expect_moved(bench, motor, held, way, "moved after it was pushed", 2.0)


def _coast(bench: RigProtocol, motor: Motor) -> None:
    """Wait until the motor rests by its friction."""
    for _ in range(100):
        before = bench.true_position(motor)
        rest_for(bench, 0.1)
        if abs(bench.true_position(motor) - before) <= 0.01 * bench.facts.window:
            return
