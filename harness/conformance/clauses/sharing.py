"""L3: logical motors that share a physical motor: ownership, refusals, random sequences."""

import gc
import warnings
from collections import Counter
from collections.abc import Callable, Iterator
from contextlib import suppress
from functools import partial
from types import SimpleNamespace
from typing import Any, Final

from motorhil.harness.conformance.bench import Ability, RigProtocol
from motorhil.harness.conformance.clause import Level, NotApplicable, Violated, clause, expect
from motorhil.harness.conformance.clauses.helpers import (
    begin_move,
    elapsed_s,
    expect_moved,
    expect_raises,
    expect_rest,
    expect_state,
    expect_taken_over,
    expect_unmoved,
    failure_of,
    finish,
    follow,
    later,
    long_move,
    midway_s,
    move,
    position_of,
    prepare,
    reached,
    rest_for,
    shortest_s,
    speed,
    turn,
    until_rest_s,
)
from motorhil.harness.conformance.clauses.tracks import PositionWatch
from motorhil.harness.rig.config.conformance import Capability
from motorhil.harness.rig.config.toml import RigError
from motorhil.motorapi import (
    MotionInterrupted,
    Motor,
    MotorBusyError,
    MotorError,
    MotorState,
    StateError,
    TrapezoidalTrajectory,
    UnsupportedError,
    UsageError,
)
from motorhil.motorapi.outcome import Ending, Outcome

_WATCHED_S = 0.2
_INTERFACE: Final = "motorhil.motorapi."
_SHARED = {Ability.SEVERAL_USERS}
_TOGETHER = {*_SHARED, Ability.ONE_PROGRAM}
_MOVES = {Capability.POSITION_TRAJECTORY}
_PATIENCE_S = 10.0
_BEFORE_CLOSE_S: Final = 0.01
_ENDED_S: Final = 1.0
_STOPS: Final = 8
_AFTER_STOPS_S: Final = 1.5
_LEASE_S = 0.2
_LOW_LEVEL: Final = "low-level access"
_COURSES: Final = 8
_EXAMPLES: Final = 8
_STEPS: Final = 15
_READINGS: Final = 20


def _both(bench: RigProtocol) -> tuple[Motor, Motor]:
    return bench.motor, bench.another_user_of(bench.motor)


@clause(
    "SHARE-01",
    Level.L3,
    needs=_MOVES,
    bench={*_TOGETHER, Ability.TRUTH},
    source="requirement 4 of the paper: inform the users; MotorBusyError",
)
def moving_motor_refuses_other_user(bench: RigProtocol) -> None:
    """While a motor moves for one user, commands of another are refused, naming the owner."""
    motor, other = _both(bench)
    before, way = position_of(bench, motor), long_move(bench)
    follow(motor, TrapezoidalTrajectory(way))
    begun_ns = bench.runtime.now_ns()
    rest_for(bench, 0.3 * shortest_s(motor, way))
    prepare(other, -0.5 * way)
    for operation in (other.start, other.enable, other.disable, other.reset_fault, other.home):
        error = _refusal_of(operation)
        expect(
            error is not None and error.holder.endswith(motor.name),
            f"{operation.__name__}() of {other.name} while {motor.name} moves: {error}",
        )
        since_ns = begun_ns if error is None else error.since_ns
        expect(
            since_ns <= begun_ns,
            f"held since {since_ns} ns; expected <= {begun_ns} ns",
        )
    finish(bench, motor, shortest_s(motor, way))
    expect_moved(bench, motor, before, way, "the first user's motion")
    before = position_of(bench, motor)
    other.start()  # the motor is free at once
    finish(bench, other, shortest_s(motor, way))
    expect_moved(bench, motor, before, -0.5 * way, f"then started by {other.name}")


def _refusal_of(operation: Callable[[], object]) -> MotorBusyError | None:
    try:
        operation()
    except MotorBusyError as error:
        return error
    return None


@clause(
    "SHARE-02",
    Level.L3,
    needs=_MOVES,
    bench={*_SHARED, Ability.TRAFFIC},
    source="requirement 4; harness.sharing_tests: only the owner commands a motor",
)
def refused_user_sends_no_command(bench: RigProtocol) -> None:
    """If a user without ownership is refused, no command of that user reaches the bus."""
    motor, other = _both(bench)
    with bench.commands_to(motor) as sent, motor.reserve("a clause"):
        move(bench, motor, 0.1 * long_move(bench))
        reached(bool(sent), "a command on the bus")
        rest_for(bench, 0.1)
        with bench.commands_to(motor) as usual:
            rest_for(bench, 0.1)
        prepare(other, long_move(bench))
        with bench.commands_to(motor) as new:
            for operation in (other.start, other.enable, other.disable, other.home):
                expect(_refusal_of(operation) is not None, f"{operation.__name__}() was accepted")
                rest_for(bench, 0.025)
        strange = sorted(set(new) - set(usual))
        expect(not strange, f"{other.name} was refused, but sent {', '.join(strange)}")


