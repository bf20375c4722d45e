"""Hypothesis state machines: several owners of shared motors in one deterministic run.

    from motorhil.harness.sharing_tests.state_machine import group_machine, ownership_machine
    from motorhil.harness.sharing_tests.state_machine import shared_rig

    TestMyMotor = ownership_machine(shared_rig("rig.toml")).TestCase
    TestMyGroups = group_machine(shared_rig("rig.toml")).TestCase

Hypothesis chooses the actions and the virtual time between them. No time lets several owners ask at
the same instant. Less than a frame's duration lets one ask while another's settings are being sent.
A long time allows a whole motion. The same choices give the same run, and a failure is shrunk. The
following must hold for any adaptation:

- The history of every motor is that of a motor with one owner at a time, first come, first served,
  with growing tokens (`require_linearizable`).
- A party that lost the motor, or never had it, does not command it. A motor with a valid lease is
  not taken over.
- An uninterrupted motion takes the time and goes the distance that its owner asked for, and thus
  used the settings of its owner.
- A party that is killed at any point leaves a motor that others can take.
- All motors of a group are armed before one is fired. If one refuses, none has moved. Overlapping
  groups wait for each other, but never forever.

The number of tests of each rule is counted in `reach` of the machine's class, and as Hypothesis
events (`pytest --hypothesis-show-statistics`).

A stage has the rig in virtual time, its history, and its parties, which are the logical owners. The
next action of an owner is an *errand*. An errand may take long, and other owners work meanwhile.
All uses are noted in a history with a strictly increasing clock. Each owner checks its own motions.
"""

from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from contextlib import AbstractContextManager, ExitStack, contextmanager
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, ClassVar, Final, final

from motorhil.harness.rig.config.rig_file import RigDescription, read_rig
from motorhil.harness.rig.reading import installed_plugins
from motorhil.harness.rig.rig import Rig
from motorhil.harness.sharing_tests.history import (
    Action,
    Answer,
    History,
    Note,
    SharingViolated,
    tokens_that_did_not_grow,
)
from motorhil.harness.sharing_tests.linearizability import require_linearizable
from motorhil.motorapi import (
    ControlMode,
    LinkError,
    Motor,
    MotorBusyError,
    MotorError,
    MotorGroup,
    TrapezoidalTrajectory,
    UsageError,
)
from motorhil.motorapi.motion import Motion
from motorhil.motorapi.ownership.claim import LockAction, OwnershipEvent
from motorhil.motorapi.synchronization.offer import Trigger

try:
    from hypothesis import event, settings
    from hypothesis import strategies as st
    from hypothesis.stateful import RuleBasedStateMachine, invariant, rule
except ImportError as _missing:  # pragma: no cover -- without it nothing here can be tested
    raise ImportError("this module needs Hypothesis: pip install 'motorhil[test]'") from _missing

if TYPE_CHECKING:
    from motorhil.harness.virtual_time.runtime import VirtualParty, VirtualRuntime
    from motorhil.motorapi.ownership.reservation import Reservation


MakeRig = Callable[[], Rig]

_LONG_S: Final = 60.0
_GROUP_PATIENCE_S: Final = 120.0
_RENEWED: Final = 7 / 8
"""The minimum share of a lease that is left when a use does not renew it."""
_STOPS: Final = ("stop() of ", "halt() of ")
_STEPS: Final = 25
_SETTLED_S: Final = 300.0
_WHO: Final = st.integers(0, 5)
_PATIENCE_S: Final = st.sampled_from([None, 0.0, 0.05, 1.0, 5.0])
_LEASE_S: Final = st.sampled_from([None, None, 0.05, 0.3])
_PAUSE_S: Final = st.sampled_from([None, 0.0, 1e-5, 2e-4, 1e-3, 0.02, 0.1, 0.5, 2.0])


@final
@dataclass(frozen=True, slots=True)
class Course:
    """The motions of the owners; owner number n goes (n + 1) times as far, and takes longer.

    Attributes:
        distance: of the first owner's motions [rad or m].
        duration_s: of the first owner's motions [s]; owner n takes (1 + n / 2) times as long.
        window: maximum distance from the target at the end [rad or m].
        tolerance_s: maximum deviation of a motion's reported duration [s].
    """

    distance: float = 0.05
    duration_s: float = 0.3
    window: float = 0.004
    tolerance_s: float = 0.06

    def of(self, number: int) -> tuple[float, float]:
        """Return (distance, duration_s) of owner `number`."""
        return self.distance * (number + 1), self.duration_s * (1.0 + number / 2.0)


