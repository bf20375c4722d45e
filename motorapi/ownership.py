"""Who may command a physical motor: one logical motor at a time, of whatever process.

It is owned for an operation, for low-level access, and for a reservation; between processes also
for as long as a run goes on (within a process the run itself says whose it is). Its owner may own
it for several reasons at once; it is free when the last is gone.

Where the bus belongs to this process alone (a rig in virtual time), owners queue here. On a bus
that other processes can open they queue in a `ProcessLock`, with those of other processes, in one
order. Whether another process has had the motor in between is counted (`absences`): what this one
believes of the drive may then be true no more.
"""

import threading
from collections import deque
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import TYPE_CHECKING, Final, Protocol, final

from motorapi.claim import Claim
from motorapi.errors import MotorBusyError, MotorError
from motorapi.outcome import LOOK_PERIOD_S
from motorapi.ownership_events import LockAction, OwnershipEvent, OwnershipListener
from motorapi.process_lock import Hold, ProcessLock, this_process
from motorapi.runtime import wait_until

if TYPE_CHECKING:
    from motorapi.runtime import Registration, Runtime
    from motorapi.waiting import News

SET_UP_TIMEOUT_S: Final = 10.0
"""How long an owner waits for a drive to be set up for somebody who reads it."""


class Owner(Protocol):
    """A logical motor, as an owner."""

    @property
    def name(self) -> str:
        """What messages call it."""

    @property
    def runtime(self) -> "Runtime":
        """Where it waits."""


@final
class _Place:
    """One who waits."""

    __slots__ = ("since_ns", "who")

    def __init__(self, who: str, since_ns: int) -> None:
        self.who: Final = who
        self.since_ns: Final = since_ns