@clause(
    "SHARE-03",
    Level.L3,
    needs=_MOVES,
    bench=_TOGETHER,
    source="Sharing and locking: reading and stops are free; MotionInterrupted",
)
def any_user_may_read_and_stop(bench: RigProtocol) -> None:
    """Other users may read and stop a moving motor; its user learns which one stopped it."""
    motor, other = _both(bench)
    way = 2.0 * long_move(bench)
    for stop in (Motor.stop, Motor.halt, Motor.quick_stop):
        begin = begin_move(bench, motor, way, midway_s(motor, way, 0.3))
        difference = abs(other.position() - motor.position())
        expect(
            difference <= 0.1 * motor.model.velocity_max,
            f"positions of {other.name} and {motor.name} differ by {difference:g}",
        )
        expect(other.state() is motor.state(), "the states of one motor differ")
        what = f"{stop.__name__}() of {other.name}"
        stop(other)
        _expect_interrupted(motor, other, what)
        finish(bench, other)
        expect_rest(bench, motor, what)
        made = abs(position_of(bench, motor) - begin)
        expect(made < 0.95 * abs(way), f"after {what}, the motor moved {made:g} of {way:g}")
        motor.enable()
        way = -way


def _expect_interrupted(motor: Motor, other: Motor, what: str) -> None:
    """Check that the user of this motor learns that `other` has stopped it."""
    try:
        motor.wait_until_done(_PATIENCE_S)
    except MotionInterrupted as error:
        expect(other.name in error.by, f"{what}: reported is {error.by}; expected {other.name}")
    else:
        raise Violated(f"{what} stopped the motor, but {motor.name} reported done")


@clause(
    "SHARE-04",
    Level.L3,
    needs=_MOVES,
    bench=_SHARED,
    source="paper 3.5: settings are local; start sets and starts in one atomic operation",
)
def each_user_keeps_own_settings(bench: RigProtocol) -> None:
    """Each user's motions use that user's own settings, whatever other users set."""
    motor, other = _both(bench)
    way = 0.25 * long_move(bench)
    least_s = shortest_s(motor, way)
    durations = {motor: 2.0 * least_s, other: 4.0 * least_s}
    for user, side in ((motor, 1.0), (other, -1.0), (motor, 1.0), (other, -1.0)):
        before = position_of(bench, motor)
        prepare(user, side * way, durations[user])
        prepare(motor if user is other else other, 0.5 * way)  # never started
        user.start()
        took_s = finish(bench, user, durations[user])
        expect(
            abs(took_s - durations[user]) <= bench.facts.time_tolerance_s + 0.1 * durations[user],
            f"{user.name}: the move took {took_s:.3f} s; expected {durations[user]:.3f} s",
        )
        expect_moved(bench, motor, before, side * way, f"started by {user.name}")


@clause(
    "SHARE-05",
    Level.L3,
    needs=_MOVES,
    bench=_SHARED,
    source="requirement 4; Motor.reserve: only its user commands the motor inside the block",
)
def reservation_lasts_for_its_block(bench: RigProtocol) -> None:
    """During its block, and no longer, a reservation keeps other users away."""
    motor, other = _both(bench)
    way = 0.1 * long_move(bench)
    prepare(other, way)
    with motor.reserve("survey") as reservation:
        for _ in range(2):
            move(bench, motor, way)
            error = _refusal_of(other.start)
            expect(error is not None, f"{other.name} moved between two motions of a reservation")
            expect(
                error is not None and "survey" in str(error),
                f"purpose not in the error: {error}",
            )
        expect(reservation.is_held, "is_held is False inside the block")
    _expect_free(bench, other, "after a reservation")
    with motor.reserve("survey"):
        with motor.reserve("a part of it", lease_s=_LEASE_S):
            pass
        rest_for(bench, 2.0 * _LEASE_S)
        error = _refusal_of(other.start)
        what = "moved in a reservation without a lease, after a part of it that had one"
        expect(error is not None, f"{other.name} {what}")
    with suppress(ZeroDivisionError), motor.reserve("survey"):
        raise ZeroDivisionError
    _expect_free(bench, other, "after a block left by an error")
    prepare(motor, 0.0)
    with suppress(MotorError), warnings.catch_warnings():
        warnings.simplefilter("ignore")  # it warns that nothing was started
        motor.wait_until_done(0.0)
    with suppress(MotorError), motor.reserve("survey"):
        motor.home(-128)  # not a homing method of any motor
    _expect_free(bench, other, "after an error in a reservation")


