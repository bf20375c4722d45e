"""L2 and L5: interference by other programs on the bus, and by loads too large for the motor."""

from collections.abc import Callable, Sequence
from functools import partial
from itertools import pairwise
from math import inf
from typing import Final

from motorhil.harness.conformance.bench import Ability, RigProtocol
from motorhil.harness.conformance.clause import Level, NotApplicable, clause, expect
from motorhil.harness.conformance.clauses.helpers import (
    MOVING_S,
    aim,
    begin_move,
    expect_group_moved,
    expect_moved,
    expect_rest,
    expect_state,
    expect_unmoved,
    expect_usable,
    failure_of,
    finish,
    finish_group,
    follow,
    is_over_soon,
    later,
    long_move,
    move,
    pair_of,
    position_of,
    reached,
    rest_for,
    shortest_s,
    smooth_move,
    torque_of,
    until_rest_s,
)
from motorhil.harness.conformance.clauses.tracks import positions_of
from motorhil.harness.rig.config.conformance import Capability
from motorhil.motorapi import (
    DeviceFault,
    LinkError,
    MotionInterrupted,
    Motor,
    MotorState,
    SyncLevel,
    TrapezoidalTrajectory,
    UsageError,
)

_SIGNALS: Final = 10
_SELDOM_S: Final = 0.1  # between two signals, so that a start waits for one
_STRAY: Final = 0.42  # periods until a single further signal
_HEARD_S: Final = 0.3
_OVERLOADS: Final = (3.0, 20.0)  # of the largest torque
_GIVES_UP_S: Final = 3.0


def _clock_period_s(bench: RigProtocol) -> float:
    """Return the period of the host's clock signal in a streamed motion [s].

    Raises:
        NotApplicable: there is no such signal.
    """
    motor, way = bench.motor, 0.2 * long_move(bench)
    motor.enable()
    with bench.clock() as times_ns:
        follow(motor, smooth_move(motor, way))
        finish(bench, motor)
    if len(times_ns) < _SIGNALS:
        raise NotApplicable("streamed motions use no clock signal on the bus")
    return _median_s(times_ns)


