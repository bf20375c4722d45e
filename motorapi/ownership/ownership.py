"""Ownership of a physical motor: one logical motor at a time, of any process.

A motor is owned for an operation, for low-level access, and for a reservation; between processes
also while a motion is active (within a process the motion itself names its owner). An owner may own
it for several reasons at once; the motor is free after the last one.

If the bus belongs to this process alone (a rig in virtual time), owners queue here. On a bus that
other processes can open they queue in a `ProcessLock`, in one order with those of other processes.
`absences` counts how often another process had the motor in between: the knowledge of this process
about the drive may then be out of date.

A motor can be taken over from a living owner: on demand, or by the next request once its lease has
expired. Only actions of the owner renew the lease: a timer would continue behind a debugger prompt.
The former owner notices the loss at its next action at the latest. Until the end of its reservation
block it is refused, with the name of the new owner, unless it reserves the motor again. All this
holds with and without a lock.

A drive is set up for readers, too; they own it for that time only.
"""

import threading
from collections import deque
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from typing import TYPE_CHECKING, Final, NamedTuple, final

from motorhil.motorapi.errors import MotorBusyError, MotorError
from motorhil.motorapi.locking.process_lock import LockHandle, Loss, ProcessLock, this_process
from motorhil.motorapi.ownership.claim import (
    RENEWALS_IN_WAIT,
    AcquirePolicy,
    Claim,
    LockAction,
    Owner,
    OwnershipEvent,
    OwnershipKeepAlive,
    OwnershipListener,
    OwnershipRequest,
    register,
)

if TYPE_CHECKING:
    from motorhil.motorapi.runtime.api import ChangeCounter, Runtime

_LOOK_S: Final = 0.1
"""The maximum delay before a waiter notices a lease set after its request [s]."""
_LOSS_LOOK_S: Final = 0.1
"""The maximum delay before a waiter notices a takeover by another process [s]."""
_SET_UP_TIMEOUT_S: Final = 10.0
"""The timeout of an owner for the set-up of a drive by readers [s]."""


@final
class OwnershipNotifier:
    """Notifier of listeners about the events of an ownership."""

    def __init__(self) -> None:
        self.listeners: Final[list[OwnershipListener]] = []

    def tell(
        self,
        action: LockAction,
        of: Claim | OwnershipRequest,
        holder: str = "",
        *,
        since_ns: int | None = None,
    ) -> None:
        """Report an event; `since_ns` is the beginning of the ownership or of the wait."""
        if not self.listeners:
            return
        process = this_process()
        now_ns = of.owner.runtime.now_ns()
        time_s = 0.0 if since_ns is None else (now_ns - since_ns) / 1e9
        has_ended = action in (LockAction.RELEASED, LockAction.LOST)
        event = OwnershipEvent(
            action,
            of.who,
            holder,
            of.purpose,
            of.token if isinstance(of, Claim) else 0,
            now_ns,
            waited_s=0.0 if has_ended else time_s,
            held_s=time_s if has_ended else 0.0,
            pid=process.pid,
            program=process.program,
        )
        for listener in tuple(self.listeners):
            listener(event)


