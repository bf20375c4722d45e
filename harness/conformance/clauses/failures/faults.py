"""L2 and L5: drive faults, lost answers, homing, and low-level access."""

import re
from collections.abc import Callable
from contextlib import ExitStack, nullcontext, suppress
from functools import partial
from typing import Any, Final

from motorhil.harness.conformance.bench import Ability, RigProtocol
from motorhil.harness.conformance.clause import (
    Level,
    NotApplicable,
    Violated,
    clause,
    expect,
)
from motorhil.harness.conformance.clauses.helpers import (
    aim,
    begin_move,
    elapsed_s,
    error_ending,
    expect_at,
    expect_moved,
    expect_raises,
    expect_rest,
    expect_state,
    expect_unmoved,
    expect_usable,
    failure_of,
    finish,
    follow,
    long_move,
    modes_of,
    move,
    move_exactly,
    position_of,
    reached,
    rest_for,
    shortest_s,
    until_rest_s,
)
from motorhil.harness.conformance.clauses.tracks import PositionWatch
from motorhil.harness.rig.config.conformance import Capability
from motorhil.harness.rig.config.toml import RigError
from motorhil.motorapi import (
    ControlMode,
    ControlVariable,
    DeadlineExceeded,
    DeviceFault,
    LinkError,
    Motor,
    MotorError,
    MotorState,
    PeerError,
    TrapezoidalTrajectory,
    UnsupportedError,
)

_NOTICED_S = 0.3
_SOON_S = 0.05
_BACK_S = 1.0
_COASTS_S: Final = 1.0
"""The time in which a motor without power comes to rest, as far as clauses need it [s]."""
_PLACES: Final = 12
_LENGTHS_S: Final = (0.3, 0.02)
_ONCE: Final = 1.5  # of the distance: the motor may coast after the failure
_BOUND_S: Final = 10.0
_ERRORS: Final = (LinkError, PeerError, DeadlineExceeded, DeviceFault)
_METHODS: Final = range(1, 38)  # CiA 402-2, 6098h
_HERE = 37
_TIMEOUT: Final = "timeout_s"
_PATIENT: Final = 0.9
_READINGS: Final = 3
_SPOT_S: Final = 0.5
_HOMINGS: Final = 4
_BETWEEN_S: Final = 0.04
_SEARCH_S: Final = 0.4
_LATE_S: Final = (0.11, 0.21, 0.31)
_LATE_PLACES: Final = 4
_FAILS_S: Final = 5.0
_LOST: Final = 40  # every second answer
_TURNED: Final = 4.0  # long moves: more than half a turn of some motors
_NO_METHOD = 77  # reserved in CiA 402-2


def _raised(what: str, operation: Callable[[], object]) -> DeviceFault:
    try:
        operation()
    except DeviceFault as error:
        return error
    raise Violated(f"{what} did not raise DeviceFault")


def _expect_fault(motor: Motor, code: int) -> None:
    fault = motor.fault()  # first: the state must not have to be asked for it
    expect(fault is not None and fault.code == code, f"drive fault {code:04X}h: fault() is {fault}")
    expect_state(motor, MotorState.FAULT, "drive fault")


@clause(
    "FAULT-01",
    Level.L2,
    needs={Capability.FAULTS, Capability.POSITION_TRAJECTORY},
    bench={Ability.FAULT},
    source="Motor.wait_until_done: DeviceFault, the drive has a fault; CiA 402-2, FAULT",
)
def fault_during_motion_ends_wait(bench: RigProtocol) -> None:
    """During a motion, a fault ends the wait with its code and time, and becomes the state."""
    motor, way = bench.motor, 2.0 * long_move(bench)
    begin = begin_move(bench, motor, way, 0.4 * shortest_s(motor, way))
    reached(abs(position_of(bench, motor) - begin) > 0.05 * way, "a motion before the fault")
    code = bench.fail(motor)
    failed_ns = bench.runtime.now_ns()
    error = _raised("the wait", lambda: finish(bench, motor, shortest_s(motor, way)))
    expect(
        (error.motor, error.code) == (motor.name, code),
        f"the wait raised fault {error.code:04X}h of {error.motor}; expected {code:04X}h",
    )
    late_s = elapsed_s(bench, failed_ns)
    expect(
        late_s <= _NOTICED_S + bench.facts.time_tolerance_s,
        f"the wait ended {late_s:.3f} s after the fault",
    )
    _expect_fault(motor, code)
    _raised("the second wait", lambda: finish(bench, motor))
    rest_for(bench, _COASTS_S)
    motor.reset_fault()
    begin_move(bench, motor, -way, 0.2 * shortest_s(motor, way))
    bench.fail(motor)
    failed_ns = bench.runtime.now_ns()
    rest_for(bench, _BACK_S)
    error, fault = _raised("a wait after the fault", lambda: finish(bench, motor)), motor.fault()
    since_s = (error.since_ns - failed_ns) / 1e9
    told_s = since_s if fault is None else (fault.since_ns - failed_ns) / 1e9
    expect(
        -bench.facts.time_tolerance_s <= since_s == told_s,
        f"the wait says that the fault began {since_s:g} s after its cause, fault() {told_s:g} s;"
        " expected one time, after it",
    )


