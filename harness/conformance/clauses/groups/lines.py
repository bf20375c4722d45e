"""L4: groups whose members keep to a straight line."""

from collections.abc import Sequence
from functools import partial
from math import hypot, inf

from motorhil.harness.conformance.bench import Ability, RigProtocol
from motorhil.harness.conformance.clause import Level, clause, expect
from motorhil.harness.conformance.clauses.demands import jerk_of, least_s, shortest
from motorhil.harness.conformance.clauses.helpers import (
    fastest,
    finish_group,
    half_move,
    in_phase,
    move,
    pair_of,
)
from motorhil.harness.conformance.clauses.tracks import (
    GroupPositions,
)
from motorhil.harness.rig.config.conformance import Capability
from motorhil.motorapi import (
    DerivativeLimits,
    MotorGroup,
    MotorState,
    TrapezoidalTrajectory,
)

_TWO = {Ability.TRUTH, Ability.SECOND_MOTOR}
_MOVES = {Capability.POSITION_TRAJECTORY}
_SLOWLY = 0.1  # of the largest velocity
_INSTANTS = 400  # of a pair of profiles
_COMPARED = 5  # positions of each member: some can be compared
_HEARD_S = 0.005


@clause(
    "SYNC-08",
    Level.L4,
    needs=_MOVES,
    bench=_TWO,
    source="Synchronization.PHASE: at every instant all have the same share of their distance",
)
def phase_sync_stays_on_straight_line(bench: RigProtocol) -> None:
    """Phase-synchronised motors stay on a straight line, within the predicted deviation."""
    way = half_move(bench)
    ways = (way, -0.4 * way)
    group = pair_of(bench, *ways)
    slowly = _SLOWLY * bench.motors[1].model.velocity_max
    for limits in (None, DerivativeLimits(first=slowly)):
        first, second = ways
        group.set_trajectory(
            TrapezoidalTrajectory(first), TrapezoidalTrajectory(second, limits=limits)
        )
        with in_phase(group):
            track, took_s = _expect_line(bench, group, ways)
        if limits is None:
            most_s = 1.1 * _fastest_line_s(group, ways) + bench.facts.time_tolerance_s
            expect(took_s <= most_s, f"the line took {took_s:.3f} s; limit {most_s:.3f} s")
            continue
        found = fastest([(at_ns / 1e9, at) for at_ns, (_, at) in track.samples])
        unit = bench.motors[1].model.unit
        expect(
            found <= 1.1 * slowly,
            f"{group[1].name}: limited to {slowly:g} {unit}/s, and {found:g} {unit}/s fast",
        )
    told = group.sync_quality().path
    move(bench, group[0], 0.3 * way)
    after = group.sync_quality().path
    expect(after == told, f"one member moved alone later: the path was {told}, and is {after}")
    for first in (0.2 * way, 0.0):
        _expect_idle_member(bench, group, first)


def _expect_idle_member(bench: RigProtocol, group: MotorGroup, way: float) -> None:
    """Expect a member without a distance to be done at once, and to stay where it is."""
    group.set_trajectory(TrapezoidalTrajectory(way), TrapezoidalTrajectory(0.0))
    with in_phase(group):
        group.start()
        finish_group(bench, group)
    idle = group.sync_quality().path[-1]
    expect(
        (idle.deviation or 0.0) <= 2.0 * bench.facts.following and bool(idle.source),
        f"{group[1].name} had no distance to move, but its deviation from the path is {idle}",
    )


def _fastest_line_s(group: MotorGroup, ways: tuple[float, float]) -> float:
    """Return the shortest time in which its members go their ways in proportion [s]."""
    longest = max(map(abs, ways))
    pairs = [(motor, abs(way) / longest) for motor, way in zip(group, ways, strict=True)]
    return least_s(
        longest,
        min(motor.model.velocity_max / part for motor, part in pairs),
        min(motor.model.acceleration_max / part for motor, part in pairs),
        min(motor.model.deceleration / part for motor, part in pairs),
        min(jerk_of(motor) / part for motor, part in pairs),
    )