@final
class WaitQueue:
    """The waiters for one motor, in the order of their requests.

    Attributes: token (of the last owner).
    """

    def __init__(self, claims: "Ownership", notifier: OwnershipNotifier) -> None:
        self.token: int = 0
        self._claims: Final = claims
        self._notifier: Final = notifier
        self._places: deque[OwnershipRequest] = deque()

    def take(self, asked: OwnershipRequest) -> tuple[Claim, LockAction, str]:
        """Return (the new claim, the kind of acquisition, the former owner).

        Raises:
            MotorBusyError: another owner holds it, or waits for it, beyond the timeout.
        """
        policy, taken = asked.policy, _Taken()

        def is_taken() -> bool:
            return self._is_taken(asked, taken)

        while not is_taken():
            if policy is None or asked.take_over:
                busy = self._busy(asked.owner, None)
                if busy is None:
                    continue  # the holder or waiter has finished meanwhile
                raise busy
            self._places.append(asked)
            try:
                self._notifier.tell(LockAction.WAITING, asked, self._in_front(policy))
                timeout_s = policy.timeout_s
                if not policy.until(
                    asked.owner.runtime, is_taken, timeout_s, self._look_s, self._claims
                ):
                    busy = self._busy(asked.owner, policy)
                    assert busy is not None, "its own place must be in the queue"
                    raise busy
            finally:
                self._places.remove(asked)
            break
        assert taken.claim is not None
        if taken.before is not None:
            return taken.claim, LockAction.TAKEN_OVER, taken.before.who
        if asked.take_over and self._claims.end_run(asked):
            return taken.claim, LockAction.TAKEN_OVER, ""
        return taken.claim, LockAction.TAKEN, ""

    def _is_taken(self, asked: OwnershipRequest, taken: "_Taken") -> bool:
        held = self._claims.held
        if not asked.take_over:
            if held is not None and held.left_s != 0.0:
                return False
            if self._places and self._places[0] is not asked:
                return False
            policy = asked.policy
            if held is None and policy is not None and policy.in_the_way() is not None:
                return False
        claim = self._claims.replace(held, asked, self.token + 1)
        if claim is None:
            return False
        self.token += 1
        taken.claim, taken.before = claim, held
        if held is not None:
            self._claims.lose(held, asked)
        return True

    def _look_s(self) -> float | None:
        """Return the time until a waiter should check again [s]."""
        held = self._claims.held
        left_s = None if held is None else held.left_s
        return _LOOK_S if left_s is None else min(_LOOK_S, max(left_s, 1e-9))

    def _busy(self, owner: Owner, policy: "AcquirePolicy | None") -> MotorBusyError | None:
        """Return the error that names the owner or first waiter; None: there is none any more."""
        held = self._claims.held
        if held is not None:
            return held.busy(owner.name)
        in_the_way = None if policy is None else policy.in_the_way()
        if in_the_way is not None:
            return in_the_way
        try:
            first = self._places[0]
        except IndexError:
            return None
        holder = f"{first.who}, which waits for it,"
        return MotorBusyError(motor=owner.name, holder=holder, since_ns=first.asked_ns)

    def _in_front(self, policy: "AcquirePolicy") -> str:
        """Return the name of the owner or waiter in front."""
        held = self._claims.held
        if held is not None:
            return held.who
        in_the_way = policy.in_the_way()
        return "" if in_the_way is None else in_the_way.holder


@final
class _Taken:
    """The result of an acquisition: the new claim, and the one it replaced."""

    __slots__ = ("before", "claim")

    def __init__(self) -> None:
        self.claim: Claim | None = None
        self.before: Claim | None = None


def action_of(hold: LockHandle) -> LockAction:
    """Return the kind of acquisition of a lock."""
    if hold.was_abandoned:
        return LockAction.BROKEN
    return LockAction.TAKEN_OVER if hold.was_taken_over else LockAction.TAKEN


@final
class _Reader(NamedTuple):
    """The owner of a drive that is set up for readers, without a logical motor."""

    name: str
    runtime: "Runtime"


