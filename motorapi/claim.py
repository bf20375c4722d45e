"""Whose a physical motor is in this process: one logical motor's, for some reasons at once."""

from typing import Final, final

from motorapi.errors import MotorBusyError
from motorapi.process_lock import Hold


@final
class Claim:
    """The one who owns it in this process, and for how many reasons.

    Attributes: owner, who and purpose (in words), since_ns, hold (of the lock between processes;
    None: there is none), token, reasons, lost_to (who took it over, and why; None: nobody did).
    """

    __slots__ = ("_token", "hold", "lost_to", "owner", "purpose", "reasons", "since_ns", "who")

    def __init__(
        self,
        owner: object,
        who: str,
        purpose: str,
        since_ns: int,
        hold: Hold | None,
        token: int,
    ) -> None:
        self.owner: Final = owner
        self.who: Final = who
        self.purpose: Final = purpose
        self.since_ns: Final = since_ns
        self.hold: Final = hold
        self._token = token
        self.reasons = 1
        self.lost_to: str | None = None

    @property
    def token(self) -> int:
        """The number of this ownership, greater than that of anybody before."""
        return self._token if self.hold is None else self.hold.token

    @property
    def is_held(self) -> bool:
        """Whether it was neither lost nor given back."""
        return self.reasons > 0 and self.lost_to is None

    def renew(self) -> None:
        """The lease begins anew. Raises MotorBusyError if it was taken over."""
        if self.hold is not None:
            self.hold.renew()

    def busy(self, motor: str) -> MotorBusyError:
        """What others are told."""
        return MotorBusyError(
            motor=motor, holder=self.who, since_ns=self.since_ns, purpose=self.purpose
        )
