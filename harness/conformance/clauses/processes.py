"""L3: programs that share a motor by a lock in a file: ownership, takeovers, leases, fences.

Each program here has its own lock object on one lock file in a temporary folder, as another process
has: a lock tells its holders apart by their files, and not by their processes. No drive takes part.
"""

import threading
from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager, ExitStack, contextmanager
from functools import partial
from pathlib import Path
from tempfile import TemporaryDirectory
from types import SimpleNamespace
from typing import Any, Final, final

from motorhil.frozen import frozen
from motorhil.harness.conformance.bench import RigProtocol
from motorhil.harness.conformance.clause import Level, Violated, clause, expect
from motorhil.harness.conformance.clauses.helpers import rest_for
from motorhil.motorapi import MotorBusyError
from motorhil.motorapi.locking.directory import LockDirectory
from motorhil.motorapi.locking.process_lock import ProcessLock, close_spare_files
from motorhil.motorapi.logical_motor import LogicalMotor
from motorhil.motorapi.ownership.claim import (
    AcquirePolicy,
    Claim,
    LockAction,
    OwnershipEvent,
    use_leases,
)
from motorhil.motorapi.ownership.fencing import JointFence, NodeFence, announce, joint_fence
from motorhil.motorapi.ownership.ownership import Ownership
from motorhil.motorapi.ownership.physical_motor import ActiveMotion, PhysicalMotor, RunStatus
from motorhil.motorapi.ownership.queue import FifoQueue, share_trigger, trigger_turns
from motorhil.motorapi.runtime.api import ChangeCounter, Runtime

_SOURCE: Final = "requirement 4 of the paper; Sharing and locking: one owner, of any process"
_LEASE_S: Final = 0.02
_LONG_S: Final = 1000.0
_RESOURCE: Final = 0x105


@final
@frozen
class _Owner:
    """A logical motor in the role of an owner."""

    name: str
    runtime: Runtime

    def goes_on(self, run: ActiveMotion) -> bool:
        return not run.is_over


@final
class _FencedBus:
    """A bus that notes what passes its fence, and what was announced."""

    def __init__(self) -> None:
        self.sent: list[tuple[bytes, int, int]] = []
        self.announced: list[tuple[int, int, int, dict[str, str | int]]] = []
        self.checked: list[tuple[int, int]] = []

    def transmit(self, frame: bytes) -> None:
        self.sent.append((frame, 0, 0))

    def transmit_fenced(self, frame: bytes, resource: int, token: int) -> None:
        self.sent.append((frame, resource, token))

    def check_token(self, resource: int, token: int) -> None:
        self.checked.append((resource, token))

    def announce_ownership(
        self, resource: int, action: int, token: int, **facts: str | int
    ) -> None:
        self.announced.append((resource, action, token, facts))


@final
class _Program:
    """One program with its lock, its record of the motor, and the events that it heard of."""

    def __init__(self, runtime: Runtime, folder: Path, name: str, motor: str = "axle") -> None:
        self.lock = ProcessLock(motor, f"the {motor}", LockDirectory(folder))
        self.motor = PhysicalMotor(f"the {motor}", 1, self.lock)
        self.ownership: Ownership = self.motor.ownership
        self.owner = _Owner(name, runtime)
        self.events: list[OwnershipEvent] = []
        self.ownership.listeners.append(self.events.append)
        self.bus = _FencedBus()
        bus: Any = self.bus
        self.fence = NodeFence(self.lock, self.ownership, runtime, bus, _RESOURCE)

    def own(self, purpose: str = "", **how: Any) -> AbstractContextManager[Claim]:
        """Own the motor inside the block."""
        return self.ownership.owned(self.owner, f"start() of {self.owner.name}", purpose, **how)

    def told(self) -> list[LockAction]:
        """Return what its listeners were told since the last call."""
        told = [event.action for event in self.events]
        self.events.clear()
        return told

    def begin(self) -> ActiveMotion:
        """Begin a motion of this program."""
        owner = self.owner
        run = ActiveMotion(f"start() of {owner.name}", owner, owner.runtime.now_ns(), None)
        self.motor.begin(run, RunStatus.GOING)
        return run


@contextmanager
def _lock_folder() -> Iterator[Path]:
    """Return a new folder for locks, whose files are closed at the end."""
    with TemporaryDirectory() as name:
        folder = Path(name)
        try:
            yield folder
        finally:
            close_spare_files(folder)


@contextmanager
def _programs(bench: RigProtocol, *names: str) -> Iterator[list[_Program]]:
    """Return programs that share one motor."""
    with _lock_folder() as folder:
        yield [_Program(bench.runtime, folder, name) for name in names]


