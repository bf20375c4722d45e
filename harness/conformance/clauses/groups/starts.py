"""L4: starts and ends of synchronised groups, their quality, and operations on all members."""

from contextlib import suppress
from functools import partial
from math import inf, sqrt

from motorhil.harness.conformance.bench import Ability, RigProtocol
from motorhil.harness.conformance.clause import Level, clause, expect
from motorhil.harness.conformance.clauses.helpers import (
    FINE_S,
    braking_distance,
    elapsed_s,
    expect_group_moved,
    expect_moved,
    expect_raises,
    expect_rest,
    expect_unmoved,
    failure_of,
    finish,
    finish_group,
    follow,
    half_move,
    midway_s,
    pair_of,
    position_of,
    reached,
    rest_for,
    shortest_s,
    smooth_move,
    speed,
    torque_of,
    trajectories_of,
)
from motorhil.harness.conformance.clauses.tracks import (
    BEGUN,
    GroupPositions,
    positions_of,
    sampling_error_s,
    when_made_s,
)
from motorhil.harness.rig.config.conformance import Capability
from motorhil.harness.rig.config.toml import RigError
from motorhil.motorapi import (
    ComplexTrajectory,
    ControlMode,
    ControlVariable,
    Motor,
    MotorGroup,
    SyncCapability,
    Synchronization,
    SynchronizationError,
    SyncLevel,
    SyncQuality,
    TrapezoidalTrajectory,
    UnsupportedError,
    UsageError,
)
from motorhil.motorapi.synchronization.bus_load import (
    CanTraffic,
    declare_traffic,
    declared_traffic,
)

_STREAMS_S = 0.2
_ON_A_BUSY_BUS_S = 0.002  # of undeclared messages
_PERIOD, _HEARD = "set_point_period_ms", "status_period_ms"
_OFTEN_MS = 2
_ROUNDING_S = 1e-6
_STRIKES = 30  # attempts of one frame, a few milliseconds in all; 32 end in bus-off
_TWO = {Ability.TRUTH, Ability.SECOND_MOTOR}
_MOVES = {Capability.POSITION_TRAJECTORY}
_ENDED = 1.0 - BEGUN
_WATCHED_S = 0.2
_LEVELS = ("SEQUENTIAL", "TRIGGERED", "CYCLIC")
_STREAMED_S = 20.0
_SPEED_S = 0.02
_FAST_BIT_S = 1_000_000
_FRAMES_S = 0.02
_SLOWLY = 0.1  # of the largest velocity
_FIRST = 0.01  # of a streamed move: it has begun
_LITTLE = 0.05  # of the largest torque
_FAR = 1e-6  # U: two skews that are not meant to differ


@clause(
    "SYNC-01",
    Level.L4,
    needs=_MOVES,
    bench=_TWO,
    source="requirement 5 of the paper; 3.4, Algorithm 2",
)
def group_starts_and_ends_together(bench: RigProtocol) -> None:
    """All members begin within the reported bound, and end together, at their targets."""
    way = half_move(bench)
    ways = (way, -way)
    group = pair_of(bench, *ways)
    before = positions_of(bench, group)
    predicted = group.sync_capability()
    track = GroupPositions(bench, group)
    group.start()
    finish_group(bench, group)
    track.end()
    expect_group_moved(bench, group, before, ways, "after Algorithm 2")
    tolerance_s = bench.facts.time_tolerance_s
    begun_s = tolerance_s if predicted.start_skew_s is None else predicted.start_skew_s
    ended_s = tolerance_s if predicted.end_skew_s is None else predicted.end_skew_s
    error_s = sampling_error_s(bench, way, BEGUN)
    for share, bound_s, what in ((BEGUN, begun_s, "began"), (_ENDED, ended_s, "ended")):
        skew_s = track.skew_s(share, ways)
        expect(skew_s is not None, f"not all members {what}")
        expect(
            (skew_s or 0.0) <= bound_s + error_s,
            f"members {what} {skew_s} s apart; predicted at most {bound_s:g} s,"
            f" measurement error {error_s:.6f} s",
        )


