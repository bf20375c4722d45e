"""L1: effects and conditions of start(); the end of a motion, notification and progress."""

import logging
import re
import warnings
from itertools import pairwise
from math import ceil
from typing import TYPE_CHECKING, Any, Final

from motorhil.harness.conformance.bench import Ability, RigProtocol
from motorhil.harness.conformance.clause import Level, Violated, clause, expect
from motorhil.harness.conformance.clauses.demands import jerk_of, least_s
from motorhil.harness.conformance.clauses.helpers import (
    SAMPLE_S,
    aim,
    braking_distance,
    elapsed_s,
    expect_at,
    expect_raises,
    expect_rest,
    expect_same_end,
    expect_speed,
    failure_of,
    finish,
    follow,
    long_move,
    move,
    move_exactly,
    prepare,
    quiet_settings,
    rest_for,
    sample_positions,
    shortest_s,
    speed,
    turn,
)
from motorhil.harness.rig.config.conformance import Capability
from motorhil.motorapi import (
    ControlMode,
    ControlVariable,
    DeadlineExceeded,
    DerivativeLimits,
    Motor,
    MotorError,
    PluginError,
    StateError,
    TrapezoidalTrajectory,
    UnsupportedError,
    UsageError,
)
from motorhil.motorapi.outcome import Ending, Outcome, Progress

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence

_EXAMPLES: Final = 6
_LONG: Final = 4.0
_HALF_S: Final = 0.03  # of the window of a mean velocity
_TURN_RAD: Final = 6.3
_GENTLE: Final = 0.25  # of the limits
_GENTLY_S: Final = 10.0
_TINY: Final = 0.45  # of the resolution
_BEYOND: Final = 1.3  # position windows
_MANY: Final = 100


@clause(
    "START-01",
    Level.L1,
    needs={Capability.POSITION_TRAJECTORY},
    source="Motor.start: starting again repeats the command",
)
def second_start_repeats_command(bench: RigProtocol) -> None:
    """On a second start, the command is repeated: a distance is moved once more."""
    motor, way = bench.motor, 0.2 * long_move(bench)
    origin = motor.position()
    move(bench, motor, way)
    motor.start()
    finish(bench, motor, shortest_s(motor, way))
    expect_at(bench, motor, origin + 2.0 * way, f"after {way:g}, started twice")


@clause(
    "START-02",
    Level.L1,
    needs={Capability.POSITION_TRAJECTORY},
    source="paper 3.5: start both sets the parameters to match the user's view and executes",
)
def start_uses_latest_settings(bench: RigProtocol) -> None:
    """Each motion uses the settings made before its own start, not earlier ones."""
    motor, model = bench.motor, bench.motor.model
    way, tolerance_s = 0.3 * long_move(bench), bench.facts.time_tolerance_s
    motor.enable()
    for share in (0.3, 1.0, 0.5, 0.25):
        velocity, up, down = (
            share * most
            for most in (model.velocity_max, model.acceleration_max, model.deceleration)
        )
        limits = DerivativeLimits(first=velocity, second=(-down, up))
        expected_s = least_s(way, velocity, up, down, jerk_of(motor))
        follow(motor, TrapezoidalTrajectory(way, limits=limits))
        taken_s = finish(bench, motor, expected_s)
        early_s, late_s = bench.facts.latency_s
        expect(
            early_s - tolerance_s <= taken_s - expected_s <= late_s + tolerance_s,
            f"with limits of {share:.0%} of the model's {way:g} {model.unit} take"
            f" {expected_s:.3f} s; took {taken_s:.3f} s",
        )


