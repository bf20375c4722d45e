"""L2: what becomes of commands whose answers are lost, and of a drive that does not answer."""

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
_ONCE: Final = 1.5  # of the way: where it failed it may coast
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
    """Whenever its answers are lost, a relative move is made once, or in part, never further."""
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
    reached(lost > 0, "an answer that was lost")


def _move_without_answers(bench: RigProtocol, from_s: float, length_s: float) -> int:
    """How many answers to the commands of a relative move were lost."""
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
    what = (
        f"told to move {way:g} {motor.model.unit}, and of its answers those lost of {length_s:g} s"
    )
    ended = "it said that it had" if failed is None else f"it said {failed}"
    low, high = (way - spare, way + spare) if failed is None else (-spare, _ONCE * way)
    expect(
        low <= made <= high,
        f"{what} from {from_s:g} s on, it moved {made:.5g} {motor.model.unit}; {ended}",
    )
    return max(counts)


@clause(
    "HEAR-02",
    Level.L2,
    needs={Capability.POSITION_TRAJECTORY},
    bench={Ability.LOSE, Ability.TRUTH},
    source="errors: LinkError, PeerError, DeadlineExceeded; Motor.state: OFFLINE if not heard",
)
def silence_is_told_within_a_bound(bench: RigProtocol) -> None:
    """What is asked of a drive that does not answer is told as that, in time, and not as done."""
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
        expect(state is MotorState.OFFLINE, f"nothing is heard of it, and it is {state.value}")
        for what, operation in asked:
            _expect_told(bench, what, operation)
        reached(count() > 0, "an answer that was lost")


def _expect_told(bench: RigProtocol, what: str, operation: Callable[[], object]) -> None:
    begun_ns = bench.runtime.now_ns()
    try:
        operation()
    except _TOLD_BY as error:
        expect(
            not isinstance(error, DeviceFault), f"{what} of a drive that is not heard told {error}"
        )
    else:
        raise Violated(f"{what} of a drive that does not answer returned as if it had")
    took_s = (bench.runtime.now_ns() - begun_ns) / 1e9
    expect(took_s <= _BOUND_S, f"{what} of a drive that does not answer took {took_s:.1f} s")


@clause(
    "HEAR-03",
    Level.L2,
    needs={Capability.POSITION_TRAJECTORY},
    bench={Ability.LOSE, Ability.TRUTH},
    source="requirement 4: inform the users; Motor.wait_until_done: LinkError, DeadlineExceeded",
)
def who_is_heard_again_moves_again(bench: RigProtocol) -> None:
    """A motor that was not heard for a while is the same motor afterwards, and moves as told."""
    motor, way = bench.motor, 0.2 * long_move(bench)
    move(bench, motor, way)
    with bench.lose_answers_of(motor) as count:
        rest_for(bench, bench.facts.dead_man_s)
        with suppress(*_TOLD_BY):
            motor.position()
        reached(count() > 0, "an answer that was lost")
    rest_for(bench, bench.facts.dead_man_s)
    _until_heard(bench, motor)
    before = motor.position()
    move(bench, motor, way)
    expect_at(bench, motor, before + way, "heard again, told to move")


def _until_heard(bench: RigProtocol, motor: Motor) -> None:
    """It answers again, and has no fault; a drive may take it for one that its host was lost."""
    for _ in range(20):
        try:
            motor.reset_fault()
            motor.enable()
        except _TOLD_BY:
            rest_for(bench, 0.5)
        else:
            return
    motor.enable()