@clause(
    "SYNC-02",
    Level.L4,
    needs=_MOVES,
    bench=_TWO,
    source="requirement 5 of the paper: feedback on the quality of synchronization",
)
def sync_quality_is_as_measured(bench: RigProtocol) -> None:
    """Each member's start and end, and the skew, are reported as they were, or not at all."""
    way = half_move(bench)
    ways = (way, -way)
    group = pair_of(bench, *ways)
    expect_raises(
        UsageError, group.sync_quality, "sync_quality() returned a value before the first start"
    )
    before = [motor.logical.hooks.motion_times() for motor in group]
    track = GroupPositions(bench, group)
    group.start()
    finish_group(bench, group)
    track.end()
    quality = group.sync_quality()
    for (name, after), was in zip(quality.times, before, strict=True):
        expect(
            was is None or after is not None,
            f"{name}: before a motion, its times are told as {was}; after it, as {after}",
        )
    seen_s = track.skew_s(BEGUN, ways) or 0.0
    error_s = sampling_error_s(bench, way, BEGUN) + bench.facts.latency_s[1]
    expect(
        quality.start_skew_s is None or abs(quality.start_skew_s - seen_s) <= error_s,
        f"start skew: {quality.start_skew_s} s reported; {seen_s:.6f} s measured",
    )
    _expect_true_times(bench, quality, track, ways)
    _expect_times_of_each_start(bench, group, quality, way)


def _expect_times_of_each_start(
    bench: RigProtocol, group: MotorGroup, first: SyncQuality, way: float
) -> None:
    """Check that no time of one start is told as that of the next, after a stop likewise."""
    group.set_trajectory(*trajectories_of(-way, way))
    group.start()
    rest_for(bench, midway_s(bench.motor, way, 0.3))
    _expect_ends_after_starts(group, "in the second motion")
    group.stop()
    finish_group(bench, group)
    _expect_ends_after_starts(group, "after a stop of the second motion")
    group.start()
    finish_group(bench, group)
    for (name, was), (_, times) in zip(first.times, group.sync_quality().times, strict=True):
        if was is not None and was.ended_ns is not None:
            expect(
                times is not None and times.ended_ns is not None,
                f"{name}: the end of the first motion is reported, that of the third is not",
            )


def _expect_ends_after_starts(group: MotorGroup, when: str) -> None:
    """Check that no member reports an end before its start."""
    for name, times in group.sync_quality().times:
        if times is None or times.started_ns is None or times.ended_ns is None:
            continue
        expect(
            times.ended_ns >= times.started_ns,
            f"{name}, {when}: the end is reported at {times.ended_ns / 1e9:.6f} s, before the start"
            f" at {times.started_ns / 1e9:.6f} s",
        )


def _expect_true_times(
    bench: RigProtocol, quality: SyncQuality, track: GroupPositions, ways: tuple[float, ...]
) -> list[float]:
    """Check each member's reported start and end against its motion; return the true ends [ns]."""
    expect(len(quality.times) == len(ways), f"times of {len(quality.times)} motors reported")
    ends_ns = []
    for member, (name, times) in enumerate(quality.times):
        way = ways[member]
        begin_s, end_s = (when_made_s(bench.motors[member], way, one) for one in (BEGUN, _ENDED))
        left_s = shortest_s(bench.motors[member], way) - end_s
        begun_ns = (track.when(member, BEGUN, way) or 0.0) - 1e9 * begin_s
        ends_ns.append((track.when(member, _ENDED, way) or 0.0) + 1e9 * left_s)
        error_s = sampling_error_s(bench, way, BEGUN) + max(map(abs, bench.facts.latency_s))
        late_s = error_s + bench.facts.time_tolerance_s
        if times is None:
            continue
        for what, reported_ns, true_ns, most_s in (
            ("start", times.started_ns, begun_ns, error_s),
            ("end", times.ended_ns, ends_ns[member], late_s),
        ):
            off_s = 0.0 if reported_ns is None else (reported_ns - true_ns) / 1e9
            expect(
                -error_s <= off_s <= most_s,
                f"{name}: {what} reported {off_s:.6f} s after that of the motion, which was at"
                f" {true_ns / 1e9:.6f} s; expected {-error_s:.6f} to {most_s:.6f} s",
            )
    return ends_ns