def _expect_free(bench: RigProtocol, user: Motor, when: str) -> None:
    error = _refusal_of(user.start)
    expect(error is None, f"{when} {user.name} is refused: {error}")
    finish(bench, user, _PATIENCE_S)


@clause(
    "SHARE-06",
    Level.L3,
    needs=_MOVES,
    bench={*_SHARED, Ability.TRUTH},
    source="Sharing and locking; Motor.start(timeout_s): waits its turn",
)
def next_user_gets_motor_at_rest(bench: RigProtocol) -> None:
    """While a motor slows down, no other user gets it; the next one gets it at rest."""
    motor, other = _both(bench)
    way = 3.0 * long_move(bench)
    begin_move(bench, motor, way, 0.4 * shortest_s(motor, way))
    reached(abs(speed(bench, motor, 0.02)) > 0.3 * motor.model.velocity_max, "motion at full speed")
    motor.stop()
    with other.reserve("next", timeout_s=_PATIENCE_S):
        expect_rest(bench, motor, f"granted to {other.name} while slowing down")


@clause(
    "SHARE-07",
    Level.L3,
    needs=_MOVES,
    bench=_SHARED,
    source="Motor.start(timeout_s): first come, first served",
)
def users_are_served_in_order(bench: RigProtocol) -> None:
    """First come, first served: waiting users get the motor in the order of their requests."""
    motor, other = _both(bench)
    served: list[str] = []
    way = 0.2 * long_move(bench)
    follow(motor, TrapezoidalTrajectory(way))

    def start_next() -> None:
        prepare(other, -way)
        other.start(timeout_s=_PATIENCE_S)
        served.append(other.name)
        other.wait_until_done(_PATIENCE_S)

    party = bench.runtime.spawn("next", start_next)
    rest_for(bench, 0.2 * shortest_s(motor, way))
    expect(not served, f"{other.name} got the motor while it moved for {motor.name}")
    finish(bench, motor, shortest_s(motor, way))
    motor.start(timeout_s=_PATIENCE_S)
    served.append(motor.name)
    finish(bench, motor, shortest_s(motor, way))
    expect(party.join(_PATIENCE_S), f"{other.name} was never served")
    if party.error is not None:
        raise party.error
    expect(served == [other.name, motor.name], f"served in the order {', '.join(served)}")


@clause(
    "SHARE-08",
    Level.L3,
    needs={*_MOVES, Capability.VELOCITY_SET_POINT},
    bench=_TOGETHER,
    source="Sharing and locking: leases, take_over; the next owner brings a moving motor to rest",
)
def takeover_brings_motor_to_rest(bench: RigProtocol) -> None:
    """On a takeover, the motor is brought to rest, and its former user loses the ownership."""
    motor, other = _both(bench)
    with motor.reserve("survey") as survey:
        turn(motor, 0.5 * motor.model.velocity_max)
        finish(bench, motor)
        with other.reserve("rescue", take_over=True, timeout_s=_PATIENCE_S):
            expect_rest(bench, motor, f"taken over by {other.name}")
            expect(not survey.is_held, "is_held is True after a takeover")
            prepare(motor, long_move(bench))
            before = position_of(bench, motor)
            for operation in (motor.start, motor.enable, motor.disable, motor.home):
                error = _refusal_of(operation)
                what = f"{operation.__name__}() of {motor.name}, which was taken over"
                expect(
                    error is not None and error.holder.endswith(other.name),
                    f"{what}: {error}; expected a refusal that names {other.name}",
                )
                expect_unmoved(bench, motor, before, what)
            expect_state(other, MotorState.ENABLED, "after commands of the former user")
            move(bench, other, 0.1 * long_move(bench))
    turn(motor, 0.5 * motor.model.velocity_max)
    finish(bench, motor)
    with other.reserve("rescue", take_over=True, timeout_s=_PATIENCE_S):
        expect_rest(bench, motor, f"turning without a reservation, taken over by {other.name}")
        move(bench, other, 0.1 * long_move(bench))
    what = f"taken over, and then moved by {other.name}"
    expect_taken_over(partial(motor.wait_until_done, _PATIENCE_S), what)
    with motor.reserve("survey"):
        way = 2.0 * long_move(bench)
        begin_move(bench, motor, way, midway_s(motor, way, 0.3))
        other.stop()
        with motor.reserve("back", take_over=True, timeout_s=_PATIENCE_S):
            expect_rest(bench, motor, f"stopped by {other.name}, taken over by {motor.name}")
            _expect_interrupted(other, motor, "reserve(take_over=True)")
    with motor.reserve("lease", lease_s=_LEASE_S) as lease:
        expect(_refusal_of(lambda: _reserve(other)) is not None, "a valid lease was taken")
        rest_for(bench, 2.0 * _LEASE_S)
        _reserve(other)
        expect(not lease.is_held, "is_held is True after the lease expired and was taken")


