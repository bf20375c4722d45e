"""L2 and L5: faults are reported, prevent motion, and are reset.

L2: commands whose answers are lost, and drives that do not answer.

L2: homing and low-level access.
"""

from collections.abc import Callable
from contextlib import suppress
from typing import Final

from motorhil.harness.conformance.bench import RigProtocol
from motorhil.harness.conformance.clause import Ability, Capability, Level, Violated, clause, expect
from motorhil.harness.conformance.clauses.helpers import (
    aim,
    ending,
    expect_at,
    expect_rest,
    expect_unmoved,
    expect_usable,
    finish,
    follow,
    long_move,
    modes_of,
    move,
    place,
    reached,
    rest_for,
    shortest_s,
    turn,
    until_rest_s,
)
from motorhil.motorapi import (
    ControlMode,
    DeadlineExceeded,
    DeviceFault,
    LinkError,
    Motor,
    MotorBusyError,
    MotorError,
    MotorState,
    PeerError,
    StateError,
    TrapezoidalTrajectory,
    UnsupportedError,
)

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
    source="Motor.fault: what the drive says is wrong; Motor.enable: DeviceFault",
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


_PLACES: Final = 12
_LENGTHS_S: Final = (0.3, 0.02)
_ONCE: Final = 1.5  # of the distance: the motor may coast after the failure
_BOUND_S: Final = 10.0
_TOLD_BY: Final = (LinkError, PeerError, DeadlineExceeded, DeviceFault)


@clause(
    "HEAR-01",
    Level.L2,
    needs={Capability.POSITION_SET_POINT, Capability.POSITION_TRAJECTORY},
    bench={Ability.TRUTH, Ability.LOSE, Ability.AFRESH},
    source="paper 3.3.3: start() executes only if there were no errors; harness.sharing_tests",
)
def a_relative_move_is_never_made_twice(bench: RigProtocol) -> None:
    """Whenever its answers are lost, a relative move is made once, or in part, but not twice."""
    bench.motor.enable()
    begun_ns = bench.runtime.now_ns()
    aim(bench.motor, 0.1 * long_move(bench), relative=True)
    starting_s = (bench.runtime.now_ns() - begun_ns) / 1e9
    lost = 0
    for number in range(_PLACES):
        bench.afresh()
        bench.motor.enable()
        from_s = starting_s * (number + 1) / _PLACES
        lost += _move_without_answers(bench, from_s, _LENGTHS_S[number % len(_LENGTHS_S)])
    reached(lost > 0, "the loss of an answer")


def _move_without_answers(bench: RigProtocol, from_s: float, length_s: float) -> int:
    """Lose answers to the commands of a relative move, and return how many were lost."""
    motor, way = bench.motor, long_move(bench)
    begin, counts = bench.true_position(motor), [0]

    def lose() -> None:
        rest_for(bench, from_s)
        with bench.lose_answers_of(motor) as count:
            rest_for(bench, length_s)
            counts.append(count())

    party = bench.runtime.spawn("who loses answers", lose)
    failed: MotorError | None = None
    try:
        aim(motor, way, relative=True)
        finish(bench, motor, shortest_s(motor, way))
    except _TOLD_BY as error:
        failed = error
    party.join()
    rest_for(bench, 1.0 + shortest_s(motor, way))
    made, spare = bench.true_position(motor) - begin, bench.facts.window + 0.1 * way
    what = f"move of {way:g} {motor.model.unit} with all answers lost for {length_s:g} s"
    ended = "done was reported" if failed is None else f"it failed with {failed}"
    low, high = (way - spare, way + spare) if failed is None else (-spare, _ONCE * way)
    expect(
        low <= made <= high,
        f"{what} from {from_s:g} s on: moved {made:.5g} {motor.model.unit}; {ended}",
    )
    return max(counts)


@clause(
    "HEAR-02",
    Level.L2,
    needs={Capability.POSITION_TRAJECTORY},
    bench={Ability.LOSE, Ability.TRUTH},
    source="errors: LinkError, PeerError, DeadlineExceeded; Motor.state: OFFLINE without answers",
)
def silence_is_told_within_a_bound(bench: RigProtocol) -> None:
    """Commands to a drive that does not answer fail in time, and are never reported as done."""
    motor, way = bench.motor, 0.2 * long_move(bench)
    move(bench, motor, way)
    asked: list[tuple[str, Callable[[], object]]] = [
        ("enable()", motor.enable),
        ("disable()", motor.disable),
        ("start()", motor.start),
    ]
    with bench.lose_answers_of(motor) as count:
        rest_for(bench, bench.facts.dead_man_s)
        state = motor.state()
        expect(state is MotorState.OFFLINE, f"no answers: state is {state.value}; expected offline")
        for what, operation in asked:
            _expect_late_reply_told(bench, what, operation)
        reached(count() > 0, "the loss of an answer")


def _expect_late_reply_told(bench: RigProtocol, what: str, operation: Callable[[], object]) -> None:
    begun_ns = bench.runtime.now_ns()
    try:
        operation()
    except _TOLD_BY as error:
        expect(not isinstance(error, DeviceFault), f"{what} without answers raised {error}")
    else:
        raise Violated(f"{what} without answers returned without an error")
    took_s = (bench.runtime.now_ns() - begun_ns) / 1e9
    expect(took_s <= _BOUND_S, f"{what} without answers took {took_s:.1f} s; limit {_BOUND_S:g} s")


@clause(
    "HEAR-03",
    Level.L2,
    needs={Capability.POSITION_TRAJECTORY},
    bench={Ability.LOSE, Ability.TRUTH},
    source="requirement 4: inform the users; Motor.wait_until_done: LinkError, DeadlineExceeded",
)
def who_is_heard_again_moves_again(bench: RigProtocol) -> None:
    """After a time without answers, a motor that answers again moves as commanded."""
    motor, way = bench.motor, 0.2 * long_move(bench)
    move(bench, motor, way)
    with bench.lose_answers_of(motor) as count:
        rest_for(bench, bench.facts.dead_man_s)
        with suppress(*_TOLD_BY):
            motor.position()
        reached(count() > 0, "the loss of an answer")
    rest_for(bench, bench.facts.dead_man_s)
    _until_heard(bench, motor)
    before = motor.position()
    move(bench, motor, way)
    expect_at(bench, motor, before + way, "moved after answers came again")


def _until_heard(bench: RigProtocol, motor: Motor) -> None:
    """Wait until the motor answers; the drive may report the loss of its host as a fault."""
    for _ in range(20):
        try:
            motor.reset_fault()
            motor.enable()
        except _TOLD_BY:
            rest_for(bench, 0.5)
        else:
            return
    motor.enable()


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