@clause(
    "SYNC-10",
    Level.L4,
    needs=_MOVES,
    bench=_TWO,
    source="requirement 5 of the paper: feedback on the quality; SyncQuality.end_skew_s",
)
def unequal_ends_are_reported(bench: RigProtocol) -> None:
    """If members end apart, their ends and the end skew are reported as they were, or not."""
    way = half_move(bench)
    ways = (0.4 * way, -4.0 * way)
    group = pair_of(bench, *ways)
    group.synchronization = Synchronization.NONE
    track = GroupPositions(bench, group)
    group.start()
    finish_group(bench, group)
    rest_for(bench, bench.facts.time_tolerance_s)
    track.end()
    quality = group.sync_quality()
    ends_ns = _expect_true_times(bench, quality, track, ways)
    true_s = (max(ends_ns) - min(ends_ns)) / 1e9
    most_s = bench.facts.time_tolerance_s + sampling_error_s(bench, ways[0], BEGUN)
    reached(true_s > most_s, f"members that end more than {most_s:.3f} s apart")
    for what, found_s in (
        ("measured", quality.end_skew_s),
        ("predicted", quality.predicted_end_skew_s),
    ):
        expect(
            found_s is None or abs(found_s - true_s) <= most_s,
            f"end skew: {found_s} s {what}; the motors ended {true_s:.6f} s apart",
        )
    _expect_ends_of_torques(bench, group)


def _expect_ends_of_torques(bench: RigProtocol, group: MotorGroup) -> None:
    """Expect the ends of torque ramps to be predicted as far apart as the ramps say."""
    torque, durations_s = ControlVariable.TORQUE, (0.2, 0.5)
    if any(one.model.torque_max is None for one in group):
        return
    try:
        group.for_each(Motor.set_control_mode, ControlMode.TRAJECTORY, torque)
        group.set_trajectory(
            *(
                TrapezoidalTrajectory(torque_of(one, _LITTLE), duration_s=lasts_s)
                for one, lasts_s in zip(group, durations_s, strict=True)
            )
        )
        group.start()
    except UnsupportedError:
        return
    found_s = group.sync_quality().predicted_end_skew_s
    group.stop()
    finish_group(bench, group)
    wanted_s = durations_s[1] - durations_s[0]
    expect(
        abs(found_s - wanted_s) <= bench.facts.time_tolerance_s,
        f"torque ramps of {durations_s} s: end skew of {found_s:g} s predicted",
    )


@clause(
    "SYNC-11",
    Level.L4,
    needs={*_MOVES, Capability.COMMON_TRIGGER},
    bench={*_TWO, Ability.AFRESH},
    source="SyncLevel.TRIGGERED: one signal starts all motors; SyncCapability.command_skew_s",
)
def common_signal_starts_all_at_once(bench: RigProtocol) -> None:
    """If one signal starts all, the order of the members does not matter: none has a lead."""
    (ahead_s, most_s), (behind_s, _) = _lead_s(bench, 1), _lead_s(bench, -1)
    lead_s = 0.5 * (ahead_s + behind_s)  # a difference of the motors cancels out
    expect(
        abs(lead_s) <= most_s,
        f"one signal is claimed, but in either order the first member began {lead_s:.6f} s before"
        f" the second; expected at most {most_s:.6f} s",
    )


def _lead_s(bench: RigProtocol, order: int) -> tuple[float, float]:
    """Start equal moves of two motors, set up already, in this order.

    Returns:
        The lead of the first member, and the largest lead of motors that one signal starts [s].
    """
    bench.afresh()
    way = half_move(bench)
    group = MotorGroup(*bench.motors[:2][::order])
    group.for_each(Motor.set_control_mode, ControlMode.TRAJECTORY)
    group.set_trajectory(*trajectories_of(0.1 * way, 0.1 * way))
    group.start()
    finish_group(bench, group)
    group.set_trajectory(*trajectories_of(way, way))
    early_s, late_s = bench.facts.latency_s
    most_s = (group.sync_capability().command_skew_s or 0.0) + late_s - early_s + 0.5 * FINE_S
    track = GroupPositions(bench, group)
    group.start()
    finish_group(bench, group)
    track.end()
    apart = group.sync_quality().straddles
    expect(apart == 0, f"started by one signal, but {apart} signals are told between the commands")
    first, second = (track.when(member, BEGUN, way) for member in (0, 1))
    expect(first is not None and second is not None, "not all members began")
    return ((second or 0.0) - (first or 0.0)) / 1e9, most_s


