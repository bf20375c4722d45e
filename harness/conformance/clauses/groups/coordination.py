"""L4: groups as a whole: members, commands, reservations, failures, common stops, deviations."""

import logging
import warnings
from collections.abc import Sequence
from functools import partial
from itertools import permutations, product
from math import hypot
from typing import Any, Final

from motorhil.harness.conformance.bench import Ability, RigProtocol
from motorhil.harness.conformance.clause import Level, NotApplicable, clause, expect
from motorhil.harness.conformance.clauses.helpers import (
    elapsed_s,
    expect_group_moved,
    expect_raises,
    expect_rest,
    expect_unmoved,
    failure_of,
    finish,
    finish_group,
    follow,
    half_move,
    in_phase,
    limits_jerk,
    midway_s,
    pair_of,
    position_of,
    rest_for,
    shortest_s,
    torque_of,
    trajectories_of,
)
from motorhil.harness.conformance.clauses.tracks import GroupPositions, positions_of
from motorhil.harness.rig.config.conformance import Capability
from motorhil.motorapi import (
    ControlMode,
    DerivativeLimits,
    DeviceFault,
    FaultReaction,
    LimitError,
    Measurement,
    Motion,
    Motor,
    MotorBusyError,
    MotorGroup,
    MotorModel,
    MotorState,
    StateError,
    Synchronization,
    SyncQuality,
    TrapezoidalTrajectory,
    UnsupportedError,
    UsageError,
)
from motorhil.motorapi.hooks import implements
from motorhil.motorapi.ownership.physical_motor import register_physical_motor

_TWO = {Ability.TRUTH, Ability.SECOND_MOTOR}
_MOVES = {Capability.POSITION_TRAJECTORY}
_GROUP_S: Final = 10.0
_GROUP_TIMEOUT_S: Final = 0.5
_BRAKES_S: Final = 0.03
_PHASE: Final = Synchronization.PHASE
_STRIKES: Final = 30  # attempts of one frame, a few milliseconds in all; 32 end in bus-off
_LATE_S: Final = 0.004
_CREEPS: Final = 0.001  # of the model's velocity: hardly a motion, but one
_CREEPS_S: Final = 10.0
_UNHEARD: Final = (3, 4, 5)  # frames: the first ones of a stop of two motors
_JAMMED: Final = "its brake is jammed"


@clause(
    "SYNC-13",
    Level.L4,
    needs=_MOVES,
    bench=_TWO,
    source="requirement 5: feedback on the quality; PathDeviation.deviation, largest found",
)
def deviation_from_path_is_reported(bench: RigProtocol) -> None:
    """If one member is stopped, the deviation from the path is reported as large as it was."""
    way = half_move(bench)
    for stopped, ways in ((0, (-0.5 * way, way)), (1, (way, -0.5 * way))):
        duration_s = 4.0 * shortest_s(bench.motor, way)
        group = pair_of(bench, *ways)
        group.set_trajectory(*(TrapezoidalTrajectory(one, duration_s=duration_s) for one in ways))
        track = GroupPositions(bench, group)
        with in_phase(group):
            group.start()
        late, begun_ns = group[stopped], bench.runtime.now_ns()
        rest_for(bench, 0.25 * duration_s)
        late.stop()
        finish(bench, late)
        rest_for(bench, 0.2 * duration_s)
        left = ways[stopped] - position_of(bench, late) + track.samples[0][1][stopped]
        follow(late, TrapezoidalTrajectory(left))  # it is at its target before the other one
        while elapsed_s(bench, begun_ns) < duration_s + 0.2:
            rest_for(bench, 0.02)
            for motor in group:
                motor.position()  # a host that only polls when asked to hears of them now
        track.end()
        path = group.sync_quality().path
        names = [one.motor for one in path]
        expect(names == [motor.name for motor in group], f"deviations of {names}")
        square = ways[0] ** 2 + ways[1] ** 2
        begun = track.samples[0][1]
        for place, one in enumerate(path):
            worst = 0.0
            for _, positions in track.samples:
                gone = [at - was for at, was in zip(positions, begun, strict=True)]
                part = (gone[0] * ways[0] + gone[1] * ways[1]) / square
                worst = max(worst, abs(gone[place] - part * ways[place]))
            if one.deviation is None or one.age_s is None:
                expect(one.deviation is None and bool(one.source), f"{one}: no reason")
                continue
            expect(bool(one.source), f"{one}: no source")
            late_s = bench.facts.latency_s[1] + 0.01 + one.age_s
            expect(one.age_s <= 0.1, f"{one}: compared {one.age_s} s from a sample")
            spare = 2.0 * bench.facts.following + late_s * bench.motor.model.velocity_max
            expect(
                abs(one.deviation - worst) <= spare,
                f"{one.motor}: deviation {one.deviation:.6g} reported; {worst:.6g} measured",
            )
    is_able = {Ability.FAULT, Ability.LOAD} <= set(bench.abilities)
    if is_able and len(bench.motors) > 2 and bench.motors[1].model.torque_max is not None:
        _expect_deviation_after_failure(bench)


