"""L4: groups of which a member is refused, lost or fails."""

from collections.abc import Iterator
from contextlib import AbstractContextManager, contextmanager, nullcontext
from functools import partial
from itertools import product

from motorhil.harness.conformance.bench import Ability, RigProtocol
from motorhil.harness.conformance.clause import Level, NotApplicable, clause, expect
from motorhil.harness.conformance.clauses.helpers import (
    expect_group_moved,
    expect_rest,
    expect_unmoved,
    failure_of,
    finish,
    finish_group,
    follow,
    half_move,
    in_phase,
    midway_s,
    move,
    pair_of,
    position_of,
    reached,
    rest_for,
    shortest_s,
    smooth_move,
    trajectories_of,
)
from motorhil.harness.conformance.clauses.tracks import (
    positions_of,
)
from motorhil.harness.rig.config.conformance import Capability
from motorhil.motorapi import (
    DerivativeLimits,
    FaultReaction,
    LinkError,
    Motor,
    MotorState,
    SyncLevel,
    TrapezoidalTrajectory,
    Trigger,
    UnsupportedError,
)

_TWO = {Ability.TRUTH, Ability.SECOND_MOTOR}
_MOVES = {Capability.POSITION_TRAJECTORY}
_ARM = "_arm"
_FRAMES = 16  # of the host, in the start of a pair
_WATCHED_S = 0.2
_LOOKS = 10  # at the positions, while no caller waits
_SLOWLY = 0.1  # of the largest velocity


@clause(
    "SYNC-12",
    Level.L4,
    needs=_MOVES,
    bench=_TWO,
    source="MotorGroup.start: if one refuses, none moves; paper 3.3.3, only without errors",
)
def refused_member_keeps_all_at_rest(bench: RigProtocol) -> None:
    """If the start of one member is refused, no member moves; the next start moves all of them."""
    way = half_move(bench)
    motors = bench.motors[:2]
    group = pair_of(bench, *(0.2 * way for _ in motors))
    group.start()
    finish_group(bench, group)  # both motors are now fully set up
    for place, motor in enumerate(motors):
        for what, trouble in _refusals(bench, motor, way):
            before = positions_of(bench, group)
            ways: list[TrapezoidalTrajectory] = trajectories_of(way, way)
            with trouble as instead:
                if instead is not None:
                    ways[place] = instead
                group.set_trajectory(*ways)
                error = failure_of(group.start)
                expect(error is not None, f"{motor.name} {what}, but its group was started")
                rest_for(bench, _WATCHED_S)
                for one, was in zip(motors, before, strict=True):
                    expect_unmoved(bench, one, was, f"{motor.name} {what}: {one.name}")
            rest_for(bench, _WATCHED_S)
            for one, was in zip(motors, before, strict=True):
                expect_unmoved(bench, one, was, f"{motor.name} {what}: later, {one.name}")
        for mover, other in (reversed(motors), motors):  # one that stayed armed would begin, too
            was = position_of(bench, other)
            move(bench, mover, 0.2 * way)
            expect_unmoved(bench, other, was, f"{mover.name} moves alone: {other.name}")
    before = positions_of(bench, group)
    group.set_trajectory(*trajectories_of(-way, -way))
    group.start()
    finish_group(bench, group)
    expect_group_moved(bench, group, before, (-way, -way), "after starts that were refused")


def _refusals(
    bench: RigProtocol, motor: Motor, way: float
) -> Iterator[tuple[str, AbstractContextManager[TrapezoidalTrajectory | None]]]:
    """Yield reasons to refuse a motor, in words, and each reason with its trajectory, if any."""
    here = motor.position()
    far = here - way - 2.0 * motor.model.start_tolerance
    limits = DerivativeLimits(value=(here - way, here + 0.5 * way))
    yield "would leave its limits", nullcontext(TrapezoidalTrajectory(way, limits=limits))
    yield "is elsewhere", nullcontext(TrapezoidalTrajectory(here, far))
    if Ability.SEVERAL_USERS in bench.abilities:
        yield "is reserved", _reserved(bench.another_user_of(motor))
    yield "cannot be armed", _not_armed(motor)