@clause(
    "START-03",
    Level.L1,
    needs={Capability.POSITION_SET_POINT},
    source="Motor.start: during a motion, a set-point replaces one of its variable",
)
def position_setpoint_replaces_previous(bench: RigProtocol) -> None:
    """During a motion, a new position set-point replaces the previous one at once."""
    motor, way = bench.motor, 2.0 * long_move(bench)
    aim(motor, way)
    rest_for(bench, 0.3 * shortest_s(motor, way))
    left_at = motor.position()
    target = left_at + 0.3 * long_move(bench)
    aim(motor, target)
    farthest = max(at for _, at in sample_positions(bench, motor, shortest_s(motor, way)))
    finish(bench, motor, shortest_s(motor, way))
    expect_at(bench, motor, target, f"after {way:g}, replaced by {target:g} half-way")
    brakes = braking_distance(motor, motor.model.velocity_max)
    expect(
        farthest <= max(target, left_at + brakes) + 0.15 * way,
        f"overshot to {farthest:.4g} {motor.model.unit} on the way to {target:.4g}",
    )
    aim(motor, 0.0)
    rest_for(bench, 0.05)
    aim(motor, target)
    finish(bench, motor, shortest_s(motor, way))
    expect_at(bench, motor, target, "replaced on the way to 0")


@clause(
    "START-04",
    Level.L1,
    needs={Capability.VELOCITY_SET_POINT},
    bench={Ability.TRUTH},
    source="Motor.start: a velocity set-point replaces another one",
)
def velocity_setpoint_replaces_previous(bench: RigProtocol) -> None:
    """During a motion, a new velocity set-point replaces the previous one."""
    motor = bench.motor
    ramp_s = motor.model.velocity_max / motor.model.acceleration_max
    for share in (0.2, 0.5, -0.3):
        asked = share * motor.model.velocity_max
        turn(motor, asked)
        finish(bench, motor, 2.0 * ramp_s)
        rest_for(bench, 0.1)
        expect_speed(bench, motor, asked, 0.3, "with a new set-point")
    motor.stop()
    finish(bench, motor)
    expect_rest(bench, motor, "after stop()")


@clause(
    "START-05",
    Level.L1,
    needs={Capability.POSITION_TRAJECTORY},
    source="Motor.start: everything else starts from rest; paper 3.3.3, only without errors",
)
def trajectory_refuses_another_and_continues(bench: RigProtocol) -> None:
    """During a trajectory, another one is refused, and the first one is not disturbed."""
    motor, way = bench.motor, 0.5 * long_move(bench)
    rest_for(bench, 0.1)  # what is told must not be 0 s
    begin, begun_s = motor.position(), bench.runtime.now_ns() / 1e9
    follow(motor, TrapezoidalTrajectory(way, duration_s=1.5 * shortest_s(motor, way)))
    started_s = bench.runtime.now_ns() / 1e9
    rest_for(bench, 0.5 * shortest_s(motor, way))
    motor.set_trajectory(TrapezoidalTrajectory(-way))
    refusal = failure_of(motor.start)
    if not isinstance(refusal, StateError):
        raise Violated(f"a second trajectory during the first one: {refusal or 'started'}")
    told = re.search(r"since ([0-9.e+]+) s\b", str(refusal))
    expect(
        told is not None and begun_s - 1e-6 <= float(told[1]) <= started_s + 1e-6,
        f"the motion began between {begun_s:.6f} and {started_s:.6f} s: {refusal}",
    )
    finish(bench, motor, 1.5 * shortest_s(motor, way))
    expect_at(bench, motor, begin + way, "after the refusal of another trajectory")


@clause(
    "START-06",
    Level.L1,
    needs={Capability.POSITION_TRAJECTORY},
    source="paper 3.5: start sets the parameters to match the user's view; 3.2, model's by default",
)
def settings_of_motion_end_with_it(bench: RigProtocol) -> None:
    """The limits of one motion do not apply to the next one, of the same or of another mode."""
    bench.motor.enable()
    kinds: dict[str, Callable[[RigProtocol, float | None], None]] = {
        "a trajectory": _follow_limited,
        "a position set-point": _aim_limited,
        "a velocity trajectory": _speed_up_limited,
    }
    usual_s = {name: _time_of(bench, begin, None) for name, begin in kinds.items()}
    for before, begin_gently in kinds.items():
        for name, begin in kinds.items():
            if name == before != "a position set-point":
                continue  # START-02 compares trajectories
            _time_of(bench, begin_gently, _GENTLE)
            known_s, found_s = usual_s[name], _time_of(bench, begin, None)
            most_s = 1.05 * known_s + bench.facts.time_tolerance_s
            expect(
                found_s <= most_s,
                f"{name} took {found_s:.3f} s after {before} with {_GENTLE:.0%} of the limits;"
                f" expected at most {most_s:.3f} s, as it took {known_s:.3f} s before",
            )


