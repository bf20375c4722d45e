"""Who may command a physical motor: one logical motor at a time, of whatever process.

It is owned for an operation, for low-level access, and for a reservation; between processes also
for as long as a run goes on (within a process the run itself says whose it is). Its owner may own
it for several reasons at once; it is free when the last is gone.

Where the bus belongs to this process alone (a rig in virtual time), owners queue here. On a bus
that other processes can open they queue in a `ProcessLock`, with those of other processes, in one
order. Whether another process has had the motor in between is counted (`absences`): what this one
believes of the drive may then be true no more.

From an owner who lives it can be taken over: on demand, or by whoever comes next once its lease is
over. A lease is renewed by what the owner does, and by nothing else: a timer would go on behind a
debugger's prompt. Who has lost it finds out with his next step at the latest; as long as his
reservation's block lasts he is refused, by the name of who took it, unless he reserves it again.
Both are the same with a lock and without.
"""

import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from typing import TYPE_CHECKING, Final, final

from motorapi.claim import Asked, Claim, Owner
from motorapi.errors import MotorBusyError, MotorError
from motorapi.hold import Loss
from motorapi.leases import RENEWALS_IN_WAIT, register
from motorapi.owner_row import OwnerRow, Teller
from motorapi.ownership_events import LockAction
from motorapi.patience import Keeper, Patience
from motorapi.process_lock import Hold, ProcessLock
from motorapi.set_up import SetUp, action_of

if TYPE_CHECKING:
    from motorapi.runtime import Runtime
    from motorapi.waiting import News

_LOSS_LOOK_S: Final = 0.1
"""How soon one who waits notices that another process took the motor over, if nothing tells."""
SET_UP_TIMEOUT_S: Final = 10.0
"""How long an owner waits for a drive to be set up for somebody who reads it."""