def several_owners(rig: str | Path | RigDescription, owners: Sequence[str]) -> RigDescription:
    """Return the rig with each motor once per owner, as "owner.motor"; groups are left out."""
    if not isinstance(rig, RigDescription):
        rig = read_rig(Path(rig), installed_plugins())
    motors = {}
    for owner in owners:
        for motor in rig.motors.values():
            settings = dict(motor.settings)
            if motor.adaptation == "ideal":
                settings.setdefault("axis", motor.name)
            name = f"{owner}.{motor.name}"
            motors[name] = replace(motor, name=name, settings=settings)
    return replace(rig, motors=motors, groups={})


def shared_rig(
    rig: str | Path | RigDescription, owners: Sequence[str] = ("ann", "ben", "cem")
) -> Callable[[], Rig]:
    """Return a function that opens the rig with these owners of every motor."""
    description = several_owners(rig, owners)
    return lambda: Rig(description)


@final
class Stage:
    """The common state of all owners of one run: time, history, counts, violations."""

    def __init__(self, rig: Rig, course: Course) -> None:
        self.rig: Final = rig
        self.runtime: Final[VirtualRuntime] = rig.runtime
        self.course: Final = course
        self.history: Final = History(self._tick)
        self.counts: Final[Counter[str]] = Counter()
        self.violations: Final[list[str]] = []
        self.owners: Final[list[Owner]] = []
        self._last_ns = -1

    def _tick(self) -> int:
        """Return the time [ns], later than the last returned one."""
        self._last_ns = max(self._last_ns + 1, self.runtime.now_ns())
        return self._last_ns

    def physical_motors(self) -> list[list[Motor]]:
        """Return the logical motors of each physical one, both in the order of the rig."""
        found: dict[int, list[Motor]] = {}
        for name in self.rig.motors:
            motor = self.rig.motors[name]
            found.setdefault(id(motor.logical.physical), []).append(motor)
        return list(found.values())

    def require(self, holds: bool, words: str) -> None:
        """Note a violation if the condition does not hold."""
        if not holds:
            self.violations.append(f"at {self.runtime.now_ns() / 1e9:.6f} s: {words}")

    def check(self) -> None:
        """Raise SharingViolated if there are violations."""
        if self.violations:
            raise SharingViolated("\n".join(self.violations))


class Party:
    """A party that does errands in the rig's virtual time, until it is killed."""

    def __init__(self, name: str, stage: Stage) -> None:
        self.name: Final = name
        self.stage: Final = stage
        self.errand: Callable[[], None] | None = None
        self._party: Final[VirtualParty] = stage.runtime.spawn(name, self._work)
        self._party.joined = True  # errors are reported by the stage
        stage.runtime.run_for(0.0)  # it has begun, and can be killed from now on

    @property
    def is_idle(self) -> bool:
        """True if it lives and has nothing to do."""
        return self.errand is None and not self._party.finished

    def kill(self) -> None:
        """Kill the party, and wait until it has left its blocks."""
        self.stage.runtime.end(self._party)
        self.stage.require(self._party.join(_LONG_S), f"{self.name} did not end after the kill")

    def _work(self) -> None:
        runtime = self.stage.runtime
        try:
            while True:
                runtime.wait_until(lambda: self.errand is not None)
                assert self.errand is not None
                self.errand()
                self.errand = None
        except Exception as error:
            self.stage.violations.append(f"{self.name}: {type(error).__name__}: {error}")
        finally:
            self.leave()

    def leave(self) -> None:
        """Close everything that the party has open."""