@contextmanager
def _reserved(user: Motor) -> Iterator[None]:
    with user.reserve("a clause"):
        yield None


@contextmanager
def _not_armed(motor: Motor) -> Iterator[None]:
    """Let the hook that arms this motor fail, after those before it have been armed."""

    def refuse(*_: object, **__: object) -> Trigger:
        raise LinkError(link=motor.name, reason="refused by a clause")

    setattr(motor, _ARM, refuse)
    try:
        yield None
    finally:
        delattr(motor, _ARM)


@clause(
    "SYNC-05",
    Level.L4,
    needs=_MOVES,
    bench={*_TWO, Ability.CUT, Ability.AFRESH},
    source="MotorGroup.start: if one refuses, none moves",
)
def group_with_lost_member_does_not_move(bench: RigProtocol) -> None:
    """If one member does not answer when it is armed, no member moves, then or later."""
    _require_separate_cables(bench)
    for lost in (1, 0):
        bench.afresh()
        way = 0.5 * half_move(bench)
        group = pair_of(bench, way, -way)
        group.start()
        group.wait_until_done(10.0)  # both motors are now fully set up
        refusing, other = bench.motors[lost], bench.motors[1 - lost]
        before = position_of(bench, other)
        is_one_signal = group.sync_capability().level >= SyncLevel.TRIGGERED
        with bench.cut(refusing):
            if not is_one_signal:  # else the others begin before its loss is known
                rest_for(bench, bench.facts.lost_s)
            error = failure_of(group.start)
            rest_for(bench, bench.facts.lost_s)
        expect(error is not None, f"{refusing.name} does not answer, but start() returned")
        rest_for(bench, 1.0)
        expect_unmoved(bench, other, before, f"{refusing.name} refused: {other.name}")
        _start_alone(bench, refusing)
        expect_unmoved(bench, other, before, f"{refusing.name} refused: later {other.name}")


def _require_separate_cables(bench: RigProtocol) -> None:
    first, second = bench.motors[:2]
    second.enable()
    with bench.cut(first):
        rest_for(bench, bench.facts.lost_s)
        if second.state() is not MotorState.ENABLED:
            raise NotApplicable(f"{second.name} and {first.name} share a cable")


def _start_alone(bench: RigProtocol, motor: Motor) -> None:
    """Start a motion of this motor alone, so that any common start signal is sent again."""
    motor.reset_fault()
    motor.enable()
    way = 0.25 * half_move(bench)
    try:
        follow(motor, smooth_move(motor, way))
    except UnsupportedError:
        move(bench, motor, way)
        return
    finish(bench, motor, 10.0)


@clause(
    "SYNC-06",
    Level.L4,
    needs={*_MOVES, Capability.COMMON_TRIGGER},
    bench={*_TWO, Ability.SILENCE_HOST, Ability.AFRESH},
    source="MotorHooks._arm: in the hardware, confirmed; decision 0010, arm, then fire",
)
def lost_start_frame_moves_all_or_none(bench: RigProtocol) -> None:
    """Whichever frame of a common start is lost, all members move, or none and start() fails."""
    hit, halved = 0, None
    for skip in range(_FRAMES):
        bench.afresh()
        way = half_move(bench)
        group = pair_of(bench, 0.1 * way, -0.1 * way)
        group.start()
        finish_group(bench, group)  # both motors are now fully set up
        group.set_trajectory(*trajectories_of(way, -way))
        before = positions_of(bench, group)
        with bench.silence_host(skip=skip, limit=1) as lost:
            error = failure_of(group.start)
            hit += lost()
        which = f"frame {skip + 1} of the host was lost"
        if error is None:
            finish_group(bench, group)
            expect_group_moved(bench, group, before, (way, -way), which)
            continue
        rest_for(bench, 1.0)
        for motor in group:
            expect_rest(bench, motor, f"{which}, start() failed: {motor.name}")
        ways = zip(before, positions_of(bench, group), strict=True)
        if halved is None and any(abs(now - was) > 0.1 * way for was, now in ways):
            halved = skip
        first, second = bench.motors[:2]
        rested = position_of(bench, first)
        _start_alone(bench, second)
        expect_unmoved(bench, first, rested, f"{which}, start() failed; later, {first.name}")
    reached(hit > 0, "the loss of a frame")
    if halved is not None:
        _expect_failed_start_is_stopped(bench, halved)


