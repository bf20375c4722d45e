"""L3 and L4: two programs that share the drives on a bus, each with its own hardware objects.

The motor under test is in one program, other users are in the other. They know of each other by the
locks and by the bus only, as two processes do: `RigProtocol.apart`.
"""

from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from functools import partial
from itertools import groupby, pairwise
from math import copysign
from typing import Any, Final

from motorhil.harness.conformance.bench import Ability, RigProtocol
from motorhil.harness.conformance.clause import Level, NotApplicable, Violated, clause, expect
from motorhil.harness.conformance.clauses.helpers import (
    begin_move,
    elapsed_s,
    expect_moved,
    expect_rest,
    expect_taken_over,
    expect_unmoved,
    failure_of,
    finish,
    finish_group,
    follow,
    half_move,
    long_move,
    midway_s,
    move,
    pair_of,
    position_of,
    prepare,
    reached,
    rest_for,
    shortest_s,
    smooth_move,
    turn,
)
from motorhil.harness.rig.config.conformance import Capability
from motorhil.motorapi import (
    MotionInterrupted,
    Motor,
    MotorBusyError,
    MotorError,
    MotorGroup,
    MotorState,
    TrapezoidalTrajectory,
    UnsupportedError,
)
from motorhil.motorapi.ownership.claim import LockAction

_MOVES = {Capability.POSITION_TRAJECTORY}
_TWO = {Ability.SECOND_PROGRAM, Ability.TRUTH}
_SOURCE: Final = "requirement 4 of the paper; Sharing and locking: one owner, of any program"
_PATIENCE_S: Final = 10.0
_LEASE_S: Final = 0.2
_SLOW: Final = 2.0
_DEVICE_TYPE: Final = 0x1000  # CiA 301
_WATCHED_S: Final = 0.3
_LINGER_S: Final = 0.1
_ROUNDS: Final = 2
_SHARES: Final = (0.1, 0.3, 0.5, 0.7, 0.9)  # of the messages of a start
_DEATHS: Final = 8
_LOST: Final = 2  # answers; a reading may be repeated
_NEVER: Final = 1_000_000_000  # messages
_TAKES: Final = (LockAction.TAKEN, LockAction.BROKEN, LockAction.TAKEN_OVER)


def _both(bench: RigProtocol) -> tuple[Motor, Motor]:
    """Return the motor and that of the other program."""
    bench.apart()
    return bench.motor, bench.another_user_of(bench.motor)


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
        prepare(user, way, duration_s)
        prepare(stranger, -0.5 * way)
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
        state = stranger.state()  # some drives do not tell whether they are on
        is_right = state in (user.state(), MotorState.DISABLED)
        expect(is_right, f"{what}, {stranger.name} reads state {state.value}")
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
    "PROC-18",
    Level.L3,
    needs=_MOVES,
    bench={*_TWO, Ability.SECOND_MOTOR},
    source="paper 3.5, one physical motor object for any motor; Sharing and locking",
)
def other_program_leaves_neighbour_alone(bench: RigProtocol) -> None:
    """Whatever another program does with one motor, the motion of another motor goes on."""
    bench.apart()
    motor, neighbour = bench.motor, bench.another_user_of(bench.motors[1])
    way, duration_s = long_move(bench), _SLOW * shortest_s(bench.motor, long_move(bench))
    neighbour.position()
    before = position_of(bench, motor)
    prepare(motor, way, duration_s)
    motor.start()
    for operation in (Motor.enable, Motor.reset_fault, Motor.disable, Motor.stop):
        rest_for(bench, 0.1 * duration_s)
        what = f"{operation.__name__}() of {neighbour.name} by another program"
        error = failure_of(partial(operation, neighbour))
        expect(error is None or isinstance(error, MotorBusyError), f"{what}: {error}")
    finish(bench, motor, duration_s)
    expect_moved(bench, motor, before, way, f"another program used {neighbour.name} meanwhile")
    _leave(bench, motor)