def _median_s(times_ns: Sequence[int]) -> float:
    steps = sorted(later - earlier for earlier, later in pairwise(times_ns))
    return steps[len(steps) // 2] / 1e9


@clause(
    "CLOCK-01",
    Level.L5,
    needs={Capability.COMPLEX_POSITION},
    bench={Ability.TRUTH, Ability.CLOCK, Ability.AFRESH},
    source="CiA 301, 7.2.5: one SYNC producer on a bus; UsageError, SYNC runs with another period",
)
def clock_of_another_program_is_followed(bench: RigProtocol) -> None:
    """If another program produces the clock signal, streams use it, or refuse its period."""
    period_s, way = _clock_period_s(bench), 0.2 * long_move(bench)
    bench.afresh()
    motor = bench.motor
    with bench.another_clock(period_s), bench.clock() as own_ns:
        rest_for(bench, _HEARD_S)
        motor.enable()
        for _ in range(2):
            before = bench.true_position(motor)
            follow(motor, smooth_move(motor, way))
            finish(bench, motor)
            expect_moved(bench, motor, before, way, "clocked by another program")
        if Ability.SECOND_MOTOR in bench.abilities:
            _expect_group_beside_clock(bench, way, period_s)
        expect(not own_ns, f"beside another producer, the host sent {len(own_ns)} clock signals")
    if Ability.SECOND_MOTOR in bench.abilities:
        bench.afresh()
        with bench.another_clock(period_s):
            rest_for(bench, _HEARD_S)
            pair_of(bench, way, way).for_each(Motor.enable)
            _expect_group_beside_clock(bench, way, period_s)
        _expect_stop_before_signal(bench, way)
    bench.afresh()
    motor = bench.motor
    with bench.another_clock(period_s):
        rest_for(bench, _HEARD_S)
        motor.enable()
        before = bench.true_position(motor)
        with bench.another_clock(_STRAY * period_s):
            rest_for(bench, 1.1 * _STRAY * period_s)
        follow(motor, smooth_move(motor, way))
        finish(bench, motor)
        expect_moved(bench, motor, before, way, "clocked by another program, once irregularly")
    bench.afresh()
    motor = bench.motor
    with bench.another_clock(2.0 * period_s):
        rest_for(bench, _HEARD_S)
        before = bench.true_position(motor)
        error = failure_of(partial(_enabled_stream, motor, way))
        periods = [f" {one * 1e3:g} ms" for one in (2.0 * period_s, period_s)]
        expect(
            isinstance(error, UsageError) and all(one in f"{error}" for one in periods),
            f"another program clocks the bus every{periods[0]}: a stream every{periods[1]} ended"
            f" with {error!r}; expected UsageError with both",
        )
        rest_for(bench, _HEARD_S)
        expect_unmoved(bench, motor, before, "refused for the period of another program's clock")


def _expect_group_beside_clock(bench: RigProtocol, way: float, period_s: float) -> None:
    """Start groups beside another program's clock; check that their skew is as told."""
    group = pair_of(bench, way, way)
    for _ in range(2):
        places, can = positions_of(bench, group), group.sync_capability()
        group.start()
        finish_group(bench, group)
        expect_group_moved(bench, group, places, (way, way), "clocked by another program")
        found_s = group.sync_quality().command_skew_s
        most_s = can.command_skew_s
        if most_s is None:  # of the other program's frames, nothing is declared
            most_s = period_s if can.level >= SyncLevel.TRIGGERED else inf
        expect(
            found_s is None or found_s <= most_s,
            f"beside another program's clock, commands were {found_s} s apart; told: {most_s} s",
        )


def _expect_stop_before_signal(bench: RigProtocol, way: float) -> None:
    """Expect a stop of a group that waits for its signal to end the start, as what it is."""
    bench.afresh()
    group = pair_of(bench, way, way)
    with bench.another_clock(_SELDOM_S):
        rest_for(bench, 8.0 * _SELDOM_S)
        if isinstance(failure_of(partial(group.for_each, Motor.enable)), UsageError):
            return  # they use a clock signal at rest, of another period
        for share in (0.3, 0.6, 0.9, 1.2):
            stop = partial(later, bench, share * _SELDOM_S, group.stop)
            party = bench.runtime.spawn("stop", stop)
            error = failure_of(group.start)
            expect(party.join(_HEARD_S) and party.error is None, f"stop(): {party.error!r}")
            what = f"stop() {share * _SELDOM_S:g} s into a start, which waits for a clock signal"
            if isinstance(error, UsageError):
                return  # they stream, with another period
            is_told = error is None or "stop()" in f"{error}"
            expect(is_told, f"{what}: {error!r}; expected the end of the start by the stop")
            for motor in group:
                finish(bench, motor)
                expect_rest(bench, motor, what)


def _enabled_stream(motor: Motor, way: float) -> None:
    motor.enable()
    follow(motor, smooth_move(motor, way))


@clause(
    "CLOCK-02",
    Level.L5,
    needs={Capability.COMPLEX_POSITION},
    bench={Ability.TRUTH, Ability.CLOCK, Ability.AFRESH},
    source="CiA 301, 7.2.5: one SYNC producer on a bus; errors, LinkError; dead-man",
)
def stream_with_two_clocks_or_none_fails(bench: RigProtocol) -> None:
    """If a second clock signal appears, or the other program's ends, a stream fails and stops."""
    if is_over_soon(bench):
        raise NotApplicable("no room for a long motion: long_move is too short")
    period_s, way = _clock_period_s(bench), 2.0 * long_move(bench)
    for what in ("a second clock signal", "the end of the clock signal"):
        bench.afresh()
        motor = bench.motor
        if what.startswith("a second"):
            motor.enable()
            follow(motor, smooth_move(motor, way))
            rest_for(bench, MOVING_S)
            with bench.another_clock(period_s):
                _expect_link_error(bench, motor, what)
        else:
            with bench.another_clock(period_s):
                rest_for(bench, _HEARD_S)
                motor.enable()
                follow(motor, smooth_move(motor, way))
                rest_for(bench, MOVING_S)
            _expect_link_error(bench, motor, what)
        expect_usable(bench, motor, f"after {what}")


def _expect_link_error(bench: RigProtocol, motor: Motor, what: str) -> None:
    within_s = bench.facts.lost_s + bench.facts.time_tolerance_s
    error = failure_of(partial(motor.wait_until_done, within_s))
    expect(
        isinstance(error, LinkError | DeviceFault),
        f"{what} in a stream: expected LinkError within {within_s:g} s, got {error!r}",
    )
    rest_for(bench, until_rest_s(bench, motor))
    expect_rest(bench, motor, f"after {what} in a stream")


@clause(
    "OTHER-01",
    Level.L5,
    needs={Capability.POSITION_SET_POINT, Capability.POSITION_TRAJECTORY},
    bench={Ability.OTHER_PROGRAM},
    source="errors, MotionInterrupted: another program, or the drive, has ended the motion",
)
def motion_stopped_by_another_program_is_not_done(bench: RigProtocol) -> None:
    """If another program stops a drive in a motion, the wait says so; the motor is usable."""
    if is_over_soon(bench):
        raise NotApplicable("no room for a long motion: long_move is too short")
    motor, way = bench.motor, 2.0 * long_move(bench)
    begins: tuple[tuple[str, Callable[[float], None]], ...] = (
        ("a trajectory", lambda way: follow(motor, TrapezoidalTrajectory(way))),
        ("a set-point", lambda way: aim(motor, way, relative=True)),
    )
    for what, begin in begins:
        before = position_of(bench, motor)
        begin(way)
        rest_for(bench, MOVING_S)
        bench.stop_from_elsewhere(motor)
        rest_for(bench, until_rest_s(bench, motor))
        moved = abs(position_of(bench, motor) - before)
        reached(moved < abs(way) - bench.facts.window, "a stop by another program")
        error = failure_of(partial(finish, bench, motor, shortest_s(motor, way)))
        expect(
            isinstance(error, MotionInterrupted),
            f"{what} was stopped by another program, but the wait ended with {error!r}",
        )
        expect_rest(bench, motor, f"{what} stopped by another program")
        expect_usable(bench, motor, f"after {what} stopped by another program")
        way = -way


@clause(
    "OTHER-02",
    Level.L5,
    needs={Capability.POSITION_TRAJECTORY, Capability.FAULTS},
    bench={Ability.OTHER_PROGRAM, Ability.FAULT},
    source="Motor.fault: what this drive says is wrong; DeviceFault",
)
def fault_is_seen_beside_another_program(bench: RigProtocol) -> None:
    """If another program commands a drive that has a fault, it is still reported, unless reset."""
    motor = bench.motor
    move(bench, motor, 0.1 * long_move(bench))
    code = bench.fail(motor)
    bench.stop_from_elsewhere(motor)
    rest_for(bench, bench.facts.lost_s + bench.facts.time_tolerance_s)
    fault, what = motor.fault(), "of a drive that another program commands"
    if fault is not None:
        expect(fault.code == code, f"fault {code:X}h {what}: fault() is {fault}")
        expect_state(motor, MotorState.FAULT, f"fault {code:X}h {what}")
    else:  # a command has reset it
        error = failure_of(motor.enable)
        expect(error is None, f"fault {code:X}h {what}: fault() is None, but enable(): {error}")
    expect_usable(bench, motor, "after a fault")


@clause(
    "OVER-01",
    Level.L5,
    needs={Capability.POSITION_TRAJECTORY, Capability.FAULTS},
    bench={Ability.LOAD, Ability.TRUTH, Ability.AFRESH},
    source="CiA 402-2, following error (6065h, 6066h); Motor.wait_until_done: DeviceFault",
)
def overloaded_motor_is_reported(bench: RigProtocol) -> None:
    """If a load keeps a motor from following, its motion fails, and is never reported as done."""
    way = long_move(bench)
    for share in _OVERLOADS:
        bench.afresh()
        motor = bench.motor
        before = begin_move(bench, motor, way, 0.3 * shortest_s(motor, way))
        bench.load(motor, torque_of(motor, share))
        error = failure_of(partial(finish, bench, motor, shortest_s(motor, way) + _GIVES_UP_S))
        made = bench.true_position(motor) - before
        if error is None and abs(made - way) <= bench.facts.window:
            continue  # it is stronger than its model says
        expect(
            isinstance(error, DeviceFault),
            f"overloaded, it moved {made:g} of {way:g} {motor.model.unit}, and the wait ended with"
            f" {error!r}; expected DeviceFault",
        )
        expect_state(motor, MotorState.FAULT, "overloaded")
        bench.load(motor, 0.0)
        rest_for(bench, until_rest_s(bench, motor))
        expect_usable(bench, motor, "after an overload")
        return
    raise NotApplicable("the motor overcomes many times the largest torque of its model")
