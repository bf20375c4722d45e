"""L3 and L4: two programs that share the drives on a bus, each with its own hardware objects.

The motor under test is in one program, other users are in the other. They know of each other by the
locks and by the bus only, as two processes do: `RigProtocol.apart`.
"""

from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from functools import partial
from math import copysign
from typing import Final

from motorhil.harness.conformance.bench import Ability, RigProtocol
from motorhil.harness.conformance.clause import Level, Violated, clause, expect
from motorhil.harness.conformance.clauses.helpers import (
    elapsed_s,
    expect_moved,
    expect_rest,
    expect_unmoved,
    failure_of,
    finish,
    follow,
    long_move,
    midway_s,
    move,
    position_of,
    rest_for,
    shortest_s,
    smooth_move,
    turn,
)
from motorhil.harness.rig.config.conformance import Capability
from motorhil.motorapi import (
    ControlMode,
    MotionInterrupted,
    Motor,
    MotorBusyError,
    TrapezoidalTrajectory,
    UnsupportedError,
)

_MOVES = {Capability.POSITION_TRAJECTORY}
_TWO = {Ability.SECOND_PROGRAM, Ability.TRUTH}
_SOURCE: Final = "requirement 4 of the paper; Sharing and locking: one owner, of any program"
_PATIENCE_S: Final = 10.0
_LEASE_S: Final = 0.2
_SLOW: Final = 2.0
_WATCHED_S: Final = 0.3
_LINGER_S: Final = 0.1


def _both(bench: RigProtocol) -> tuple[Motor, Motor]:
    """Return the motor and that of the other program."""
    bench.apart()
    return bench.motor, bench.another_user_of(bench.motor)


def _prepare(motor: Motor, way: float, duration_s: float | None = None) -> None:
    """Set up the trajectory of the next start."""
    motor.set_control_mode(ControlMode.TRAJECTORY)
    motor.set_trajectory(TrapezoidalTrajectory(way, duration_s=duration_s))


def _refusal_of(operation: Callable[[], object], what: str) -> MotorBusyError:
    error = failure_of(operation)
    if isinstance(error, MotorBusyError):
        return error
    raise Violated(f"{what}: {error or 'accepted'}; expected a refusal")


@contextmanager
def _silent(bench: RigProtocol, motor: Motor, what: str) -> Iterator[None]:
    """Check that the program of this motor sends no command within the block, if that is seen."""
    if Ability.TRAFFIC not in bench.abilities:
        yield
        return
    with bench.commands_to(motor) as sent:
        yield
    expect(not sent, f"{what}, but sent {', '.join(sorted(set(sent)))}")


def _expect_all_refused(bench: RigProtocol, motor: Motor, what: str) -> MotorBusyError:
    """Check that this program may not command the motor, and sends nothing; return a refusal."""
    error = None
    with _silent(bench, motor, f"{motor.name} was refused {what}"):
        for operation in (
            *(motor.start, motor.enable, motor.disable, motor.home, motor.reset_fault),
            motor.reserve("a clause").__enter__,
        ):
            name = operation.__qualname__.rpartition(".")[2]
            error = _refusal_of(operation, f"{name}() of {motor.name} {what}")
            rest_for(bench, 0.01)
    assert error is not None
    return error


def _leave(bench: RigProtocol, motor: Motor) -> None:
    """Switch the motor off: a servo on the host keeps its node until then, and a little longer."""
    motor.disable()
    rest_for(bench, _LINGER_S)


@clause("PROC-08", Level.L3, needs=_MOVES, bench=_TWO, source=_SOURCE)
def program_leaves_motor_of_other_program_alone(bench: RigProtocol) -> None:
    """Until a motion has ended, another program may read the motor, but not command it."""
    motor, other = _both(bench)
    way = long_move(bench)
    usual_s = shortest_s(motor, way)
    for user, stranger, duration_s in (
        *((motor, other, 2.0 * usual_s), (other, motor, 3.0 * usual_s)),
        (motor, other, 2.0 * usual_s),  # as before, although another program has had it
    ):
        before = position_of(bench, user)
        _prepare(user, way, duration_s)
        _prepare(stranger, -0.5 * way)
        user.start()
        begun_ns = bench.runtime.now_ns()
        rest_for(bench, 0.3 * duration_s)
        what = f"while {user.name} moves in another program"
        error = _expect_all_refused(bench, stranger, what)
        expect(error.process is not None, f"refused {what} by {error}: no process is named")
        expect(user.name in str(error), f"refused {what} by {error}: its activity is not named")
        spare = bench.facts.window + 0.1 * user.model.velocity_max
        apart = abs(stranger.position() - user.position())
        expect(apart <= spare, f"{what}, {stranger.name} reads a position {apart:g} off")
        finish(bench, user, duration_s)
        took_s = elapsed_s(bench, begun_ns)
        most_s = bench.facts.time_tolerance_s + 0.1 * duration_s
        expect(
            abs(took_s - duration_s) <= most_s,
            f"{user.name}: the move took {took_s:.3f} s; expected {duration_s:.3f} s",
        )
        expect_moved(bench, user, before, way, f"{stranger.name} is of another program")
        _leave(bench, user)
        way = -way