def _reserve(motor: Motor) -> None:
    with motor.reserve("next"):
        pass


@clause(
    "SHARE-09",
    Level.L3,
    needs={*_MOVES, Capability.LOW_LEVEL},
    bench=_TOGETHER,
    source="requirement 2 of the paper: no other part of the interface will have any effect",
)
def low_level_access_refuses_other_users(bench: RigProtocol) -> None:
    """During low-level access, all other users are refused; afterwards the motor is as before."""
    motor, other = _both(bench)
    way = 0.1 * long_move(bench)
    move(bench, motor, way)
    prepare(other, way)
    try:
        with motor.low_level():
            pass
    except StateError:  # a motion that holds the motor must end first
        motor.disable()
    with motor.low_level() as hardware:
        expect(hardware is not None, "the hardware object is None")
        rest_for(bench, 0.02)
        sent: list[str] = []
        if Ability.TRAFFIC in bench.abilities:
            with bench.commands_to(motor) as seen:
                _expect_all_refused(bench, other)
            sent = sorted(set(seen))
        else:
            _expect_all_refused(bench, other)
        _expect_last_readings(other)
        expect(not sent, f"unused low-level access, but the bus had {', '.join(sent)}")
    before = position_of(bench, motor)
    other.start()
    finish(bench, other, shortest_s(motor, way))
    expect_moved(bench, motor, before, way, f"then started by {other.name}")


def _expect_last_readings(other: Motor) -> None:
    """Check that readings are those received last, or are refused, during low-level access."""
    latest = other.latest()
    if latest is None:  # a host that only asks has forgotten them
        for ask in (other.state, other.fault):
            expect(_refusal_of(ask) is not None, f"{ask.__name__}() asked the drive")
    else:
        expect(other.state() is latest.state, f"state() is not that of {latest}")
        expect(other.fault() is None, f"fault() is {other.fault()}, but latest() is {latest}")
    if latest is None or latest.position is None:
        expect(_refusal_of(other.position) is not None, "position() asked the drive")
    else:
        expect(other.position() == latest.position, f"position() is not that of {latest}")
    for measure in (other.velocity, other.torque, other.following_error):
        error = failure_of(measure)
        is_right = error is None or isinstance(error, MotorBusyError)
        expect(is_right, f"{measure.__name__}() in low-level access of another user: {error!r}")
    refused = _refusal_of(other.is_referenced)
    expect(refused is not None, "is_referenced() asked the drive in low-level access of another")


def _expect_all_refused(bench: RigProtocol, other: Motor) -> None:
    take_over = other.reserve("rescue", take_over=True).__enter__
    for operation in (other.start, other.stop, other.enable, other.disable, other.home, take_over):
        what, refusal = f"{operation.__name__}() of {other.name}", _refusal_of(operation)
        expect(refusal is not None, f"{what} accepted")
        expect(_LOW_LEVEL in str(refusal), f"{what}: {refusal}; expected that of {_LOW_LEVEL}")
        rest_for(bench, 0.02)


@clause(
    "SHARE-10",
    Level.L3,
    needs=_MOVES,
    bench=_TOGETHER,
    source="paper 3.5: one hardware object, shared by all; Device.close",
)
def closed_motor_leaves_others_working(bench: RigProtocol) -> None:
    """After a logical motor is closed, even twice, the others work as before."""
    motor, other = _both(bench)
    move(bench, other, 0.1 * long_move(bench))
    for _ in range(2):
        other.close()
    expect_state(motor, MotorState.ENABLED, "after another user was closed")
    move(bench, motor, 0.1 * long_move(bench))
    for _ in range(2):
        motor.close()


@clause(
    "CLOSE-01",
    Level.L3,
    needs=_MOVES,
    bench={Ability.SOLE_USER},  # the last one closes the hardware object
    source="Device.close: releases the device; errors, LinkError: this hardware object is closed",
)
def closed_motor_refuses_commands(bench: RigProtocol) -> None:
    """After close(), commands fail with an error of the interface, and no motion is done."""
    motor, way = bench.motor, long_move(bench)
    begin_move(bench, motor, way, midway_s(motor, way, 0.5))
    told: list[Outcome] = []
    motor.on_done(told.append)
    motor.close()
    _expect_cut_short(motor, "close() in a motion")
    for one in told:
        expect(one.ending is not Ending.DONE, f"close() in a motion: {one}")
    for operation in (motor.start, motor.enable, motor.reset_fault, motor.disable):
        what = f"{operation.__name__}() returned after close()"
        expect_raises(MotorError, operation, what)
    if Ability.LOSE in bench.abilities:
        for other in bench.motors[1:]:
            _expect_wait_ends(bench, other)
    if Ability.AFRESH in bench.abilities:
        bench.afresh()
        _expect_end_before_close(bench)


