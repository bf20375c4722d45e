"""Leases of each thread, renewed while it waits for any motor.

A thread that waits for one motor is alive, and so are its reservations of others. A thread that is
stopped, in a debugger or by a long computation, renews nothing.
"""

import threading
from contextlib import suppress
from typing import TYPE_CHECKING, Final, final

from motorapi.errors import MotorBusyError

if TYPE_CHECKING:
    from motorapi.claim import Claim

RENEWALS_IN_WAIT: Final = 4
"""The number of renewals per lease period during a wait."""


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