def _time_of(
    bench: RigProtocol, begin: "Callable[[RigProtocol, float | None], None]", share: float | None
) -> float:
    """Make a motion with this share of the model's limits; return its time [s], else 0."""
    motor = bench.motor
    try:
        begin(bench, share)
    except UnsupportedError:
        return 0.0
    took_s = finish(bench, motor, _GENTLY_S)
    motor.stop()  # a velocity continues
    finish(bench, motor, _GENTLY_S)
    return took_s


def _follow_limited(bench: RigProtocol, share: float | None) -> None:
    model, limits = bench.motor.model, None
    if share is not None:
        ramps = -share * model.deceleration, share * model.acceleration_max
        limits = DerivativeLimits(first=share * model.velocity_max, second=ramps)
    follow(bench.motor, TrapezoidalTrajectory(0.15 * long_move(bench), limits=limits))


def _aim_limited(bench: RigProtocol, share: float | None) -> None:
    top = bench.motor.model.velocity_max
    limits = None if share is None else DerivativeLimits(first=share * top)
    aim(bench.motor, -0.15 * long_move(bench), relative=True, limits=limits)


def _speed_up_limited(bench: RigProtocol, share: float | None) -> None:
    model, limits = bench.motor.model, None
    if share is not None:
        ramp = share * min(model.acceleration_max, model.deceleration)
        limits = DerivativeLimits(first=ramp)
    trajectory = TrapezoidalTrajectory(0.3 * model.velocity_max, limits=limits)
    follow(bench.motor, trajectory, ControlVariable.VELOCITY)


@clause(
    "MOVE-01",
    Level.L1,
    needs={Capability.POSITION_SET_POINT},
    bench={Ability.AFRESH},
    source="requirement 1: to achieve a motion target; paper 3.3, Figure 4",
)
def any_target_is_reached(bench: RigProtocol) -> None:
    """Every target within the limits is reached, in sequence."""
    from hypothesis import given, seed
    from hypothesis import strategies as st

    low, high = _room(bench)
    middle, little = 0.5 * (low + high), 1e-3 * (high - low)
    values = st.one_of(st.floats(low, high), st.floats(middle - little, middle + little))

    @seed(bench.seed)
    @quiet_settings(_EXAMPLES)
    @given(st.lists(values, min_size=1, max_size=2))
    def reach_all(targets: "Sequence[float]") -> None:
        bench.afresh()
        for number, target in enumerate(targets):
            aim(bench.motor, target)
            finish(bench, bench.motor, shortest_s(bench.motor, high - low))
            expect_at(bench, bench.motor, target, f"target {number + 1} of {targets}")

    reach_all()


def _room(bench: RigProtocol) -> tuple[float, float]:
    """Return the range of targets: more than a turn each way from here, within the limits."""
    model, far = bench.motor.model, _LONG * long_move(bench)
    if model.unit == "rad":
        far = max(far, 1.2 * _TURN_RAD)
    origin = bench.motor.position()
    low, high = origin - far, origin + far
    if model.position_min is not None:
        low = max(low, model.position_min)
    if model.position_max is not None:
        high = min(high, model.position_max)
    return low, high


