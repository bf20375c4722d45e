"""Hypothesis state machines: several owners of shared motors in one deterministic run.

    from harness.sharing.machine import group_machine, ownership_machine
    from harness.sharing.stage import shared_rig

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
"""

# ruff: noqa: SLF001 -- the harness looks at who has a motor

from collections import Counter
from collections.abc import Callable
from functools import partial
from typing import ClassVar, Final

try:
    from hypothesis import event, settings
    from hypothesis import strategies as st
    from hypothesis.stateful import RuleBasedStateMachine, invariant, rule
except ImportError as missing:  # pragma: no cover -- without it nothing here can be tested
    raise ImportError(
        "harness.sharing.machine needs Hypothesis: pip install 'motorhil[test]'"
    ) from missing

from harness.rig import Rig
from harness.sharing.group_owners import GroupOwner, watched
from harness.sharing.history import SharingViolated, tokens_that_did_not_grow
from harness.sharing.linearizability import require_linearizable
from harness.sharing.owners import Owner
from harness.sharing.stage import Course, Party, Stage

MakeRig = Callable[[], Rig]

_STEPS: Final = 25
_SETTLED_S: Final = 300.0
_WHO: Final = st.integers(0, 5)
_PATIENCE_S: Final = st.sampled_from([None, 0.0, 0.05, 1.0, 5.0])
_LEASE_S: Final = st.sampled_from([None, None, 0.05, 0.3])
_PAUSE_S: Final = st.sampled_from([None, 0.0, 1e-5, 2e-4, 1e-3, 0.02, 0.1, 0.5, 2.0])


class SharingMachine(RuleBasedStateMachine):
    """Common base of both machines; not for direct use."""

    make_rig: ClassVar[MakeRig]
    course: ClassVar[Course]
    reach: ClassVar["Counter[str]"]

    def __init__(self) -> None:
        super().__init__()
        self.rig = type(self).make_rig()
        self.stage = Stage(self.rig, type(self).course)
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
        self.label = shared[0][0]._physical.label
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