def _expect_end_before_close(bench: RigProtocol) -> None:
    """Expect close() not to be told as the end of a motion that had ended, with nobody looking."""
    motor, way = bench.motor, 0.1 * long_move(bench)
    begin_move(bench, motor, way, shortest_s(motor, way) + _ENDED_S)
    motor.close()
    error = failure_of(partial(motor.wait_until_done, 1.0))
    expect(not isinstance(error, MotionInterrupted), f"a motion had ended before close(): {error}")


def _note_failure(errors: list[MotorError | None], operation: Callable[[], object]) -> None:
    errors.append(failure_of(operation))


def _expect_wait_ends(bench: RigProtocol, motor: Motor) -> None:
    """Expect close() to end a call of another thread that waits for an answer of the drive."""
    position_of(bench, motor)
    motor.position()
    with bench.lose_answers_of(motor):
        errors: list[MotorError | None] = []
        reader = partial(_note_failure, errors, motor.position)
        party = bench.runtime.spawn("reader", reader)
        rest_for(bench, _BEFORE_CLOSE_S)
        motor.close()
        within_s = bench.facts.lost_s + bench.facts.time_tolerance_s
        expect(party.join(within_s), f"close() did not end a position() within {within_s:g} s")
    expect(party.error is None, f"position() while another thread closes: {party.error!r}")


@clause(
    "CLOSE-02",
    Level.L3,
    needs=_MOVES,
    bench={*_SHARED, Ability.SOLE_USER},
    source="Device.close: releases the device; paper 3.5, one hardware object for each motor",
)
def closed_motor_can_be_opened_again(bench: RigProtocol) -> None:
    """After close(), even in a stop, a motor can be opened again; the old one is refused."""
    motor, way = bench.motor, 0.2 * long_move(bench)
    move(bench, motor, way)
    begin_move(bench, motor, 2.0 * way, 0.5 * shortest_s(motor, way))
    motor.close()
    rest_for(bench, until_rest_s(bench, motor))
    try:
        again = bench.another_user_of(motor)  # a bench makes it when it is first asked for
    except RigError as error:
        raise Violated(f"it cannot be opened again: {error}") from error
    again.reset_fault()
    again.enable()
    for _ in range(2):
        for operation in (motor.start, motor.enable, motor.position, motor.velocity):
            what, begun_ns = f"{operation.__name__}() of a closed motor", bench.runtime.now_ns()
            expect_raises(MotorError, operation, f"{what} returned, since it was opened again")
            took_s = elapsed_s(bench, begun_ns)
            most_s = bench.facts.time_tolerance_s
            expect(took_s <= most_s, f"{what} was refused after {took_s:g} s; limit {most_s:g} s")
        before = position_of(bench, again)
        move(bench, again, way)
        expect_moved(bench, again, before, way, "opened again")
    motor.close()
    expect_state(again, MotorState.ENABLED, "after a second close() of the old one")
    begin_move(bench, again, way, 0.5 * shortest_s(again, way))
    again.stop()
    again.close()
    _expect_cut_short(again, "close() before a stop was over")


def _expect_cut_short(motor: Motor, what: str) -> None:
    error = failure_of(partial(motor.wait_until_done, 1.0))
    expect(error is not None, f"{what}: the wait returned as if it were done")


@clause(
    "CLOSE-04",
    Level.L3,
    bench={Ability.SOLE_USER, Ability.ONE_PROGRAM},
    source="Device.close: releases the device; motorapi.bus_context: what is kept for one bus",
)
def last_closed_motor_leaves_its_bus(bench: RigProtocol) -> None:
    """Stops leave nothing behind; once all motors on a bus are closed, nothing of them uses it."""
    for motor in bench.motors:
        motor.position()
    _expect_nothing_left_by_stops(bench)
    kept = [one for one in gc.get_objects() if _is_used_in(one, bench.runtime)]
    for motor in bench.motors:
        motor.close()
    names = sorted({type(one).__name__ for one in kept if one.users})
    expect(not names, f"all motors are closed, but still in use: {', '.join(names)}")