@final
class Owner(Party):
    """One logical motor of a physical one, with its owner.

    Args:
        name: unique also among earlier owners that died.
        motor: its logical motor.
        label: the name of the physical motor in the history.
        number: its number among all owners.
    """

    def __init__(self, name: str, motor: Motor, label: str, number: int, stage: Stage) -> None:
        self.motor: Final = motor
        self.number: Final = number
        self.reservation: Reservation | None = None
        self.lease_s: float | None = None
        self.is_lost: bool = False
        """True if another owner is known to have taken the motor over."""
        self.used_ns: int = 0
        """The start of the last successful use [ns]; the lease was renewed then or later."""
        self._called_ns = 0
        self._label: Final = label
        self._stack: Final = ExitStack()
        self._moves = False
        self._give: Note | None = None
        self._death: Note | None = None
        self._taken: OwnershipEvent | None = None
        self._listeners: Final = motor.logical.physical.ownership.listeners
        self._listeners.append(self._note_event)
        super().__init__(name, stage)

    # ---- errands ----

    def reserve(self, timeout_s: float | None, lease_s: float | None, take_over: bool) -> None:
        """Reserve the motor, unless it is refused."""
        if self.reservation is not None:
            return
        self._await_rest()
        kind = "take over" if take_over else "reserve"
        note = self._call(Action.TAKE, forced=take_over)
        if timeout_s is not None and not take_over:
            note.queued()
        try:
            self.reservation = self._stack.enter_context(
                self.motor.reserve(kind, timeout_s=timeout_s, lease_s=lease_s, take_over=take_over)
            )
        except MotorBusyError as error:
            self._refused(note, self._refusal(error, kind))
        except MotorError as error:
            self._failed(kind, error)
            self._refused(note, Answer.UNKNOWN)
        else:
            self.lease_s = lease_s
            self.used_ns = self._called_ns
            self.is_lost = self.reservation.lost_to is not None  # taken over while it was prepared
            self._note_taken(note, kind)

    def start(self, timeout_s: float | None, wait: bool) -> None:
        """Start a motion, unless it is refused; `wait`: wait until it has ended."""
        self._await_rest()
        motor, reserved = self.motor, self.reservation
        before = motor.position() if reserved is not None else 0.0
        distance, duration_s = self.stage.course.of(self.number)
        if motor.position() > 0.0:
            distance = -distance
        motor.set_control_mode(ControlMode.TRAJECTORY)
        motor.set_trajectory(TrapezoidalTrajectory(distance, duration_s=duration_s))
        take = None if reserved is not None else self._call(Action.TAKE)
        if take is not None and timeout_s is not None:
            take.queued()
        command = self._call(Action.COMMAND, value=self.number + 1)
        try:
            motor.start(timeout_s)
        except MotorBusyError as error:
            answer = self._refusal(error, "start")
            command.returned(answer)
            if take is not None:
                self._refused(take, answer)
            return
        except MotorError as error:
            self._failed("start", error)
            command.returned(Answer.UNKNOWN)
            if take is not None:
                self._refused(take, Answer.UNKNOWN)
            return
        if take is not None:
            self._note_taken(take, "start")
        command.returned(value=self.number + 1)
        self.used_ns = self._called_ns
        self._begun(gives=take is not None)
        if wait and self._await_rest():
            self._check_motion(before, distance, duration_s, reserved)

    def trip(self, timeout_s: float | None, lease_s: float | None) -> None:
        """Reserve the motor for one motion, if it is granted."""
        self.reserve(timeout_s, lease_s, False)
        if self.reservation is not None:
            self.start(None, True)
            self.give()

    def give(self) -> None:
        """End the reservation."""
        reservation = self.reservation
        if reservation is None:
            return
        self.reservation = None
        note = self._call(Action.GIVE)
        self._stack.close()
        if reservation.lost_to is not None:
            note.returned(Answer.LOST)
            self.stage.counts["give: lost before"] += 1
        elif self._moves:
            self._give = note
        else:
            note.returned()

    def renew(self) -> None:
        """Renew the lease; note the loss if it was lost."""
        if self.reservation is None:
            return
        self._called_ns = self.stage.runtime.now_ns()
        try:
            self.reservation.renew()
        except MotorBusyError:
            self._expect_lost("renew")
        else:
            self.used_ns = self._called_ns

    def stop(self) -> None:
        """Stop the motor, whichever owner has it."""
        try:
            self.motor.stop()
            self.stage.counts["stop"] += 1
        except MotorError as error:
            self._failed("stop", error)

    def wait(self) -> None:
        """Wait until the owner's motion has ended."""
        self._await_rest()

    # ---- inside ----

    def _call(self, action: Action, *, value: int = 0, forced: bool = False) -> Note:
        self._called_ns = self.stage.runtime.now_ns()
        self._taken = None
        return self.stage.history.call(self.name, self._label, action, value=value, forced=forced)

    def _note_event(self, event: OwnershipEvent) -> None:
        if event.owner.endswith(f" of {self.motor.name}") and event.action in (
            LockAction.TAKEN,
            LockAction.BROKEN,
            LockAction.TAKEN_OVER,
        ):
            self._taken = event

    def _note_taken(self, note: Note, kind: str) -> None:
        taken = self._taken
        forced = taken is not None and taken.action is LockAction.TAKEN_OVER
        note.returned(token=0 if taken is None else taken.token, forced=forced)
        self.stage.counts[f"{kind}: {'from a living owner' if forced else 'done'}"] += 1
        if taken is not None and forced:
            self._note_losers(taken, by_lease=kind != "take over")

    def _note_losers(self, taken: OwnershipEvent, *, by_lease: bool) -> None:
        """Check that a motor taken from a living owner had an expired lease, unless by force."""
        for other in self.stage.owners:
            reservation = other.reservation
            if other.is_lost or reservation is None or reservation.lost_to is None:
                continue
            if other.motor.logical.physical is self.motor.logical.physical:
                other.is_lost = True
                lease_s = (other.lease_s or _LONG_S) * _RENEWED
                end_ns = other.used_ns + round(lease_s * 1e9)
                self.stage.require(
                    taken.time_ns >= end_ns or not by_lease,
                    f"{self.name} took the motor over from {other.name}, whose lease was valid "
                    f"until {end_ns / 1e9:.6f} s",
                )

    def _refusal(self, error: MotorBusyError, kind: str) -> Answer:
        if any(word in error.holder for word in _STOPS):
            self.stage.counts[f"{kind}: refused during a stop"] += 1
            return Answer.UNKNOWN
        if self.reservation is not None:
            self._expect_lost(kind)
            return Answer.LOST
        if self._taken is not None:  # it was granted, then lost before it could be reported
            self.stage.counts[f"{kind}: refused after it was taken"] += 1
            return Answer.UNKNOWN
        self.stage.counts[f"{kind}: refused"] += 1
        return Answer.REFUSED

    def _refused(self, take: Note, answer: Answer) -> None:
        """Note a refusal; with an unknown reason the motor may have been owned for a moment."""
        take.returned(answer)
        if answer is Answer.UNKNOWN:
            self._call(Action.GIVE).returned(Answer.UNKNOWN)

    def _expect_lost(self, kind: str) -> None:
        reservation = self.reservation
        is_lost = reservation is not None and reservation.lost_to is not None
        self.stage.counts[f"{kind}: lost before"] += 1
        self.stage.require(is_lost, f"{self.name}: {kind} was refused, although it owns the motor")

    def _failed(self, kind: str, error: MotorError) -> None:
        self.stage.counts[f"{kind}: {type(error).__name__}"] += 1
        self.stage.require(type(error) is not UsageError, f"{self.name}: {kind} failed: {error}")

    def _begun(self, *, gives: bool) -> None:
        self._moves = True
        if gives:
            self._give = self._call(Action.GIVE)
        self.motor.on_done(lambda _: self._over())

    def _over(self) -> None:
        """Complete the notes after the motion; the motor is free then, unless it is reserved."""
        self._moves = False
        give, self._give = self._give, None
        if give is not None:
            give.returned()
        death, self._death = self._death, None
        if death is not None:
            death.returned()

    def _await_rest(self) -> bool:
        """Wait for the end of the last motion; return True if it ended without an error."""
        try:
            self.motor.wait_until_done(_LONG_S)
        except MotorError as error:
            self._failed("wait", error)
            return False
        return True

    def _check_motion(
        self, before: float, distance: float, duration_s: float, reserved: "Reservation | None"
    ) -> None:
        stage = self.stage
        run = self.motor.logical.run
        assert run is not None
        took_s = (stage.runtime.now_ns() - run.since_ns) / 1e9
        stage.counts["motion: as long as asked for"] += 1
        stage.require(
            abs(took_s - duration_s) <= stage.course.tolerance_s,
            f"{self.name} asked for a motion of {duration_s:g} s, but it took {took_s:g} s: it "
            "was made with another owner's settings",
        )
        if reserved is None or reserved.lost_to is not None:
            return
        moved = self.motor.position() - before
        stage.counts["motion: as far as asked for"] += 1
        stage.require(
            abs(moved - distance) <= stage.course.window,
            f"{self.name} was the only owner and moved the motor by {distance:g}, but it went "
            f"{moved:g}",
        )

    def leave(self) -> None:
        """Leave all blocks, as after an exception."""
        self._death = self.stage.history.call(self.name, "", Action.DIE)
        self._stack.close()
        self.reservation = None
        self._listeners.remove(self._note_event)
        if not self._moves:
            self._death.returned()
            self._death = None