def _expect_deviation_after_failure(bench: RigProtocol) -> None:
    """Check that the deviation of two members is reported that brake after a third has failed."""
    way = half_move(bench)
    ways = (2.0 * way, -0.3 * way, way)
    group = pair_of(bench, *ways)
    group.synchronization = _PHASE
    group.fault_reaction = FaultReaction.TOGETHER
    try:
        group.start()
    except UnsupportedError:  # they cannot stop together
        return
    first, second, failing = group
    track = GroupPositions(bench, (first, second))
    rest_for(bench, midway_s(bench.motor, 2.0 * way, 0.5))
    bench.fail(failing)
    rest_for(bench, _BRAKES_S)
    for load in (torque_of(second, 1.5), 0.0):
        bench.load(second, load)
        rest_for(bench, _BRAKES_S)
    error = failure_of(partial(group.wait_until_done, _GROUP_S))
    expect(error is not None, f"{failing.name} failed, but its group reported done")
    rest_for(bench, 2.0 * first.model.velocity_max / first.model.deceleration)
    track.end()
    square = ways[0] ** 2 + ways[1] ** 2
    begun, worst = track.samples[0][1], 0.0
    for _, positions in track.samples:
        gone = [at - was for at, was in zip(positions, begun, strict=True)]
        part = (gone[0] * ways[0] + gone[1] * ways[1]) / square
        worst = max(worst, abs(gone[1] - part * ways[1]))
    told = group.sync_quality().path[1].deviation
    expect(
        told is None or worst <= 3.0 * bench.facts.window or told >= 0.5 * worst,
        f"{second.name}, loaded while it braked with {first.name} after {failing.name} had failed:"
        f" deviation {told:.6g} reported; {worst:.6g} measured",
    )


