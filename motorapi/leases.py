"""The leases of each thread: they are renewed while it waits for anything of a motor.

Whoever waits for one motor is alive, and so are his reservations of others. A thread that is
stopped, in a debugger or by a long computation, renews nothing.
"""

import threading
from contextlib import suppress
from typing import TYPE_CHECKING, Final, final

from motorapi.errors import MotorBusyError

if TYPE_CHECKING:
    from motorapi.claim import Claim

RENEWALS_IN_WAIT: Final = 4
"""So many times in a lease it is renewed by one who waits."""


@final
class _Mine(threading.local):
    """What this thread has reserved with a lease."""

    def __init__(self) -> None:
        self.claims: list[Claim] = []


_mine: Final = _Mine()


def register(claim: "Claim") -> None:
    """It is renewed from now on while this thread waits."""
    if claim not in _mine.claims:
        _mine.claims.append(claim)


def use_leases(waits_for: object = None) -> float | None:
    """All that this thread has reserved with a lease are renewed; when to do it again [s].

    But for the ownership it waits for itself: who has that does nothing meanwhile. None: there are
    none. Nothing is raised: who has lost one finds out by its next use.
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