def _refusal(operation: Callable[[], object], what: str) -> MotorBusyError:
    try:
        operation()
    except MotorBusyError as error:
        return error
    raise Violated(f"{what}: not refused")


def _try(program: _Program, **how: Any) -> Callable[[], int]:
    def own() -> int:
        with program.own(**how) as claim:
            return claim.token

    return own


@clause("PROC-01", Level.L3, source=_SOURCE)
def program_has_motor_until_last_reason(bench: RigProtocol) -> None:
    """Between programs, a motor has one owner, for all its reasons; others learn of its work."""
    with _programs(bench, "pan", "tilt") as (one, other):
        with one.own("tea") as claim:
            expect(claim.is_held and one.ownership.is_here, "an owner does not have the motor")
            expect(one.ownership.held is claim, "the claim of the owner is not its own")
            expect(not other.ownership.is_here, "a program has the motor of another one")
            error = _refusal(_try(other), "a second owner")
            expect(
                error.motor == "tilt" and error.pid is not None and "tea" in error.purpose,
                f"refused with {error!r}: motor {error.motor}, process {error.process}",
            )
            with one.own() as again:
                expect(again is claim and claim.reasons == 2, f"{claim.reasons} reasons of two")
            _refusal(_try(other), "a second owner, after one of two reasons has ended")
            stranger = _Owner("roll", bench.runtime)
            own = partial(one.ownership.take, stranger, "start() of roll")
            _refusal(own, "another owner of the same program")
        expect(claim.reasons == 0 and not claim.is_held, "released, but held")
        expect(claim.lost_to is None, f"released, but lost to {claim.lost_to}")
        expect(one.ownership.held is None, "a claim that was released is still there")
        tokens = [claim.token]
        for user in (other, one, one, other):
            tokens.append(_try(user)())
        expect(tokens == sorted(set(tokens)), f"tokens {tokens} do not grow")
        expect(other.ownership.absences == 2, f"{other.ownership.absences} absences; expected 2")
        expect(not other.ownership.is_orphan, "a motor that was released is taken for an orphan")
        told = (other.told(), one.told())
        taken = [LockAction.TAKEN, LockAction.RELEASED]
        busy = [LockAction.REFUSED]
        expect(
            told[0] == [*busy, *busy, *taken, *taken], f"events of {other.owner.name}: {told[0]}"
        )
        expect(told[1] == [*taken, *taken, *taken], f"events: {told[1]}")


@clause("PROC-02", Level.L3, source=_SOURCE)
def takeover_ends_former_ownership(bench: RigProtocol) -> None:
    """After a takeover by another program, a motor's former owner is refused and interrupted."""
    with _programs(bench, "pan", "tilt") as (one, other):
        with one.own("tea") as claim:
            run = one.begin()
            rest_for(bench, 1.0)
            spare_s = bench.facts.time_tolerance_s
            seen = one.motor.interruptions
            with other.own("fire", take_over=True) as taken:
                expect(taken.token > claim.token, "the token of the new owner is not greater")
                expect(other.ownership.is_orphan, "a motor in motion is not to be brought to rest")
                expect(one.ownership.is_lost_by(one.owner), "a loss was not noticed")
                expect(not claim.is_held, "held, although it was lost")
                expect(one.motor.interruptions > seen, "a start in progress would not notice it")
                by = claim.lost_to or ""
                expect("fire" in by and "on demand" in by, f"lost to {by!r}")
                expect(run.interrupted_by == by, f"its motion was ended by {run.interrupted_by}")
                late_ns = bench.runtime.now_ns() - run.interrupted_at_ns
                expect(0 <= late_ns <= spare_s * 1e9, f"told to have ended {late_ns} ns ago")
                for what, operation in (
                    ("require()", partial(one.ownership.require, one.owner)),
                    ("own()", _try(one)),
                    ("renew()", claim.renew),
                    ("use()", claim.use),
                    ("set_lease()", partial(claim.set_lease, 1.0)),
                    ("begin_write()", partial(one.ownership.begin_write, "pan")),
                    ("send()", partial(one.fence.send, b"x")),
                ):
                    error = _refusal(operation, f"{what} of the former owner")
                    expect(error.taken_over == "on demand", f"{what}: {error}")
                expect(not one.bus.sent, "a frame of the former owner was sent")
                expect(not other.ownership.is_lost_by(one.owner), "lost by a stranger")
            (lost,) = (event for event in one.events if event.action is LockAction.LOST)
            held_s = 1.0 if lost.token == claim.token else 0.0
            expect(0.0 <= lost.held_s - held_s <= spare_s, f"told: {lost}; held for {held_s} s")
            expect(lost.waited_s == 0.0, f"waited for what it lost: {lost}")
            _refusal(_try(one), "the former owner, within its block")
            expect(_try(one, afresh=True)() > taken.token, "taken afresh with an old token")
        expect(not one.ownership.is_lost_by(one.owner), "lost, after its block has ended")
        _try(one)()
        wanted = [LockAction.TAKEN_OVER, LockAction.RELEASED]
        told = other.told()
        expect(told == wanted, f"events of the new owner: {told}")