@clause(
    "SYNC-14",
    Level.L4,
    needs=_MOVES,
    bench={*_TWO, Ability.SEVERAL_USERS},
    source="MotorGroup: members, commands and settings; UsageError, nothing was sent",
)
def impossible_groups_are_refused(bench: RigProtocol) -> None:
    """A group refuses members, commands and settings that it cannot have, and does not move."""
    first, second = bench.motors[:2]
    way, empty = half_move(bench), MotorGroup()
    group: Any = pair_of(bench, way, way)
    for what, operation in (
        ("start of an empty group", empty.start),
        ("wait for an empty group", empty.wait_until_done),
        ("the same motor again", partial(group.append, first)),
        ("another user of a member", partial(group.append, bench.another_user_of(first))),
        ("no motor", partial(group.append, 1)),
        ("a motor that is no member", partial(MotorGroup(first).remove, second)),
        ("an unknown synchronization", partial(setattr, group, "synchronization", "time")),
        ("an unknown reaction", partial(setattr, group, "fault_reaction", "each")),
        ("the quality of a group that was not started", group.sync_quality),
        ("an unknown level", partial(group.start, require=1)),
        ("a negative skew", partial(group.start, max_skew_s=-1e-9)),
        ("a negative timeout", partial(group.start, -1.0)),
        ("what is not callable", partial(group.for_each, "enable")),
    ):
        expect_raises(UsageError, operation, f"{what} was accepted")
    expect([one.name for one in group] == [first.name, second.name], f"members: {group!r}")
    expect(group[1] is second and len(group) == 2, f"members: {group!r}")
    expect(repr(group) == f"<MotorGroup of 2: {first.name}, {second.name}>", f"shown as {group!r}")
    names = group.for_each(lambda motor: motor.name)
    expect(names == [first.name, second.name], f"results of for_each(): {names}")
    before = positions_of(bench, group)
    for ways in ((way,), (way, way, way), (way, 2.0 * (first.model.position_max or 1e9))):
        group.set_trajectory(*trajectories_of(way, way))
        lists = trajectories_of(*ways)
        if len(ways) == 2:
            lists[1] = TrapezoidalTrajectory(way, duration_s=1e-9)
        expect_raises(UsageError, partial(group.set_trajectory, *lists), f"{ways} was accepted")
        for motor in group:
            expect_raises(StateError, motor.start, f"{motor.name}: its old command was kept")
    _expect_durations(bench, group, way)
    error = failure_of(partial(group.for_each, Motor.set_setpoint, 1.0))
    notes = "" if error is None else " ".join(error.__notes__)
    expect(f"from {first.name}, member 1 of 2" in notes, f"for_each() failed with {error}: {notes}")
    for motor, was in zip(group, before, strict=True):
        expect_unmoved(bench, motor, was, f"{motor.name}, after its group was refused")
    if Ability.AFRESH in bench.abilities:
        former = MotorGroup(first)
        bench.afresh()
        refused = partial(former.append, bench.motors[1])
        expect_raises(UsageError, refused, "a motor of another runtime was accepted")


def _expect_durations(bench: RigProtocol, group: MotorGroup, way: float) -> None:
    """Check durations that the members cannot have together, and settings without PHASE."""
    first, second = group
    enough_s = 2.0 * shortest_s(first, way)
    group.set_trajectory(
        TrapezoidalTrajectory(way, duration_s=enough_s),
        TrapezoidalTrajectory(way, duration_s=1.5 * enough_s),
    )
    group.synchronization = Synchronization.TIME
    error = failure_of(group.start)
    expect(isinstance(error, UsageError) and "differ" in str(error), f"two durations: {error}")
    slow = DerivativeLimits(first=0.2 * second.model.velocity_max)
    for synchronization in (Synchronization.TIME, _PHASE):
        group.synchronization = synchronization
        group.set_trajectory(
            TrapezoidalTrajectory(way, duration_s=enough_s),
            TrapezoidalTrajectory(4.0 * way, limits=slow),
        )
        error = failure_of(group.start)
        if isinstance(error, UnsupportedError) and limits_jerk(group):
            continue
        expect(isinstance(error, LimitError), f"too short for {second.name}: {error}")
        told = str(error)
        expect(second.name in told and first.name in told, f"{synchronization.name}: {told}")
        low = error.low if isinstance(error, LimitError) and error.low is not None else 0.0
        least_s = 4.0 * way / (0.2 * second.model.velocity_max)
        expect(0.9 * least_s <= low <= 2.0 * least_s, f"{told}: at least {least_s:g} s needed")
    group.fault_reaction = FaultReaction.TOGETHER
    group.synchronization = Synchronization.TIME
    group.set_trajectory(*trajectories_of(way, way))
    expect_raises(UsageError, group.start, "TOGETHER was accepted without PHASE")
    group.synchronization = _PHASE
    first.set_control_mode(ControlMode.SETPOINT)
    first.set_setpoint(0.1 * way, relative=True)
    expect_raises(UnsupportedError, group.start, "a set-point was accepted on a straight line")
    group.fault_reaction = FaultReaction.EACH
    first.set_control_mode(ControlMode.TRAJECTORY)
    group.set_trajectory(*trajectories_of(way, way))