@clause(
    "FAULT-02",
    Level.L2,
    needs={Capability.FAULTS, Capability.POSITION_TRAJECTORY},
    bench={Ability.FAULT},
    source="Motor.start: DeviceFault, reset_fault() first; CiA 402-2, FAULT",
)
def fault_prevents_start_and_enable(bench: RigProtocol) -> None:
    """Until reset_fault(), a motor with a fault cannot be started or enabled."""
    motor = bench.motor
    motor.enable()
    bench.fail(motor)
    rest_for(bench, _NOTICED_S)
    before = position_of(bench, motor)
    motor.set_control_mode(ControlMode.TRAJECTORY)
    motor.set_trajectory(TrapezoidalTrajectory(0.3 * long_move(bench)))
    _raised("start()", motor.start)
    _raised("enable()", motor.enable)
    for stop in (motor.quick_stop, motor.stop):  # allowed in any state
        stop()
        rest_for(bench, 0.25)
    expect_unmoved(bench, motor, before, "started with a fault")
    expect_state(motor, MotorState.FAULT, "started with a fault")
    motor.reset_fault()
    motor.disable()
    bench.fail(motor)  # nobody has heard of it when the motor is enabled
    error = failure_of(motor.enable)
    expect(error is None or isinstance(error, DeviceFault), f"enable() with a new fault: {error!r}")
    if error is None:  # some drives fail only later
        expect_state(motor, MotorState.ENABLED, "enable() with a new fault returned")


@clause(
    "FAULT-03",
    Level.L2,
    needs={Capability.FAULTS, Capability.POSITION_TRAJECTORY},
    bench={Ability.FAULT},
    source="Motor.reset_fault: the fault is gone, the power stage is off if there was one",
)
def reset_fault_clears_fault_without_motion(bench: RigProtocol) -> None:
    """After reset_fault() the motor has no fault, is off and at rest; the next start works."""
    motor, way = bench.motor, 0.4 * long_move(bench)
    motor.enable()
    motor.reset_fault()
    expect_state(motor, MotorState.ENABLED, "reset_fault() without a fault")
    for _ in range(2):
        follow(motor, TrapezoidalTrajectory(way))
        rest_for(bench, 0.5 * shortest_s(motor, way))
        bench.fail(motor)
        rest_for(bench, _COASTS_S)
        held = position_of(bench, motor)
        motor.reset_fault()
        fault = motor.fault()
        expect(fault is None, f"after reset_fault(): fault() is {fault}")
        expect_state(motor, MotorState.DISABLED, "after reset_fault()")
        rest_for(bench, 0.3)
        expect_unmoved(bench, motor, held, "after reset_fault()")
        move_exactly(bench, motor, way, "moved after reset_fault()")


@clause(
    "FAULT-04",
    Level.L2,
    needs={Capability.FAULTS, Capability.POSITION_TRAJECTORY},
    bench={Ability.FAULT},
    source="Motor.fault: what the drive says is wrong; Motor.enable: DeviceFault",
)
def fault_at_rest_is_reported(bench: RigProtocol) -> None:
    """At rest, a fault is reported with its error code, and since when, to the next caller."""
    motor, way = bench.motor, 0.2 * long_move(bench)
    move(bench, motor, way)
    begun_ns = bench.runtime.now_ns()
    code = bench.fail(motor)
    rest_for(bench, _NOTICED_S)
    _expect_fault(motor, code)
    told = []
    for _ in range(2):
        fault = motor.fault()
        told.append(0 if fault is None else fault.since_ns - begun_ns)
        rest_for(bench, _NOTICED_S)
    seen = " and ".join(f"{one / 1e9:g} s" for one in told)
    expect(told[0] == told[1] >= 0, f"one fault, asked twice, began {seen} after its cause")
    motor.reset_fault()
    motor.start()
    finish(bench, motor, shortest_s(motor, way))
    expect_rest(bench, motor, "moved after a fault")


