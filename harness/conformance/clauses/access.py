"""L2: homing and low-level access."""

from harness.conformance.bench import RigProtocol
from harness.conformance.capability import Ability, Capability
from harness.conformance.clause import Level, Violated, clause, expect
from harness.conformance.motions import (
    expect_at,
    expect_unmoved,
    finish,
    long_move,
    move,
    place,
    rest_for,
    turn,
)
from motorapi import MotorBusyError, StateError, UnsupportedError

_HERE = 37
_NO_METHOD = 77  # reserved in CiA 402-2


@clause(
    "HOME-01",
    Level.L2,
    needs={Capability.HOMING, Capability.POSITION_TRAJECTORY},
    source="Motor.home: knows where its position 0 is, 37: here; CiA 402-2, 6098h",
)
def here_is_zero(bench: RigProtocol) -> None:
    """Homing on the spot moves nothing; the position becomes 0 and the motor is referenced."""
    motor, way = bench.motor, 0.3 * long_move(bench)
    move(bench, motor, way)
    before = place(bench, motor)
    motor.home(_HERE)
    expect(motor.is_referenced(), "homed on the spot: not referenced")
    expect_at(bench, motor, 0.0, "homed on the spot")
    if Ability.TRUTH in bench.abilities and motor.position() != place(bench, motor):
        expect_unmoved(bench, motor, before, "homed on the spot")
    move(bench, motor, -way)
    expect_at(bench, motor, -way, "moved after homing on the spot")


@clause(
    "HOME-02",
    Level.L2,
    needs={Capability.HOMING, Capability.POSITION_TRAJECTORY},
    source="Motor.home: UnsupportedError, the motor does not know the method",
)
def a_homing_it_does_not_know_is_refused(bench: RigProtocol) -> None:
    """Unknown homing methods are refused with UnsupportedError; the motor does not move."""
    motor, way = bench.motor, 0.2 * long_move(bench)
    move(bench, motor, way)
    before = place(bench, motor)
    try:
        motor.home(_NO_METHOD)
    except UnsupportedError:
        pass
    else:
        raise Violated(f"homing method {_NO_METHOD} was accepted; CiA 402 reserves it")
    rest_for(bench, 0.3)
    expect_unmoved(bench, motor, before, f"homing method {_NO_METHOD} was refused")
    move(bench, motor, way)
    expect_at(bench, motor, 2.0 * way, "moved after a homing was refused")


@clause(
    "LOW-01",
    Level.L2,
    needs={Capability.LOW_LEVEL, Capability.POSITION_TRAJECTORY},
    source="requirement 2: no other part of the interface will have any effect",
)
def low_level_access_is_alone_and_ends(bench: RigProtocol) -> None:
    """Low-level access is exclusive; when it ends, the motor works as before."""
    motor, way = bench.motor, 0.2 * long_move(bench)
    move(bench, motor, way)
    for _ in range(2):
        motor.disable()  # a servo loop on the host would have to send meanwhile
        with motor.low_level() as hardware:
            expect(hardware is not None, "low-level access: the hardware object is None")
            for what, operation in (
                ("start()", motor.start),
                ("stop()", motor.stop),
                ("disable()", motor.disable),
            ):
                try:
                    operation()
                except MotorBusyError:
                    continue
                raise Violated(f"{what} was accepted during low-level access")
            rest_for(bench, 0.3)
    expect_at(bench, motor, way, "after unused low-level access")
    move(bench, motor, way)
    expect_at(bench, motor, 2.0 * way, "moved after low-level access")


@clause(
    "LOW-02",
    Level.L2,
    needs={Capability.LOW_LEVEL, Capability.VELOCITY_SET_POINT},
    bench={Ability.TRUTH},
    source="requirement 2; Motor.low_level: StateError, a motion of this motor is active",
)
def low_level_access_begins_at_rest(bench: RigProtocol) -> None:
    """Low-level access is refused while the motor moves; the motion continues undisturbed."""
    motor = bench.motor
    asked = 0.3 * motor.model.velocity_max
    turn(motor, asked)
    finish(bench, motor, 2.0)
    rest_for(bench, 0.1)
    try:
        with motor.low_level():
            pass
    except (MotorBusyError, StateError):
        pass
    else:
        raise Violated("low-level access was granted while the motor moves")
    before, begun_ns = place(bench, motor), bench.runtime.now_ns()
    rest_for(bench, 0.3)
    found = (place(bench, motor) - before) / ((bench.runtime.now_ns() - begun_ns) / 1e9)
    expect(
        abs(found - asked) <= 0.05 * asked,
        f"low-level access refused: velocity {found:g}; expected {asked:g} {motor.model.unit}/s",
    )
    motor.stop()
    finish(bench, motor)
