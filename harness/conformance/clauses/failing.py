"""L2 and L5: faults are reported, prevent motion, and are reset."""

from collections.abc import Callable

from harness.conformance.bench import RigProtocol
from harness.conformance.capability import Ability, Capability
from harness.conformance.clause import Level, Violated, clause, expect
from harness.conformance.modes import ending, expect_usable, modes_of, until_rest_s
from harness.conformance.motions import (
    expect_at,
    expect_rest,
    expect_unmoved,
    finish,
    follow,
    long_move,
    place,
    reached,
    rest_for,
    shortest_s,
)
from motorapi import ControlMode, DeviceFault, Motor, MotorState, TrapezoidalTrajectory

_NOTICED_S = 0.3


def _raised(what: str, operation: Callable[[], object]) -> DeviceFault:
    try:
        operation()
    except DeviceFault as error:
        return error
    raise Violated(f"{what} did not raise DeviceFault")


def _expect_told(motor: Motor, code: int) -> None:
    state, fault = motor.state(), motor.fault()
    expect(state is MotorState.FAULT, f"drive fault: state is {state.value}; expected fault")
    expect(fault is not None, "drive fault: fault() returned None")
    expect(fault is None or fault.code == code, f"drive fault {code:04X}h: fault() is {fault}")


@clause(
    "FAULT-01",
    Level.L2,
    needs={Capability.FAULTS, Capability.POSITION_TRAJECTORY},
    bench={Ability.FAULT},
    source="Motor.wait_until_done: DeviceFault, the drive has a fault; CiA 402-2, FAULT",
)
def a_fault_in_mid_motion_ends_the_wait(bench: RigProtocol) -> None:
    """During a motion, a fault ends the wait with its error code and becomes the state."""
    motor, way = bench.motor, 2.0 * long_move(bench)
    motor.enable()
    begin = place(bench, motor)
    follow(motor, TrapezoidalTrajectory(way))
    rest_for(bench, 0.4 * shortest_s(motor, way))
    reached(abs(place(bench, motor) - begin) > 0.05 * way, "a motion before the fault")
    code = bench.fail(motor)
    failed_ns = bench.runtime.now_ns()
    error = _raised("the wait", lambda: finish(bench, motor, shortest_s(motor, way)))
    expect(
        (error.motor, error.code) == (motor.name, code),
        f"the wait raised fault {error.code:04X}h of {error.motor}; expected {code:04X}h",
    )
    late_s = (bench.runtime.now_ns() - failed_ns) / 1e9
    expect(
        late_s <= _NOTICED_S + bench.facts.time_tolerance_s,
        f"the wait ended {late_s:.3f} s after the fault",
    )
    _expect_told(motor, code)
    _raised("the second wait", lambda: finish(bench, motor))


@clause(
    "FAULT-02",
    Level.L2,
    needs={Capability.FAULTS, Capability.POSITION_TRAJECTORY},
    bench={Ability.FAULT},
    source="Motor.start: DeviceFault, reset_fault() first; CiA 402-2, FAULT",
)
def nothing_moves_with_a_fault(bench: RigProtocol) -> None:
    """Until reset_fault(), a motor with a fault cannot be started or enabled."""
    motor = bench.motor
    motor.enable()
    bench.fail(motor)
    rest_for(bench, _NOTICED_S)
    before = place(bench, motor)
    motor.set_control_mode(ControlMode.TRAJECTORY)
    motor.set_trajectory(TrapezoidalTrajectory(0.3 * long_move(bench)))
    _raised("start()", motor.start)
    _raised("enable()", motor.enable)
    rest_for(bench, 0.5)
    expect_unmoved(bench, motor, before, "started with a fault")
    state = motor.state()
    expect(state is MotorState.FAULT, f"started with a fault: state is {state.value}")


@clause(
    "FAULT-03",
    Level.L2,
    needs={Capability.FAULTS, Capability.POSITION_TRAJECTORY},
    bench={Ability.FAULT},
    source="Motor.reset_fault: the fault is gone, the power stage is off if there was one",
)
def a_fault_is_reset(bench: RigProtocol) -> None:
    """After reset_fault() the motor has no fault, is off and at rest; the next start works."""
    motor, way = bench.motor, 0.4 * long_move(bench)
    motor.enable()
    motor.reset_fault()
    state = motor.state()
    expect(state is MotorState.ENABLED, f"reset_fault() without a fault: state is {state.value}")
    for _ in range(2):
        follow(motor, TrapezoidalTrajectory(way))
        rest_for(bench, 0.5 * shortest_s(motor, way))
        bench.fail(motor)
        rest_for(bench, 1.0)
        held = place(bench, motor)
        motor.reset_fault()
        fault, state = motor.fault(), motor.state()
        expect(fault is None, f"after reset_fault(): fault() is {fault}")
        expect(state is MotorState.DISABLED, f"after reset_fault(): state is {state.value}")
        rest_for(bench, 0.3)
        expect_unmoved(bench, motor, held, "after reset_fault()")
        before = motor.position()
        follow(motor, TrapezoidalTrajectory(way))
        finish(bench, motor, shortest_s(motor, way))
        expect_at(bench, motor, before + way, "moved after reset_fault()")


@clause(
    "FAULT-04",
    Level.L2,
    needs={Capability.FAULTS, Capability.POSITION_TRAJECTORY},
    bench={Ability.FAULT},
    source="ReadableMotor.fault: what the drive says is wrong; Motor.enable: DeviceFault",
)
def a_fault_between_two_motions_is_not_swallowed(bench: RigProtocol) -> None:
    """At rest, a fault is reported with its error code to the next caller."""
    motor, way = bench.motor, 0.2 * long_move(bench)
    follow(motor, TrapezoidalTrajectory(way))
    finish(bench, motor, shortest_s(motor, way))
    code = bench.fail(motor)
    rest_for(bench, _NOTICED_S)
    _expect_told(motor, code)
    motor.reset_fault()
    motor.start()
    finish(bench, motor, shortest_s(motor, way))
    expect_rest(bench, motor, "moved after a fault")


@clause(
    "FAULT-05",
    Level.L5,
    needs={Capability.FAULTS},
    bench={Ability.TRUTH, Ability.FAULT, Ability.AFRESH},
    source="CiA 402-2, fault reaction; Motor.wait_until_done, DeviceFault",
)
def a_fault_ends_a_motion_in_every_mode(bench: RigProtocol) -> None:
    """In every mode, a fault is reported with its code; the motor stops, and is usable again."""
    for mode in modes_of(bench):
        motor = bench.motor
        code = bench.fail(motor)
        within_s = bench.facts.lost_s + bench.facts.time_tolerance_s
        if mode.moves:
            error = ending(bench, motor, mode, within_s)
            expect(
                isinstance(error, DeviceFault) and error.code == code,
                f"{mode.words}: fault {code:X}h, but the wait raised {error!r}",
            )
        rest_for(bench, until_rest_s(bench, motor))
        expect_rest(bench, motor, f"{mode.words}, after a drive fault")
        state = motor.state()
        expect(state is MotorState.FAULT, f"{mode.words}: state after the fault is {state.value}")
        expect_usable(bench, motor, f"{mode.words}, after a fault")
