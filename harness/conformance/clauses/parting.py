"""L4: groups with a member that refuses, is lost, or fails."""

from harness.conformance.bench import RigProtocol
from harness.conformance.capability import Ability, Capability
from harness.conformance.clause import Level, NotApplicable, Violated, clause, expect
from harness.conformance.modes import smooth_way
from harness.conformance.motions import (
    expect_rest,
    expect_unmoved,
    finish,
    midway_s,
    move,
    place,
    reached,
    rest_for,
    shortest_s,
)
from harness.conformance.pairs import expect_made, half, pair_of, places, run_to_the_end, ways_of
from motorapi import (
    ControlMode,
    FaultReaction,
    Motor,
    MotorError,
    MotorGroup,
    MotorState,
    PluginError,
    Synchronization,
    SyncLevel,
    UnsupportedError,
)

_TWO = {Ability.TRUTH, Ability.SECOND_MOTOR}
_MOVES = {Capability.POSITION_TRAJECTORY}
_FRAMES = 16  # of the host, in the start of a pair


@clause(
    "SYNC-05",
    Level.L4,
    needs=_MOVES,
    bench={*_TWO, Ability.CUT, Ability.AFRESH},
    source="MotorGroup.start: if one refuses, none moves",
)
def if_one_cannot_be_armed_none_moves(bench: RigProtocol) -> None:
    """If one member does not answer when it is armed, no member moves, then or later."""
    _require_cables_of_their_own(bench)
    for lost in (1, 0):
        bench.afresh()
        way = 0.5 * half(bench)
        group = pair_of(bench, way, -way)
        group.start()
        group.wait_until_done(10.0)  # both motors are now fully set up
        refusing, other = bench.motors[lost], bench.motors[1 - lost]
        before = place(bench, other)
        is_one_signal = group.sync_capability().level >= SyncLevel.TRIGGERED
        with bench.cut(refusing):
            if not is_one_signal:  # else the others begin before its loss is known
                rest_for(bench, bench.facts.lost_s)
            told = _failure_of(group)
            rest_for(bench, bench.facts.lost_s)
        expect(told is not None, f"{refusing.name} does not answer, but start() returned")
        rest_for(bench, 1.0)
        expect_unmoved(bench, other, before, f"{refusing.name} refused: {other.name}")
        _fire_once_more(bench, refusing)
        expect_unmoved(bench, other, before, f"{refusing.name} refused: later {other.name}")


def _require_cables_of_their_own(bench: RigProtocol) -> None:
    first, second = bench.motors[:2]
    second.enable()
    with bench.cut(first):
        rest_for(bench, bench.facts.lost_s)
        if second.state() is not MotorState.ENABLED:
            raise NotApplicable(f"{second.name} and {first.name} share a cable")


def _failure_of(group: MotorGroup) -> MotorError | None:
    try:
        group.start()
    except PluginError:
        raise
    except MotorError as error:
        return error
    return None


def _fire_once_more(bench: RigProtocol, motor: Motor) -> None:
    """Start a motion of this motor alone, so that any common start signal is sent again."""
    motor.reset_fault()
    motor.enable()
    way = 0.25 * half(bench)
    try:
        motor.set_control_mode(ControlMode.TRAJECTORY)
        motor.set_trajectory(smooth_way(motor, way))
        motor.start()
    except UnsupportedError:
        move(bench, motor, way)
        return
    finish(bench, motor, 10.0)


@clause(
    "SYNC-06",
    Level.L4,
    needs={*_MOVES, Capability.COMMON_TRIGGER},
    bench={*_TWO, Ability.SILENCE_HOST, Ability.AFRESH},
    source="MotorHooks._arm: in the hardware, confirmed; README, 'arm, then fire'",
)
def no_part_of_a_group_moves_on_alone(bench: RigProtocol) -> None:
    """Whichever frame of a common start is lost, all members move, or none and start() fails."""
    hit = 0
    for skip in range(_FRAMES):
        bench.afresh()
        way = half(bench)
        group = pair_of(bench, 0.1 * way, -0.1 * way)
        group.start()
        run_to_the_end(bench, group)  # both motors are now fully set up
        group.set_trajectory(*ways_of(way, -way))
        before = places(bench, group)
        with bench.silence_host(skip=skip, limit=1) as lost:
            told = _failure_of(group)
            hit += lost()
        which = f"frame {skip + 1} of the host was lost"
        if told is None:
            run_to_the_end(bench, group)
            expect_made(bench, group, before, (way, -way), which)
            continue
        rest_for(bench, 1.0)
        for motor in group:
            expect_rest(bench, motor, f"{which}, start() failed: {motor.name}")
        first, second = bench.motors[:2]
        rested = place(bench, first)
        _fire_once_more(bench, second)
        expect_unmoved(bench, first, rested, f"{which}, start() failed; later, {first.name}")
    reached(hit > 0, "the loss of a frame")


@clause(
    "SYNC-09",
    Level.L4,
    needs={*_MOVES, Capability.FAULTS},
    bench={*_TWO, Ability.FAULT, Ability.AFRESH},
    source="FaultReaction; requirement 5, synchronised motions",
)
def a_fault_of_one_is_answered_as_was_set(bench: RigProtocol) -> None:
    """If one member fails, the group fails, and the others react as set: stop or continue."""
    for reaction in FaultReaction:
        bench.afresh()
        way = 3.0 * half(bench)
        group = pair_of(bench, way, -way)
        if reaction is FaultReaction.TOGETHER:
            group.synchronization = Synchronization.PHASE
        group.fault_reaction = reaction
        failing, other = bench.motors[:2]
        before = place(bench, other)
        group.start()
        rest_for(bench, midway_s(other, way, 0.4))
        bench.fail(failing)
        _expect_group_told(group, reaction)
        rest_for(bench, shortest_s(other, way))
        expect_rest(
            bench, other, f"{failing.name} failed with reaction {reaction.name}: {other.name}"
        )
        made = abs(place(bench, other) - before) / abs(way)
        goes_on = reaction is FaultReaction.NONE
        expect(
            goes_on is (made > 0.98),
            f"{failing.name} failed, {reaction.name}: {other.name} made {made:.0%}",
        )


def _expect_group_told(group: MotorGroup, reaction: FaultReaction) -> None:
    try:
        group.wait_until_done(10.0)
    except PluginError:
        raise
    except MotorError:
        return
    raise Violated(f"a member failed with reaction {reaction.name}, but its group reported done")