@clause(
    "FAULT-08",
    Level.L2,
    needs={Capability.FAULTS, Capability.POSITION_TRAJECTORY},
    bench={Ability.FAULT, Ability.AFRESH},
    source="Motor.wait_until_done: DeviceFault, the drive has a fault; Ending.FAILED: by a fault",
)
def reset_fault_leaves_cause_to_wait(bench: RigProtocol) -> None:
    """A motion that a fault has ended fails with that fault, although it is reset at once."""
    way = 2.0 * long_move(bench)

    def wait() -> None:
        finish(bench, bench.motor, shortest_s(bench.motor, way))

    for waits in (True, False):
        bench.afresh()
        motor = bench.motor
        begin_move(bench, motor, way, 0.2 * shortest_s(motor, way))
        party = bench.runtime.spawn("waiter", wait) if waits else None
        rest_for(bench, 0.1 * shortest_s(motor, way))
        code = bench.fail(motor)
        for _ in range(round(_BACK_S / _SOON_S)):
            refused = failure_of(motor.reset_fault)
            rest_for(bench, _SOON_S)
            if refused is None and motor.state() is MotorState.DISABLED:
                break
        expect(refused is None, f"its short fault cannot be reset: {refused}")
        error: BaseException | None
        if party is None:
            error = failure_of(wait)
        else:
            expect(party.join(_BOUND_S), "the wait does not end")
            error = party.error
        expect(
            isinstance(error, DeviceFault) and error.code == code,
            f"{'during' if waits else 'before'} a wait, fault {code:04X}h was reset at once: the"
            f" wait ended with {error!r}",
        )


@clause(
    "FAULT-05",
    Level.L5,
    needs={Capability.FAULTS, Capability.POSITION_TRAJECTORY},
    bench={Ability.TRUTH, Ability.FAULT, Ability.AFRESH},
    source="CiA 402-2, fault reaction; Motor.wait_until_done, DeviceFault",
)
def fault_ends_motion_in_every_mode(bench: RigProtocol) -> None:
    """In every mode, a fault is reported with its code; the motor stops, and is usable again."""
    for mode in modes_of(bench):
        motor = bench.motor
        code = bench.fail(motor)
        within_s = bench.facts.lost_s + bench.facts.time_tolerance_s
        if mode.moves:
            error = error_ending(bench, motor, mode, within_s)
            expect(
                isinstance(error, DeviceFault) and error.code == code,
                f"{mode.name}: fault {code:X}h, but the wait raised {error!r}",
            )
        rest_for(bench, until_rest_s(bench, motor))
        expect_rest(bench, motor, f"{mode.name}, after a drive fault")
        expect_state(motor, MotorState.FAULT, f"{mode.name}: after the fault")
        expect_usable(bench, motor, f"{mode.name}, after a fault")


@clause(
    "FAULT-06",
    Level.L5,
    needs={Capability.FAULTS, Capability.POSITION_TRAJECTORY},
    bench={Ability.TRUTH, Ability.FAULT, Ability.SECOND_MOTOR},
    source="Motor.fault: what this drive says is wrong; paper 3.5, one object for each motor",
)
def fault_leaves_other_motors_usable(bench: RigProtocol) -> None:
    """A fault of one motor neither ends nor fails the motions of the others, nor is it theirs."""
    way = long_move(bench)
    for failing in bench.motors:
        others = [motor for motor in bench.motors if motor is not failing]
        before = {motor: bench.true_position(motor) for motor in others}
        for motor in bench.motors:
            follow(motor, TrapezoidalTrajectory(way))
        rest_for(bench, 0.3 * shortest_s(failing, way))
        code = bench.fail(failing)
        what = f"fault {code:X}h of {failing.name}"
        rest_for(bench, _SOON_S)
        expect(failing.fault() is not None, f"{what}: fault() is None")
        for motor in others:
            error = failure_of(partial(finish, bench, motor, shortest_s(motor, way)))
            expect(error is None, f"{what}: the motion of {motor.name} ended with {error!r}")
            expect_moved(bench, motor, before[motor], way, what)
            expect_state(motor, MotorState.ENABLED, f"{what}: {motor.name}")
            fault = motor.fault()
            expect(fault is None, f"{what}: {motor.name} reports {fault}; expected None")
        _raised("the wait for the failed motor", partial(finish, bench, failing))
        failing.reset_fault()
        for motor in others:
            expect_state(motor, MotorState.ENABLED, f"{what} was reset: {motor.name}")
            move_exactly(bench, motor, -way, f"{what} was reset: {motor.name}")