@clause(
    "SYNC-19",
    Level.L4,
    needs={Capability.COMPLEX_POSITION},
    bench=_TWO,
    source="requirement 5 of the paper; Motor.stop: one motor of a group alone may be stopped",
)
def streamed_group_is_timed_and_stopped(bench: RigProtocol) -> None:
    """The starts of streamed members are told as they were; one can be stopped, and stays there."""
    first, second = bench.motors[:2]
    way = half_move(bench)
    group = MotorGroup(first, second)
    group.for_each(Motor.set_control_mode, ControlMode.TRAJECTORY)
    ways = (way, -way)
    group.set_trajectory(*_streams(group, ways))
    before, track = positions_of(bench, group), GroupPositions(bench, group)
    group.start()
    group.wait_until_done(_STREAMED_S)
    rest_for(bench, _WATCHED_S)
    track.end()
    expect_group_moved(bench, group, before, ways, "streamed together")
    _expect_told_starts(bench, group, track, ways)
    group.set_trajectory(*_streams(group, (-2.0 * way, 2.0 * way)))
    begun = positions_of(bench, group)
    group.start()
    rest_for(bench, midway_s(first, 2.0 * way, 0.5))
    velocity, stopped_at = speed(bench, first, _SPEED_S), position_of(bench, first)
    first.stop()
    finish(bench, first)
    held = position_of(bench, first)
    least = 0.5 * braking_distance(first, velocity)
    most = 2.4 * least + abs(velocity) * (bench.facts.latency_s[1] + _SPEED_S)
    expect(
        least <= abs(held - stopped_at) <= most,
        f"{first.name}, stopped at {velocity:g} {first.model.unit}/s while the other goes on, moved"
        f" {held - stopped_at:.4g} {first.model.unit}; expected {least:.4g} to {most:.4g}",
    )
    reached(not second.is_done(), "a stop of one member during the motion of the other")
    expect(abs(held - begun[0]) < 1.8 * abs(way), f"{first.name} was stopped, but made its way")
    finish(bench, second, _STREAMED_S)
    expect_unmoved(bench, first, held, f"{first.name}, stopped while the other goes on")
    expect_moved(bench, second, begun[1], 2.0 * way, "after the other was stopped")
    if {Ability.ONE_KIND, Ability.SETTINGS}.issubset(bench.abilities):  # a CAN bus
        _expect_bound_beside_a_stream(bench, group)
    if {Ability.BUS_ERRORS, Ability.SETTINGS, Ability.AFRESH}.issubset(bench.abilities):
        _expect_times_of_late_set_points(bench)
    if {Ability.SETTINGS, Ability.AFRESH}.issubset(bench.abilities):
        _expect_whole_stream(bench)


def _expect_whole_stream(bench: RigProtocol) -> None:
    """Expect a stream to end no sooner than its trajectory, if the drive is heard often."""
    stated = bench.stated()
    if stated is None or _HEARD not in stated.declaration.names(bench.motor.model.unit):
        return
    with suppress(RigError), bench.altered({_HEARD: _OFTEN_MS}, {}):
        motor, way = bench.motor, half_move(bench)
        trajectory, group = smooth_move(motor, way), MotorGroup(motor)
        motor.set_control_mode(ControlMode.TRAJECTORY)
        group.set_trajectory(trajectory)
        group.start()
        group.wait_until_done(_STREAMED_S)
        times, duration_s = group.sync_quality().times[0][1], trajectory.function.domain[1]
        if times is None or times.started_ns is None or times.ended_ns is None:
            return
        lasted_s = (times.ended_ns - times.started_ns) / 1e9
        expect(
            lasted_s >= duration_s - max(map(abs, bench.facts.latency_s)) - _ROUNDING_S,
            f"a stream of {duration_s:.6f} s is told to have lasted {lasted_s:.6f} s",
        )


