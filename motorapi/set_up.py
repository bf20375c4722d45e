"""Set-up of a drive for readers, which own it for that time."""

from typing import TYPE_CHECKING, Final, final

from motorapi.claim import Asked, Claim, Losable
from motorapi.hold import Hold
from motorapi.owner_row import Teller
from motorapi.ownership_events import LockAction
from motorapi.process_lock import ProcessLock

if TYPE_CHECKING:
    from motorapi.runtime import Runtime


@final
class SetUp:
    """The common owner of drives that are set up for readers, without a logical motor.

    Attributes: name, runtime, as of any owner.
    """

    def __init__(self, of: Losable, teller: Teller, runtime: "Runtime", label: str) -> None:
        self.name: Final = label
        self.runtime: Final = runtime
        self._of: Final = of
        self._teller: Final = teller
        self._asked: Final = Asked(self, f"set-up of {label}", "", None)
        self._claim: Claim | None = None

    def take(self, lock: ProcessLock, mark: object) -> Hold | None:
        """Acquire the lock, with `mark` as the owner. Return its handle; None: already acquired.

        Raises:
            MotorBusyError: another process owns the motor.
        """
        if self._claim is not None:
            return None
        who = self._asked.who
        hold = lock.acquire(self.runtime, who, owner=mark, asker=self.name)
        self._claim = Claim(self._asked, hold, hold.token, self._of)
        self._teller.tell(
            action_of(hold), self._claim, hold.taken_from, since_ns=self._asked.asked_ns
        )
        return hold

    def give(self) -> None:
        """Release the lock, if it was acquired."""
        claim, self._claim = self._claim, None
        if claim is not None and claim.hold is not None:
            claim.hold.release()
            self._teller.tell(LockAction.RELEASED, claim, since_ns=claim.since_ns)


def action_of(hold: Hold) -> LockAction:
    """Return the kind of acquisition of a lock."""
    if hold.was_abandoned:
        return LockAction.BROKEN
    return LockAction.TAKEN_OVER if hold.was_taken_over else LockAction.TAKEN