@clause(
    "FAULT-07",
    Level.L5,
    needs={Capability.FAULTS, Capability.POSITION_TRAJECTORY},
    bench={Ability.FAULT, Ability.ONE_KIND, Ability.AFRESH},
    source="CiA 301, EMCY is not confirmed; CiA 402-2, 603Fh; Motor.fault: what the drive says",
)
def fault_without_its_message_is_reported(bench: RigProtocol) -> None:
    """If the message that a fault sends is lost, the fault is reported all the same, or no code."""
    bench.motor.enable()
    with bench.identifiers() as usual:
        rest_for(bench, _BACK_S)
    with bench.identifiers() as seen:
        bench.fail(bench.motor)
        rest_for(bench, _NOTICED_S)
    messages = sorted(set(seen) - set(usual))
    if not messages:
        raise NotApplicable("a fault sends no message of its own")
    for identifier in messages:
        bench.afresh()
        motor, what = bench.motor, f"a fault without its message {identifier:03X}h"
        motor.enable()
        with bench.lose_identifier(identifier) as count:
            code = bench.fail(motor)
            rest_for(bench, _NOTICED_S)
            reached(count() > 0, "the loss of that message")
        if motor.state() is MotorState.OFFLINE:
            continue  # it says nothing else
        fault = motor.fault()
        expect(fault is not None and fault.code == code, f"{what}, {code:04X}h: {fault}")
        expect_state(motor, MotorState.FAULT, what)
        motor.set_control_mode(ControlMode.TRAJECTORY)
        motor.set_trajectory(TrapezoidalTrajectory(0.1 * long_move(bench)))
        for operation in (motor.start, motor.enable):
            error = _raised(f"{operation.__name__}() after {what}", operation)
            expect(error.code in (code, 0), f"{what}, {code:04X}h: {error}; expected it, or 0")
        expect_usable(bench, motor, what)


@clause(
    "HEAR-01",
    Level.L2,
    needs={Capability.POSITION_SET_POINT, Capability.POSITION_TRAJECTORY},
    bench={Ability.TRUTH, Ability.LOSE, Ability.AFRESH},
    source="paper 3.3.3: start() executes only if there were no errors; harness.sharing_tests",
)
def relative_move_without_answers_is_not_doubled(bench: RigProtocol) -> None:
    """Whenever its answers are lost, a relative move is made once, or in part, but not twice."""
    bench.motor.enable()
    begun_ns = bench.runtime.now_ns()
    aim(bench.motor, 0.1 * long_move(bench), relative=True)
    starting_s = elapsed_s(bench, begun_ns)
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

    party = bench.runtime.spawn("loss of answers", lose)
    failed: MotorError | None = None
    try:
        aim(motor, way, relative=True)
        finish(bench, motor, shortest_s(motor, way))
    except _ERRORS as error:
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
def command_without_answer_fails_in_time(bench: RigProtocol) -> None:
    """Commands to a drive that does not answer fail in time, and are never reported as done."""
    motor, way = bench.motor, 0.2 * long_move(bench)
    move(bench, motor, way)
    asked: list[tuple[str, Callable[[], object]]] = [
        ("position()", motor.position),
        ("enable()", motor.enable),
        ("disable()", motor.disable),
        ("start()", motor.start),
    ]
    with bench.lose_answers_of(motor) as count:
        rest_for(bench, bench.facts.dead_man_s)
        expect_state(motor, MotorState.OFFLINE, "no answers")
        for what, operation in asked:
            _expect_no_answer(bench, what, operation)
        reached(count() > 0, "the loss of an answer")


def _expect_no_answer(bench: RigProtocol, what: str, operation: Callable[[], object]) -> None:
    begun_ns = bench.runtime.now_ns()
    unanswered = (LinkError, PeerError, DeadlineExceeded)
    expect_raises(unanswered, operation, f"{what} without answers returned without an error")
    took_s = elapsed_s(bench, begun_ns)
    expect(took_s <= _BOUND_S, f"{what} without answers took {took_s:.1f} s; limit {_BOUND_S:g} s")


@clause(
    "HEAR-03",
    Level.L2,
    needs={Capability.POSITION_TRAJECTORY},
    bench={Ability.LOSE, Ability.TRUTH},
    source="requirement 4: inform the users; Motor.wait_until_done: LinkError, DeadlineExceeded",
)
def drive_that_answers_again_moves(bench: RigProtocol) -> None:
    """After a time without answers, a motor that answers again moves as commanded."""
    motor, way = bench.motor, 0.2 * long_move(bench)
    move(bench, motor, way)
    with bench.lose_answers_of(motor) as count:
        rest_for(bench, bench.facts.dead_man_s)
        with suppress(*_ERRORS):
            motor.position()
        reached(count() > 0, "the loss of an answer")
    rest_for(bench, bench.facts.dead_man_s)
    _wait_until_it_answers(bench, motor)
    move_exactly(bench, motor, way, "moved after answers came again")


