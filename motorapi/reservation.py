"""What `with motor.reserve() as reservation:` gives: is it still ours; and, we are alive."""

from collections.abc import Sequence
from typing import Final, final

from motorapi.claim import Claim
from motorapi.commands import as_number
from motorapi.errors import UsageError

LEASE_MIN_S: Final = 0.01
LEASE_MAX_S: Final = 1e6


def check_take_over(take_over: bool) -> None:
    """Raises UsageError if it is neither True nor False: no motor is taken over by mistake."""
    if not isinstance(take_over, bool):
        raise UsageError(f"take_over = {take_over!r}: give True or False")


def check_lease(lease_s: float | None) -> None:
    """Raises UsageError if it is no time that a lease could have."""
    if lease_s is None:
        return
    if isinstance(lease_s, bool) or not LEASE_MIN_S <= as_number(lease_s) <= LEASE_MAX_S:
        raise UsageError(
            f"lease_s = {lease_s!r}: must be {LEASE_MIN_S:g} to {LEASE_MAX_S:g} seconds, or None"
        )


@final
class Reservation:
    """A motor that was reserved, or all motors of a group, until the block ends.

    Attributes: names (of the motors, in the order in which they were taken).
    """

    __slots__ = ("_claims", "names")

    def __init__(self, names: Sequence[str], claims: Sequence[Claim]) -> None:
        self.names: Final = tuple(names)
        self._claims: Final = tuple(claims)

    def __repr__(self) -> str:
        lost_to = self.lost_to
        how = "held" if self.is_held else "given back" if lost_to is None else f"lost to {lost_to}"
        return f"<Reservation of {', '.join(self.names)}: {how}>"

    @property
    def token(self) -> int:
        """The number of this ownership, greater than anybody's before; of a group: the first's."""
        return self._claims[0].token

    @property
    def tokens(self) -> tuple[int, ...]:
        """Of each motor, as `names`."""
        return tuple(claim.token for claim in self._claims)

    @classmethod
    def of_all(cls, parts: "Sequence[Reservation]") -> "Reservation":
        """Several as one."""
        names = [name for part in parts for name in part.names]
        claims = [claim for part in parts for claim in part._claims]  # noqa: SLF001 -- of its kind
        return cls(names, claims)

    @property
    def is_held(self) -> bool:
        """Whether it was neither lost nor given back."""
        return all(claim.is_held for claim in self._claims)

    @property
    def members(self) -> "tuple[Reservation, ...]":
        """Of each motor its own, as `names`."""
        return tuple(
            Reservation((name,), (claim,))
            for name, claim in zip(self.names, self._claims, strict=True)
        )

    @property
    def lost_to(self) -> str | None:
        """Who took it over, and why, in words; None: nobody did."""
        for claim in self._claims:
            if claim.lost_to is not None:
                return claim.lost_to
        return None

    def renew(self) -> None:
        """The lease begins anew. Every operation of the owner, and every wait of his, does it.

        Raises:
            MotorBusyError: it was taken over meanwhile.
        """
        for claim in self._claims:
            claim.renew()