def _expect_failed_start_is_stopped(bench: RigProtocol, skip: int) -> None:
    """Expect that a start of which one member fails ends a slow motion of the others, too."""
    bench.afresh()
    way, group = half_move(bench), pair_of(bench, 0.0, 0.0)
    limits = DerivativeLimits(first=_SLOWLY * min(motor.model.velocity_max for motor in group))
    for side in (1.0, -1.0):  # with the first one, both motors are fully set up
        ways = side * way, -side * way
        group.set_trajectory(*(TrapezoidalTrajectory(one, limits=limits) for one in ways))
        with bench.silence_host(skip=skip, limit=1) if side < 0.0 else nullcontext():
            error = failure_of(group.start)
        if side > 0.0:
            finish_group(bench, group)
    rest_for(bench, 0.5)
    for motor in group if error is not None else ():
        what = f"frame {skip + 1} of the host was lost, start() of a slow motion failed"
        expect_rest(bench, motor, f"{what}: {motor.name}")


@clause(
    "SYNC-09",
    Level.L4,
    needs={*_MOVES, Capability.FAULTS},
    bench={*_TWO, Ability.FAULT, Ability.AFRESH},
    source="FaultReaction; requirement 5, synchronised motions",
)
def member_fault_causes_set_reaction(bench: RigProtocol) -> None:
    """If one member fails, the others react as set: stop or continue, also if no caller waits."""
    for reaction, waits in product(FaultReaction, (True, False)):
        bench.afresh()
        way = 3.0 * half_move(bench)
        group = pair_of(bench, way, -way)
        is_together = reaction is FaultReaction.TOGETHER
        group.fault_reaction = reaction
        failing, other = bench.motors[:2]
        waiting = "a caller waits" if waits else "no caller waits"
        what = f"{failing.name} failed with reaction {reaction.name} while {waiting}"
        before = position_of(bench, other)
        try:
            with in_phase(group) if is_together else nullcontext():
                group.start()
        except NotApplicable:
            continue
        rest_for(bench, midway_s(other, way, 0.2))
        bench.fail(failing)
        error = failure_of(partial(group.wait_until_done, 10.0)) if waits else None
        notes = " ".join(getattr(error, "__notes__", ()))
        is_named = f"from {failing.name}" in notes
        expect(is_named or not waits, f"{what}: {error} with the notes {notes!r}")
        for _ in range(_LOOKS):
            rest_for(bench, shortest_s(other, way) / _LOOKS)
            failing.position()  # a host that only polls when asked to notices the fault now
        expect_rest(bench, other, f"{what}: {other.name}")
        made = abs(position_of(bench, other) - before) / abs(way)
        continues = reaction is FaultReaction.NONE
        expect(continues is (made > 0.98), f"{what}: {other.name} made {made:.0%}")
        if not waits:
            error = failure_of(partial(group.wait_until_done, 10.0))
        expect(error is not None, f"{what}, but its group reported done")
    bench.afresh()
    alone = pair_of(bench, 3.0 * half_move(bench))
    alone.start()
    rest_for(bench, midway_s(bench.motor, half_move(bench), 0.2))
    bench.fail(bench.motor)
    error = failure_of(partial(alone.wait_until_done, 10.0))
    expect(error is not None, "the only member of a group failed, but the group reported done")
    told = [note for note in getattr(error, "__notes__", ()) if "others of its group" in note]
    expect(not told, f"the only member of a group failed, and the error tells of others: {told}")