@clause(
    "PROC-15",
    Level.L3,
    needs=_MOVES,
    bench={*_TWO, Ability.OTHER_PROGRAM},
    source="motorapi.motor: Motor.stop",
)
def stop_of_other_program_acts(bench: RigProtocol) -> None:
    """A stop needs no ownership: it ends a motion of another program, even one just begun."""
    motor, other = _both(bench)
    other.position()
    _expect_stop_leaves_power(bench, motor, other)
    _leave(bench, motor)
    way = 2.0 * long_move(bench)
    for when, share in (("just begun", 0.0), ("on its way", 0.3)):
        before = position_of(bench, motor)
        prepare(motor, way, _SLOW * shortest_s(motor, way))
        motor.start()
        rest_for(bench, midway_s(motor, way, share))
        other.stop()
        rest_for(bench, 2.0 * _SLOW * shortest_s(motor, way))
        what = f"a stop by another program, of a motion {when}"
        expect_rest(bench, motor, what)
        went, unit = position_of(bench, motor) - before, motor.model.unit
        expect(abs(went) < 0.9 * abs(way), f"{what}: it went {went:g} of {way:g} {unit}")
        _leave(bench, motor)
        way = -way


def _expect_stop_leaves_power(bench: RigProtocol, motor: Motor, other: Motor) -> None:
    """Expect a stop by a program that has just lost its motor to leave the motor as it is."""
    move(bench, motor, 0.1 * long_move(bench))
    with other.reserve("rescue", take_over=True, timeout_s=_PATIENCE_S):
        state, before = other.state(), position_of(bench, motor)
        motor.stop()
        rest_for(bench, _WATCHED_S)
    rest_for(bench, _WATCHED_S)
    now, what = other.state(), "stopped by the program that had it before, and let go"
    expect(now is state, f"taken over, {what}: {now.value}; {state.value} before the stop")
    expect_unmoved(bench, motor, before, f"taken over, {what}")


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
            expect_taken_over(partial(motor.wait_until_done, _PATIENCE_S), what)
            prepare(motor, 0.1 * way)
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
        prepare(motor, way, duration_s)
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
            prepare(motor, way)
            _expect_all_refused(bench, motor, "after its lease was over")
            expect_unmoved(bench, motor, before, "commanded after its lease was over")
    _leave(bench, other)
    move(bench, motor, -0.5 * way)


@clause(
    "PROC-11",
    Level.L3,
    needs=_MOVES,
    bench=_TWO,
    source="motorapi.motor: read access needs no ownership; Sharing and locking",
)
def reader_waits_until_drive_is_set_up(bench: RigProtocol) -> None:
    """A program may read a motor that another program has, also before its drive was set up."""
    motor, other = _both(bench)
    way = 0.5 * long_move(bench)
    read: list[float] = []
    with motor.reserve("tea"):
        party = bench.runtime.spawn("reader", lambda: read.append(other.position()))
        expect(party.join(_PATIENCE_S), f"position() of {other.name} waits for its user for ever")
        is_right = party.error is None or isinstance(party.error, MotorBusyError)
        expect(is_right, f"position() of {other.name}, never set up by its user: {party.error!r}")
    motor, other = _both(bench)
    read.clear()
    with motor.reserve("survey"):
        party = bench.runtime.spawn("reader", lambda: read.append(other.position()))
        rest_for(bench, _LINGER_S)
        before = position_of(bench, motor)
        move(bench, motor, way)
        expect(party.join(_PATIENCE_S), f"position() of {other.name} does not return")
        if party.error is not None:
            raise Violated(f"position() of {other.name} in another program: {party.error!r}")
        spare = bench.facts.window + 0.1 * motor.model.velocity_max
        low, high = sorted((before, before + way))
        expect(low - spare <= read[0] <= high + spare, f"{other.name} read {read[0]:g}")
        expect_moved(bench, motor, before, way, "read by another program")
        apart = abs(other.position() - motor.position())
        expect(apart <= bench.facts.window, f"two programs read positions {apart:g} apart")
    _leave(bench, motor)
    before = position_of(bench, other)
    move(bench, other, way)
    expect_moved(bench, other, before, way, "once it was free")