@clause(
    "MOVE-02",
    Level.L1,
    needs={Capability.POSITION_SET_POINT, Capability.POSITION_TRAJECTORY},
    source="requirement 1; Motor.wait_until_done: the last command",
)
def tiny_move_is_done_at_once(bench: RigProtocol) -> None:
    """Zero or sub-resolution moves are done at once and add up; the next move is exact."""
    motor = bench.motor
    least = motor.model.resolution or 1e-6 * long_move(bench)
    way = 0.2 * long_move(bench)
    for tiny in (0.0, 0.4 * least, -1.2 * least):
        begin = motor.position()
        for simple in (True, False):
            if simple:
                follow(motor, TrapezoidalTrajectory(tiny))
            else:
                aim(motor, tiny, relative=True)
            taken_s = finish(bench, motor)
            late_s = bench.facts.latency_s[1] + bench.facts.time_tolerance_s
            expect(
                taken_s <= late_s,
                f"a move of {tiny:g} {motor.model.unit} took {taken_s:.3f} s; limit {late_s:.3f} s",
            )
        move(bench, motor, way)
        expect_at(bench, motor, begin + way + 2.0 * tiny, f"after moves of {tiny:g}, by {way:g}")
    _expect_tiny_moves_add_up(bench, motor, _TINY * least)


def _expect_tiny_moves_add_up(bench: RigProtocol, motor: Motor, tiny: float) -> None:
    """Check that what the hardware cannot move now is not lost: errors must not accumulate."""
    count = ceil(_BEYOND * bench.facts.window / tiny)
    if count > _MANY:
        return
    begin = motor.position() + 0.01 * long_move(bench)
    aim(motor, begin)
    finish(bench, motor)
    prepare(motor, tiny)
    for _ in range(count):
        motor.start()
        finish(bench, motor)
    expect_at(bench, motor, begin + count * tiny, f"after {count} moves of {tiny:g}")


@clause(
    "DONE-01",
    Level.L1,
    needs={Capability.POSITION_TRAJECTORY},
    bench={Ability.TRUTH},
    source="paper 3.3.3: blocks until the motor finished; MotorHooks._is_done",
)
def done_is_reported_at_rest_at_target(bench: RigProtocol) -> None:
    """Every wait ends soon after the motor is at rest at its target, and not before."""
    motor, tolerance_s = bench.motor, bench.facts.time_tolerance_s
    motor.enable()
    early_s, late_s = bench.facts.latency_s
    for share in (0.4, 0.4, -0.8, 0.1):
        way = share * long_move(bench)
        begin, expected_s = motor.position(), shortest_s(motor, way)
        follow(motor, TrapezoidalTrajectory(way))
        begun_ns = bench.runtime.now_ns()
        expect(
            not motor.is_done(), f"done was reported too early, at the start of a move of {way:g}"
        )
        finish(bench, motor, expected_s)
        left = begin + way - motor.position()
        taken_s = elapsed_s(bench, begun_ns)
        unit = motor.model.unit
        expect(
            abs(left) <= bench.facts.window,
            f"done was reported {left:.5g} {unit} before the end of a move of {way:g} {unit}",
        )
        expect_rest(bench, motor, "done was reported")
        expect(
            expected_s + early_s - tolerance_s <= taken_s <= expected_s + late_s + tolerance_s,
            f"done was reported {'late' if taken_s > expected_s else 'too early'}, after "
            f"{taken_s:.3f} s; a move of {way:g} {unit} takes {expected_s:.3f} s",
        )


@clause(
    "DONE-02",
    Level.L1,
    needs={Capability.POSITION_TRAJECTORY},
    source="Motor.wait_until_done: DeadlineExceeded, the motion continues",
)
def motion_continues_after_wait_timeout(bench: RigProtocol) -> None:
    """Every motion continues when a wait for it times out, and while no caller waits."""
    motor, way = bench.motor, long_move(bench)
    begin, expected_s = motor.position(), shortest_s(motor, way)
    follow(motor, TrapezoidalTrajectory(way))
    begun_ns = bench.runtime.now_ns()
    try:
        motor.wait_until_done(0.2 * expected_s)
    except DeadlineExceeded as error:
        named = motor.name in error.awaited and motor.name in str(error)
        expect(named, f"the error does not name the motor: {error}")
        waited_s, asked_s = elapsed_s(bench, begun_ns), 0.2 * expected_s
        expect(
            -1e-6 <= waited_s - asked_s <= bench.facts.time_tolerance_s,
            f"a wait of {asked_s:.3f} s ended after {waited_s:.3f} s",
        )
        expect(
            error.timeout_s == asked_s,
            f"a wait of {asked_s} s: the error states {error.timeout_s} s",
        )
        _expect_recent(bench, error.last_heard)
    else:
        raise Violated("a wait for a fifth of the motion ended without DeadlineExceeded")
    rest_for(bench, 2.0 * expected_s)
    finish(bench, motor)
    expect_at(bench, motor, begin + way, "after a motion without a wait")