@clause("PROC-03", Level.L3, source=f"{_SOURCE}; leases")
def lease_ends_unless_renewed(bench: RigProtocol) -> None:
    """Another program takes a motor over once its lease has ended, and not before."""
    with _programs(bench, "pan", "tilt") as (one, other):
        with one.own(lease_s=_LONG_S) as claim:
            expect(claim.lease_s == _LONG_S, f"a lease of {claim.lease_s} s")
            expect(0.0 < (claim.left_s or 0.0) <= _LONG_S, f"{claim.left_s} s left")
            _refusal(_try(other), "the owner's lease has not ended")
            with one.own(lease_s=0.5 * _LONG_S):
                expect(claim.lease_s == 0.5 * _LONG_S, f"inner lease {claim.lease_s} s")
            expect(claim.lease_s == _LONG_S, f"the outer lease is now {claim.lease_s} s")
            pause_s = one.ownership.use(one.owner)
            expect(pause_s is not None and 0.0 < pause_s <= 1.0, f"renewed in {pause_s} s")
            expect(other.ownership.use(one.owner) is None, "a lease of another owner was renewed")
            claim.set_lease(_LEASE_S)
            pause_s = one.ownership.use(one.owner)
            expect(pause_s == 0.25 * _LEASE_S, f"a lease of {_LEASE_S} s is renewed in {pause_s} s")
            threading.Event().wait(2.0 * _LEASE_S)  # leases are those of real programs
            expect(claim.left_s == 0.0, f"{claim.left_s} s left of a lease that has ended")
            expect(claim.is_held, "lost, although nobody has taken it")
            with other.own() as taken:
                expect(not claim.is_held, "the lease has ended, but the motor was not lost")
                by = claim.lost_to or ""
                expect(f"its lease of {_LEASE_S:g} s was over" in by, f"lost to {by!r}")
                expect(taken.lease_s is None, f"a lease of {taken.lease_s} s that nobody asked for")
                expect(taken.left_s is None, f"{taken.left_s} s left without a lease")
        expect(other.told()[1:] == [LockAction.TAKEN_OVER, LockAction.RELEASED], "not told so")
        _try(other)()
        with one.own(lease_s=_LONG_S), other.own(take_over=True):
            expect(use_leases() is None, "the lease of a lost motor is renewed")
        with one.own(lease_s=8.0) as claim:
            expect(use_leases() == 2.0, "a lease of 8 s is not renewed every 2 s")
            expect(use_leases(one.ownership) is None, "renewed by a wait for that motor")
            expect(claim.is_held, "lost by a renewal")
    expect(use_leases() is None, "a lease that was given back is renewed")


@clause("PROC-04", Level.L3, source=f"{_SOURCE}; motorapi.ownership.fencing")
def frames_pass_only_for_their_owner(bench: RigProtocol) -> None:
    """Frames of a program leave only while it owns the motor, with the token of that time."""
    with _programs(bench, "pan", "tilt") as (one, other):
        bus: Any = other.bus
        announce(other.ownership, bus, _RESOURCE)
        one.fence.send(b"alone")  # owned for this frame
        _try(other)()
        with one.own() as claim:
            one.fence.send(b"own")
            _expect_sent(one, (b"own", _RESOURCE, claim.token))
            one.fence.check()
            expect(one.bus.checked == [(_RESOURCE, claim.token)], f"checked {one.bus.checked}")
            expect(one.fence.is_owned and not other.fence.is_owned, "the fence has another owner")
            for passage in (one.fence.passage, one.fence.bound("a stream").passage):
                with passage():
                    _refusal(_try(other, take_over=True), "a takeover during a write")
            for what in (partial(other.fence.send, b"x"), partial(other.fence.bound, "a stream")):
                _refusal(what, "a frame of a program that does not own the motor")
            stream = one.fence.bound("a stream")
            stream.send(b"first")
            _expect_sent(one, (b"first", _RESOURCE, claim.token))
        _try(other, take_over=True)()
        with one.own():
            _refusal(partial(stream.send, b"late"), "a stream of an earlier ownership")
        _expect_sent(one, (b"first", _RESOURCE, claim.token))
        stream.release()
        alone = other.fence.bound("a stream")
        _refusal(_try(one), "a motor that is held by a stream")
        alone.send(b"second")
        for _ in range(2):
            alone.release()
        _try(one)()
        actions = [action for _, action, *_ in other.bus.announced]
        expect(
            actions[:2] == [LockAction.TAKEN, LockAction.RELEASED],
            f"announced were {other.bus.announced}",
        )
        resource, _, token, facts = other.bus.announced[1]
        expect(resource == _RESOURCE and token > 0, f"announced was {other.bus.announced[1]}")
        expect(facts["owner"] == "start() of tilt", f"facts {facts}")
        _expect_joint(bench)


