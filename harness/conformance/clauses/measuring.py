"""L0: measured values are right in sign and size."""

from harness.conformance.bench import RigProtocol
from harness.conformance.capability import Ability, Capability
from harness.conformance.clause import Level, NotApplicable, clause, expect
from harness.conformance.motions import (
    finish,
    follow,
    least_s,
    rest_for,
    torque_of,
)
from motorapi import DerivativeLimits, TrapezoidalTrajectory

_VELOCITY_SHARE = 0.05
_TORQUE_SHARE = 0.1
_LOOK_S = 0.01
_LOOKS = 10


@clause(
    "MEAS-01",
    Level.L0,
    needs={Capability.POSITION_TRAJECTORY},
    bench={Ability.TRUTH},
    source="ReadableMotor.velocity: measured velocity [U/s]; paper 3.2",
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
    source="ReadableMotor.torque: measured torque [N·m], or force [N]; paper 3.2",
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
    source="ReadableMotor.following_error: demand minus actual position [U]",
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
