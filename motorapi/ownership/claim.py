"""Claims: ownership of a physical motor by one logical motor of this process.

A claim lasts from its acquisition to its release or its loss. It may have a lease, which ends
unless its owner renews it. A thread that waits for one motor is alive, and so are its reservations
of others: it renews their leases. A thread that is stopped, in a debugger or by a long computation,
renews nothing.

Events of the ownership go to listeners. An owner is described by its activity ("reserve() of pan"),
as in errors. Another process is known only by what it has published.
"""

import threading
from collections.abc import Callable
from contextlib import suppress
from enum import IntEnum
from typing import TYPE_CHECKING, Final, Protocol, final

from motorhil.frozen import frozen
from motorhil.motorapi.errors import MotorBusyError
from motorhil.motorapi.locking.process_lock import LockHandle, Loss
from motorhil.motorapi.runtime.api import LOOK_PERIOD_S, wait_until

if TYPE_CHECKING:
    from motorhil.motorapi.runtime.api import ChangeCounter, Registration, Runtime

RENEWALS_IN_WAIT: Final = 4
"""The number of renewals per lease period during a wait."""


class Owner(Protocol):
    """A logical motor in the role of an owner."""

    @property
    def name(self) -> str:
        """The name of the motor in messages."""

    @property
    def runtime(self) -> "Runtime":
        """The runtime in which the motor waits."""


class Losable(Protocol):
    """The ownership of a motor, notified when a claim is lost."""

    def note_loss(self, claim: "Claim") -> None:
        """Handle the loss of `claim`, at the time when it is noticed."""


@final
class OwnershipRequest:
    """An ownership request; see `Ownership.owned`."""

    __slots__ = ("asked_ns", "lease_s", "owner", "policy", "purpose", "take_over", "who")

    def __init__(
        self,
        owner: Owner,
        who: str,
        purpose: str,
        policy: "AcquirePolicy | None",
        lease_s: float | None = None,
        take_over: bool = False,
    ) -> None:
        self.owner: Final = owner
        self.who: Final = who
        self.purpose: Final = purpose
        self.policy: Final = policy
        self.lease_s: Final = lease_s
        self.take_over: Final = take_over
        self.asked_ns: Final = owner.runtime.now_ns()


@final
class Claim:
    """One ownership of a motor by a logical motor, until it is released or lost.

    Attributes: owner, who and purpose (in words), since_ns, hold (handle of the lock between
    processes, or None), of (the ownership), token (greater than any earlier one), reasons (how
    often it was acquired).
    """

    __slots__ = (
        "_end_ns",
        "_lease_ns",
        "_loss",
        "hold",
        "of",
        "owner",
        "purpose",
        "reasons",
        "since_ns",
        "token",
        "who",
    )

    def __init__(
        self,
        asked: OwnershipRequest,
        hold: LockHandle | None,
        token: int,
        of: Losable,
    ) -> None:
        self.owner: Final = asked.owner
        self.who: Final = asked.who
        self.purpose: Final = asked.purpose
        self.since_ns: Final = asked.owner.runtime.now_ns()
        self.hold: Final = hold
        self.token: Final = token
        self.reasons: int = 1
        self.of: Final = of
        self._loss: Loss | None = None
        self._lease_ns = 0  # used only without a lock between processes that knows the lease
        self._end_ns = 0

    # ---- ownership ----

    @property
    def is_held(self) -> bool:
        """True while it is neither lost nor released."""
        return self.reasons > 0 and self.loss is None

    @property
    def loss(self) -> Loss | None:
        """The reason of the loss, or None."""
        if self._loss is None and self.hold is not None and self.reasons > 0:
            loss = self.hold.loss
            if loss is not None:
                self.lose(loss)
        return self._loss

    @property
    def lost_to(self) -> str | None:
        """The new owner and its reason in words, or None."""
        loss = self.loss
        return None if loss is None else str(loss)

    def notice(self) -> None:
        """Report a loss of the claim, unless it was reported before."""
        self.loss  # noqa: B018 -- looking is what finds it

    def lose(self, loss: Loss) -> None:
        """Mark the claim as lost, and report this once."""
        if self._loss is None:
            self._loss = loss
            self.of.note_loss(self)

    def require(self) -> None:
        """Raise MotorBusyError if the claim was lost."""
        loss = self.loss
        if loss is not None:
            raise loss.busy(self.owner.name)

    def busy(self, motor: str) -> MotorBusyError:
        """Return the error for other requests while this claim is held."""
        return MotorBusyError(
            motor=motor, holder=self.who, since_ns=self.since_ns, purpose=self.purpose
        )

    # ---- leases ----

    @property
    def lease_s(self) -> float | None:
        """The lease [s], or None."""
        if self.hold is not None:
            return self.hold.lease_s
        return self._lease_ns / 1e9 if self._lease_ns else None

    @property
    def left_s(self) -> float | None:
        """The remaining time of the lease [s]; 0 if it has expired, None without a lease."""
        if self.hold is not None:
            return self.hold.left_s
        if not self._lease_ns:
            return None
        return max(0, self._end_ns - self.owner.runtime.now_ns()) / 1e9

    def set_lease(self, lease_s: float | None) -> None:
        """Set another lease, which begins now. Raises as `require`."""
        self.require()
        self._lease_ns = 0 if lease_s is None else round(lease_s * 1e9)
        if self.hold is not None:
            self._by_hold(lambda hold: hold.set_lease(lease_s))
        self.renew()

    def renew(self) -> None:
        """Restart the lease. Raises as `require`."""
        self.require()
        if self.hold is not None:
            self._by_hold(LockHandle.renew)
        else:
            self._end_ns = self.owner.runtime.now_ns() + self._lease_ns

    def use(self) -> None:
        """Restart the lease if it is due. Raises as `require`."""
        self.require()
        if self.hold is not None:
            self._by_hold(LockHandle.use)
        else:
            self._end_ns = self.owner.runtime.now_ns() + self._lease_ns

    def _by_hold(self, action: Callable[[LockHandle], None]) -> None:
        assert self.hold is not None
        try:
            action(self.hold)
        except MotorBusyError:
            self.require()
            raise