@final
class _WatchedTrigger:
    """A trigger that reports its firing; everything else is delegated."""

    def __init__(self, trigger: Trigger, watch: "Watch") -> None:
        self.trigger = trigger
        self._watch = watch

    def __getattr__(self, name: str) -> object:
        return getattr(self.trigger, name)

    def __repr__(self) -> str:
        return repr(self.trigger)

    def fire(self) -> None:
        """Report the firing, then fire the trigger."""
        self._watch.fired()
        self.trigger.fire()


@final
class Watch:
    """Observer of arming and firing of one logical motor; can make arming fail.

    Attributes:
        refuses: True if the motor refuses to be armed next.
        was_armed: True if it was armed since `begin`.
        fired: called before its trigger is fired.
    """

    def __init__(self, motor: Motor) -> None:
        self.motor: Final = motor
        self.refuses: bool = False
        self.was_armed: bool = False
        self.fired: Callable[[], None] = lambda: None
        self._arm = motor._arm  # noqa: SLF001 -- it lets arming fail, as a vendor would
        self._known: list[_WatchedTrigger] = []  # a common trigger stays a single one
        motor._arm = self._watched_arm  # type: ignore[method-assign]  # noqa: SLF001 -- likewise

    def begin(
        self, fired: Callable[[], None], known: list[_WatchedTrigger], *, refuses: bool
    ) -> None:
        """Begin a start; its triggers are added to `known`."""
        self.was_armed, self.refuses, self.fired, self._known = False, refuses, fired, known

    def _watched_arm(self, motion: Motion, *, together: bool) -> Trigger:
        if self.refuses:
            raise LinkError(
                link=self.motor.logical.physical.label, reason="it refuses, as planned by the test"
            )
        trigger = self._arm(motion, together=together)
        self.was_armed = True
        for known in self._known:
            if known.trigger is trigger:
                return known
        self._known.append(_WatchedTrigger(trigger, self))
        return self._known[-1]