def _wait_until_it_answers(bench: RigProtocol, motor: Motor) -> None:
    """Wait until the motor answers; the drive may report the loss of its host as a fault."""
    for _ in range(20):
        try:
            motor.reset_fault()
            motor.enable()
        except _ERRORS:
            rest_for(bench, 0.5)
        else:
            return
    motor.enable()


@clause(
    "HEAR-04",
    Level.L2,
    needs={Capability.POSITION_TRAJECTORY},
    bench={Ability.LOSE, Ability.TRUTH},
    source="Motor.wait_until_done: DeadlineExceeded, not within timeout_s",
)
def deadline_holds_without_answers(bench: RigProtocol) -> None:
    """Without answers, a wait ends at its timeout, or before; with half of them, all is true."""
    motor, way = bench.motor, long_move(bench)
    move(bench, motor, 0.1 * way)
    for timeout_s in (0.0, 0.3):
        begin_move(bench, motor, way, 0.1 * shortest_s(motor, way))
        with bench.lose_answers_of(motor) as count:
            begun_ns = bench.runtime.now_ns()
            error = failure_of(partial(motor.wait_until_done, timeout_s))
            took_s = elapsed_s(bench, begun_ns)
            expect(error is not None, f"without answers, done was reported after {took_s:.3f} s")
            most_s = timeout_s + bench.facts.lost_s + bench.facts.time_tolerance_s
            expect(
                took_s <= most_s,
                f"without answers, a wait of {timeout_s:g} s ended after {took_s:.3f} s;"
                f" expected at most {most_s:.3f} s",
            )
            rest_for(bench, 0.1)
            reached(count() > 0, "the loss of an answer")
        rest_for(bench, bench.facts.dead_man_s + shortest_s(motor, way))
        _wait_until_it_answers(bench, motor)
        motor.stop()
        finish(bench, motor)
    watch = PositionWatch(bench, motor)
    with ExitStack() as losses:
        for lost in range(_LOST):
            losses.enter_context(bench.lose_answers_of(motor, skip=lost, limit=1))
        _read_all(motor, watch, "with every second answer lost")
    _wait_until_it_answers(bench, motor)


@clause(
    "HEAR-05",
    Level.L2,
    needs={Capability.POSITION_TRAJECTORY},
    bench={Ability.LATE, Ability.TRUTH},
    source="errors: DeadlineExceeded, PeerError; a late answer is that to its own request",
)
def late_answer_is_not_taken_for_next(bench: RigProtocol) -> None:
    """A late answer is not taken for that to a later request: what is read is true, or refused."""
    motor, way = bench.motor, 0.5 * long_move(bench)
    late = 0
    for delay_s in _LATE_S:
        for skip in range(_LATE_PLACES):
            _wait_until_it_answers(bench, motor)
            watch = PositionWatch(bench, motor)
            slowly_s = 2.0 * shortest_s(motor, way)
            follow(motor, TrapezoidalTrajectory(way, duration_s=slowly_s))
            rest_for(bench, 0.3 * slowly_s)
            with bench.delay_answers_of(motor, delay_s, skip=skip, limit=1) as count:
                _read_all(motor, watch, f"answer {skip + 1} late by {delay_s:g} s")
                late += count()
            watch.end(0.0)
            with suppress(*_ERRORS):
                motor.stop()
                finish(bench, motor)
            rest_for(bench, delay_s)
            way = -way
        if not late:
            raise NotApplicable("the motor reads nothing by requests")
    if Ability.SETTINGS in bench.abilities:
        _expect_patience(bench, motor)


def _expect_patience(bench: RigProtocol, motor: Motor) -> None:
    """Expect positions of a drive that takes most of the stated timeout for each answer."""
    stated = bench.stated()
    if stated is None or _TIMEOUT not in stated.declaration.keys:
        return
    timeout_s: Any = stated.values.get(_TIMEOUT, stated.declaration.defaults.get(_TIMEOUT))
    _wait_until_it_answers(bench, motor)
    with bench.delay_answers_of(motor, _PATIENT * timeout_s):
        for _ in range(_READINGS):
            error = failure_of(motor.position)
            text = f"each answer comes {_PATIENT:g} of {_TIMEOUT} = {timeout_s:g} s late: {error}"
            expect(error is None, text)


def _read_all(motor: Motor, watch: PositionWatch, when: str) -> None:
    """Read all values twice; each must be one of the motor's, or be refused."""
    top, unit = motor.model.velocity_max, motor.model.unit
    for _ in range(2):
        with suppress(*_ERRORS):
            watch.read(when)
        with suppress(*_ERRORS):
            velocity = motor.velocity()
            expect(abs(velocity) <= 1.2 * top, f"{when}: velocity() is {velocity:g} {unit}/s")
        with suppress(*_ERRORS, UnsupportedError):
            behind = motor.following_error()
            expect(abs(behind) <= top, f"{when}: following_error() is {behind:g} {unit}")
        with suppress(*_ERRORS):
            fault = motor.fault()
            expect(fault is None, f"{when}: fault() is {fault}; expected None")


