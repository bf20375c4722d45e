"""Whose a physical motor is in this process: one logical motor's, for some reasons at once."""

from collections.abc import Callable
from typing import TYPE_CHECKING, Final, Protocol, final

from motorapi.errors import MotorBusyError
from motorapi.hold import Hold, Loss

if TYPE_CHECKING:
    from motorapi.patience import Patience
    from motorapi.runtime import Runtime


class Owner(Protocol):
    """A logical motor, as an owner."""

    @property
    def name(self) -> str:
        """What messages call it."""

    @property
    def runtime(self) -> "Runtime":
        """Where it waits."""


class Losable(Protocol):
    """The ownership of a motor, which hears when a claim is lost."""

    def note_loss(self, claim: "Claim") -> None:
        """It was lost just now, or that was noticed."""


@final
class Asked:
    """What somebody asks for; see `Ownership.owned`."""

    __slots__ = ("asked_ns", "lease_s", "owner", "patience", "purpose", "take_over", "who")

    def __init__(
        self,
        owner: Owner,
        who: str,
        purpose: str,
        patience: "Patience | None",
        lease_s: float | None = None,
        take_over: bool = False,
    ) -> None:
        self.owner: Final = owner
        self.who: Final = who
        self.purpose: Final = purpose
        self.patience: Final = patience
        self.lease_s: Final = lease_s
        self.take_over: Final = take_over
        self.asked_ns: Final = owner.runtime.now_ns()


@final
class Claim:
    """One ownership of a logical motor. It is given back, or lost.

    Attributes: owner, who and purpose (in words), since_ns, hold (of the lock between processes;
    None: there is none), of (the ownership), token (greater than that of anybody before), reasons
    (how often it was taken).
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
        asked: Asked,
        hold: Hold | None,
        token: int,
        of: Losable,
    ) -> None:
        self.owner: Final = asked.owner
        self.who: Final = asked.who
        self.purpose: Final = asked.purpose
        self.since_ns: Final = asked.owner.runtime.now_ns()
        self.hold: Final = hold
        self.token: Final = token
        self.reasons = 1
        self.of: Final = of
        self._loss: Loss | None = None
        self._lease_ns = 0  # where there is no lock between processes that knows of it
        self._end_ns = 0

    # ---- whose is it ----

    @property
    def is_held(self) -> bool:
        """Whether it was neither lost nor given back."""
        return self.reasons > 0 and self.loss is None

    @property
    def loss(self) -> Loss | None:
        """How it was lost; None: it was not."""
        if self._loss is None and self.hold is not None and self.reasons > 0:
            loss = self.hold.loss
            if loss is not None:
                self.lose(loss)
        return self._loss

    @property
    def lost_to(self) -> str | None:
        """Who took it over, and why, in words; None: nobody did."""
        loss = self.loss
        return None if loss is None else str(loss)

    def notice(self) -> None:
        """If it was lost, that is told now, unless it was before."""
        self.loss  # noqa: B018 -- looking is what finds it

    def lose(self, loss: Loss) -> None:
        """It is somebody else's from now on; that is told once."""
        if self._loss is None:
            self._loss = loss
            self.of.note_loss(self)

    def require(self) -> None:
        """Raises MotorBusyError if it was lost."""
        loss = self.loss
        if loss is not None:
            raise loss.busy(self.owner.name)

    def busy(self, motor: str) -> MotorBusyError:
        """What others are told."""
        return MotorBusyError(
            motor=motor, holder=self.who, since_ns=self.since_ns, purpose=self.purpose
        )

    # ---- leases ----

    @property
    def lease_s(self) -> float | None:
        """The lease [s]; None: there is none."""
        if self.hold is not None:
            return self.hold.lease_s
        return self._lease_ns / 1e9 if self._lease_ns else None

    @property
    def left_s(self) -> float | None:
        """How long the lease lasts [s]; 0: it is over; None: there is none."""
        if self.hold is not None:
            return self.hold.left_s
        if not self._lease_ns:
            return None
        return max(0, self._end_ns - self.owner.runtime.now_ns()) / 1e9

    def set_lease(self, lease_s: float | None) -> None:
        """It has another lease, which begins now. Raises as `require`."""
        self.require()
        self._lease_ns = 0 if lease_s is None else round(lease_s * 1e9)
        if self.hold is not None:
            self._by_hold(lambda hold: hold.set_lease(lease_s))
        self.renew()

    def renew(self) -> None:
        """The lease begins anew. Raises as `require`."""
        self.require()
        if self.hold is not None:
            self._by_hold(Hold.renew)
        else:
            self._end_ns = self.owner.runtime.now_ns() + self._lease_ns

    def use(self) -> None:
        """As `renew`, as often as is good for the lease."""
        self.require()
        if self.hold is not None:
            self._by_hold(Hold.use)
        else:
            self._end_ns = self.owner.runtime.now_ns() + self._lease_ns

    def _by_hold(self, action: Callable[[Hold], None]) -> None:
        assert self.hold is not None
        try:
            action(self.hold)
        except MotorBusyError:
            self.require()
            raise