def _expect_recent(bench: RigProtocol, heard: str) -> None:
    """Check the time in the text about the last status."""
    stated = re.search(r" at ([0-9.]+) s", heard)
    if stated is None:  # nothing was heard, or its time is not known
        return
    now_s = bench.runtime.now_ns() / 1e9
    expect(
        -1e-6 <= now_s - float(stated[1]) <= bench.facts.lost_s,
        f"at {now_s:.3f} s, the last status is stated as: {heard}",
    )


@clause(
    "DONE-03",
    Level.L1,
    needs={Capability.POSITION_TRAJECTORY},
    source="Motor.on_done: called once, at the end of the last commanded motion",
)
def on_done_is_called_once(bench: RigProtocol) -> None:
    """Callbacks of on_done() come once, at the end, with the outcome; their errors end the wait."""
    motor, way = bench.motor, 0.4 * long_move(bench)
    calls: list[tuple[int, Outcome]] = []
    follow(motor, TrapezoidalTrajectory(way))
    untyped: Any = motor
    expect_raises(UsageError, lambda: untyped.on_done(1), "on_done(1) was accepted")
    expect_raises(UsageError, lambda: untyped.set_control_mode("position"), "a text as a mode")
    motor.on_done(lambda outcome: calls.append((bench.runtime.now_ns(), outcome)))
    cancelled: list[Outcome] = []
    motor.on_done(cancelled.append).cancel()
    expect(not calls, "the end was notified at the start")
    finish(bench, motor, shortest_s(motor, way))
    done_ns = bench.runtime.now_ns()
    rest_for(bench, bench.facts.time_tolerance_s)
    _expect_one_call(calls, Ending.DONE, done_ns, bench.facts.time_tolerance_s)
    expect(not cancelled, f"the end was notified after cancel() of on_done(): {cancelled}")
    calls.clear()
    follow(motor, TrapezoidalTrajectory(way))
    motor.on_done(lambda outcome: calls.append((bench.runtime.now_ns(), outcome)))
    rest_for(bench, 0.5 * shortest_s(motor, way))
    stopped_ns = bench.runtime.now_ns()
    motor.stop()
    finish(bench, motor)
    rest_for(bench, bench.facts.time_tolerance_s)
    _expect_one_call(calls, Ending.INTERRUPTED, stopped_ns, bench.facts.time_tolerance_s)
    _expect_error_of_callback(bench, motor, -way)


def _expect_error_of_callback(bench: RigProtocol, motor: Motor, way: float) -> None:
    """Check is_done() in a callback, and that a wait raises the error of on_done()'s callback."""
    seen: list[bool | MotorError] = []

    def look() -> None:
        try:
            seen.append(motor.is_done())
        except MotorError as error:
            seen.append(error)

    follow(motor, TrapezoidalTrajectory(way))
    timer = bench.runtime.every(0.1 * shortest_s(motor, way), look)
    motor.on_done(lambda outcome: 1 / 0)
    rest_for(bench, 0.5 * shortest_s(motor, way))
    timer.cancel()
    shown = ", ".join(map(repr, seen))
    expect(not any(seen), f"is_done() in a callback in a motion: {shown}; expected False")
    raised, log = "no error", logging.getLogger("motorapi")
    logged: list[str] = []

    def is_shown(record: logging.LogRecord) -> bool:
        """Return whether a message of the log is another one than that of this clause's error."""
        is_raised = record.exc_info is not None and record.exc_info[0] is ZeroDivisionError
        if not is_raised and ZeroDivisionError.__name__ not in record.getMessage():
            return True
        logged.append(record.getMessage())
        return False

    log.addFilter(is_shown)
    try:
        finish(bench, motor, shortest_s(motor, way))
        rest_for(bench, bench.facts.time_tolerance_s)  # the call may come after the end of the wait
        finish(bench, motor)
    except PluginError as error:
        raised = f"{error!r}" if error.__cause__ is None else type(error.__cause__).__name__
    finally:
        log.removeFilter(is_shown)
    expect(
        raised == ZeroDivisionError.__name__,
        f"a callback of on_done() raised ZeroDivisionError; the wait raised {raised}; expected a"
        " PluginError from it",
    )
    expect(
        not log.isEnabledFor(logging.ERROR) or any(motor.name in one for one in logged),
        f"a callback of {motor.name} raised ZeroDivisionError; logged: {logged}",
    )
    move_exactly(bench, motor, -way, "moved after a callback of on_done() raised an error")