@clause(
    "HOME-01",
    Level.L2,
    needs={Capability.HOMING, Capability.POSITION_TRAJECTORY},
    source="Motor.home: knows where its position 0 is, 37: here; None: the drive's own method;"
    " CiA 402-2, 6098h, 607Ch",
)
def homing_on_the_spot_sets_zero(bench: RigProtocol) -> None:
    """Homing on the spot moves nothing; the position becomes 0 and the motor is referenced."""
    motor, way = bench.motor, 0.3 * long_move(bench)
    own = _place_of_own_homing(bench, motor)
    move(bench, motor, way)
    before, state = position_of(bench, motor), motor.state()
    begun_ns = bench.runtime.now_ns()
    try:
        motor.home(_HERE)
    except UnsupportedError as error:
        if Capability.HOMING in bench.facts.claims:
            raise
        raise NotApplicable(f"homing on the spot is refused: {error}") from None
    took_s, most_s = elapsed_s(bench, begun_ns), _SPOT_S + bench.facts.time_tolerance_s
    expect(took_s <= most_s, f"homing on the spot took {took_s:.3f} s; limit {most_s:g} s")
    expect(motor.is_referenced(), "homed on the spot: not referenced")
    now = motor.state()
    expect(now is state, f"homed on the spot: {now.value}; {state.value} before")
    expect_at(bench, motor, 0.0, "homed on the spot")
    if Ability.TRUTH in bench.abilities and motor.position() != position_of(bench, motor):
        expect_unmoved(bench, motor, before, "homed on the spot")
    move(bench, motor, -way)
    expect_at(bench, motor, -way, "moved after homing on the spot")
    expect(motor.is_referenced(), "moved after homing on the spot: not referenced any more")
    again = None if own is None else _place_of_own_homing(bench, motor)
    expect(
        own is None or again is None or abs(again - own) <= bench.facts.window,
        f"home() ended at {own} {motor.model.unit}, and after home({_HERE}) at {again}",
    )
    _expect_even_times(bench, motor)


def _expect_even_times(bench: RigProtocol, motor: Motor) -> None:
    """Expect homing on the spot to take as long each time: its end is told when it comes."""
    took_s = []
    for number in range(_HOMINGS):
        if number % 2:
            move(bench, motor, 0.1 * long_move(bench))
        begun_ns = bench.runtime.now_ns()
        motor.home(_HERE)
        took_s.append(elapsed_s(bench, begun_ns))
        rest_for(bench, _BETWEEN_S)
    told = ", ".join(f"{one:.3f} s" for one in took_s)
    apart_s = 2.0 * bench.facts.time_tolerance_s
    for alike in (took_s[::2], took_s[1::2]):  # after a homing, and after a move
        expect(max(alike) - min(alike) <= apart_s, f"homing on the spot took {told}")


def _place_of_own_homing(bench: RigProtocol, motor: Motor) -> float | None:
    """Return the position after homing by the motor's own method; None: it must move for that."""
    if Ability.TRUTH not in bench.abilities:
        return None
    before = bench.true_position(motor)
    error = failure_of(partial(motor.home, timeout_s=_SEARCH_S))
    moved = abs(bench.true_position(motor) - before)
    return None if error is not None or moved > bench.facts.window else motor.position()


@clause(
    "HOME-02",
    Level.L2,
    needs={Capability.POSITION_TRAJECTORY},
    source="Motor.home: UnsupportedError, the motor does not know the method; timeout_s: stopped",
)
def unknown_homing_method_is_refused(bench: RigProtocol) -> None:
    """Unknown homing methods are refused, and do not move; one that fails, or lasts, is ended."""
    motor, way = bench.motor, 0.2 * long_move(bench)
    origin = motor.position()
    move(bench, motor, way)
    before = position_of(bench, motor)
    expect_raises(
        UnsupportedError,
        partial(motor.home, _NO_METHOD),
        f"homing method {_NO_METHOD} was accepted; CiA 402 reserves it",
    )
    rest_for(bench, 0.3)
    expect_unmoved(bench, motor, before, f"homing method {_NO_METHOD} was refused")
    move(bench, motor, way)
    expect_at(bench, motor, origin + 2.0 * way, "moved after a homing was refused")
    method = bench.facts.seeking_method
    if method is not None and Capability.HOMING not in bench.facts.without:
        _expect_search_is_stopped(bench, motor, method)
        if bench.facts.homing_fails and Ability.SETTINGS in bench.abilities:
            with suppress(RigError), bench.altered({}, bench.facts.homing_fails):  # if it has them
                _expect_failure(bench, bench.motor, method)