@final
class Ownership:
    """Who owns one physical motor.

    Args:
        lock: shared with other processes; None: there are none on this bus.
        interrupt: ends, in the name of who takes the motor over, what it does for others than the
            new owner (None: for whom it was lost); whether it did anything.

    Attributes:
        absences: grows whenever another process had the motor since this one owned it last.
        is_orphan: whether who had it before died with it, or lost it, so that it may be moving for
            nobody; the next one brings it to rest first, and says so here.
        listeners: are told what happens to the ownership; see `motorapi.ownership_events`.
    """

    def __init__(
        self,
        lock: ProcessLock | None,
        interrupt: Callable[[str, int, object, object], bool] = lambda *_: False,
    ) -> None:
        self.lock: Final = lock
        self.absences = 0
        self.is_orphan = False
        self._teller: Final = Teller()
        self.listeners: Final = self._teller.listeners
        self._interrupt: Final = interrupt
        self._held: Claim | None = None
        self._lost: list[Claim] = []  # as long as their owners have not given them back
        self._row: Final = OwnerRow(self, self._teller)
        self._mutex = threading.Lock()  # never held while waiting
        self._keeper: Keeper | None = None
        self._set_up = object()  # the owner while a drive is set up for readers

    @property
    def is_here(self) -> bool:
        """Whether somebody of this process owns it, as far as that one knows."""
        return self._held is not None

    @property
    def held(self) -> Claim | None:
        """The claim of this process, held or lost; None: there is none."""
        return self._held

    @contextmanager
    def owned(
        self,
        owner: Owner,
        who: str,
        purpose: str = "",
        patience: Patience | None = None,
        *,
        lease_s: float | None = None,
        take_over: bool = False,
        afresh: bool = False,
    ) -> Iterator[Claim]:
        """The motor is the owner's inside the block, for one reason more.

        Args:
            owner: the logical motor.
            who: what he does, in words.
            purpose: what for, in words.
            patience: how to wait for others; None: not at all.
            lease_s: others may take it over once it was not used for so long [s]; None: as before.
            take_over: take it from whoever has it.
            afresh: though he has lost it, and has not given it back yet.

        Raises:
            MotorBusyError: somebody else's it is, or was for as long as `patience` says.
        """
        before = self._held
        asked = Asked(owner, who, purpose, patience, lease_s, take_over)
        try:
            claim = self._take(asked, afresh)
        except MotorBusyError as error:
            self._teller.tell(LockAction.REFUSED, asked, error.holder, since_ns=asked.asked_ns)
            raise
        outer_s = claim.lease_s if claim is before else None
        try:
            if claim is before and lease_s is not None:
                claim.set_lease(lease_s)
            if lease_s is not None:
                register(claim)
            yield claim
        finally:
            if lease_s is not None and claim.reasons > 1:
                with suppress(MotorBusyError):
                    claim.set_lease(outer_s)
            self.give(claim)

    def take(
        self, owner: Owner, who: str, purpose: str = "", patience: Patience | None = None
    ) -> Claim:
        """The motor is the owner's until `give`. As `owned`."""
        return self._take(Asked(owner, who, purpose, patience), False)

    def _take(self, asked: Asked, afresh: bool) -> Claim:
        self.look()
        claim = self._again(asked.owner, afresh)
        if claim is not None:
            return claim
        action: LockAction | None
        if self.lock is None:
            claim, action, before = self._row.take(asked)
        else:
            claim, action, before = self._take_lock(self.lock, asked)
        if action is not None:
            self._teller.tell(action, claim, before, since_ns=asked.asked_ns)
        return claim

    def _again(self, owner: Owner, afresh: bool) -> Claim | None:
        """The claim that the owner has already, with a reason more."""
        held = self._held
        if held is not None and held.owner is owner and held.is_held:
            held.use()
            with self._mutex:
                if held.reasons:
                    held.reasons += 1
                    return held
        if not afresh:
            self.require(owner)
        return None

    def replace(self, held: Claim | None, asked: Asked, token: int) -> Claim | None:
        """The new claim, in place of the one there was; None: that is there no more."""
        with self._mutex:
            if self._held is not held:
                return None
            claim = self._held = Claim(asked, None, token, self)
        if asked.lease_s is not None:
            claim.set_lease(asked.lease_s)
        return claim

    def end_run(self, asked: Asked) -> bool:
        """What it does for others, who own it no more, is over, and it is to be brought to rest.

        Whether it did anything.
        """
        by = f"{asked.who}, which took the motor over (on demand)"
        if not self._interrupt(by, asked.owner.runtime.now_ns(), None, asked.owner):
            return False
        self.is_orphan = True
        return True

    # ---- with a lock ----

    def _take_lock(self, lock: ProcessLock, asked: Asked) -> tuple[Claim, LockAction | None, str]:
        owner, patience, runtime = asked.owner, asked.patience, asked.owner.runtime
        held = self._held
        timeout_s = 0.0 if patience is None else patience.timeout_s
        may_take = asked.take_over or (held is not None and held.left_s == 0.0)
        if patience is None and held is not None and held.is_held and not may_take:
            raise held.busy(owner.name)
        if patience is None and lock.hold is not None and lock.hold.owner is self._set_up:
            timeout_s = SET_UP_TIMEOUT_S
        words = f"{asked.purpose} ({asked.who})" if asked.purpose else asked.who
        hold = lock.acquire(
            runtime,
            words,
            timeout_s,
            owner,
            asker=owner.name,
            wait=None if patience is None else self._waiting(patience, asked, lock),
            lease_s=asked.lease_s,
            take_over=asked.take_over,
        )
        with self._mutex:
            held = self._held
            if held is not None and held.hold is hold:  # another thread of his was quicker
                held.reasons += 1
                hold.release()
                return held, None, ""
            self._note(hold)
            claim = self._held = Claim(asked, hold, hold.token, self)
        if held is not None and hold.was_taken_over and not hold.changed_hands:
            self.lose(held, asked)
        elif held is not None:
            held.notice()
        return claim, action_of(hold), hold.taken_from

    def _waiting(
        self, patience: Patience, asked: Asked, lock: ProcessLock
    ) -> "Callable[[Runtime, Callable[[], bool], float | None], bool]":
        """How to wait for the lock: the listeners are told first."""

        def wait(runtime: "Runtime", done: Callable[[], bool], timeout_s: float | None) -> bool:
            if self.listeners:
                holder = lock.look().holder
                self._teller.tell(LockAction.WAITING, asked, "" if holder is None else holder.who)
            return patience.until(runtime, done, timeout_s, of=self)

        return wait

    def _note(self, hold: Hold) -> None:
        if hold.changed_hands:
            self.absences += 1
        if hold.was_abandoned or hold.was_taken_over:
            self.is_orphan = True

    # ---- losing it, and giving it back ----

    def lose(self, claim: Claim, asked: Asked) -> None:
        """It is taken over by somebody of this process."""
        lease_s = None if asked.take_over else claim.lease_s
        reason = "on demand" if lease_s is None else f"its lease of {lease_s:g} s was over"
        self.is_orphan = True
        claim.lose(Loss(asked.who, asked.purpose, reason, asked.owner.runtime.now_ns()))

    def note_loss(self, claim: Claim) -> None:
        """It was lost just now, or that was noticed."""
        loss = claim.loss
        assert loss is not None
        with self._mutex:
            if claim in self._lost:
                return  # two threads have noticed
            if claim.reasons:
                self._lost.append(claim)
        self._interrupt(str(loss), claim.owner.runtime.now_ns(), claim.owner, None)
        self._teller.tell(LockAction.LOST, claim, loss.who, since_ns=claim.since_ns)

    def is_lost_by(self, owner: object) -> bool:
        """Whether it was taken over from this one, who has neither given it back nor retaken it."""
        return self._loser(owner) is not None

    def require(self, owner: object) -> None:
        """Raises MotorBusyError if `is_lost_by`."""
        lost = self._loser(owner)
        if lost is not None:
            lost.require()

    def _loser(self, owner: object) -> Claim | None:
        held = self._held
        if held is not None and held.owner is owner and held.is_held:
            return None
        self.notice(owner)
        for claim in tuple(self._lost):
            if claim.owner is owner:
                return claim
        return None

    def notice(self, owner: object) -> None:
        """If this one has lost it, what he did with it is over, and that is told."""
        held = self._held
        if held is not None and held.owner is owner:
            held.notice()

    def use(self, owner: object) -> float | None:
        """The owner is alive: its lease begins anew, if it has one; when to say so again [s].

        A loss is noticed, and ends what goes on; nothing is raised.
        """
        held = self._held
        if held is None or held.owner is not owner:
            return None
        with suppress(MotorBusyError):
            held.use()
        pause_s = None if held.lease_s is None else held.lease_s / RENEWALS_IN_WAIT
        if self.lock is None:
            return pause_s
        return _LOSS_LOOK_S if pause_s is None else min(_LOSS_LOOK_S, pause_s)

    def give(self, claim: Claim) -> None:
        """One reason less for which its owner has it; after the last it is the next one's."""
        claim.notice()
        with self._mutex:
            if claim.reasons == 0:
                return
            claim.reasons -= 1
            if claim.reasons:
                return
            if self._held is claim:
                self._held = None
            if claim in self._lost:
                self._lost.remove(claim)
        if claim.hold is not None:
            claim.hold.release()
        if claim.lost_to is None:
            self._teller.tell(LockAction.RELEASED, claim, since_ns=claim.since_ns)

    # ---- writing ----

    def begin_write(self, asker: str = "") -> int:
        """The token under which this process commands the motor; nobody takes it over meanwhile.

        Until `end_write`. Without a lock nobody could.

        Raises:
            MotorBusyError: this process does not own it (any more); says who does, and why.
        """
        if self.lock is None:
            return self._row.token
        try:
            return self.lock.begin_write(asker)
        except MotorBusyError:
            if self._held is not None:
                self._held.notice()
            raise

    def end_write(self) -> None:
        """What was begun by `begin_write` is over."""
        if self.lock is not None:
            self.lock.end_write()

    # ---- runs ----

    def keep(self, owner: Owner, goes_on: Callable[[], bool], news: "News", counts: bool) -> None:
        """While `goes_on()`, it is the owner's; no other process has it.

        Args:
            owner: who owns it now.
            goes_on: neither waits nor sends.
            news: tell when to ask that.
            counts: whether they tell of everything.
        """
        if self.lock is None or not goes_on():
            return
        if self._keeper is not None and self._keeper.claim.owner is owner:
            return  # it looks at whatever goes on
        try:
            claim = self.take(owner, f"a motion of {owner.name}")
        except MotorError:  # it was stopped without being owned, and nothing must forbid that
            return
        self._keeper = Keeper(claim, goes_on, news, self._end_keeping)
        self._keeper.begin(owner.runtime, counts)

    def look(self) -> None:
        """If what it was kept for is over, and nobody has seen it yet, it is given back."""
        keeper = self._keeper
        if keeper is not None:
            keeper.look()

    def _end_keeping(self, keeper: Keeper) -> None:
        """What it was kept for is over."""
        if self._keeper is keeper:
            self._keeper = None
        self.give(keeper.claim)

    # ---- set-up ----

    @contextmanager
    def owned_to_set_up(self, runtime: "Runtime", label: str) -> Iterator[Callable[[], None]]:
        """What the block is given makes sure that it may write to the drive, when it has to.

        That raises MotorBusyError if another process owns the motor.
        """
        set_up = SetUp(self, self._teller, runtime, label)

        def own() -> None:
            if self.lock is not None and not self.is_here:
                hold = set_up.take(self.lock, self._set_up)
                if hold is not None:
                    self._note(hold)

        try:
            yield own
        finally:
            set_up.give()
