"""Owners of one process, which wait for a motor that no other process can have; and who is told."""

from collections import deque
from typing import TYPE_CHECKING, Final, Protocol, final

from motorapi.claim import Asked, Claim, Owner
from motorapi.errors import MotorBusyError
from motorapi.ownership_events import LockAction, OwnershipEvent, OwnershipListener
from motorapi.process_lock import this_process

if TYPE_CHECKING:
    from motorapi.patience import Patience

_LOOK_S: Final = 0.1
"""How soon one who waits notices that a lease was given which was not there when he asked."""


@final
class Teller:
    """Tells listeners what happens to an ownership."""

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
        """It has happened; since when he had it, or has waited for it, if he did."""
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
    """Where the claim there is, is kept: see `motorapi.ownership.Ownership`."""

    @property
    def held(self) -> Claim | None:
        """The claim there is."""

    def replace(self, held: Claim | None, asked: Asked, token: int) -> Claim | None:
        """The new claim, in place of the one there was; None: that is there no more."""

    def lose(self, claim: Claim, asked: Asked) -> None:
        """It is taken over by somebody of this process."""

    def end_run(self, asked: Asked) -> bool:
        """What it does for others, who own it no more, is over; whether it did anything."""


@final
class OwnerRow:
    """Those who wait for one motor, in the order of asking.

    Attributes: token (of who had it last).
    """

    def __init__(self, claims: ClaimKeeper, teller: Teller) -> None:
        self.token = 0
        self._claims: Final = claims
        self._teller: Final = teller
        self._places: deque[Asked] = deque()

    def take(self, asked: Asked) -> tuple[Claim, LockAction, str]:
        """(the new claim, how it was taken, from whom).

        Raises:
            MotorBusyError: somebody has it, or waits for it, for longer than one is patient.
        """
        patience, taken = asked.patience, _Taken()

        def is_taken() -> bool:
            return self._is_taken(asked, taken)

        while not is_taken():
            if patience is None or asked.take_over:
                busy = self._busy(asked.owner, None)
                if busy is None:
                    continue  # whoever had it, or waited for it, is through with it by now
                raise busy
            self._places.append(asked)
            try:
                self._teller.tell(LockAction.WAITING, asked, self._in_front(patience))
                timeout_s = patience.timeout_s
                if not patience.until(
                    asked.owner.runtime, is_taken, timeout_s, self._look_s, self._claims
                ):
                    busy = self._busy(asked.owner, patience)
                    assert busy is not None, "one's own place is in the row"
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
        """How soon one who waits is to look again [s]."""
        held = self._claims.held
        left_s = None if held is None else held.left_s
        return _LOOK_S if left_s is None else min(_LOOK_S, max(left_s, 1e-9))

    def _busy(self, owner: Owner, patience: "Patience | None") -> MotorBusyError | None:
        """Who has it, or is in front; None: nobody any more. Threads come and go meanwhile."""
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
        """Whom one waits for, in words."""
        held = self._claims.held
        if held is not None:
            return held.who
        in_the_way = patience.in_the_way()
        return "" if in_the_way is None else in_the_way.holder


@final
class _Taken:
    """What came of it: the claim, and the one it took the place of."""

    __slots__ = ("before", "claim")

    def __init__(self) -> None:
        self.claim: Claim | None = None
        self.before: Claim | None = None