def _expect_failure(bench: RigProtocol, motor: Motor, method: int) -> None:
    """Expect a homing that fails in the drive to raise by its method, and not to be believed."""
    motor.enable()
    error = failure_of(partial(motor.home, method, timeout_s=_FAILS_S))
    if isinstance(error, UnsupportedError):  # this drive lacks what its kind has
        return
    what = f"homing by method {method}, which fails in the drive: {error!r}"
    expect(isinstance(error, PeerError), f"{what}; expected PeerError")
    told = getattr(error, "method", method)
    expect(told == method, f"{what}; expected method {method}, not {told}")
    words = [motor.name, *([f"method {method}"] if hasattr(error, "method") else [])]
    expect(all(one in f"{error}" for one in words), f"{what}: {error}; expected {words}")
    expect(not motor.is_referenced(), f"{what}, but the motor is referenced")
    motor.stop()
    finish(bench, motor)
    move_exactly(bench, motor, 0.1 * long_move(bench), what)
    error = failure_of(partial(motor.home, timeout_s=_FAILS_S))  # by the method that the drive has
    is_none = getattr(error, "method", None) == 0 or re.search(r"method 0\b", f"{error}")
    expect(not is_none, f"homing by the drive's own method: {error!r}; expected no method 0")


def _expect_search_is_stopped(bench: RigProtocol, motor: Motor, method: int) -> None:
    """Expect that a homing which finds nothing in its time fails, and is stopped."""
    error = failure_of(partial(motor.home, method, timeout_s=_SEARCH_S))
    if isinstance(error, UnsupportedError):
        return
    what = f"homing by method {method} for {_SEARCH_S:g} s"
    expect(isinstance(error, DeadlineExceeded), f"{what}: {error!r}; expected DeadlineExceeded")
    rest_for(bench, motor.model.velocity_max / motor.model.deceleration)
    expect_rest(bench, motor, f"{what}, and then")


@clause(
    "HOME-05",
    Level.L2,
    needs={Capability.HOMING},
    bench={Ability.SETTINGS},
    source="UnsupportedError.supported: the alternatives; Motor.home",
)
def listed_homing_methods_are_known(bench: RigProtocol) -> None:
    """The refusal of a homing method lists only methods that the motor knows."""
    error = failure_of(partial(bench.motor.home, _NO_METHOD))
    listed = error.supported if isinstance(error, UnsupportedError) else ""
    numbers = [int(one) for one in re.findall(r"(?<![\w.])\d{1,2}(?![\w.])", listed)]
    for method in (one for one in numbers if one in _METHODS):
        bench.afresh()
        error = failure_of(partial(bench.motor.home, method, wait=False))
        expect(
            not isinstance(error, UnsupportedError),
            f"method {method} is listed ({listed}), but refused: {error}",
        )


@clause(
    "HOME-03",
    Level.L5,
    needs={Capability.HOMING, Capability.POSITION_TRAJECTORY},
    bench={Ability.TRUTH, Ability.RESTART},
    source="Motor.is_referenced: position 0 is that of the model; CiA 402-2, homing mode",
)
def restarted_drive_is_referenced_only_if_it_knows(bench: RigProtocol) -> None:
    """After a restart of its drive, a motor is referenced only if its position is still right."""

    def restart() -> None:
        bench.restart(bench.motor)
        rest_for(bench, until_rest_s(bench, bench.motor))

    _expect_true_reference(bench, "a restart", restart)


@clause(
    "HOME-04",
    Level.L5,
    needs={Capability.HOMING, Capability.POSITION_TRAJECTORY},
    bench={Ability.TRUTH, Ability.CUT},
    source="Motor.is_referenced: position 0 is that of the model; Motor.home",
)
def lost_motor_is_referenced_only_if_it_knows(bench: RigProtocol) -> None:
    """After a loss of its drive, a motor is referenced only if its position is still right."""

    def lose() -> None:
        with bench.cut(bench.motor):
            rest_for(bench, until_rest_s(bench, bench.motor))
            bench.motor.state()  # a host that only asks when asked to notices the loss now
        rest_for(bench, _BACK_S)
        bench.motor.reset_fault()

    _expect_true_reference(bench, "a loss", lose)