def _expect_one_call(
    calls: list[tuple[int, Outcome]], ending: Ending, at_ns: int, tolerance_s: float
) -> None:
    endings = ", ".join(outcome.ending.value for _, outcome in calls) or "no call"
    expect(
        [outcome.ending for _, outcome in calls] == [ending],
        f"callback of on_done(): {endings}; expected one call, {ending.value}, by {tolerance_s:g} s"
        f" after {at_ns / 1e9:.3f} s; what ends a motion must be counted when it is known",
    )
    (called_ns, outcome), is_done = calls[0], ending is Ending.DONE
    expect(bool(outcome) is is_done, f"{outcome!r} counts as {bool(outcome)}")
    expect((outcome.error is None) is is_done, f"{outcome!r} has the error {outcome.error!r}")
    expect(outcome.time_ns <= called_ns, f"{outcome!r} was told at {called_ns} ns")
    off_s = (called_ns - at_ns) / 1e9
    expect(abs(off_s) <= tolerance_s, f"the end was notified {off_s:.3f} s late")


@clause(
    "DONE-04",
    Level.L1,
    needs={Capability.POSITION_TRAJECTORY},
    source="Motor.progress, Motor.on_done: of the last commanded motion; None once it is over",
)
def progress_grows_to_one_then_ends(bench: RigProtocol) -> None:
    """Progress grows from 0 to 1 along the distance, agrees with the time left, and then ends."""
    motor, way = bench.motor, 0.5 * long_move(bench)
    expect(motor.progress() is None, "progress() before the first command; expected None")
    for signed in (way, -way):
        _expect_progress(bench, motor, signed)
    follow(motor, TrapezoidalTrajectory(way))
    rest_for(bench, 2.0 * shortest_s(motor, way))
    expect_same_end(motor, "a motion has ended, and no caller has asked")
    finish(bench, motor)


def _expect_both_places(progress: Progress) -> None:
    """Check that the text of progress names its position and its target."""
    if progress.position is not None and progress.target is not None:
        places = f"at {progress.position:g} on the way to {progress.target:g}"
        expect(places in repr(progress), f"progress is shown as {progress!r}; expected {places}")


def _expect_progress(bench: RigProtocol, motor: Motor, way: float) -> None:
    expected_s = shortest_s(motor, way)
    start = motor.position()
    follow(motor, TrapezoidalTrajectory(way))
    begun_ns = bench.runtime.now_ns()
    seen = []
    while not motor.is_done():
        progress = motor.progress()
        if progress is not None:
            since_s = elapsed_s(bench, begun_ns)
            seen.append((since_s, progress))
            _expect_both_places(progress)
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
        if one.position is None or one.fraction is None:
            continue
        made = min(1.0, max(0.0, (one.position - start) / way))
        expect(
            abs(one.fraction - made) <= 2.0 * bench.facts.window / abs(way),
            f"{one!r}: {one.fraction:.1%} reported; expected {made:.1%} of {way:g}",
        )