@clause(
    "PROC-12",
    Level.L3,
    needs={*_MOVES, Capability.LOW_LEVEL},
    bench=_TWO,
    source=f"{_SOURCE}; Motor.low_level: afterwards nothing is assumed",
)
def waiting_program_gets_motor_in_turn(bench: RigProtocol) -> None:
    """Programs wait for a motor in the order of their requests, and no longer than they asked."""
    motor, other = _both(bench)
    way = 0.2 * long_move(bench)
    before = position_of(bench, motor)
    move(bench, motor, way)
    motor.disable()
    prepare(other, way)
    with motor.low_level():
        for wait_s in (None, _LEASE_S):
            begun_ns = bench.runtime.now_ns()
            what = f"start(timeout_s={wait_s}) of {other.name} in another program"
            error = _refusal_of(partial(other.start, wait_s), what)
            late_s = elapsed_s(bench, begun_ns) - (wait_s or 0.0)
            most_s = bench.facts.time_tolerance_s
            expect(0.0 <= late_s <= most_s, f"{what} was refused {late_s:g} s late")
            expect("low-level" in str(error), f"{what}: {error}; expected the purpose")
        served: list[str] = []

        def start_next() -> None:
            other.start(timeout_s=_PATIENCE_S)
            served.append(other.name)
            other.wait_until_done(_PATIENCE_S)

        party = bench.runtime.spawn("next", start_next)
        rest_for(bench, _LINGER_S)
        expect(not served, f"{other.name} got the motor in low-level access of another program")
    with motor.reserve("after it", timeout_s=_PATIENCE_S):
        expect(served == [other.name], "the motor was not given to the program that asked first")
        _expect_objects_are_read(other)
    expect(party.join(_PATIENCE_S) and party.error is None, f"{other.name}: {party.error!r}")
    expect_moved(bench, motor, before, 2.0 * way, f"moved by {motor.name}, then {other.name}")


def _expect_objects_are_read(stranger: Motor) -> None:
    """Expect a program to read objects of a CANopen node that another program owns."""
    hardware: Any = getattr(stranger, "hardware", None)
    if not all(hasattr(hardware, name) for name in ("upload", "sdo")):
        return
    with hardware.sdo() as client:
        found = client.upload(_DEVICE_TYPE, 0)
    expect(found == hardware.upload(_DEVICE_TYPE), f"1000h of another program's drive: {found!r}")


@clause(
    "PROC-13",
    Level.L3,
    needs=_MOVES,
    bench={*_TWO, Ability.OWNERS},
    source="motorapi.hooks: on CAN, announce informs a hub; recordings have the history of owners",
)
def owners_are_announced_on_the_bus(bench: RigProtocol) -> None:
    """On the bus, each program tells when it takes, loses or releases a motor, by its token."""
    motor, other = _both(bench)
    way = 0.2 * long_move(bench)
    with bench.owners_of(motor) as told:
        move(bench, motor, way)
        with motor.reserve("tea"), other.reserve("fire", take_over=True):
            _refusal_of(motor.enable, f"enable() of {motor.name}, which was taken over")
        _leave(bench, other)
    owned, last = 0, 0
    for one in told:
        what = f"announced was {one} after token {last}; all: {told}"
        if one.action in _TAKES:
            expect(one.token > last, what)
            expect(not owned or one.action is LockAction.TAKEN_OVER, what)
            owned = last = one.token
        elif one.action is LockAction.RELEASED:
            expect(one.token == owned, what)
            owned = 0
        elif one.action is LockAction.LOST:
            expect(one.token < last and motor.name in one.owner, what)
    expect(not owned, f"a motor that was released is announced as taken: {told}")
    actions = {one.action: one for one in told}
    for action, user in (
        *((LockAction.TAKEN, other), (LockAction.TAKEN_OVER, other), (LockAction.LOST, motor)),
        *((LockAction.REFUSED, motor), (LockAction.RELEASED, other)),
    ):
        found = actions.get(action)
        is_told = found is not None and user.name in found.owner
        expect(is_told, f"{action.name} of {user.name}: announced was {found}; all: {told}")
    over = actions[LockAction.TAKEN_OVER]
    expect(over.purpose == "fire" and over.sender != told[0].sender, f"the takeover: {over}")


