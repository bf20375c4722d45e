"""L1: the end of a motion: waiting, notification and progress."""

from harness.conformance.bench import RigProtocol
from harness.conformance.capability import Ability, Capability
from harness.conformance.clause import Level, Violated, clause, expect
from harness.conformance.motions import (
    expect_at,
    expect_rest,
    finish,
    follow,
    long_move,
    rest_for,
    shortest_s,
)
from motorapi import DeadlineExceeded, Motor, TrapezoidalTrajectory
from motorapi.outcome import Ending, Outcome


@clause(
    "DONE-01",
    Level.L1,
    needs={Capability.POSITION_TRAJECTORY},
    bench={Ability.TRUTH},
    source="paper 3.3.3: blocks until the motor finished; MotorHooks._is_done",
)
def done_is_neither_early_nor_late(bench: RigProtocol) -> None:
    """Every wait ends soon after the motor is at rest at its target, and not before."""
    motor, tolerance_s = bench.motor, bench.facts.time_tolerance_s
    motor.enable()
    early_s, late_s = bench.facts.latency_s
    for share in (0.4, 0.4, -0.8, 0.1):
        way = share * long_move(bench)
        begin, expected_s = motor.position(), shortest_s(motor, way)
        follow(motor, TrapezoidalTrajectory(way))
        begun_ns = bench.runtime.now_ns()
        expect(not motor.is_done(), f"done was reported at the start of a move of {way:g}")
        finish(bench, motor, expected_s)
        left = begin + way - motor.position()
        taken_s = (bench.runtime.now_ns() - begun_ns) / 1e9
        unit = motor.model.unit
        expect(
            abs(left) <= bench.facts.window,
            f"done was reported {left:.5g} {unit} before the end of a move of {way:g} {unit}",
        )
        expect_rest(bench, motor, "done was reported")
        expect(
            expected_s + early_s - tolerance_s <= taken_s <= expected_s + late_s + tolerance_s,
            f"done was reported after {taken_s:.3f} s; the move takes {expected_s:.3f} s",
        )


@clause(
    "DONE-02",
    Level.L1,
    needs={Capability.POSITION_TRAJECTORY},
    source="Motor.wait_until_done: DeadlineExceeded, the motion continues",
)
def a_motion_goes_on_unwatched(bench: RigProtocol) -> None:
    """Every motion continues when a wait for it times out, and while no caller waits."""
    motor, way = bench.motor, long_move(bench)
    begin, expected_s = motor.position(), shortest_s(motor, way)
    follow(motor, TrapezoidalTrajectory(way))
    begun_ns = bench.runtime.now_ns()
    try:
        motor.wait_until_done(0.2 * expected_s)
    except DeadlineExceeded as error:
        expect(motor.name in error.awaited, f"the error does not name the motor: {error}")
        waited_s = (bench.runtime.now_ns() - begun_ns) / 1e9
        expect(
            waited_s <= 0.2 * expected_s + bench.facts.time_tolerance_s,
            f"a wait of {0.2 * expected_s:.3f} s ended after {waited_s:.3f} s",
        )
    else:
        raise Violated("a wait for a fifth of the motion ended without DeadlineExceeded")
    rest_for(bench, 2.0 * expected_s)
    finish(bench, motor)
    expect_at(bench, motor, begin + way, "after a motion without a wait")


@clause(
    "DONE-03",
    Level.L1,
    needs={Capability.POSITION_TRAJECTORY},
    source="Motor.on_done: called once, at the end of the last commanded motion",
)
def the_end_is_told_once(bench: RigProtocol) -> None:
    """Callbacks of on_done() are called once, at the end of the motion, with its outcome."""
    motor, way = bench.motor, 0.4 * long_move(bench)
    told: list[tuple[int, Outcome]] = []
    follow(motor, TrapezoidalTrajectory(way))
    motor.on_done(lambda outcome: told.append((bench.runtime.now_ns(), outcome)))
    expect(not told, "the end was notified at the start")
    finish(bench, motor, shortest_s(motor, way))
    done_ns = bench.runtime.now_ns()
    rest_for(bench, bench.facts.time_tolerance_s)
    _expect_told(told, Ending.DONE, done_ns, bench.facts.time_tolerance_s)
    told.clear()
    follow(motor, TrapezoidalTrajectory(way))
    motor.on_done(lambda outcome: told.append((bench.runtime.now_ns(), outcome)))
    rest_for(bench, 0.5 * shortest_s(motor, way))
    stopped_ns = bench.runtime.now_ns()
    motor.stop()
    finish(bench, motor)
    rest_for(bench, bench.facts.time_tolerance_s)
    _expect_told(told, Ending.INTERRUPTED, stopped_ns, bench.facts.time_tolerance_s)


def _expect_told(
    told: list[tuple[int, Outcome]], ending: Ending, at_ns: int, tolerance_s: float
) -> None:
    endings = ", ".join(outcome.ending.value for _, outcome in told) or "nothing"
    expect([outcome.ending for _, outcome in told] == [ending], f"notified: {endings}")
    off_s = (told[0][0] - at_ns) / 1e9
    expect(abs(off_s) <= tolerance_s, f"the end was notified {off_s:.3f} s late")


@clause(
    "DONE-04",
    Level.L1,
    needs={Capability.POSITION_TRAJECTORY},
    source="Motor.progress: of the last commanded motion; None once it is over",
)
def progress_goes_from_nothing_to_all(bench: RigProtocol) -> None:
    """Progress grows from 0 to 1 along the distance, agrees with the time left, and then ends."""
    motor, way = bench.motor, 0.5 * long_move(bench)
    expect(motor.progress() is None, "progress() before the first command; expected None")
    for signed in (way, -way):
        _expect_progress(bench, motor, signed)


def _expect_progress(bench: RigProtocol, motor: Motor, way: float) -> None:
    expected_s = shortest_s(motor, way)
    follow(motor, TrapezoidalTrajectory(way))
    begun_ns = bench.runtime.now_ns()
    seen = []
    while not motor.is_done():
        progress = motor.progress()
        if progress is not None:
            since_s = (bench.runtime.now_ns() - begun_ns) / 1e9
            seen.append((since_s, progress))
        motor.position()  # some motors report only when they are asked
        rest_for(bench, 0.1 * expected_s)
        expect(len(seen) < 30, "the motion does not end")
    expect(motor.progress() is None, "progress() after the end of the motion; expected None")
    fractions = [one.fraction for _, one in seen if one.fraction is not None]
    shown = ", ".join(f"{fraction:.2f}" for fraction in fractions)
    expect(
        len(fractions) >= 5 and fractions == sorted(fractions) and fractions[-1] > 0.7,
        f"progress, sampled every tenth of the time: {shown}; expected 0 to 1, rising",
    )
    expect(fractions[0] < 0.3, f"the first progress was {fractions[0]:.0%} of the distance")
    tolerance_s = bench.facts.time_tolerance_s + max(map(abs, bench.facts.latency_s))
    for since_s, one in seen:
        expect(
            abs(one.elapsed_s - since_s) <= tolerance_s,
            f"elapsed time: {one.elapsed_s:.3f} s reported; expected {since_s:.3f} s",
        )
        left_s, wanted_s = one.remaining_s, max(0.0, expected_s - since_s)
        expect(
            left_s is None or abs(left_s - wanted_s) <= tolerance_s,
            f"remaining time: {left_s} s reported; expected {wanted_s:.3f} s",
        )