@final
class Ownership:
    """The ownership of one physical motor.

    Args:
        lock: shared with other processes; None: no other process is on this bus.
        interrupt: ends the present motion of others than the new owner (None: that of the former
            owner), in the name of the new one; returns True if there was one.

    Attributes:
        absences: grows whenever another process had the motor since this one owned it last.
        is_orphan: True if the previous owner died with the motor, or lost it, so that it may still
            be moving; the next owner brings it to rest first, and clears this.
        listeners: called with each event of the ownership; see `motorhil.motorapi.ownership.claim`.
        is_announced: True if one of them tells the events to a bus, or to a record.
        refusal_check: raises MotorBusyError if the bus has refused frames of this ownership.
    """

    def __init__(
        self,
        lock: ProcessLock | None,
        interrupt: Callable[[str, int, object, object], bool] = lambda *_: False,
    ) -> None:
        self.lock: Final = lock
        self.absences: int = 0
        self.is_orphan: bool = False
        self.is_announced: bool = False
        self.refusal_check: Callable[[], None] = lambda: None
        self._notifier: Final = OwnershipNotifier()
        self.listeners: Final = self._notifier.listeners
        self._interrupt: Final = interrupt
        self._held: Claim | None = None
        self._lost: list[Claim] = []  # until their owners have released them
        self._row: Final = WaitQueue(self, self._notifier)
        self._mutex = threading.Lock()  # never held during a wait
        self._keeper: OwnershipKeepAlive | None = None
        self._set_up = object()  # the owner during the set-up of a drive for readers

    @property
    def is_here(self) -> bool:
        """True if this process owns the motor, to its own knowledge."""
        return self._held is not None

    @property
    def held(self) -> Claim | None:
        """The claim of this process, held or lost, or None."""
        return self._held

    @contextmanager
    def owned(
        self,
        owner: Owner,
        who: str,
        purpose: str = "",
        policy: AcquirePolicy | None = None,
        *,
        lease_s: float | None = None,
        take_over: bool = False,
        afresh: bool = False,
    ) -> Iterator[Claim]:
        """Own the motor inside the block, for one more reason.

        Args:
            owner: the logical motor.
            who: its activity, in words.
            purpose: its purpose, in words.
            policy: of the wait for others; None: do not wait.
            lease_s: others may take it over after this time without use [s]; None: as before.
            take_over: take it from its owner.
            afresh: acquire it again, although it was lost and the lost claim is not yet released.

        Raises:
            MotorBusyError: another owner holds it, or held it until the timeout of `policy`.
        """
        before = self._held
        asked = OwnershipRequest(owner, who, purpose, policy, lease_s, take_over)
        try:
            claim = self._take(asked, afresh)
        except MotorBusyError as error:
            self._notifier.tell(LockAction.REFUSED, asked, error.holder, since_ns=asked.asked_ns)
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
        self, owner: Owner, who: str, purpose: str = "", policy: AcquirePolicy | None = None
    ) -> Claim:
        """Own the motor until `give`. As `owned`."""
        return self._take(OwnershipRequest(owner, who, purpose, policy), False)

    def _take(self, asked: OwnershipRequest, afresh: bool) -> Claim:
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
            self._notifier.tell(action, claim, before, since_ns=asked.asked_ns)
        return claim

    def _again(self, owner: Owner, afresh: bool) -> Claim | None:
        """Return the present claim of this owner with one more reason, or None."""
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

    def replace(self, held: Claim | None, asked: OwnershipRequest, token: int) -> Claim | None:
        """Replace claim `held` by a new one and return it; None: `held` is no longer present."""
        with self._mutex:
            if self._held is not held:
                return None
            claim = self._held = Claim(asked, None, token, self)
        if asked.lease_s is not None:
            claim.set_lease(asked.lease_s)
        return claim

    def end_run(self, asked: OwnershipRequest) -> bool:
        """End a motion of former owners, and mark the motor to be brought to rest.

        Return True if there was one.
        """
        by = f"{asked.who}, which took the motor over (on demand)"
        if not self._interrupt(by, asked.owner.runtime.now_ns(), None, asked.owner):
            return False
        self.is_orphan = True
        return True

    # ---- with a lock ----

    def _take_lock(
        self, lock: ProcessLock, asked: OwnershipRequest
    ) -> tuple[Claim, LockAction | None, str]:
        owner, policy, runtime = asked.owner, asked.policy, asked.owner.runtime
        held = self._held
        timeout_s = 0.0 if policy is None else policy.timeout_s
        may_take = asked.take_over or (held is not None and held.left_s == 0.0)
        if policy is None and held is not None and held.is_held and not may_take:
            raise held.busy(owner.name)
        if policy is None and lock.hold is not None and lock.hold.owner is self._set_up:
            timeout_s = _SET_UP_TIMEOUT_S
        words = f"{asked.purpose} ({asked.who})" if asked.purpose else asked.who
        hold = lock.acquire(
            runtime,
            words,
            timeout_s,
            owner,
            asker=owner.name,
            wait=None if policy is None else self._waiting(policy, asked, lock),
            lease_s=asked.lease_s,
            take_over=asked.take_over,
        )
        with self._mutex:
            held = self._held
            if held is not None and held.hold is hold:  # another thread of the owner was quicker
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
        self, policy: AcquirePolicy, asked: OwnershipRequest, lock: ProcessLock
    ) -> "Callable[[Runtime, Callable[[], bool], float | None], bool]":
        """Return the wait function for the lock, which notifies the listeners first."""

        def wait(runtime: "Runtime", done: Callable[[], bool], timeout_s: float | None) -> bool:
            if self.listeners:
                holder = lock.look().holder
                self._notifier.tell(LockAction.WAITING, asked, "" if holder is None else holder.who)
            return policy.until(runtime, done, timeout_s, of=self)

        return wait

    def _note(self, hold: LockHandle) -> None:
        if hold.changed_hands:
            self.absences += 1
        if hold.was_abandoned or hold.was_taken_over:
            self.is_orphan = True

    # ---- loss and release ----

    def lose(self, claim: Claim, asked: OwnershipRequest) -> None:
        """Mark the claim as taken over by another owner of this process."""
        lease_s = None if asked.take_over else claim.lease_s
        reason = "on demand" if lease_s is None else f"its lease of {lease_s:g} s was over"
        self.is_orphan = True
        claim.lose(Loss(asked.who, asked.purpose, reason, asked.owner.runtime.now_ns()))

    def note_loss(self, claim: Claim) -> None:
        """Handle the loss of `claim`, at the time when it is noticed."""
        loss = claim.loss
        assert loss is not None
        with self._mutex:
            if claim in self._lost:
                return  # two threads have noticed it
            if claim.reasons:
                self._lost.append(claim)
        self._interrupt(str(loss), claim.owner.runtime.now_ns(), claim.owner, None)
        self._notifier.tell(LockAction.LOST, claim, loss.who, since_ns=claim.since_ns)

    def is_lost_by(self, owner: object) -> bool:
        """Return True if `owner` has lost the motor, and neither released nor retaken it."""
        return self._loser(owner) is not None

    def require(self, owner: object) -> None:
        """Raise MotorBusyError if `is_lost_by`."""
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
        """Notice a loss by `owner`: end its motion and report the loss."""
        held = self._held
        if held is not None and held.owner is owner:
            held.notice()

    def use(self, owner: object) -> float | None:
        """Renew the lease of the owner. Return the time until the next renewal [s], or None.

        A loss is noticed, and ends the active motion; nothing is raised.
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
        """Remove one reason of the claim; the last one releases the motor."""
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
            self._notifier.tell(LockAction.RELEASED, claim, since_ns=claim.since_ns)

    # ---- writing ----

    def begin_write(self, asker: str = "") -> int:
        """Block takeovers until `end_write`. Return the token of this process.

        Without a lock no takeover is possible.

        Raises:
            MotorBusyError: this process does not own it (any more); names the owner and the reason.
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
        """End the write begun by `begin_write`."""
        if self.lock is not None:
            self.lock.end_write()

    # ---- motions ----

    def keep(
        self, owner: Owner, goes_on: Callable[[], bool], news: "ChangeCounter", counts: bool
    ) -> None:
        """Keep the motor owned, against other processes, while `goes_on()` is true.

        Args:
            owner: the present owner.
            goes_on: neither waits nor sends.
            news: counts the changes after which `goes_on` is evaluated.
            counts: True if `news` counts every change.
        """
        if self.lock is None or not goes_on():
            return
        if self._keeper is not None and self._keeper.claim.owner is owner:
            return  # the present keep-alive covers any motion
        try:
            claim = self.take(owner, f"a motion of {owner.name}")
        except MotorError:  # a stop without ownership, which must always be possible
            return
        self._keeper = OwnershipKeepAlive(claim, goes_on, news, self._end_keeping)
        self._keeper.begin(owner.runtime, counts)

    def look(self) -> None:
        """Release the motor if its motion has ended unnoticed."""
        keeper = self._keeper
        if keeper is not None:
            keeper.look()

    def _end_keeping(self, keeper: OwnershipKeepAlive) -> None:
        """Release the claim of a keep-alive that has ended."""
        if self._keeper is keeper:
            self._keeper = None
        self.give(keeper.claim)

    # ---- set-up of drives for readers ----

    @contextmanager
    def owned_to_set_up(self, runtime: "Runtime", label: str) -> Iterator[Callable[[], None]]:
        """Yield a function that ensures the ownership needed to write to the drive.

        The function raises MotorBusyError if another process owns the motor.
        """
        asked = OwnershipRequest(_Reader(label, runtime), f"set-up of {label}", "", None)
        claim: Claim | None = None

        def own() -> None:
            nonlocal claim
            if self.lock is None or self.is_here or claim is not None:
                return
            hold = self.lock.acquire(runtime, asked.who, owner=self._set_up, asker=label)
            claim = Claim(asked, hold, hold.token, self)
            action = action_of(hold)
            self._notifier.tell(action, claim, hold.taken_from, since_ns=asked.asked_ns)
            self._note(hold)

        try:
            yield own
        finally:
            if claim is not None and claim.hold is not None:
                claim.hold.release()
                self._notifier.tell(LockAction.RELEASED, claim, since_ns=claim.since_ns)