def watched(motor: Motor) -> Watch:
    """Return an observer of the motor."""
    return Watch(motor)


@final
class GroupOwner(Party):
    """An owner with a logical motor of each physical one, who moves them in groups.

    Args:
        name: its name.
        motors: its logical motor of each physical one, in the order of the rig.
        number: its number among all owners.
    """

    def __init__(self, name: str, motors: Sequence[Watch], number: int, stage: Stage) -> None:
        self.number: Final = number
        self.motors: Final = list(motors)
        super().__init__(name, stage)

    def move(
        self, chosen: Sequence[int], refuses: int | None, reserves: bool, patient: bool
    ) -> None:
        """Move the chosen motors together, or none if one refuses or is not free."""
        stage = self.stage
        places = list(dict.fromkeys(place % len(self.motors) for place in chosen))
        watches = [self.motors[place] for place in places]
        refusing = None if refuses is None else watches[refuses % len(watches)]
        group = MotorGroup(*(watch.motor for watch in watches))
        timeout_s = _GROUP_PATIENCE_S if patient else None
        words = f"{len(watches)} motors"
        with ExitStack() as held:
            try:
                if reserves:
                    reservation = group.reserve("together", timeout_s=timeout_s)
                    held.enter_context(self._noted(reservation, watches))
                self._start(group, watches, refusing, timeout_s, reserves)
            except MotorBusyError as error:
                stage.counts[f"{words}: refused"] += 1
                stage.require(
                    not patient, f"{self.name} waited {_GROUP_PATIENCE_S:g} s: {error}; a deadlock"
                )
            except LinkError:
                stage.counts[f"{words}: one refused to be armed"] += 1
                stage.require(refusing is not None, f"{self.name}: a motor refused unexpectedly")
            except MotorError as error:
                stage.counts[f"{words}: {type(error).__name__}"] += 1
            else:
                stage.counts[f"{words}: moved{' in a reservation' if reserves else ''}"] += 1

    def _start(
        self,
        group: MotorGroup,
        watches: Sequence[Watch],
        refusing: Watch | None,
        timeout_s: float | None,
        reserved: bool,
    ) -> None:
        stage = self.stage
        distance, duration_s = stage.course.of(self.number)
        before = [watch.motor.position() for watch in watches]
        ways = [distance if place <= 0.0 else -distance for place in before]

        def fired() -> None:
            late = [watch.motor.name for watch in watches if not watch.was_armed]
            stage.counts["trigger fired"] += 1
            stage.require(not late, f"{self.name}: fired before {', '.join(late)} was armed")

        known: list[_WatchedTrigger] = []
        for watch in watches:
            watch.begin(fired, known, refuses=watch is refusing)
            watch.motor.set_control_mode(ControlMode.TRAJECTORY)
        group.set_trajectory(*(TrapezoidalTrajectory(way, duration_s=duration_s) for way in ways))
        try:
            group.start(timeout_s)
        except LinkError:
            if reserved:
                self._require_moved(watches, before, [0.0] * len(ways), "although one refused")
            raise
        if not reserved:
            self._take(watches)
        gives = [] if reserved else self._gives(watches)  # owned as long as they move
        group.wait_until_done(_GROUP_PATIENCE_S)
        for give in gives:
            give.returned()
        took_s = (stage.runtime.now_ns() - self._begun_ns(watches)) / 1e9
        stage.require(
            abs(took_s - duration_s) <= stage.course.tolerance_s,
            f"{self.name} asked for {duration_s:g} s, but the motion took {took_s:g} s",
        )
        if reserved:
            self._require_moved(watches, before, ways, "to its target")

    def _begun_ns(self, watches: Sequence[Watch]) -> int:
        runs = [watch.motor.logical.run for watch in watches]
        return min(run.since_ns for run in runs if run is not None)

    def _require_moved(
        self, watches: Sequence[Watch], before: Sequence[float], ways: Sequence[float], why: str
    ) -> None:
        for watch, place, way in zip(watches, before, ways, strict=True):
            moved = watch.motor.position() - place
            self.stage.counts["positions compared"] += 1
            self.stage.require(
                abs(moved - way) <= self.stage.course.window,
                f"{self.name}: {watch.motor.name} went {moved:g} instead of {way:g} {why}",
            )

    @contextmanager
    def _noted(
        self, reservation: AbstractContextManager[object], watches: Sequence[Watch]
    ) -> Iterator[None]:
        gives: list[Note] = []
        try:
            with reservation:
                self._take(watches)
                try:
                    yield
                finally:
                    gives = self._gives(watches)
        finally:
            for give in gives:
                give.returned()

    def _take(self, watches: Sequence[Watch]) -> None:
        for watch in watches:
            label = watch.motor.logical.physical.label
            self.stage.history.call(self.name, label, Action.TAKE).returned()

    def _gives(self, watches: Sequence[Watch]) -> list[Note]:
        """Begin the notes of release; they are completed when ownership has ended."""
        labels = [watch.motor.logical.physical.label for watch in watches]
        return [self.stage.history.call(self.name, label, Action.GIVE) for label in labels]


