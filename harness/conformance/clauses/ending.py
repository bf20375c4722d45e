"""L1: how the end of a motion is waited for, and told."""

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
    """Waiting ends when the motor is at rest at its target, each time anew, and soon after that."""
    motor, tolerance_s = bench.motor, bench.facts.time_tolerance_s
    motor.enable()
    early_s, late_s = bench.facts.latency_s
    for share in (0.4, 0.4, -0.8, 0.1):
        way = share * long_move(bench)
        begin, expected_s = motor.position(), shortest_s(motor, way)
        follow(motor, TrapezoidalTrajectory(way))
        begun_ns = bench.runtime.now_ns()
        expect(not motor.is_done(), f"it is done as soon as a move of {way:g} was started")
        finish(bench, motor, expected_s)
        left = begin + way - motor.position()
        taken_s = (bench.runtime.now_ns() - begun_ns) / 1e9
        unit = motor.model.unit
        expect(
            abs(left) <= bench.facts.window,
            f"it is done {left:.5g} {unit} before the end of a move of {way:g} {unit}",
        )
        expect_rest(bench, motor, "when it was done")
        expect(
            expected_s + early_s - tolerance_s <= taken_s <= expected_s + late_s + tolerance_s,
            f"a move of {expected_s:.3f} s was done after {taken_s:.3f} s",
        )


@clause(
    "DONE-02",
    Level.L1,
    needs={Capability.POSITION_TRAJECTORY},
    source="Motor.wait_until_done: DeadlineExceeded, the motion goes on",
)
def a_motion_goes_on_unwatched(bench: RigProtocol) -> None:
    """A motion goes on when a wait for it has run out, and while nobody waits or asks."""
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
        raise Violated("a wait of a fifth of the motion ended as if the motion was over")
    rest_for(bench, 2.0 * expected_s)
    finish(bench, motor)
    expect_at(bench, motor, begin + way, "after a motion that nobody waited for")


@clause(
    "DONE-03",
    Level.L1,
    needs={Capability.POSITION_TRAJECTORY},
    source="Motor.on_done: called once, when what was commanded last here is over",
)
def the_end_is_told_once(bench: RigProtocol) -> None:
    """Whoever asked for it is told of the end once, when it is there, and how it was."""
    motor, way = bench.motor, 0.4 * long_move(bench)
    told: list[tuple[int, Outcome]] = []
    follow(motor, TrapezoidalTrajectory(way))
    motor.on_done(lambda outcome: told.append((bench.runtime.now_ns(), outcome)))
    expect(not told, "its end was told as soon as it had begun")
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
    expect([outcome.ending for _, outcome in told] == [ending], f"{endings} was told")
    off_s = (told[0][0] - at_ns) / 1e9
    expect(abs(off_s) <= tolerance_s, f"its end was told {off_s:.3f} s after it was there")


@clause(
    "DONE-04",
    Level.L1,
    needs={Capability.POSITION_TRAJECTORY},
    source="Motor.progress: how far what was commanded last here is; None once it is over",
)
def progress_goes_from_nothing_to_all(bench: RigProtocol) -> None:
    """Progress grows from nothing to all of the way, by what is left of the time, and is over."""
    motor, way = bench.motor, 0.5 * long_move(bench)
    expect(motor.progress() is None, "there is progress before anything was commanded")
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
        motor.position()  # of a motor that must be asked something is heard
        rest_for(bench, 0.1 * expected_s)
        expect(len(seen) < 30, "its motion does not end")
    expect(motor.progress() is None, "there is progress of a motion that is over")
    fractions = [one.fraction for _, one in seen if one.fraction is not None]
    shown = ", ".join(f"{fraction:.2f}" for fraction in fractions)
    expect(
        len(fractions) >= 5 and fractions == sorted(fractions) and fractions[-1] > 0.7,
        f"of its way it told these parts, a tenth of the time apart: {shown}",
    )
    expect(fractions[0] < 0.3, f"it began at {fractions[0]:.0%} of its way")
    tolerance_s = bench.facts.time_tolerance_s + max(map(abs, bench.facts.latency_s))
    for since_s, one in seen:
        expect(
            abs(one.elapsed_s - since_s) <= tolerance_s,
            f"{since_s:.3f} s after its start it said that it was {one.elapsed_s:.3f} s",
        )
        left_s, wanted_s = one.remaining_s, max(0.0, expected_s - since_s)
        expect(
            left_s is None or abs(left_s - wanted_s) <= tolerance_s,
            f"{wanted_s:.3f} s before its end it told {left_s} s as what remains",
        )