def _expect_nothing_left_by_stops(bench: RigProtocol) -> None:
    """Expect stops to leave no object of the interface, such as a timer that never ends."""
    motor = bench.motor
    motor.enable()
    counts: list[Counter[str]] = []
    for stops in (2, _STOPS):
        for _ in range(stops):
            motor.stop()
            finish(bench, motor)
        rest_for(bench, _AFTER_STOPS_S)
        gc.collect()
        counts.append(Counter(_classes()))
    left = [one for one, number in (counts[1] - counts[0]).items() if number >= _STOPS]
    expect(not left, f"{_STOPS} stops leave as many {', '.join(left)}, {_AFTER_STOPS_S:g} s later")


def _classes() -> Iterator[str]:
    """Yield the class of each object of the interface that is alive."""
    for one in gc.get_objects():
        module: Any = type(one).__module__
        if isinstance(module, str) and module.startswith(_INTERFACE) and hasattr(one, "cancel"):
            yield type(one).__name__


def _is_used_in(one: Any, runtime: object) -> bool:
    """Return whether an object of the interface counts its users, and is of this runtime."""
    module: Any = type(one).__module__  # a descriptor, of a few types
    if not isinstance(module, str) or not module.startswith(_INTERFACE):
        return False
    if not isinstance(getattr(one, "users", None), int):
        return False
    link = getattr(one, "link", one)
    return getattr(link, "runtime", None) is runtime and one.users > 0


@clause(
    "CLOSE-03",
    Level.L3,
    needs=_MOVES,
    bench=_SHARED,
    source="Motor.close: commands and measurements are refused; others stay open",
)
def closed_motor_refuses_while_another_is_open(bench: RigProtocol) -> None:
    """After close(), a motor is refused although another user keeps its hardware open."""
    motor, other = _both(bench)
    way = 0.1 * long_move(bench)
    move(bench, other, way)
    move(bench, motor, way)
    before = position_of(bench, other)
    motor.close()
    for operation in (
        *(motor.start, motor.reset_fault, motor.disable, motor.enable, motor.stop),
        *(motor.quick_stop, motor.position, motor.velocity, motor.reserve().__enter__),
    ):
        what = f"{operation.__qualname__}() of a closed motor returned: another user has it open"
        expect_raises(MotorError, operation, what)
    rest_for(bench, _WATCHED_S)
    expect_unmoved(bench, other, before, "after commands of a closed motor")
    expect_state(other, MotorState.ENABLED, "after commands of a closed motor")
    move(bench, other, way)
    expect_moved(bench, other, before, way, "after another user was closed")


@clause(
    "SHARE-12",
    Level.L3,
    needs=_MOVES,
    bench=_SHARED,
    source="motorapi.motor: read access needs no ownership and never disturbs the owner",
)
def reserved_motor_may_be_read(bench: RigProtocol) -> None:
    """During a reservation and its motions, others read the motor, and do not disturb it."""
    motor, other = _both(bench)
    way = 0.5 * long_move(bench)
    move(bench, motor, 0.1 * way)
    for user, reader in ((motor, other), (other, motor)):
        before, expected_s = position_of(bench, motor), shortest_s(motor, way)
        with user.reserve("a clause"):
            _expect_readable(bench, reader, user)
            follow(user, TrapezoidalTrajectory(way))
            begun_ns = bench.runtime.now_ns()
            while not user.is_done():
                _expect_readable(bench, reader, user)
                rest_for(bench, 0.05 * expected_s)
                expect(elapsed_s(bench, begun_ns) < 10.0 * expected_s, "the motion does not end")
            took_s = elapsed_s(bench, begun_ns)
            most_s = 1.2 * expected_s + bench.facts.time_tolerance_s + bench.facts.latency_s[1]
            expect(
                took_s <= most_s,
                f"read by {reader.name}, a move of {user.name} took {took_s:.3f} s; expected at"
                f" most {most_s:.3f} s",
            )
            expect_moved(bench, motor, before, way, f"read by {reader.name}, moved by {user.name}")


def _expect_readable(bench: RigProtocol, reader: Motor, user: Motor) -> None:
    """Check that this user reads the motor as it is, although another one has it."""
    what = f"read by {reader.name}, reserved by {user.name}"
    error = failure_of(reader.position, reader.velocity, reader.fault)
    expect(error is None, f"{what}: {error}; expected a value")
    expect_state(reader, MotorState.ENABLED, what)
    mine, theirs = user.position(), reader.position()
    spare = bench.facts.window + 0.1 * user.model.velocity_max
    expect(abs(theirs - mine) <= spare, f"{what}: position {theirs:g}; {user.name} reads {mine:g}")