@clause(
    "SYNC-15",
    Level.L4,
    needs=_MOVES,
    bench={*_TWO, Ability.SEVERAL_USERS},
    source="MotorGroup.reserve: all motors or none; Reservation",
)
def group_reserves_all_or_none(bench: RigProtocol) -> None:
    """A reservation of a group has all members for its block, or none of them."""
    first, second = bench.motors[:2]
    group = MotorGroup(first, second)
    others = [bench.another_user_of(motor) for motor in group]
    with MotorGroup(second).reserve("alone") as alone:
        expect(alone.names == (second.name,), f"a group of one: {alone!r}")
    with group.reserve("survey", timeout_s=1.0, lease_s=5.0) as reservation:
        expect(reservation.is_held and reservation.lost_to is None, f"{reservation!r}")
        expect(set(reservation.names) == {first.name, second.name}, f"{reservation!r}")
        expect(
            repr(reservation) == f"<Reservation of {', '.join(reservation.names)}: held>",
            f"shown as {reservation!r}",
        )
        tokens = tuple(one.token for one in reservation.members)
        names = tuple(one.names[0] for one in reservation.members)
        expect((tokens, names) == (reservation.tokens, reservation.names), f"{reservation!r}")
        expect(reservation.token == tokens[0], f"token {reservation.token} of {tokens}")
        expect([one.lease_s for one in reservation.claims] == [5.0, 5.0], "not its lease")
        for _ in range(2):
            rest_for(bench, 4.0)
            reservation.renew()
        for other in others:
            error = failure_of(other.enable)
            expect(isinstance(error, MotorBusyError), f"{other.name}: {error}; expected a refusal")
    expect(not reservation.is_held and reservation.lost_to is None, f"given back: {reservation!r}")
    expect("given back" in repr(reservation), f"shown as {reservation!r}")
    for place in (0, 1):
        with others[place].reserve("lunch"):
            for timeout_s in (None, 0.25):
                begun_ns = bench.runtime.now_ns()
                error = failure_of(group.reserve("survey", timeout_s=timeout_s).__enter__)
                waited_s = (bench.runtime.now_ns() - begun_ns) / 1e9
                expect(isinstance(error, MotorBusyError) and "lunch" in str(error), f"{error}")
                late_s = waited_s - (timeout_s or 0.0)
                expect(0.0 <= late_s <= bench.facts.time_tolerance_s, f"refused after {waited_s} s")
            others[1 - place].enable()
    _expect_one_timeout(bench, group, others)
    with group.reserve("survey") as reservation, others[1].reserve("fire", take_over=True):
        expect(not reservation.is_held, "held, although one member was taken over")
        by = reservation.lost_to or ""
        expect(others[1].name in by and "lost to" in repr(reservation), f"{reservation!r}: {by}")
        expect_raises(MotorBusyError, reservation.renew, "a lost reservation was renewed")
        expect([one.is_held for one in reservation.members].count(True) == 1, "not one is left")


def _expect_one_timeout(bench: RigProtocol, group: MotorGroup, others: Sequence[Motor]) -> None:
    """Check that the timeout of a reservation is for the group, not for each of its members."""
    for first, second in permutations(others):
        with second.reserve("lunch"):
            party = bench.runtime.spawn("break", partial(_reserve_for, bench, first))
            rest_for(bench, 0.1 * _GROUP_TIMEOUT_S)
            begun_ns = bench.runtime.now_ns()
            error = failure_of(group.reserve("survey", timeout_s=_GROUP_TIMEOUT_S).__enter__)
            waited_s = (bench.runtime.now_ns() - begun_ns) / 1e9
        expect(party.join(_GROUP_S) and party.error is None, f"{first.name}: {party.error}")
        expect(isinstance(error, MotorBusyError), f"one member was never free: {error}")
        late_s = waited_s - _GROUP_TIMEOUT_S
        expect(
            0.0 <= late_s <= bench.facts.time_tolerance_s,
            f"reserve(timeout_s={_GROUP_TIMEOUT_S:g}) of a group was refused after {waited_s:g} s",
        )