@clause(
    "DONE-05",
    Level.L1,
    needs={Capability.POSITION_TRAJECTORY},
    source="Motor.wait_until_done: a command that was not started is no reason to wait",
)
def forgotten_start_is_warned_of(bench: RigProtocol) -> None:
    """A wait for a command that was never started ends at once, with a warning that names it."""
    motor, way = bench.motor, 0.1 * long_move(bench)
    for is_forgotten in (False, True, False):
        if is_forgotten:
            motor.set_control_mode(ControlMode.TRAJECTORY)
            motor.set_trajectory(TrapezoidalTrajectory(way))
        with warnings.catch_warnings(record=True) as heard:
            warnings.simplefilter("always")
            begun_ns = bench.runtime.now_ns()
            motor.wait_until_done(1.0)
            waited_s = elapsed_s(bench, begun_ns)
        told = [str(one.message) for one in heard if issubclass(one.category, UserWarning)]
        wanted = f"{motor.name}: its trajectory was set, but not started"
        expect(
            [text.startswith(wanted) for text in told] == [True] * is_forgotten,
            f"not started: {is_forgotten}; warned of {told}",
        )
        expect(waited_s < 1.0, f"waited {waited_s:g} s for nothing")
        move(bench, motor, way)


@clause(
    "SET-11",
    Level.L1,
    needs={Capability.VELOCITY_SET_POINT},
    bench={Ability.TRUTH},
    source="paper 3.3, derivative limits: a range, so that each direction has its own",
)
def velocity_set_point_keeps_its_slopes(bench: RigProtocol) -> None:
    """Velocity set-points with limits of their own are no steeper, in either direction."""
    motor, model = bench.motor, bench.motor.model
    top = 0.4 * model.velocity_max
    gentle = min(model.acceleration_max, model.deceleration)
    falling, rising = 0.2 * gentle, 0.4 * gentle
    motor.enable()
    motor.set_control_mode(ControlMode.SETPOINT, ControlVariable.VELOCITY)
    for before, after in ((0.0, top), (top, 0.5 * top), (0.5 * top, 0.0), (0.0, -top)):
        rate = rising if after > before else falling
        least_s = abs(after - before) / rate
        motor.set_setpoint(after, limits=DerivativeLimits(first=(-falling, rising)))
        begun_ns = bench.runtime.now_ns()
        motor.start()
        rest_for(bench, 0.5 * least_s - _HALF_S)
        found = speed(bench, motor, 2.0 * _HALF_S)
        most = rate * (elapsed_s(bench, begun_ns) - _HALF_S) + 0.05 * top
        expect(
            abs(found - before) <= most,
            f"from {before:g} to {after:g} {model.unit}/s at {rate:g} {model.unit}/s²: {found:g}"
            f" {model.unit}/s at half-time; expected a change of at most {most:g} {model.unit}/s",
        )
        finish(bench, motor, least_s)
        rest_for(bench, least_s)
        if after:
            expect_speed(bench, motor, after, 0.1, "after a set-point with limits of its own")
    motor.set_setpoint(top, limits=DerivativeLimits(first=(-falling, rising)))
    motor.start()
    _expect_no_step(bench, motor, rising, 4.0 * top / falling)
    motor.stop()
    finish(bench, motor)


def _expect_no_step(bench: RigProtocol, motor: Motor, rate: float, duration_s: float) -> None:
    """Check that the velocity, which reverses, is nowhere steeper than this rate."""
    samples = sample_positions(bench, motor, duration_s)[:: round(2.0 * _HALF_S / SAMPLE_S)]
    speeds = [(there - here) / (then - now) for (now, here), (then, there) in pairwise(samples)]
    steepest = max(abs(after - before) for before, after in pairwise(speeds))
    most = 2.0 * _HALF_S * rate + 0.05 * motor.model.velocity_max
    expect(
        steepest <= most,
        f"a reversal at {rate:g} {motor.model.unit}/s²: a step of {steepest:g}"
        f" {motor.model.unit}/s; expected at most {most:g} {motor.model.unit}/s",
    )