@clause(
    "PROC-09",
    Level.L3,
    needs=_MOVES,
    bench=_TWO,
    source=f"{_SOURCE}; motorapi.ownership.fencing; MotionInterrupted",
)
def program_that_lost_motor_sends_nothing(bench: RigProtocol) -> None:
    """If a program loses its motor in a motion, it stops commanding it, and its user learns why."""
    motor, other = _both(bench)
    way = 2.0 * long_move(bench)
    for kind, begin in _MOTIONS.items():
        what = f"{motor.name} was taken over in {kind}"
        motor.enable()
        try:
            begin(motor, way)
        except UnsupportedError:
            continue
        rest_for(bench, midway_s(motor, way, 0.3))
        with other.reserve("rescue", take_over=True, timeout_s=_PATIENCE_S) as taken:
            expect_rest(bench, motor, what)
            before = position_of(bench, motor)
            with _silent(bench, motor, what):
                rest_for(bench, _WATCHED_S)
            expect_unmoved(bench, motor, before, what)
            error = failure_of(partial(motor.wait_until_done, _PATIENCE_S))
            expect(
                isinstance(error, MotionInterrupted) and "on demand" in error.by,
                f"{what}: its wait ended with {error!r}; expected the takeover",
            )
            _prepare(motor, 0.1 * way)
            _expect_all_refused(bench, motor, "after a takeover by another program")
            move(bench, other, -0.25 * way)
            expect_moved(bench, other, before, -0.25 * way, f"{what}: {other.name} moves it")
            expect(taken.is_held, f"{what}: the new owner has lost it")
        _leave(bench, other)
        way = -way


_MOTIONS: Final[Mapping[str, Callable[[Motor, float], None]]] = {
    "a trajectory": lambda motor, way: follow(motor, TrapezoidalTrajectory(way)),
    "a streamed trajectory": lambda motor, way: follow(motor, smooth_move(motor, way)),
    "a turn": lambda motor, way: turn(motor, copysign(0.5 * motor.model.velocity_max, way)),
}


@clause("PROC-10", Level.L3, needs=_MOVES, bench=_TWO, source=f"{_SOURCE}; leases; Motor.reserve")
def unused_lease_passes_to_other_program(bench: RigProtocol) -> None:
    """A lease lasts while its program uses the motor or waits for it; unused, it passes on."""
    motor, other = _both(bench)
    way = long_move(bench)
    move(bench, motor, 0.1 * way)
    with motor.reserve("survey", lease_s=_LEASE_S) as survey:
        duration_s = max(4.0 * _LEASE_S, _SLOW * shortest_s(motor, way))
        _prepare(motor, way, duration_s)
        motor.start()
        refused: list[str] = []

        def try_it() -> None:
            while elapsed_s(bench, begun_ns) < 0.9 * duration_s:
                refused.append(str(failure_of(other.enable)))
                rest_for(bench, 0.2 * _LEASE_S)

        begun_ns = bench.runtime.now_ns()
        party = bench.runtime.spawn("other program", try_it)
        finish(bench, motor, duration_s)
        expect(party.join(_PATIENCE_S) and party.error is None, f"{party.error!r}")
        wrong = [one for one in refused if "survey" not in one]
        expect(not wrong, f"during a wait under a lease, the other program got {wrong}")
        expect(survey.is_held, "a lease ended, although its owner waited for the motor")
        _refusal_of(other.reserve("next").__enter__, "a reservation of a motor with a valid lease")
        rest_for(bench, 2.0 * _LEASE_S)
        with other.reserve("next", timeout_s=_PATIENCE_S):
            expect(not survey.is_held, "is_held is True after the lease was over and taken")
            expect("lease" in (survey.lost_to or ""), f"lost to {survey.lost_to}")
            before = position_of(bench, motor)
            _prepare(motor, way)
            _expect_all_refused(bench, motor, "after its lease was over")
            expect_unmoved(bench, motor, before, "commanded after its lease was over")
    _leave(bench, other)
    move(bench, motor, -0.5 * way)