@clause(
    "PROC-14",
    Level.L3,
    needs=_MOVES,
    bench={*_TWO, Ability.OTHER_PROGRAM, Ability.TRAFFIC},
    source="Sharing and locking: stops are free; MotionInterrupted names the other program",
)
def any_program_may_stop_the_motor(bench: RigProtocol) -> None:
    """Any program may stop a motor; the user of the motor learns it, and may move it again."""
    motor, other = _both(bench)
    way = 2.0 * long_move(bench)
    other.position()  # connected, and so quick to stop
    for stop in (Motor.stop, Motor.halt, Motor.quick_stop):
        what = f"{stop.__name__}() of {other.name} in another program"
        with motor.reserve("survey"):
            begin = begin_move(bench, motor, way, midway_s(motor, way, 0.3))
            stop(other)
            error = failure_of(partial(motor.wait_until_done, _PATIENCE_S))
            is_told = isinstance(error, MotionInterrupted) and "program" in error.by
            expect(is_told, f"{what}: the wait of {motor.name} ended with {error!r}")
            finish(bench, other)
            with _silent(bench, motor, f"{what} was obeyed: {motor.name} waited for that"):
                rest_for(bench, _LINGER_S)
            expect_rest(bench, motor, what)
            made = abs(position_of(bench, motor) - begin)
            expect(made < 0.95 * abs(way), f"after {what}, the motor moved {made:g} of {way:g}")
            motor.enable()
            before = position_of(bench, motor)
            move(bench, motor, -0.1 * way)
            expect_moved(bench, motor, before, -0.1 * way, f"after {what}")
        way = -way


def _require_separate(first: Motor, second: Motor) -> None:
    """Require that two programs can have these motors at once, and enable them."""
    try:
        first.enable()
        second.enable()
    except MotorBusyError as error:  # as with motors that share a node
        raise NotApplicable(f"two programs cannot have them at once: {error}") from None