def _reserve_for(bench: RigProtocol, motor: Motor) -> None:
    """Hold a motor for the larger part of the timeout."""
    with motor.reserve("break"):
        rest_for(bench, 0.7 * _GROUP_TIMEOUT_S)


@clause(
    "SYNC-16",
    Level.L4,
    needs={*_MOVES, Capability.FAULTS},
    bench={*_TWO, Ability.FAULT, Ability.AFRESH},
    source="MotorGroup.fault_reaction: a caller that waits for the group gets the cause",
)
def failure_of_single_start_stops_group(bench: RigProtocol) -> None:
    """If members were started one by one, a wait for the group reacts to a failure, by name."""
    for reaction, fails in product((FaultReaction.EACH, FaultReaction.NONE), (0, 1)):
        bench.afresh()
        group = MotorGroup(*bench.motors[:2])
        group.fault_reaction = reaction
        way = half_move(bench)
        duration_s = 8.0 * shortest_s(bench.motor, way)  # a start of some drives takes long
        failing, other = group[fails], group[1 - fails]
        before = position_of(bench, other)
        for motor in group:
            follow(motor, TrapezoidalTrajectory(way, duration_s=duration_s))
        rest_for(bench, 0.1 * duration_s)
        bench.fail(failing)
        error = failure_of(partial(group.wait_until_done, _GROUP_S))
        what = f"{failing.name} failed with reaction {reaction.name}"
        notes = " ".join(getattr(error, "__notes__", ()))
        expect(error is not None, f"{what}, but its group reported done")
        stops = reaction is FaultReaction.EACH
        named = f"from {failing.name}" in notes
        expect(named is stops, f"{what}: {error} with the notes {notes!r}")
        rest_for(bench, 1.1 * duration_s)
        made = abs(position_of(bench, other) - before) / abs(way)
        expect(stops is (made < 0.98), f"{what}: {other.name} made {made:.0%}")


@clause(
    "SYNC-17",
    Level.L4,
    needs=_MOVES,
    bench=_TWO,
    source="FaultReaction.TOGETHER: with it, stop() of the group follows the path, too",
)
def common_stop_stays_on_path(bench: RigProtocol) -> None:
    """A stop of a group whose members stop together keeps all on their straight line."""
    way = half_move(bench)
    ways = (2.0 * way, -0.6 * way)
    group = pair_of(bench, *ways)
    group.synchronization = _PHASE
    group.fault_reaction = FaultReaction.TOGETHER
    track = GroupPositions(bench, group)
    try:
        group.start()
    except UnsupportedError as error:
        raise NotApplicable(f"its motors cannot stop together: {error}") from None
    rest_for(bench, midway_s(bench.motor, 2.0 * way, 0.3))
    group.stop()
    group.wait_until_done(_GROUP_S)
    track.end()
    made = []
    for motor, was, its in zip(group, track.samples[0][1], ways, strict=True):
        expect_rest(bench, motor, f"after stop() of its group, {motor.name}")
        made.append((position_of(bench, motor) - was) / its)
        expect(0.0 < made[-1] < 0.98, f"{motor.name} made {made[-1]:.0%} of its way")
    first, second = track.samples[0][1]
    worst = max(
        abs((a - first) * ways[1] - (b - second) * ways[0]) / hypot(*ways)
        for _, (a, b) in track.samples
    )
    late_s = bench.facts.latency_s[1] - bench.facts.latency_s[0]
    skew_s = late_s + (group.sync_capability().start_skew_s or late_s) + 0.002
    allowed = 3.0 * bench.facts.following + skew_s * bench.motor.model.velocity_max
    expect(worst <= allowed, f"stopped together, but {worst:.6g} off the line; limit {allowed:.6g}")
    group.for_each(Motor.disable)
    group.stop()  # nobody has to brake
    group.wait_until_done(_GROUP_S)
    before = positions_of(bench, group)
    further = 0.2 * way, -0.1 * way
    group.set_trajectory(*trajectories_of(*further))
    group.start()
    finish_group(bench, group)
    expect_group_moved(bench, group, before, further, "after it was stopped")
    if {Ability.BUS_ERRORS, Ability.AFRESH}.issubset(bench.abilities):
        _expect_one_stop_signal(bench)
    if {Ability.SILENCE_HOST, Ability.AFRESH}.issubset(bench.abilities):
        for unheard in _UNHEARD if bench.facts.repeats_stops else ():
            _expect_true_stop_of_creepers(bench, unheard)


