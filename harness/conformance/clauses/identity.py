"""L0: the motor is the one that its model describes, and counts as it does."""

from harness.conformance.bench import RigProtocol
from harness.conformance.capability import Ability, Capability
from harness.conformance.clause import Level, clause, expect
from harness.conformance.motions import long_move
from motorapi import ControlMode, MotorState, TrapezoidalTrajectory


@clause(
    "UNIT-01",
    Level.L0,
    needs={Capability.POSITION_TRAJECTORY},
    bench={Ability.TRUTH},
    source="paper 3.2, the motor model; 3.1, the adaptation maps logical to physical operations",
)
def it_moves_as_far_and_to_the_side_that_its_model_says(bench: RigProtocol) -> None:
    """A move of so many units is one of so many units at the motor's output, in sign and size."""
    motor = bench.motor
    before = bench.true_position(motor)
    way = 0.25 * long_move(bench)
    motor.set_control_mode(ControlMode.TRAJECTORY)
    motor.set_trajectory(TrapezoidalTrajectory(way))
    motor.start()
    motor.wait_until_done()
    moved = bench.true_position(motor) - before
    unit = motor.model.unit
    expect(
        abs(moved - way) <= bench.facts.window,
        f"told to move {way:g} {unit}, it moved {moved:g} {unit},"
        f" which is more than {bench.facts.window:g} {unit} off",
    )


@clause(
    "STATE-01",
    Level.L0,
    source="paper 3.1, the base class; CiA 402-2, PDS FSA",
)
def enabling_and_disabling_are_told(bench: RigProtocol) -> None:
    """A motor is enabled after enable(), and is not after disable()."""
    motor = bench.motor
    motor.enable()
    expect(motor.state() is MotorState.ENABLED, f"after enable() it is {motor.state().value}")
    motor.disable()
    expect(motor.state() is not MotorState.ENABLED, "after disable() it is still enabled")