@clause(
    "SYNC-20",
    Level.L4,
    needs={*_MOVES, Capability.COMPLEX_POSITION},
    bench={*_TWO, Ability.CLOCK, Ability.SECOND_MOTOR},
    source="Sharing and locking: one program produces a cyclic SYNC, others follow it; CiA 301",
)
def programs_share_one_clock(bench: RigProtocol) -> None:
    """If two programs stream, one signal clocks both; it goes on when its producer has ended."""
    bench.apart()
    first, second = bench.motors[0], bench.another_user_of(bench.motors[1])
    way = half_move(bench)
    _require_separate(first, second)
    for early, late in ((first, second), (second, first)):
        before = [position_of(bench, motor) for motor in (early, late)]
        with bench.clock() as times_ns:
            follow(early, smooth_move(early, way))
            rest_for(bench, 0.3 * shortest_s(early, way))
            follow(late, smooth_move(late, way))
            for motor in (early, late):
                finish(bench, motor, shortest_s(motor, way))
        steps_s = sorted((after - was) / 1e9 for was, after in pairwise(times_ns))
        reached(len(steps_s) > 2, "a clock signal")
        usual_s = steps_s[len(steps_s) // 2]
        expect(
            0.5 * usual_s <= steps_s[0] and steps_s[-1] <= 2.0 * usual_s,
            f"clock signals of two programs are {steps_s[0]:g} to {steps_s[-1]:g} s apart;"
            f" expected {usual_s:g} s",
        )
        for motor, was in zip((early, late), before, strict=True):
            expect_moved(bench, motor, was, way, "streamed beside another program")
        way = -way


@clause(
    "SYNC-21",
    Level.L4,
    needs=_MOVES,
    bench={*_TWO, Ability.SECOND_MOTOR},
    source="MotorGroup.reserve: acquired in the same order in all programs; no deadlock",
)
def groups_of_programs_take_turns(bench: RigProtocol) -> None:
    """Groups of two programs on the same motors start in turn, whatever their own order is."""
    bench.apart()
    mine = MotorGroup(*bench.motors[:2])
    others = [bench.another_user_of(motor) for motor in bench.motors[:2]]
    theirs = MotorGroup(*reversed(others))
    way = 0.1 * long_move(bench)
    before = [position_of(bench, motor) for motor in mine]
    made: list[str] = []

    def use(group: MotorGroup, name: str) -> None:
        for _ in range(_ROUNDS):
            with group.reserve(name, timeout_s=_PATIENCE_S):
                for motor in group:
                    prepare(motor, way)
                group.start()
                made.append(name)
                finish_group(bench, group)
                for motor in group:
                    motor.disable()
                rest_for(bench, _LINGER_S)

    party = bench.runtime.spawn("theirs", lambda: use(theirs, "theirs"))
    use(mine, "mine")
    expect(party.join(_PATIENCE_S), "the group of the other program does not end")
    if party.error is not None:
        raise Violated(f"the group of the other program: {party.error!r}")
    skew = mine.sync_capability()  # frames of the other program have no bound
    is_bounded = skew.command_skew_s is not None and skew.command_skew_s > 0.0
    expect(
        not is_bounded and (skew.command_skew_s == 0.0 or bool(skew.no_command_bound)), f"{skew}"
    )
    turns = [len(list(some)) for _, some in groupby(made)]
    expect(max(turns) == 1, f"groups that wait for each other were served in the order {made}")
    for motor, was in zip(mine, before, strict=True):
        expect_moved(bench, motor, was, 2.0 * _ROUNDS * way, "two programs took turns", 2.0)


@clause(
    "SYNC-22",
    Level.L4,
    needs=_MOVES,
    bench={*_TWO, Ability.SECOND_MOTOR},
    source="MotorGroup.fault_reaction: a motor fails by a fault, a lost link, or a takeover",
)
def takeover_of_member_stops_its_group(bench: RigProtocol) -> None:
    """If another program takes a member over, the others stop, and a wait tells the reason."""
    bench.apart()
    theirs = bench.another_user_of(bench.motors[1])
    _require_separate(bench.motors[0], theirs)
    _leave(bench, theirs)  # some programs command a motor at rest
    way = half_move(bench)
    for place in (0, 1):
        group = pair_of(bench, way, way)
        duration_s = 5.0 * shortest_s(bench.motor, way)
        group.set_trajectory(*(TrapezoidalTrajectory(way, duration_s=duration_s) for _ in group))
        lost, left = group[place], group[1 - place]
        group.start()
        before = position_of(bench, left)
        rest_for(bench, 0.2 * duration_s)
        other = bench.another_user_of(lost)
        with other.reserve("rescue", take_over=True, timeout_s=_PATIENCE_S):
            expect_rest(bench, lost, f"{lost.name} was taken over from its group")
            end = partial(group.wait_until_done, _PATIENCE_S) if place else group.is_done
            expect_taken_over(end, f"{lost.name} was taken over from its group")
            rest_for(bench, 1.1 * duration_s)
            made = abs(position_of(bench, left) - before)
            is_stopped = made < 0.9 * abs(way)
            expect(is_stopped, f"{lost.name} was taken over, but {left.name} moved {made:g}")
            _leave(bench, other)
        _leave(bench, left)
        way = -way


def _begin_pair(group: MotorGroup, way: float) -> None:
    for motor in group:
        prepare(motor, way)
    group.start()


def _begin_all(motors: Sequence[Motor], way: float) -> None:
    """Start the motors together; a single one by a stream of set-points, if it can."""
    if len(motors) > 1:
        _begin_pair(MotorGroup(*motors), way)
        return
    try:
        follow(motors[0], smooth_move(motors[0], way))
    except UnsupportedError:
        prepare(motors[0], way)
        motors[0].start()


def _kill_in_start(bench: RigProtocol, group: MotorGroup, way: float, messages: int) -> None:
    """Start the group, and kill its program after so many messages, or when it has started."""
    has_started = False

    def start() -> None:
        nonlocal has_started
        _begin_pair(group, way)
        has_started = True

    with bench.killed_after(group[0], messages) as sent:
        bench.runtime.spawn("start", start)
        bench.runtime.wait_until(lambda: has_started or sent() >= messages, _PATIENCE_S)
    if has_started:
        with bench.killed_after(group[0], 0):
            pass


@clause(
    "SYNC-23",
    Level.L4,
    needs=_MOVES,
    bench={*_TWO, Ability.SECOND_MOTOR},
    source="Sharing and locking: kill -9 leaves nothing that the next start would set in motion",
)
def start_of_killed_program_is_over(bench: RigProtocol) -> None:
    """If a program is killed while it starts a group, no start of another program completes it."""
    bench.apart()
    _require_separate(bench.motors[0], bench.another_user_of(bench.motors[1]))
    way = 0.2 * long_move(bench)
    ways_out = [(1, False), (3, False)]  # the last message may start all motors at once
    if len(bench.motors) > 2:
        ways_out.append((1, True))  # the others start together, and nobody touches the first one
    for left, is_left_alone in ways_out:
        bench.apart()
        motor, *mine = bench.motors
        theirs = MotorGroup(*map(bench.another_user_of, (motor, mine[0])))
        motor.position()  # connected: it keeps the drive on when its user is dead
        _begin_pair(theirs, way)
        finish_group(bench, theirs)
        with bench.killed_after(theirs[0], _NEVER) as sent:
            _begin_pair(theirs, -way)
            messages = sent()
        finish_group(bench, theirs)
        _kill_in_start(bench, theirs, way, max(1, messages - left))
        rest_for(bench, 2.0 * shortest_s(motor, way) + _LINGER_S)
        what = f"a program was killed in the start of {motor.name} and {mine[0].name}"
        for one in mine if is_left_alone else bench.motors:
            if one.state() is MotorState.FAULT:  # some drives miss their host
                one.reset_fault()
            one.enable()
        before = [position_of(bench, one) for one in bench.motors]
        if left > 1:  # the next start is that of a motor which the program has left
            prepare(motor, -way, 4.0 * shortest_s(motor, way))
            motor.start()
        _begin_all(mine, -way)
        for one in mine:
            finish(bench, one)
        if left > 1:
            finish(bench, motor)
            expect_moved(bench, motor, before[0], -way, what)
        for one, was in zip(mine, before[1:], strict=True):
            expect_moved(bench, one, was, -way, what)
        made = abs(position_of(bench, motor) - before[0])
        expect(left > 1 or made < 0.5 * abs(way), f"{what}: a start moved {motor.name} by {made:g}")


def _count_start(bench: RigProtocol, motor: Motor, way: float) -> int:
    """Return the number of messages of a start of this motor, which moves by this distance."""
    prepare(motor, way)
    with bench.killed_after(motor, _NEVER) as sent:
        motor.start()
        messages = sent()
    finish(bench, motor)
    return messages


def _require_quiet(bench: RigProtocol, motor: Motor) -> None:
    """Raise NotApplicable if the program of this motor commands it at rest, too."""
    if Ability.TRAFFIC in bench.abilities:
        with bench.commands_to(motor) as held:
            rest_for(bench, _LINGER_S)
        if held:
            raise NotApplicable("its program commands it at rest, until another one does")


def _lose_in_start(
    bench: RigProtocol, motor: Motor, other: Motor, messages: int, what: str
) -> None:
    """Start the motor, and take it over once its program has sent so many messages."""
    with bench.killed_after(motor, _NEVER) as sent:
        party = bench.runtime.spawn("start", motor.start)
        bench.runtime.wait_until(lambda: sent() >= messages, _PATIENCE_S)
    with (
        _silent(bench, motor, what),
        other.reserve("rescue", take_over=True, timeout_s=_PATIENCE_S),
    ):
        expect(party.join(_PATIENCE_S), f"{what}: start() does not return")
        error = party.error  # a drive that obeys its new owner may not answer as expected
        expect(isinstance(error, MotorError), f"{what}: start() ended with {error!r}")
        before = position_of(bench, motor)
        rest_for(bench, _LINGER_S)
        expect_unmoved(bench, motor, before, what)


@clause(
    "PROC-16",
    Level.L3,
    needs=_MOVES,
    bench=_TWO,
    source=f"{_SOURCE}; motorapi.ownership.fencing",
)
def program_that_lost_motor_in_start_sends_nothing(bench: RigProtocol) -> None:
    """If a program loses its motor while it starts it, the start fails, and sends nothing more."""
    motor, other = _both(bench)
    way = 0.2 * long_move(bench)
    first = _count_start(bench, motor, way)
    _require_quiet(bench, motor)
    _leave(bench, motor)
    usual = _count_start(bench, motor, -way)
    _require_quiet(bench, motor)
    for messages, is_first in ((usual, False), (first, True)):
        for share in _SHARES:
            last = round(share * messages)
            if not 0 < last < messages:
                continue  # a motion that has begun: PROC-09
            if is_first:
                motor, other = _both(bench)
            else:
                _leave(bench, motor)
            prepare(motor, way, (2.0 + share) * shortest_s(motor, way))
            start = "first start" if is_first else "start"
            what = f"{motor.name} was taken over after {last} of {messages} messages of its {start}"
            _lose_in_start(bench, motor, other, last, what)
            way = -way


@clause(
    "PROC-17",
    Level.L3,
    needs=_MOVES,
    bench=_TWO,
    source="Sharing and locking: kill -9 at any moment; a line belongs to one exchange at a time",
)
def broken_exchange_disturbs_no_other(bench: RigProtocol) -> None:
    """If a program gets no answer, or is killed before it comes, others use the drive as before."""
    motor, other = _both(bench)
    way = 0.1 * long_move(bench)
    move(bench, other, way)
    usual = _count_start(bench, other, -way)
    if Ability.LOSE in bench.abilities:
        motor.position()
        with bench.lose_answers_of(motor, limit=_LOST):
            failure_of(motor.position)
        before = position_of(bench, other)
        move(bench, other, way)
        expect_moved(bench, other, before, way, "another program has got no answer")
    step = max(1, usual // (2 * _DEATHS))  # commands come in the second half, behind readings
    for messages in range(max(1, usual // 2), max(2, usual), step):
        motor, other = _both(bench)
        move(bench, other, way)
        motor.position()
        prepare(other, -way)
        before = position_of(bench, other)
        with bench.killed_after(motor, messages):
            bench.runtime.spawn("reader", partial(_read, motor))
            other.start()
        finish(bench, other)
        what = f"a program was killed after {messages} of its messages beside a start"
        expect_moved(bench, other, before, -way, what)


def _read(motor: Motor) -> None:
    """Read the motor's position until its program is killed."""
    while True:
        motor.position()
        motor.runtime.wait_until(lambda: False, 0.001)