class SharingMachine(RuleBasedStateMachine):
    """Common base of both machines; not for direct use."""

    make_rig: ClassVar[MakeRig]
    course: ClassVar[Course]
    reach: ClassVar["Counter[str]"]

    def __init__(self) -> None:
        super().__init__()
        self.rig: Rig = type(self).make_rig()
        self.stage: Stage = Stage(self.rig, type(self).course)
        self.parties: list[Party] = []
        self.deaths = 0
        try:
            self.set_up()
        except BaseException:
            self.rig.close()
            raise

    def set_up(self) -> None:
        """Create the parties."""

    def idle(self, who: int) -> Party | None:
        """Return an idle party, or None if all are busy."""
        idle = [party for party in self.parties if party.is_idle]
        return idle[who % len(idle)] if idle else None

    def pass_time(self, time_s: float | None) -> None:
        """Let time pass, so that parties proceed; None: no party runs yet."""
        if time_s is not None:
            self.stage.runtime.run_for(time_s)

    @rule(time_s=_PAUSE_S)
    def wait(self, time_s: float | None) -> None:
        """Let time pass without a new errand."""
        self.pass_time(time_s)

    @invariant()
    def nothing_went_wrong(self) -> None:
        """Check that the owners have found no violation."""
        self.stage.check()

    def teardown(self) -> None:
        """Let all parties finish, and judge the history."""
        try:
            self.settle()
            self.stage.check()
            uses = self.stage.history.uses()
            require_linearizable(uses)
            for earlier, later in tokens_that_did_not_grow(uses):
                raise SharingViolated(
                    f"the token did not grow from\n    {earlier}\nto\n    {later}"
                )
        finally:
            counts = self.stage.counts
            type(self).reach.update(counts)
            type(self).reach["runs"] += 1
            for name in sorted(counts):
                event(name)
            self.rig.close()

    def settle(self) -> None:
        """Wait until every errand is done."""
        done = self.stage.runtime.wait_until(
            lambda: all(party.is_idle for party in self.parties), _SETTLED_S
        )
        busy = ", ".join(party.name for party in self.parties if not party.is_idle)
        self.stage.require(done, f"{busy} did not finish within {_SETTLED_S:g} s")