def _expect_sent(program: _Program, frame: tuple[bytes, int, int]) -> None:
    sent = program.bus.sent
    expect(bool(sent) and sent[-1] == frame, f"sent were {sent}; expected {frame} at last")


def _expect_joint(bench: RigProtocol) -> None:
    """Check a fence for several motors: it is open while all are owned."""
    with _lock_folder() as folder, ExitStack() as held:
        mine, theirs = (
            [_Program(bench.runtime, folder, name, motor) for motor in ("left", "right")]
            for name in ("pan", "tilt")
        )
        fences = [one.fence for one in mine]
        joint = joint_fence(fences)
        expect(isinstance(joint, JointFence), f"the fence of two motors is {joint!r}")
        expect(joint_fence(fences[:1]) is fences[0], "the fence of one motor is not its own")
        expect(joint_fence(()) is None, "a fence of no motor")
        assert joint is not None
        for one in mine:
            held.enter_context(one.own())
        joint.send(b"both")
        expect([len(one.bus.sent) for one in mine] == [0, 1], "a joint frame was not sent once")
        with joint.passage():
            for one in theirs:
                _refusal(_try(one, take_over=True), "a takeover during a joint write")
        for one in theirs:
            with one.own(take_over=True):
                _refusal(partial(joint.send, b"one"), "a joint frame without one of its motors")
        expect([len(one.bus.sent) for one in mine] == [0, 1], "a frame was sent without its motor")


@clause("PROC-05", Level.L3, source=f"{_SOURCE}; a motion holds its motor")
def motion_keeps_other_programs_away(bench: RigProtocol) -> None:
    """Until its motion has ended, a motor is refused to other programs, and no longer."""
    with _programs(bench, "pan", "tilt") as (one, other):
        for counts in (True, False):
            goes_on, news = [True], ChangeCounter()
            one.ownership.keep(one.owner, lambda: False, news, counts)
            expect(not one.ownership.is_here, "kept for a motion that has ended")
            with one.own():
                one.ownership.keep(one.owner, partial(bool, goes_on), news, counts)
                one.ownership.keep(one.owner, partial(bool, goes_on), news, counts)
            _refusal(_try(other), "a motor in motion")
            news.grow()
            _refusal(_try(other), "a motor that is still in motion")
            goes_on.clear()
            if counts:
                news.grow()
            else:
                rest_for(bench, 0.1)
            expect(not one.ownership.is_here, "kept although the motion has ended")
            expect(not news.listeners, "a motion that has ended is still looked at")
            _try(other)()
            goes_on.append(True)
            one.ownership.keep(one.owner, partial(bool, goes_on), news, True)
            goes_on.clear()
            _try(other, take_over=True)()
            one.ownership.look()
            expect(not one.ownership.is_here, "a motion that has ended unnoticed holds the motor")
            with other.own():
                goes_on.append(True)
                one.ownership.keep(one.owner, partial(bool, goes_on), news, True)
                expect(not one.ownership.is_here, "a stop without ownership took the motor")
        _expect_kept_by_motion(bench, one, other)


def _expect_kept_by_motion(bench: RigProtocol, one: _Program, other: _Program) -> None:
    """Check that a logical motor keeps its physical one until its motion is over."""
    is_over: list[bool] = []
    hooks: Any = SimpleNamespace(is_done=lambda: bool(is_over), latest=lambda: None)
    motor = LogicalMotor("pan", bench.motor.model, bench.runtime, one.motor, hooks)
    with one.ownership.owned(motor, "start() of pan"):
        run = motor.begin("start", None)
        motor.keep()
    _refusal(_try(other), "a motor whose motion has begun")
    rest_for(bench, 0.1)
    _refusal(_try(other), "a motor whose motion goes on")
    expect(not motor.look(run) and motor.goes_on(run), "a motion that goes on has ended")
    is_over.append(True)
    rest_for(bench, 0.1)
    _try(other)()
    expect(motor.look(run) and not motor.goes_on(run), "a motion that has ended goes on")