@clause(
    "HOME-06",
    Level.L2,
    source="Motor.is_referenced: position 0 is that of the model; [conformance] absolute_encoder",
)
def motor_is_referenced_at_first_if_absolute(bench: RigProtocol) -> None:
    """Before any homing, a motor is referenced if its encoder is absolute, and only then."""
    wanted, motor = bench.facts.absolute_encoder, bench.motor
    if wanted is None:
        raise NotApplicable("the rig does not state it ([conformance] absolute_encoder)")
    motor.position()
    found = motor.is_referenced()
    expect(found is wanted, f"before any homing, is_referenced() is {found}; expected {wanted}")
    if motor.logical.hooks.supports(ControlMode.TRAJECTORY, ControlVariable.POSITION):
        move(bench, motor, 0.1 * long_move(bench))
        moved = motor.is_referenced()
        expect(moved is wanted, f"after a move, is_referenced() is {moved}; expected {wanted}")


@clause(
    "HOME-07",
    Level.L5,
    needs={Capability.POSITION_TRAJECTORY},
    bench={Ability.TRUTH, Ability.RESTART, Ability.LOSE, Ability.AFRESH},
    source="Motor.position: measured position; errors, LinkError: the drive was lost",
)
def unseen_restart_is_as_a_seen_one(bench: RigProtocol) -> None:
    """After a restart of its drive that the host could not hear, a position is as if it had."""
    found = []
    for is_seen in (True, False):
        bench.afresh()
        motor = bench.motor
        move(bench, motor, _TURNED * long_move(bench))
        with nullcontext() if is_seen else bench.lose_answers_of(motor):
            bench.restart(motor)
            rest_for(bench, until_rest_s(bench, motor) + bench.facts.lost_s)
            motor.state()  # a host that only asks when asked to notices the loss now
        rest_for(bench, _BACK_S)
        for operation in (motor.reset_fault, motor.enable):  # one of them sets the drive up again
            failure_of(operation)
        try:
            found.append(motor.position() - bench.true_position(motor))
        except LinkError as error:
            raise NotApplicable(f"after a restart, no position is told: {error}") from None
    seen, unseen = found
    expect(
        abs(seen - unseen) <= 2.0 * bench.facts.window,
        f"after a restart, position() was off by {seen:g} {motor.model.unit} if the host heard the"
        f" drive meanwhile, and by {unseen:g} {motor.model.unit} if not",
    )


def _expect_true_reference(bench: RigProtocol, trouble: str, suffer: Callable[[], object]) -> None:
    """Check that a homed motor is referenced after this trouble only if its position is right."""
    motor, way = bench.motor, 0.3 * long_move(bench)
    move(bench, motor, way)
    if failure_of(partial(motor.home, _HERE)) is not None:
        raise NotApplicable("homing on the spot is refused")
    zero = bench.true_position(motor)
    move(bench, motor, way)
    suffer()
    rest_for(bench, _BACK_S)
    is_referenced, reported = motor.is_referenced(), motor.position()
    true, unit = bench.true_position(motor) - zero, motor.model.unit
    expect(
        not is_referenced or abs(reported - true) <= 2.0 * bench.facts.window,
        f"after {trouble}: referenced, but position() is {reported:g} {unit} at {true:g} {unit}"
        " from home; expected this position, or not referenced",
    )
    motor.home(_HERE)
    expect(motor.is_referenced(), f"homed again after {trouble}: not referenced")
    expect_at(bench, motor, 0.0, f"homed again after {trouble}")


@clause(
    "FAULT-09",
    Level.L5,
    needs={Capability.FAULTS},
    bench={Ability.FAULT, Ability.AFRESH},
    source="DeviceFault: code and text; the maker's list of errors, [conformance] fault_texts",
)
def fault_has_text_of_its_maker(bench: RigProtocol) -> None:
    """Each fault is reported with its code, and with what its maker calls it."""
    if not bench.facts.fault_texts or bench.facts.fault_value is not None:
        raise NotApplicable("the rig states no texts of faults ([conformance] fault_texts)")
    for code, words in bench.facts.fault_texts.items():
        motor = bench.motor
        if failure_of(motor.reset_fault, motor.enable) is not None:  # the last one stays
            bench.afresh()
            motor = bench.motor
            motor.enable()
        bench.fail(motor, code)
        rest_for(bench, bench.facts.time_tolerance_s)
        expect_state(motor, MotorState.FAULT, f"after fault {code:X}h")
        fault = motor.fault()
        expect(fault is not None and fault.code == code, f"fault {code:X}h is reported as {fault}")
        expect(
            fault is None or words.lower() in fault.text.lower(),
            f"fault {code:X}h is reported as {fault}; its maker calls it {words}",
        )
    bench.afresh()
    rest_for(bench, bench.facts.time_tolerance_s)  # it has power
    motor = bench.motor
    bench.fail(motor, code)
    motor.position()  # a drive is known by its answers, whatever its fault
    fault = motor.fault()
    expect(fault is None or fault.code == code, f"first of all, fault {code:X}h is told as {fault}")