def _expect_line(
    bench: RigProtocol, group: MotorGroup, ways: tuple[float, float]
) -> tuple[GroupPositions, float]:
    """Start the group, and check that it stays on the line, as it tells.

    Return its positions, and the time from the end of its start to the end of its motion [s].
    """
    can = group.sync_capability()
    track = GroupPositions(bench, group)
    heard: list[set[int]] = [set() for _ in group]
    group.start()
    timer = bench.runtime.every(_HEARD_S, partial(_note_heard, group, heard))
    took_s = finish_group(bench, group)
    timer.cancel()
    track.end()
    expect(len(can.path) == len(ways), f"a path of {len(can.path)} motors was predicted")
    worst = _distance_from_line(track, ways)
    predicted = max(one.predicted or 0.0 for one in can.path)
    expect(
        predicted <= 2.0 * bench.facts.following,
        f"predicted deviation by rounding: {predicted:.6g}; too large",
    )
    late_s = bench.facts.latency_s[1] - bench.facts.latency_s[0]
    allowed = 2.0 * bench.facts.following + predicted
    allowed += (can.start_skew_s or late_s) * bench.motor.model.velocity_max
    expect(
        worst <= allowed,
        f"deviation from the line: {worst:.6g}; allowed are {allowed:.6g}",
    )
    path, often = group.sync_quality().path, min(map(len, heard))
    expect(
        often < _COMPARED or all(one.deviation is not None for one in path),
        f"{often} positions of each member came in its motion, and none was compared: {path}",
    )
    reported = max(one.deviation or 0.0 for one in path)
    expect(reported <= 2.0 * allowed, f"deviation: {reported:.6g} reported; {worst:.6g} measured")
    _expect_rounding(group)
    return track, took_s


def _note_heard(group: MotorGroup, heard: Sequence[set[int]]) -> None:
    """Note the time of the last position that each member has told, with power."""
    for motor, times in zip(group, heard, strict=True):
        latest = motor.latest()
        if latest is None or latest.position is None:
            continue
        if latest.state is MotorState.ENABLED:
            times.add(latest.time_ns)


def _expect_rounding(group: MotorGroup) -> None:
    """Check the predicted deviations of a start: those of the profiles that the hardware makes.

    "Nearest" on the line is measured in the time that each motor needs at its top speed.
    """
    runs = [(motor, motor.logical.physical.run) for motor in group]
    made = [
        (one, one.logical.hooks.quantise(run.motion)) for one, run in runs if run and run.motion
    ]
    if len(made) < len(group) or any(jerk_of(motor) != inf for motor in group):
        return
    speeds = [motor.model.velocity_max for motor in group]
    ways = [motion.distance for _, motion in made]
    limits = [(one.distance, one.velocity, one.acceleration, one.deceleration) for _, one in made]
    demands = [shortest(*one) for one in limits]
    last_s = max(least_s(*one) for one in limits)
    square = sum((way / top) ** 2 for way, top in zip(ways, speeds, strict=True))
    worst = [0.0 for _ in group]
    for step in range(_INSTANTS):
        at = [demand(last_s * step / _INSTANTS) for demand in demands]
        parts = zip(at, ways, speeds, strict=True)
        share = sum(gone * way / top**2 for gone, way, top in parts) / square
        off = [abs(gone - share * way) for gone, way in zip(at, ways, strict=True)]
        worst = [max(pair) for pair in zip(worst, off, strict=True)]
    for one, found, way in zip(group.sync_quality().path, worst, ways, strict=True):
        told = one.predicted or 0.0
        expect(
            abs(told - found) <= 0.05 * found + 1e-9 * abs(way),
            f"{one.motor}: deviation by rounding predicted as {told:.6g}; the profiles of its"
            f" hardware deviate by {found:.6g}",
        )


def _distance_from_line(track: GroupPositions, ways: tuple[float, float]) -> float:
    """Return the largest distance of the motors from the line between start and end [U]."""
    first, second = track.samples[0][1]
    length = hypot(*ways)
    return max(
        abs((a - first) * ways[1] - (b - second) * ways[0]) / length for _, (a, b) in track.samples
    )