@clause("PROC-06", Level.L3, source=f"{_SOURCE}; turns on a bus")
def turns_alternate_between_programs(bench: RigProtocol) -> None:
    """Programs take turns on what they share; the number of a turn grows with each, of any."""
    with _lock_folder() as folder:
        one, other = (
            FifoQueue("SYNC", ProcessLock("sync", "SYNC", LockDirectory(folder))) for _ in "ab"
        )
        numbers = []
        for queue in (one, other, other, one):
            with queue.turn(bench.runtime, "start()"):
                numbers.append(queue.number)
                expect(queue.is_mine, "a turn that is not of this thread")
                with one.at_once(bench.runtime, "stop()") as mine:
                    expect(not mine, "a second turn was given at once")
                with other.at_once(bench.runtime, "stop()") as mine:
                    expect(not mine, "a second turn was given at once, to another program")
            expect(not queue.is_mine, "a turn that has ended")
            with queue.at_once(bench.runtime, "stop()") as mine:
                expect(mine, "a free turn was not given at once")
        expect(numbers == sorted(set(numbers)), f"turns {numbers}")
        expect(not one.died and not other.died, "a program that lives has died")
        alone = FifoQueue("alone")
        for number in (1, 2):
            with alone.turn(bench.runtime, "start()") as ticket:
                expect(alone.number == number, f"turn {alone.number}; expected {number}")
                ticket.exclusive = True
                error = _refusal(
                    lambda: alone.turn(bench.runtime, "stop()").__enter__(), "a turn in a turn"
                )
                expect(error.holder == "start()", f"refused with {error}")
    named = FifoQueue("SYNC of can0")
    share_trigger(bench.runtime, "bus", named)
    turns = trigger_turns(bench.runtime, ("tube", "bus", "tube", "axle"))
    labels = [one.label for one in turns]
    expect(labels == ["SYNC of can0", "the trigger axle", "the trigger tube"], f"turns {labels}")
    again = trigger_turns(bench.runtime, ("tube", "bus"))
    expect(again == [turns[0], turns[2]], f"other turns for the same triggers: {again}")


@clause("PROC-07", Level.L3, source=f"{_SOURCE}; first come, first served")
def waiting_program_names_what_it_waits_for(bench: RigProtocol) -> None:
    """A program that waits tells whom it waits for, and is refused when its time is over."""
    with _programs(bench, "pan", "tilt") as (one, other):
        with one.own("tea"):
            policy = AcquirePolicy(0.0, lambda: None, lambda: None)
            error = _refusal(_try(other, policy=policy), "a wait that has timed out")
            expect("tea" in error.purpose, f"refused with {error}")
        with other.own(policy=AcquirePolicy(0.0, lambda: None, lambda: None)) as claim:
            expect(claim.is_held, "a free motor was not taken")
        told = other.told()
        expect(told[-2:] == [LockAction.TAKEN, LockAction.RELEASED], f"events {told}")
        expect(LockAction.REFUSED in told, f"events {told}")
        steps = iter((None, None, 0.5, None))
        policy = AcquirePolicy(1.0, lambda: None, lambda: next(steps, None))
        begun_ns = bench.runtime.now_ns()
        done = policy.until(bench.runtime, lambda: False, 1.0, lambda: 0.125)
        waited_s = (bench.runtime.now_ns() - begun_ns) / 1e9
        spare_s = bench.facts.time_tolerance_s
        is_over = not done and 0.0 <= waited_s - 1.0 <= spare_s
        expect(is_over, f"waited {waited_s} s of 1 s, and done: {done}")
        end_ns = bench.runtime.now_ns() + 300_000_000
        done = policy.until(bench.runtime, lambda: bench.runtime.now_ns() >= end_ns, 1.0)
        expect(done, "a wait whose condition came true has timed out")
        own = other.ownership.owned_to_set_up(bench.runtime, "axle")
        with own as needed:
            expect(_try(one)() > 0, "a set-up that needs no writing holds the motor")
            for _ in range(2):
                needed()
            expect(one.lock.look().holder is not None, "a set-up does not hold the motor")
            _refusal(_try(one), "a motor in its set-up")
        _try(one)()
        told = other.told()
        expect(told == [LockAction.TAKEN, LockAction.RELEASED], f"events of a set-up: {told}")
        with one.own(), other.ownership.owned_to_set_up(bench.runtime, "axle") as needed:
            _refusal(needed, "a set-up of a motor of another program")