class OwnershipMachine(SharingMachine):
    """Several owners of one motor; see `ownership_machine`."""

    def set_up(self) -> None:
        """Create an owner for each logical motor."""
        shared = [motors for motors in self.stage.physical_motors() if len(motors) > 1]
        if not shared:
            raise SharingViolated("no motor of the rig has two logical motors; use shared_rig()")
        self.label: str = shared[0][0].logical.physical.label
        self.owners: list[Owner] = []
        for number, motor in enumerate(shared[0]):
            self.owners.append(Owner(motor.name, motor, self.label, number, self.stage))
        self.parties.extend(self.owners)
        self.stage.owners.extend(self.owners)

    def ask(self, who: int, errand: "Callable[[Owner], None]", pause_s: float | None) -> None:
        """Give the errand to an idle owner, and let time pass."""
        party = self.idle(who)
        if isinstance(party, Owner):
            party.errand = partial(errand, party)
        self.pass_time(pause_s)

    @rule(who=_WHO, timeout_s=_PATIENCE_S, lease_s=_LEASE_S, pause_s=_PAUSE_S)
    def reserve(
        self, who: int, timeout_s: float | None, lease_s: float | None, pause_s: float | None
    ) -> None:
        """Let an owner reserve the motor."""
        self.ask(who, lambda owner: owner.reserve(timeout_s, lease_s, False), pause_s)

    @rule(who=_WHO, lease_s=_LEASE_S, pause_s=_PAUSE_S)
    def take_over(self, who: int, lease_s: float | None, pause_s: float | None) -> None:
        """Let an owner take the motor over."""
        self.ask(who, lambda owner: owner.reserve(None, lease_s, True), pause_s)

    @rule(who=_WHO, timeout_s=_PATIENCE_S, wait=st.booleans(), pause_s=_PAUSE_S)
    def start(self, who: int, timeout_s: float | None, wait: bool, pause_s: float | None) -> None:
        """Let an owner start its own motion."""
        self.ask(who, lambda owner: owner.start(timeout_s, wait), pause_s)

    @rule(who=_WHO, timeout_s=_PATIENCE_S, lease_s=_LEASE_S, pause_s=_PAUSE_S)
    def trip(
        self, who: int, timeout_s: float | None, lease_s: float | None, pause_s: float | None
    ) -> None:
        """Let an owner reserve the motor, move it, wait for the end, and release it."""
        self.ask(who, lambda owner: owner.trip(timeout_s, lease_s), pause_s)

    @rule(who=_WHO, pause_s=_PAUSE_S)
    def give(self, who: int, pause_s: float | None) -> None:
        """Let an owner end its reservation."""
        self.ask(who, Owner.give, pause_s)

    @rule(who=_WHO, pause_s=_PAUSE_S)
    def renew(self, who: int, pause_s: float | None) -> None:
        """Let an owner renew its lease."""
        self.ask(who, Owner.renew, pause_s)

    @rule(who=_WHO, pause_s=_PAUSE_S)
    def stop(self, who: int, pause_s: float | None) -> None:
        """Let an owner stop the motor, whichever owner has it."""
        self.ask(who, Owner.stop, pause_s)

    @rule(who=_WHO, really=st.integers(0, 2))
    def kill(self, who: int, really: int) -> None:
        """Kill an owner, a busy one if there is one; a new one takes over its logical motor."""
        if really:
            return
        owners = [owner for owner in self.owners if not owner.is_idle] or self.owners
        dead = owners[who % len(owners)]
        place = self.owners.index(dead)
        self.stage.counts["kill: idle" if dead.is_idle else "kill: at work"] += 1
        if dead.reservation is not None:
            self.stage.counts["kill: while it was reserved"] += 1
        dead.kill()
        self.deaths += 1
        name = f"{dead.motor.name}#{self.deaths}"
        new = Owner(name, dead.motor, self.label, dead.number, self.stage)
        self.owners[place] = self.stage.owners[place] = new
        self.parties[place] = new

    def settle(self) -> None:
        """Finish all errands and reservations; check that each owner then gets the motor."""
        super().settle()
        for errand in (Owner.give, Owner.wait):
            for owner in self.owners:
                owner.errand = partial(errand, owner)
            super().settle()
        for owner in self.owners:
            owner.errand = partial(owner.reserve, None, None, False)
            super().settle()
            has = owner.reservation is not None
            self.stage.require(has, f"the motor is free, but {owner.name} was refused")
            owner.errand = owner.give
            super().settle()