def _expect_true_stop_of_creepers(bench: RigProtocol, unheard: int) -> None:
    """Expect motors that creep to rest once a common stop without its first frames is over."""
    bench.afresh()
    way = _CREEPS * _CREEPS_S * min(one.model.velocity_max for one in bench.motors[:2])
    group = pair_of(bench, way, way)
    group.synchronization = _PHASE
    group.fault_reaction = FaultReaction.TOGETHER
    group.set_trajectory(*(TrapezoidalTrajectory(way, duration_s=_CREEPS_S) for _ in group))
    if failure_of(group.start) is not None:  # they have no such motion
        return
    rest_for(bench, 0.1 * _CREEPS_S)
    with bench.silence_host(limit=unheard):
        error = failure_of(group.stop, partial(group.wait_until_done, 0.1 * _CREEPS_S))
    if error is not None:
        return
    before = positions_of(bench, group)
    rest_for(bench, 0.3 * _CREEPS_S)
    for motor, was in zip(group, before, strict=True):
        what = f"{motor.name}, whose stop without its first {unheard} frames was over"
        expect_unmoved(bench, motor, was, what)


def _expect_one_stop_signal(bench: RigProtocol) -> None:
    """Expect one signal to stop all members, if their hooks say so, whichever frame is late.

    The members change places for a second stop, so that a difference of the motors cancels out.
    """
    if not all(implements(motor, "_stop_with_others") for motor in bench.motors[:2]):
        return
    late = []
    for order in (1, -1):
        bench.afresh()
        found = _late_at_stop(bench, MotorGroup(*bench.motors[:2][::order]), order)
        if found is None:
            return  # a slow bus: a stop does not wait for so long
        late.append(found)
    model, (early_s, late_s) = bench.motor.model, bench.facts.latency_s
    spare = 0.5 * (late_s - early_s) * model.velocity_max + bench.facts.following
    expect(
        0.5 * sum(late) <= spare,
        f"one signal stops all members, but the second one, whose frame is late, goes on for"
        f" {0.5 * sum(late):.6g} {model.unit}; limit {spare:.6g} {model.unit}",
    )


def _late_at_stop(bench: RigProtocol, group: MotorGroup, order: int) -> float | None:
    """Stop a group while the frames of its second member are repeated.

    Returns:
        How far this member moves on beyond its share of the way [U], or None if the frames take
        longer than a stop waits for them.
    """
    way = order * half_move(bench)
    ways = (-1.2 * way, 4.0 * way)
    group.for_each(Motor.set_control_mode, ControlMode.TRAJECTORY)
    group.set_trajectory(*trajectories_of(*ways))
    group.synchronization, group.fault_reaction = _PHASE, FaultReaction.TOGETHER
    before = [position_of(bench, motor) for motor in group]
    group.start()
    rest_for(bench, midway_s(group[1], ways[1], 0.4))
    with bench.strike(None, _STRIKES, skip=1) as struck:
        group.stop()
        is_soon = bench.runtime.wait_until(lambda: struck() >= _STRIKES, _LATE_S)
        group.wait_until_done(_GROUP_S)
    first, second = (
        (position_of(bench, motor) - was) / its
        for motor, was, its in zip(group, before, ways, strict=True)
    )
    return (second - first) * abs(ways[1]) if is_soon else None


