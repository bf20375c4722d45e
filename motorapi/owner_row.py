"""Wait queue of owners within one process, and notification of listeners."""

from collections import deque
from typing import TYPE_CHECKING, Final, Protocol, final

from motorapi.claim import Asked, Claim, Owner
from motorapi.errors import MotorBusyError
from motorapi.ownership_events import LockAction, OwnershipEvent, OwnershipListener
from motorapi.process_lock import this_process

if TYPE_CHECKING:
    from motorapi.patience import Patience

_LOOK_S: Final = 0.1
"""The maximum delay before a waiter notices a lease set after its request [s]."""


@final
class Teller:
    """Notifier of listeners about the events of an ownership."""

    def __init__(self) -> None:
        self.listeners: Final[list[OwnershipListener]] = []

    def tell(
        self,
        action: LockAction,
        of: Claim | Asked,
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


class ClaimKeeper(Protocol):
    """The keeper of the present claim; see `motorapi.ownership.Ownership`."""

    @property
    def held(self) -> Claim | None:
        """The present claim."""

    def replace(self, held: Claim | None, asked: Asked, token: int) -> Claim | None:
        """Replace claim `held` by a new one and return it; None: `held` is no longer present."""

    def lose(self, claim: Claim, asked: Asked) -> None:
        """Mark the claim as taken over by another owner of this process."""

    def end_run(self, asked: Asked) -> bool:
        """End a motion of former owners. Return True if there was one."""


@final
class OwnerRow:
    """The waiters for one motor, in the order of their requests.

    Attributes: token (of the last owner).
    """

    def __init__(self, claims: ClaimKeeper, teller: Teller) -> None:
        self.token = 0
        self._claims: Final = claims
        self._teller: Final = teller
        self._places: deque[Asked] = deque()

    def take(self, asked: Asked) -> tuple[Claim, LockAction, str]:
        """Return (the new claim, the kind of acquisition, the former owner).

        Raises:
            MotorBusyError: another owner holds it, or waits for it, beyond the timeout.
        """
        patience, taken = asked.patience, _Taken()

        def is_taken() -> bool:
            return self._is_taken(asked, taken)

        while not is_taken():
            if patience is None or asked.take_over:
                busy = self._busy(asked.owner, None)
                if busy is None:
                    continue  # the holder or waiter has finished meanwhile
                raise busy
            self._places.append(asked)
            try:
                self._teller.tell(LockAction.WAITING, asked, self._in_front(patience))
                timeout_s = patience.timeout_s
                if not patience.until(
                    asked.owner.runtime, is_taken, timeout_s, self._look_s, self._claims
                ):
                    busy = self._busy(asked.owner, patience)
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

    def _is_taken(self, asked: Asked, taken: "_Taken") -> bool:
        held = self._claims.held
        if not asked.take_over:
            if held is not None and held.left_s != 0.0:
                return False
            if self._places and self._places[0] is not asked:
                return False
            patience = asked.patience
            if held is None and patience is not None and patience.in_the_way() is not None:
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

    def _busy(self, owner: Owner, patience: "Patience | None") -> MotorBusyError | None:
        """Return the error that names the owner or first waiter; None: there is none any more."""
        held = self._claims.held
        if held is not None:
            return held.busy(owner.name)
        in_the_way = None if patience is None else patience.in_the_way()
        if in_the_way is not None:
            return in_the_way
        try:
            first = self._places[0]
        except IndexError:
            return None
        holder = f"{first.who}, which waits for it,"
        return MotorBusyError(motor=owner.name, holder=holder, since_ns=first.asked_ns)

    def _in_front(self, patience: "Patience") -> str:
        """Return the name of the owner or waiter in front."""
        held = self._claims.held
        if held is not None:
            return held.who
        in_the_way = patience.in_the_way()
        return "" if in_the_way is None else in_the_way.holder


@final
class _Taken:
    """The result of an acquisition: the new claim, and the one it replaced."""

    __slots__ = ("before", "claim")

    def __init__(self) -> None:
        self.claim: Claim | None = None
        self.before: Claim | None = None