@final
class Patience:
    """How a patient one waits for the motor.

    Args:
        timeout_s: how long [s].
        in_the_way: what keeps a free motor from being taken, as an error; neither waits nor sends.
        refresh: what `in_the_way` looks at is fresh; after how long to call it again [s], if at
            all.
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

    def until(self, runtime: "Runtime", done: Callable[[], bool], timeout_s: float | None) -> bool:
        """As `runtime.wait_until`, with everything fresh."""
        end_ns = runtime.now_ns() + round(min(timeout_s or 0.0, 1e9) * 1e9)
        while True:
            left_s = max(0, end_ns - runtime.now_ns()) / 1e9
            pause_s = self._refresh()
            if wait_until(runtime, done, left_s if pause_s is None else min(left_s, pause_s)):
                return True
            if runtime.now_ns() >= end_ns:
                return False


@final
class Ownership:
    """Who owns one physical motor.

    Args:
        lock: shared with other processes; None: there are none on this bus.

    Attributes:
        absences: grows whenever another process had the motor since this one owned it last.
        is_orphan: whether who had it before died with it, so that it may be moving for nobody; the
            next one brings it to rest first, and says so here.
        listeners: are told what happens to the ownership; see `motorapi.ownership_events`.
    """

    def __init__(self, lock: ProcessLock | None) -> None:
        self.lock: Final = lock
        self.absences = 0
        self.is_orphan = False
        self.listeners: list[OwnershipListener] = []
        self._held: Claim | None = None
        self._token = 0  # where there is no lock
        self._queue: deque[_Place] = deque()  # of those who wait here, not in the lock
        self._mutex = threading.Lock()  # never held while waiting
        self._keeper: _Keeper | None = None
        self._set_up = object()  # the owner while a drive is set up for readers

    @property
    def is_here(self) -> bool:
        """Whether somebody of this process owns it."""
        return self._held is not None

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
    ) -> Iterator[Claim]:
        """The motor is the owner's inside the block, for one reason more.

        Args:
            owner: the logical motor.
            who: what he does, in words.
            purpose: what for, in words.
            patience: how to wait for others; None: not at all.
            lease_s: others may take it over once it was not renewed for so long [s].
            take_over: take it from whoever has it.

        Raises:
            MotorBusyError: somebody else's it is, or was for as long as `patience` says.
        """
        claim = self.take(owner, who, purpose, patience, lease_s=lease_s, take_over=take_over)
        try:
            yield claim
        finally:
            self.give(owner)

    def take(
        self,
        owner: Owner,
        who: str,
        purpose: str = "",
        patience: Patience | None = None,
        *,
        lease_s: float | None = None,
        take_over: bool = False,
    ) -> Claim:
        """The motor is the owner's until `give`. As `owned`."""
        keeper = self._keeper
        if keeper is not None:
            keeper.look()  # what it was kept for may be over, and nobody has seen it yet
        with self._mutex:
            held = self._held
            if held is not None and held.owner is owner:
                held.reasons += 1
                return held
        asked_ns = owner.runtime.now_ns()
        if self.lock is None:
            claim = self._take_here(owner, who, purpose, patience)
        else:
            claim = self._take_lock(self.lock, owner, who, purpose, patience)
        broken = claim.hold is not None and claim.hold.was_abandoned
        action = LockAction.BROKEN if broken else LockAction.TAKEN
        self._tell(action, claim, waited_ns=claim.since_ns - asked_ns)
        return claim

    def begin_write(self, asker: str = "") -> int:
        """The token under which this process commands the motor; nobody takes it over meanwhile.

        Until `end_write`. Without a lock nobody could.

        Raises:
            MotorBusyError: this process does not own it (any more); says who does, and why.
        """
        return self._token if self.lock is None else self.lock.begin_write(asker)

    def end_write(self) -> None:
        """What was begun by `begin_write` is over."""
        if self.lock is not None:
            self.lock.end_write()

    def _tell(
        self, action: LockAction, claim: Claim, *, waited_ns: int = 0, held_ns: int = 0
    ) -> None:
        if not self.listeners:
            return
        process = this_process()
        runtime: Runtime = claim.owner.runtime  # type: ignore[attr-defined]
        event = OwnershipEvent(
            action,
            claim.who,
            "",
            claim.purpose,
            claim.token,
            runtime.now_ns(),
            waited_s=waited_ns / 1e9,
            held_s=held_ns / 1e9,
            pid=process.pid,
            program=process.program,
        )
        for listener in tuple(self.listeners):
            listener(event)

    def _take_here(self, owner: Owner, who: str, purpose: str, patience: Patience | None) -> Claim:
        runtime = owner.runtime
        place = _Place(who, runtime.now_ns())
        made: list[Claim] = []

        def is_taken() -> bool:
            if patience is not None and patience.in_the_way() is not None:
                return False
            with self._mutex:
                if self._held is not None or (self._queue and self._queue[0] is not place):
                    return False
                self._token += 1
                self._held = Claim(owner, who, purpose, runtime.now_ns(), None, self._token)
                made.append(self._held)
                return True

        if is_taken():
            return made[0]
        if patience is None:
            raise self._busy(owner, None)
        self._queue.append(place)
        try:
            if not patience.until(runtime, is_taken, patience.timeout_s):
                raise self._busy(owner, patience)
        finally:
            self._queue.remove(place)
        return made[0]

    def _busy(self, owner: Owner, patience: Patience | None) -> MotorBusyError:
        held = self._held
        if held is not None:
            return held.busy(owner.name)
        in_the_way = None if patience is None else patience.in_the_way()
        if in_the_way is not None:
            return in_the_way
        first = self._queue[0]
        holder = f"{first.who}, which waits for it,"
        return MotorBusyError(motor=owner.name, holder=holder, since_ns=first.since_ns)

    def _take_lock(
        self, lock: ProcessLock, owner: Owner, who: str, purpose: str, patience: Patience | None
    ) -> Claim:
        runtime = owner.runtime
        held = self._held
        timeout_s = 0.0 if patience is None else patience.timeout_s
        if patience is None and held is not None:
            raise held.busy(owner.name)
        if patience is None and lock.hold is not None and lock.hold.owner is self._set_up:
            timeout_s = SET_UP_TIMEOUT_S
        words = f"{purpose} ({who})" if purpose else who
        wait = None if patience is None else patience.until
        hold = lock.acquire(runtime, words, timeout_s, owner, asker=owner.name, wait=wait)
        with self._mutex:
            held = self._held
            if held is not None and held.owner is owner:  # another thread of his was quicker
                held.reasons += 1
                hold.release()
                return held
            self._note(hold)
            claim = self._held = Claim(owner, who, purpose, runtime.now_ns(), hold, hold.token)
            return claim

    def _note(self, hold: Hold) -> None:
        if hold.changed_hands:
            self.absences += 1
        if hold.was_abandoned:
            self.is_orphan = True

    def give(self, owner: object) -> None:
        """One reason less for which the owner has it; after the last it is the next one's."""
        with self._mutex:
            held = self._held
            if held is None or held.owner is not owner:
                return
            held.reasons -= 1
            if held.reasons:
                return
            self._held = None
        if held.hold is not None:
            held.hold.release()
        runtime: Runtime = held.owner.runtime  # type: ignore[attr-defined]
        self._tell(LockAction.RELEASED, held, held_ns=runtime.now_ns() - held.since_ns)

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
        if self._keeper is not None and self._keeper.owner is owner:
            return  # it looks at whatever goes on
        try:
            self.take(owner, f"a motion of {owner.name}")
        except MotorError:  # it was stopped without being owned, and nothing must forbid that
            return
        self._keeper = _Keeper(self, owner, goes_on, news)
        self._keeper.begin(counts)

    def end_keeping(self, keeper: "_Keeper") -> None:
        """What it was kept for is over."""
        if self._keeper is keeper:
            self._keeper = None
        self.give(keeper.owner)

    # ---- set-up ----

    @contextmanager
    def owned_to_set_up(self, runtime: "Runtime", label: str) -> Iterator[Callable[[], None]]:
        """What the block is given makes sure that it may write to the drive, when it has to.

        That raises MotorBusyError if another process owns the motor.
        """
        holds: list[Hold] = []

        def own() -> None:
            if self.lock is not None and not holds and not self.is_here:
                hold = self.lock.acquire(
                    runtime, f"set-up of {label}", owner=self._set_up, asker=label
                )
                self._note(hold)
                holds.append(hold)

        try:
            yield own
        finally:
            for hold in holds:
                hold.release()


@final
class _Keeper:
    """Owns the motor while a run goes on; looks at every news."""

    def __init__(
        self, ownership: Ownership, owner: Owner, goes_on: Callable[[], bool], news: "News"
    ) -> None:
        self.owner: Final = owner
        self._ownership = ownership
        self._goes_on = goes_on
        self._listeners = news.listeners
        self._timer: Registration | None = None

    def begin(self, counts: bool) -> None:
        """It looks from now on."""
        self._listeners.append(self.look)
        if not counts:
            self._timer = self.owner.runtime.every(LOOK_PERIOD_S, self.look)
        self.look()

    def look(self) -> None:
        """The motor is given away if nothing goes on any more."""
        if self._goes_on():
            return
        try:
            self._listeners.remove(self.look)
        except ValueError:
            return  # another thread was quicker
        if self._timer is not None:
            self._timer.cancel()
        self._ownership.end_keeping(self)