@final
class _Mine(threading.local):
    """Reservations of this thread with a lease."""

    def __init__(self) -> None:
        self.claims: list[Claim] = []


_mine: Final = _Mine()


def register(claim: "Claim") -> None:
    """Renew `claim` from now on while this thread waits."""
    if claim not in _mine.claims:
        _mine.claims.append(claim)


def use_leases(waits_for: object = None) -> float | None:
    """Renew all leases of this thread. Return the time until the next renewal [s], or None.

    The ownership for which the thread waits is excluded, because its owner is idle meanwhile.
    Nothing is raised: a lost claim raises at its next use.
    """
    if not _mine.claims:
        return None
    _mine.claims = [claim for claim in _mine.claims if claim.reasons and claim.lost_to is None]
    pauses_s = []
    for claim in _mine.claims:
        lease_s = claim.lease_s
        if lease_s is not None and claim.of is not waits_for:
            with suppress(MotorBusyError):
                claim.use()
            pauses_s.append(lease_s / RENEWALS_IN_WAIT)
    return min(pauses_s, default=None)


@final
class AcquirePolicy:
    """The policy of a request that waits for the motor.

    Args:
        timeout_s: timeout [s].
        in_the_way: returns the obstacle to the acquisition of a free motor, as an error, or None;
            neither waits nor sends.
        refresh: refreshes the data of `in_the_way`; returns the polling interval [s], or None.
    """

    def __init__(
        self,
        timeout_s: float,
        in_the_way: Callable[[], MotorBusyError | None],
        refresh: Callable[[], float | None],
    ) -> None:
        self.timeout_s: Final = timeout_s
        self.in_the_way: Final = in_the_way
        self._refresh: Final = refresh

    def until(
        self,
        runtime: "Runtime",
        done: Callable[[], bool],
        timeout_s: float | None,
        soonest_s: Callable[[], float | None] = lambda: None,
        of: object = None,
    ) -> bool:
        """Wait as `runtime.wait_until`, with all data refreshed.

        Args:
            runtime: the runtime of the wait.
            done: as in `wait_until`.
            timeout_s: as in `wait_until`.
            soonest_s: returns the maximum time until the next check [s], or None.
            of: the awaited ownership.
        """
        end_ns = runtime.now_ns() + round(min(timeout_s or 0.0, 1e9) * 1e9)
        while True:
            left_s = max(0, end_ns - runtime.now_ns()) / 1e9
            for pause_s in (self._refresh(), soonest_s(), use_leases(of)):
                left_s = left_s if pause_s is None else min(left_s, pause_s)
            if wait_until(runtime, done, left_s):
                return True
            if runtime.now_ns() >= end_ns:
                return False


@final
class OwnershipKeepAlive:
    """Keep-alive of a claim during a motion, which examines every change.

    Args:
        claim: the claim to be kept.
        goes_on: returns True while the motion is active; neither waits nor sends.
        news: the counter of changes.
        is_over: called when no motion is active any more.
    """

    def __init__(
        self,
        claim: "Claim",
        goes_on: Callable[[], bool],
        news: "ChangeCounter",
        is_over: "Callable[[OwnershipKeepAlive], None]",
    ) -> None:
        self.claim: Final = claim
        self._goes_on = goes_on
        self._is_over = is_over
        self._listeners = news.listeners
        self._timer: Registration | None = None

    def begin(self, runtime: "Runtime", counts: bool) -> None:
        """Begin to examine changes."""
        self._listeners.append(self.look)
        if not counts:
            self._timer = runtime.every(LOOK_PERIOD_S, self.look)
        self.look()

    def look(self) -> None:
        """Release the motor if it was lost, or no motion is active any more."""
        if self.claim.is_held and self._goes_on():
            return
        try:
            self._listeners.remove(self.look)
        except ValueError:
            return  # another thread was quicker
        if self._timer is not None:
            self._timer.cancel()
        self._is_over(self)


@final
class LockAction(IntEnum):
    """The kind of event. Each acquisition is one of TAKEN, BROKEN and TAKEN_OVER."""

    TAKEN = 1
    RELEASED = 2
    WAITING = 3
    REFUSED = 4
    BROKEN = 5
    """Acquired from an owner that died with it."""
    TAKEN_OVER = 6
    """Acquired from a living owner."""
    LOST = 7
    """Noticed by the former owner of a takeover."""


@final
@frozen
class OwnershipEvent:
    """One event of an ownership.

    Attributes:
        action: the kind of event.
        owner: the acting owner, in words; for LOST: the former owner.
        holder: the present or previous owner, if another one; "" if unknown or none.
        purpose: the purpose, in words.
        token: token of the owner; for WAITING and REFUSED: 0.
        time_ns: time of the event, by the runtime.
        waited_s: time for which the owner had waited [s].
        held_s: time for which the owner had held it [s]: RELEASED and LOST; and TAKEN, if reported
            late.
        pid, program: the process of the owner.
    """

    action: LockAction
    owner: str
    holder: str
    purpose: str
    token: int
    time_ns: int
    waited_s: float = 0.0
    held_s: float = 0.0
    pid: int = 0
    program: str = ""


OwnershipListener = Callable[[OwnershipEvent], None]
"""Called in the thread of the event, without any lock held; it must not wait."""