@clause(
    "SHARE-13",
    Level.L3,
    needs=_MOVES,
    bench={*_SHARED, Ability.TRUTH},
    source="motorapi.motor: read access needs no ownership; paper 3.5, one object shared by all",
)
def readers_at_once_get_own_answers(bench: RigProtocol) -> None:
    """Several threads that read a moving motor at once get true values, each its own."""
    motor, other = _both(bench)
    motor.enable()
    way = long_move(bench)
    expected_s = shortest_s(motor, way)
    watches = [PositionWatch(bench, one) for one in (motor, other)]
    top = 1.2 * motor.model.velocity_max
    velocities: list[float] = []

    def read_positions(watch: PositionWatch) -> None:
        for _ in range(_READINGS):
            watch.read("read by two threads at once")

    def read_velocities(user: Motor) -> None:
        velocities.extend(user.velocity() for _ in range(_READINGS))

    def read_errors() -> None:
        with suppress(UnsupportedError):
            for _ in range(_READINGS):
                other.following_error()

    begin_move(bench, motor, way, 0.3 * expected_s)
    reads: list[Callable[[], None]] = [partial(read_positions, watch) for watch in watches]
    reads += [partial(read_velocities, motor), partial(read_velocities, other), read_errors]
    parties = [bench.runtime.spawn(f"reader {n + 1}", read) for n, read in enumerate(reads)]
    for party in parties:
        expect(party.join(_PATIENCE_S), f"{party.name} got no answers within {_PATIENCE_S:g} s")
        if party.error is not None:
            raise Violated(f"{party.name} of {len(parties)} at once: {party.error!r}")
    finish(bench, motor, expected_s)
    for watch in watches:
        watch.end(0.5 * way)
    wrong = [velocity for velocity in velocities if not -0.1 * top <= velocity <= top]
    expect(not wrong, f"velocities of {wrong} were read in a move of at most {top:g}")


@clause(
    "SHARE-15",
    Level.L3,
    needs=_MOVES,
    bench=_TOGETHER,
    source="motorapi.ownership: one operation at a time, in the order of requests; Motor.enable",
)
def operations_at_once_take_turns(bench: RigProtocol) -> None:
    """Operations of two users at the same instant are all carried out, one after the other."""
    motor, other = _both(bench)
    way = 0.1 * long_move(bench)
    move(bench, motor, way)
    for first, second in ((motor, other), (other, motor)):
        first.disable()
        party = bench.runtime.spawn("second", second.enable)
        first.reset_fault()
        first.enable()
        expect(party.join(_PATIENCE_S), f"enable() of {second.name} does not end")
        if party.error is not None:
            raise Violated(f"enable() of both at once: {second.name} got {party.error!r}")
        for user in (first, second):
            expect_state(user, MotorState.ENABLED, "enabled by two users at once")
        before = position_of(bench, motor)
        move(bench, second, way)
        expect_moved(bench, motor, before, way, "enabled by two users at once")


@clause(
    "SHARE-11",
    Level.L3,
    needs={Capability.POSITION_TRAJECTORY},
    bench={*_TOGETHER, Ability.AFRESH},
    source="harness.sharing_tests: the history of every motor is that of one owner at a time",
)
def motor_has_one_owner_at_a_time(bench: RigProtocol) -> None:
    """Whatever users start, reserve, stop, take over, or die of, one has the motor at a time."""
    from hypothesis import HealthCheck, Phase, seed, settings
    from hypothesis.errors import HypothesisException

    from motorhil.harness.sharing_tests.history import SharingViolated
    from motorhil.harness.sharing_tests.state_machine import Course, ownership_machine

    if not hasattr(bench.runtime, "end"):
        raise NotApplicable("users cannot be killed in wall time")
    way = 0.05 * long_move(bench)
    quick_s = max(0.3, 2.0 * shortest_s(bench.motor, 3.0 * way))
    facts = bench.facts
    course = Course(way, quick_s, 2.0 * facts.window, facts.time_tolerance_s)
    machine: Any = ownership_machine(lambda: _rig_of(bench), course)
    machine.TestCase.settings = settings(
        deadline=None,
        max_examples=_EXAMPLES,
        stateful_step_count=_STEPS,
        phases=[Phase.generate],
        database=None,
        report_multiple_bugs=False,
        suppress_health_check=list(HealthCheck),
    )
    for attempt in range(_COURSES):
        seed(f"{bench.seed} {attempt}" if attempt else bench.seed)(machine)
        try:
            machine.TestCase().runTest()
        except (SharingViolated, HypothesisException) as error:
            raise Violated(f"{error}") from error
        if any(count for name, count in machine.reach.items() if name.startswith("start: done")):
            return
    raise NotApplicable(f"no user completed a motion in {_COURSES} courses; use another seed")