class GroupMachine(SharingMachine):
    """Several overlapping groups; see `group_machine`."""

    def set_up(self) -> None:
        """Create an owner for each set of logical motors."""
        motors = self.stage.physical_motors()
        number = min(len(shared) for shared in motors)
        if len(motors) < 2 or number < 2:
            raise SharingViolated("groups need two motors, each with two owners; use shared_rig()")
        self.owners: list[GroupOwner] = []
        for place in range(number):
            name = motors[0][place].name.partition(".")[0]
            mine = [watched(shared[place]) for shared in motors]
            self.owners.append(GroupOwner(name, mine, place, self.stage))
        self.parties.extend(self.owners)

    @rule(
        who=_WHO,
        chosen=st.lists(st.integers(0, 5), min_size=1, max_size=4),
        refuses=st.none() | st.none() | st.integers(0, 3),
        reserves=st.booleans(),
        patient=st.booleans(),
        pause_s=_PAUSE_S,
    )
    def move(
        self,
        who: int,
        chosen: list[int],
        refuses: int | None,
        reserves: bool,
        patient: bool,
        pause_s: float | None,
    ) -> None:
        """Let an owner move a group of motors, one of which may refuse to be armed."""
        party = self.idle(who)
        if isinstance(party, GroupOwner):
            party.errand = partial(party.move, chosen, refuses, reserves, patient)
        self.pass_time(pause_s)

    @rule(who=_WHO, really=st.integers(0, 3))
    def kill(self, who: int, really: int) -> None:
        """Kill an owner that moves a group; a new one takes over its logical motors."""
        owners = [owner for owner in self.owners if not owner.is_idle]
        if really or not owners:
            return
        dead = owners[who % len(owners)]
        self.stage.counts["kill: at work"] += 1
        dead.kill()
        self.deaths += 1
        place = self.owners.index(dead)
        new = GroupOwner(f"{dead.name}#{self.deaths}", dead.motors, dead.number, self.stage)
        self.owners[place] = self.parties[place] = new


def ownership_machine(
    make_rig: MakeRig, course: Course | None = None
) -> type[RuleBasedStateMachine]:
    """Return a state machine of several owners that share the first motor with several.

    Args:
        make_rig: opens a rig with several logical motors for one motor; see `shared_rig`.
        course: the motion of each owner; None: 0.05 rad in 0.3 s for the first one.
    """
    return _machine(OwnershipMachine, make_rig, course)


def group_machine(make_rig: MakeRig, course: Course | None = None) -> type[RuleBasedStateMachine]:
    """Return a state machine of overlapping groups; arguments as for `ownership_machine`."""
    return _machine(GroupMachine, make_rig, course)


def _machine(
    base: type[SharingMachine], make_rig: MakeRig, course: Course | None
) -> type[RuleBasedStateMachine]:
    name = base.__name__
    facts = {
        "make_rig": staticmethod(make_rig),
        "course": course or Course(),
        "reach": Counter[str](),
        "__doc__": base.__doc__,
    }
    machine: type[SharingMachine] = type(name, (base,), facts)
    machine.TestCase.settings = settings(deadline=None, stateful_step_count=_STEPS)
    return machine