@clause(
    "SYNC-18",
    Level.L4,
    needs=_MOVES,
    bench=_TWO,
    source="requirement 5: feedback on the quality; MotorGroup.observe",
)
def observer_gets_each_quality(bench: RigProtocol) -> None:
    """After each wait for a start, its observer gets the quality."""
    way = 0.25 * half_move(bench)
    told: list[SyncQuality] = []
    group = pair_of(bench, way, 0.0)
    group.observe(told.append)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # it warns that nothing was started
        group.wait_until_done(_GROUP_S)
    expect(not told, "told of a group that was not started")
    before = positions_of(bench, group)
    group.start()
    finish_group(bench, group)
    expect_group_moved(bench, group, before, (way, 0.0), "observed")
    expect(len(told) == 1, f"told {len(told)} times of one start")
    (one,) = told
    expect([name for name, _ in one.times] == [motor.name for motor in group], f"{one}")
    expect(one.start_skew_s in (0.0, None), f"one of two members has a way: {one}")
    expect(one.predicted_end_skew_s == 0.0, f"one of two members ends: {one}")
    expect(one.path == (), f"a path without PHASE: {one}")
    group.observe(_refuse)
    what = "its observer raised an error, but the wait returned"
    expect_raises(UsageError, partial(group.wait_until_done, _GROUP_S), what)


def _refuse(quality: SyncQuality) -> None:
    raise UsageError(f"an observer does not like {quality}")


class _Stubborn(Motor):
    """A motor without a drive, which takes a command, never arrives, and cannot be stopped."""

    def __init__(self, name: str, bench: RigProtocol) -> None:
        self._state = MotorState.DISABLED
        self._error: DeviceFault | None = None
        super().__init__(
            name=name,
            model=MotorModel(velocity_max=1.0, acceleration_max=1.0),
            runtime=bench.runtime,
            physical=register_physical_motor(bench.runtime, name, name, self),
        )

    def fail(self) -> None:
        """End its motion by a fault."""
        self._error = DeviceFault(motor=self.name, code=1, text="of a clause", since_ns=0)

    def _connect(self) -> None:
        """There is nothing to connect to."""

    def _enable(self) -> None:
        self._state = MotorState.ENABLED

    def _disable(self) -> None:
        self._state = MotorState.DISABLED

    def _latest(self) -> Measurement:
        return Measurement(self.runtime.now_ns(), self._state, 0.0, 0.0)

    def _command(self, motion: Motion) -> None:
        """Do nothing: this motor does not move."""

    def _is_done(self) -> bool:
        if self._error is not None:
            raise self._error
        return False

    def _stop(self) -> None:
        raise ValueError(_JAMMED)


@clause("SYNC-24", Level.L4, source="FaultReaction; errors, notes: who could not be stopped, why")
def member_that_cannot_be_stopped_is_named(bench: RigProtocol) -> None:
    """If the reaction to a failure cannot stop a member, error and log name it, and the reason."""
    failing, stubborn = (_Stubborn(name, bench) for name in ("failing", "stubborn"))
    group = MotorGroup(failing, stubborn)
    group.for_each(Motor.set_control_mode, ControlMode.TRAJECTORY)
    group.set_trajectory(*trajectories_of(1.0, 1.0))
    logged: list[str] = []

    def is_shown(record: logging.LogRecord) -> bool:
        """Return whether a message of the log is another one than that of this clause's error."""
        logged.append(record.getMessage())
        return _JAMMED not in logged[-1]

    log = logging.getLogger("motorapi")
    log.addFilter(is_shown)
    try:
        group.start()
        failing.fail()
        error = failure_of(partial(group.wait_until_done, _GROUP_TIMEOUT_S))
    finally:
        log.removeFilter(is_shown)
    expect(isinstance(error, DeviceFault), f"the failure of {failing.name}: {error!r}")
    notes = getattr(error, "__notes__", [])
    for what, told in (("notes", notes), ("log", logged)):
        found = [one for one in told if f"{stubborn.name} could not be stopped" in one]
        is_told = any(_JAMMED in one for one in found) or not log.isEnabledFor(logging.ERROR)
        expect(is_told, f"{stubborn.name} could not be stopped; the {what}: {told}")
