"""Reservation handles of `with motor.reserve() as reservation:`."""

from collections.abc import Sequence
from typing import Final, final

from motorhil.motorapi.commands import as_number
from motorhil.motorapi.errors import UsageError
from motorhil.motorapi.ownership.claim import Claim

LEASE_MIN_S: Final = 0.01
LEASE_MAX_S: Final = 1e6


def check_take_over(take_over: bool) -> None:
    """Raise UsageError if it is neither True nor False: no takeover happens by mistake."""
    if not isinstance(take_over, bool):
        raise UsageError(f"take_over = {take_over!r}: give True or False")


def check_lease(lease_s: float | None) -> None:
    """Raise UsageError if `lease_s` is not a valid lease."""
    if lease_s is None:
        return
    if isinstance(lease_s, bool) or not LEASE_MIN_S <= as_number(lease_s) <= LEASE_MAX_S:
        raise UsageError(
            f"lease_s = {lease_s!r}: must be {LEASE_MIN_S:g} to {LEASE_MAX_S:g} seconds, or None"
        )


@final
class Reservation:
    """A reserved motor, or all motors of a group, until the end of the block.

    Attributes: names (of the motors, in the order of acquisition), claims (one per motor).
    """

    __slots__ = ("claims", "names")

    def __init__(self, names: Sequence[str], claims: Sequence[Claim]) -> None:
        self.names: Final = tuple(names)
        self.claims: Final = tuple(claims)

    def __repr__(self) -> str:
        lost_to = self.lost_to
        how = "held" if self.is_held else "given back" if lost_to is None else f"lost to {lost_to}"
        return f"<Reservation of {', '.join(self.names)}: {how}>"

    @property
    def token(self) -> int:
        """The token of this ownership, greater than any earlier one (group: of the first)."""
        return self.claims[0].token

    @property
    def tokens(self) -> tuple[int, ...]:
        """The token of each motor, in the order of `names`."""
        return tuple(claim.token for claim in self.claims)

    @classmethod
    def of_all(cls, parts: "Sequence[Reservation]") -> "Reservation":
        """Combine several reservations into one."""
        names = [name for part in parts for name in part.names]
        claims = [claim for part in parts for claim in part.claims]
        return cls(names, claims)

    @property
    def is_held(self) -> bool:
        """True while it is neither lost nor released."""
        return all(claim.is_held for claim in self.claims)

    @property
    def members(self) -> "tuple[Reservation, ...]":
        """The reservation of each motor, in the order of `names`."""
        return tuple(
            Reservation((name,), (claim,))
            for name, claim in zip(self.names, self.claims, strict=True)
        )

    @property
    def lost_to(self) -> str | None:
        """The new owner and its reason in words, or None."""
        for claim in self.claims:
            if claim.lost_to is not None:
                return claim.lost_to
        return None

    def renew(self) -> None:
        """Restart the lease, as every operation and every wait of the owner does.

        Raises:
            MotorBusyError: it was taken over meanwhile.
        """
        for claim in self.claims:
            claim.renew()