def _expect_times_of_late_set_points(bench: RigProtocol) -> None:
    """Expect a stream with a late set-point to be timed as any other, at the shortest period."""
    stated = bench.stated()
    if stated is None or _PERIOD not in stated.declaration.names(bench.motor.model.unit):
        return
    with suppress(RigError), bench.altered({_PERIOD: 1}, {}):  # else another setting forbids it
        motor, way = bench.motor, half_move(bench)
        group = MotorGroup(motor)
        motor.set_control_mode(ControlMode.TRAJECTORY)
        try:
            group.set_trajectory(smooth_move(motor, way))
            group.start()
        except UsageError:  # not at this period
            return
        rest_for(bench, midway_s(motor, way, 0.5))
        with bench.strike(None, _STRIKES):
            error = failure_of(partial(group.wait_until_done, _STREAMED_S))
        told = dict(group.sync_quality().times)[motor.name]
        expect(
            error is not None or (told is not None and told.started_ns is not None),
            f"a stream with a late set-point was done, and its times are told as {told}",
        )


def _expect_bound_beside_a_stream(bench: RigProtocol, group: MotorGroup) -> None:
    """Expect a streamed member to begin with one that is not, within the bound for both."""
    way, before = 0.5 * half_move(bench), declared_traffic(bench.link)
    group.set_trajectory(smooth_move(group[0], way), TrapezoidalTrajectory(0.1 * way))
    declare_traffic(bench.link, before or CanTraffic(_FAST_BIT_S))
    can = group.sync_capability()
    declare_traffic(bench.link, before)
    if can.start_skew_s is None or can.level < SyncLevel.TRIGGERED:
        return
    group.start()
    group.wait_until_done(_STREAMED_S)
    skew_s, most_s = group.sync_quality().start_skew_s, can.start_skew_s + _ON_A_BUSY_BUS_S
    expect(
        skew_s is None or skew_s <= most_s,
        f"{group[0].name} is streamed to, and {group[1].name} is not: their starts are {skew_s} s"
        f" apart; predicted is a skew of up to {can.start_skew_s:g} s",
    )


def _streams(group: MotorGroup, ways: tuple[float, float]) -> list[ComplexTrajectory]:
    return [smooth_move(motor, way) for motor, way in zip(group, ways, strict=True)]


def _expect_told_starts(
    bench: RigProtocol, group: MotorGroup, track: GroupPositions, ways: tuple[float, float]
) -> None:
    """Check the reported starts of streamed moves, of which the host sends every set-point."""
    error_s = sampling_error_s(bench, ways[0], BEGUN) + max(map(abs, bench.facts.latency_s))
    told = dict(group.sync_quality().times)
    for member, (motor, way) in enumerate(zip(group, ways, strict=True)):
        times = told[motor.name]
        started_ns = None if times is None else times.started_ns
        rise_s = smooth_move(motor, way).function.domain[1] * sqrt(_FIRST / 3.0)  # of 3 s²
        seen_ns = (track.when(member, _FIRST, way) or 0.0) - 1e9 * rise_s
        off_s = inf if started_ns is None else (started_ns - seen_ns) / 1e9
        expect(
            abs(off_s) <= error_s,
            f"{motor.name}: the start of its stream is told as {started_ns} ns; it was at"
            f" {seen_ns:.0f} ns, within {error_s:.6f} s",
        )


@clause(
    "SYNC-03",
    Level.L4,
    needs=_MOVES,
    bench=_TWO,
    source="paper 3.4: as fast as motors allow, at the same time; MotorGroup.start",
)
def group_takes_time_of_slowest_member(bench: RigProtocol) -> None:
    """Each group takes the time of its slowest member; it is done only when all members are."""
    way = half_move(bench)
    ways = (0.25 * way, way)
    group = pair_of(bench, *ways)
    before = positions_of(bench, group)
    least_s = shortest_s(bench.motors[1], way)
    group.start()
    begun_ns = bench.runtime.now_ns()
    rest_for(bench, 0.6 * least_s)
    expect(not group.is_done(), f"done was reported after {0.6 * least_s:.3f} of {least_s:.3f} s")
    short = abs(position_of(bench, bench.motor) - before[0])
    expect(
        short < 0.95 * abs(ways[0]),
        f"{bench.motor.name} was at its target after 60 % of the common time",
    )
    group.wait_until_done(10.0)
    took_s = elapsed_s(bench, begun_ns)
    expect_group_moved(bench, group, before, ways, "when done was reported")
    most_s = least_s + bench.facts.time_tolerance_s + 0.1 * least_s
    expect(took_s <= most_s, f"the group took {took_s:.3f} s; limit {most_s:.3f} s")
    if len(bench.motors) > len(ways):
        _expect_start_beside_a_stream(bench, group)


