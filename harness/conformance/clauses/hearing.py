"""L2: commands whose answers are lost, and drives that do not answer."""

from collections.abc import Callable
from contextlib import suppress
from typing import Final

from harness.conformance.bench import RigProtocol
from harness.conformance.capability import Ability, Capability
from harness.conformance.clause import Level, Violated, clause, expect
from harness.conformance.motions import (
    aim,
    expect_at,
    finish,
    long_move,
    move,
    reached,
    rest_for,
    shortest_s,
)
from motorapi import (
    DeadlineExceeded,
    DeviceFault,
    LinkError,
    Motor,
    MotorError,
    MotorState,
    PeerError,
)

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
    source="paper 3.3.3: start() executes only if there were no errors; harness.sharing",
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
            _expect_told(bench, what, operation)
        reached(count() > 0, "the loss of an answer")


def _expect_told(bench: RigProtocol, what: str, operation: Callable[[], object]) -> None:
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