def _rig_of(bench: RigProtocol) -> Any:
    """Return the bench, switched on again, as a rig for the state machine."""
    bench.afresh()
    motor, other = bench.motor, bench.another_user_of(bench.motor)
    motors = {motor.name: motor, other.name: other}
    return SimpleNamespace(runtime=bench.runtime, motors=motors, close=lambda: None)


@clause(
    "SHARE-14",
    Level.L3,
    needs=_MOVES,
    bench=_TOGETHER,
    source="Motor.reserve, Motor.start: MotorBusyError names the holder; UsageError",
)
def refusal_names_who_is_next(bench: RigProtocol) -> None:
    """Invalid requests are refused; during a wait, all others learn who waits for the motor."""
    motor, other = _both(bench)
    wrong: tuple[dict[str, Any], ...] = (
        *({"lease_s": one} for one in (0.0099, 1.1e6, True, "1", float("nan"))),
        *({"take_over": 1}, {"purpose": None}, {"timeout_s": -1e-9}, {"timeout_s": "1"}),
    )
    for how in wrong:
        arguments = ", ".join(f"{name}={value!r}" for name, value in how.items())
        reserve = partial(motor.reserve, **how)
        expect_raises(UsageError, partial(_enter, reserve), f"reserve({arguments})")
    for lease_s in (0.01, 1e6):
        with motor.reserve("survey", lease_s=lease_s) as reservation:
            (claim,) = reservation.claims
            expect(claim.lease_s == lease_s, f"a lease of {claim.lease_s} s, not {lease_s} s")
    tokens = []
    for user in (motor, other, motor):
        with user.reserve("survey") as reservation:
            tokens.append(reservation.token)
            with user.reserve("inner") as inner:
                expect(inner.token == reservation.token, "an inner reservation has a new token")
            expect(reservation.is_held, "an inner block gave the outer reservation back")
    expect(tokens == sorted(set(tokens)), f"tokens {tokens} do not grow")
    way = long_move(bench)
    follow(motor, TrapezoidalTrajectory(way))

    def start_next() -> None:
        prepare(other, -way)
        other.start(timeout_s=_PATIENCE_S)

    party = bench.runtime.spawn("next", start_next)
    rest_for(bench, 0.2 * shortest_s(motor, way))
    error = _refusal_of(motor.reset_fault)
    expect(
        error is not None and error.motor == motor.name and other.name in error.holder,
        f"while {other.name} waits, reset_fault() of {motor.name}: {error}",
    )
    finish(bench, motor, shortest_s(motor, way))
    expect(party.join(_PATIENCE_S) and party.error is None, f"{other.name}: {party.error!r}")
    finish(bench, other, shortest_s(motor, way))


def _enter(reserve: Callable[[], Any]) -> None:
    with reserve():
        pass


_STOPS_IN_A_START: Final = (
    *((Motor.stop, 0.02), (Motor.quick_stop, 0.04), (Motor.quick_stop, 0.1)),
    *((Motor.stop, 0.5), (Motor.quick_stop, 0.7), (Motor.stop, 0.98)),
)


@clause(
    "SHARE-16",
    Level.L3,
    needs=_MOVES,
    bench={*_TOGETHER, Ability.TRUTH},
    source="Motor.start: MotionInterrupted, another party stopped the motor meanwhile",
)
def stop_during_start_is_not_overridden(bench: RigProtocol) -> None:
    """A stop while another user's start prepares a motion ends it: it is not made all the same."""
    motor, other = _both(bench)
    way = long_move(bench)
    usual_s = 0.0
    for _ in range(2):  # the first start sets the drive up, too
        motor.disable()
        begun_ns = bench.runtime.now_ns()
        prepare(motor, way)
        motor.start()
        usual_s = elapsed_s(bench, begun_ns)
        motor.stop()
        finish(bench, motor)
    for stop, share in _STOPS_IN_A_START:
        motor.disable()
        before = position_of(bench, motor)
        stopping = partial(later, bench, share * usual_s, partial(stop, other))
        party = bench.runtime.spawn("stop", stopping)
        prepare(motor, way)
        error = failure_of(motor.start)
        expect(party.join(_PATIENCE_S) and party.error is None, f"its stop: {party.error!r}")
        what = f"{other.name} called {stop.__name__}() {share:.0%} into start() of {motor.name}"
        error = error or failure_of(partial(motor.wait_until_done, _PATIENCE_S))
        is_told = isinstance(error, MotionInterrupted | MotorBusyError) and other.name in str(error)
        expect(is_told, f"{what}: {error!r}; expected that it is told of the stop")
        finish(bench, other)
        expect_rest(bench, motor, what)
        made = abs(position_of(bench, motor) - before)
        expect(made < 0.9 * abs(way), f"{what}, but it moved {made:g} of {abs(way):g}")
        way = -way