def _expect_start_beside_a_stream(bench: RigProtocol, group: MotorGroup) -> None:
    """Check that a group starts as soon while a further motor is streamed to."""
    third, way = bench.motors[len(group)], 0.25 * half_move(bench)
    took_s: list[float] = []
    for ways in ((way, -way), (-way, way)):
        if took_s:
            try:
                follow(third, smooth_move(third, 4.0 * half_move(bench)))
            except UnsupportedError:
                return
            rest_for(bench, _STREAMS_S)
        group.set_trajectory(*trajectories_of(*ways))
        before, begun_ns = positions_of(bench, group), bench.runtime.now_ns()
        group.start()
        took_s.append(elapsed_s(bench, begun_ns))
        group.wait_until_done(10.0)
        expect_group_moved(bench, group, before, ways, f"beside {third.name}")
    finish(bench, third)
    alone_s, beside_s = took_s
    expect(
        beside_s <= alone_s + bench.facts.time_tolerance_s,
        f"start() took {beside_s:.3f} s while {third.name} was streamed to, {alone_s:.3f} s before",
    )


@clause(
    "SYNC-04",
    Level.L4,
    needs=_MOVES,
    bench=_TWO,
    source="MotorGroup.synchronization NONE; MotorGroup.append, remove (paper 3.4)",
)
def group_operations_reach_every_member(bench: RigProtocol) -> None:
    """Group operations act on every member, and on no motor that was removed."""
    first, second = bench.motors[:2]
    way = half_move(bench)
    ways = (way, 0.25 * way)
    group = pair_of(bench, *ways)
    group.synchronization = Synchronization.NONE
    before = positions_of(bench, group)
    group.start()
    second.wait_until_done(10.0)
    expect(not group.is_done(), f"done was reported while {first.name} moves")
    group.wait_until_done(10.0)
    expect_group_moved(
        bench, group, before, ways, "without synchronization, when done was reported"
    )
    way = 2.0 * half_move(bench)
    group.set_trajectory(*trajectories_of(-way, -way))
    for stop in (MotorGroup.stop, MotorGroup.halt, MotorGroup.quick_stop):
        group.start()
        rest_for(bench, midway_s(first, way, 0.3))
        before = positions_of(bench, group)
        stop(group)
        group.wait_until_done(10.0)
        for motor, was in zip(group, before, strict=True):
            what = f"after {stop.__name__}() of its group, {motor.name}"
            expect_rest(bench, motor, what)
            moved = abs(position_of(bench, motor) - was)
            expect(moved < 0.5 * way, f"{what} moved on by {moved:g} of {way:g}")
        group.for_each(Motor.enable)
    _expect_removal(bench, group)
    _expect_stop_of_the_others(bench)


def _expect_stop_of_the_others(bench: RigProtocol) -> None:
    """Expect that a group is stopped although one member, the first, cannot be any more."""
    first, second = bench.motors[:2]
    way = 2.0 * half_move(bench)
    group = pair_of(bench, way, way)
    group.for_each(Motor.start)  # not by the group, whose reaction would stop them anyway
    rest_for(bench, midway_s(second, way, 0.3))
    was = position_of(bench, second)
    first.close()
    error = failure_of(group.stop)
    expect(error is not None, f"stop() of a group did not tell that {first.name} was closed")
    second.wait_until_done(10.0)
    moved = abs(position_of(bench, second) - was)
    what = f"{first.name} was closed, and its group stopped: {second.name}"
    expect(moved < 0.5 * way, f"{what} moved on by {moved:g} of {way:g}")


def _expect_removal(bench: RigProtocol, group: MotorGroup) -> None:
    first, second = bench.motors[:2]
    group.remove(first)
    before, way = position_of(bench, first), 0.25 * half_move(bench)
    group.set_trajectory(*trajectories_of(way))
    was = position_of(bench, second)
    group.start()
    group.wait_until_done(10.0)
    expect_unmoved(bench, first, before, f"{first.name}, removed from the group")
    expect_moved(bench, second, was, way, "a group of one")


@clause(
    "SYNC-07",
    Level.L4,
    needs=_MOVES,
    bench=_TWO,
    source="requirement 5 of the paper: feedback on the possible capability; declare_traffic",
)
def start_requirement_is_met_or_refused(bench: RigProtocol) -> None:
    """Every skew has a bound or a reason; a start that cannot meet a requirement is refused."""
    way = half_move(bench)
    group = pair_of(bench, way, -way)
    can = group.sync_capability()
    for value, why, what in (
        (can.command_skew_s, can.no_command_bound, "of the commands"),
        (can.start_skew_s, can.no_start_bound, "of the starts"),
        (can.end_skew_s, can.no_end_bound, "of the ends"),
    ):
        expect(value is not None or bool(why), f"no bound on the skew {what}, and no reason")
        expect(value is None or value >= 0.0, f"a skew {what} of {value} s")
    expect(bool(can.reason), "sync_capability() has no reason for its level")
    _expect_bound_of_frames(bench, group)
    before = positions_of(bench, group)
    if can.level < max(SyncLevel):
        _expect_refused(group, can, SyncLevel(max(SyncLevel)), None)
    if can.start_skew_s is None or can.start_skew_s > 0.0:
        too_little = 3600.0 if can.start_skew_s is None else 0.5 * can.start_skew_s
        _expect_refused(group, can, None, too_little)
        _expect_refused(group, can, None, 0.0)
    names = [level.name for level in sorted(SyncLevel)]
    expect(names == list(_LEVELS), f"levels, the lowest first: {names}; expected {_LEVELS}")
    for motor, was in zip(group, before, strict=True):
        expect_unmoved(bench, motor, was, f"{motor.name}, after its group was refused")
    enough = None if can.start_skew_s is None else 1.01 * can.start_skew_s + _FAR
    group.start(require=can.level, max_skew_s=enough)
    finish_group(bench, group)
    expect_group_moved(
        bench, group, before, (way, -way), "with the reported capability as requirement"
    )
    _expect_level_of_velocities(bench, group)


def _expect_level_of_velocities(bench: RigProtocol, group: MotorGroup) -> None:
    """Expect velocities that one signal has started to be told as such beforehand."""
    speeds = [_SLOWLY * one.model.velocity_max for one in group]
    try:
        group.for_each(Motor.set_control_mode, ControlMode.SETPOINT, ControlVariable.VELOCITY)
        for one, speed_of in zip(group, speeds, strict=True):
            one.set_setpoint(speed_of)
        can = group.sync_capability()
        group.start()
    except UnsupportedError:
        return
    found_s = group.sync_quality().command_skew_s
    group.stop()
    finish_group(bench, group)
    is_one = found_s == 0.0 and can.level < SyncLevel.TRIGGERED
    expect(not is_one, f"one signal has started velocities, but the capability was {can}")


def _expect_bound_of_frames(bench: RigProtocol, group: MotorGroup) -> None:
    """Expect a bound on the skew of the commands, of a few frames, once all traffic is declared."""
    if not {Ability.ONE_KIND, Ability.SETTINGS}.issubset(bench.abilities):
        return  # not a CAN bus that the check has
    before = declared_traffic(bench.link)
    declare_traffic(bench.link, CanTraffic(_FAST_BIT_S))
    can = group.sync_capability()
    declare_traffic(bench.link, before)
    skew_s = can.command_skew_s
    expect(skew_s is not None or bool(can.no_command_bound), "no bound, and no reason")
    expect(
        skew_s is None or 0.0 <= skew_s <= _FRAMES_S,
        f"commands of frames at {_FAST_BIT_S} bit/s, without other traffic: a skew of {skew_s} s;"
        f" expected at most {_FRAMES_S:g} s",
    )


def _expect_refused(
    group: MotorGroup, can: SyncCapability, level: SyncLevel | None, skew_s: float | None
) -> None:
    expect_raises(
        SynchronizationError,
        partial(group.start, require=level, max_skew_s=skew_s),
        f"start(require={level}, max_skew_s={skew_s}) was not refused; the capability is {can}",
    )
