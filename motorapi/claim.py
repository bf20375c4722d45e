"""Claims: ownership of a physical motor by one logical motor of this process."""

from collections.abc import Callable
from typing import TYPE_CHECKING, Final, Protocol, final

from motorapi.errors import MotorBusyError
from motorapi.hold import Hold, Loss

if TYPE_CHECKING:
    from motorapi.patience import Patience
    from motorapi.runtime import Runtime


class Owner(Protocol):
    """A logical motor in the role of an owner."""

    @property
    def name(self) -> str:
        """The name of the motor in messages."""

    @property
    def runtime(self) -> "Runtime":
        """The runtime in which the motor waits."""


class Losable(Protocol):
    """The ownership of a motor, notified when a claim is lost."""

    def note_loss(self, claim: "Claim") -> None:
        """Handle the loss of `claim`, at the time when it is noticed."""


@final
class Asked:
    """An ownership request; see `Ownership.owned`."""

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
    """One ownership of a motor by a logical motor, until it is released or lost.

    Attributes: owner, who and purpose (in words), since_ns, hold (handle of the lock between
    processes, or None), of (the ownership), token (greater than any earlier one), reasons (how
    often it was acquired).
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
        self._lease_ns = 0  # used only without a lock between processes that knows the lease
        self._end_ns = 0

    # ---- ownership ----

    @property
    def is_held(self) -> bool:
        """True while it is neither lost nor released."""
        return self.reasons > 0 and self.loss is None

    @property
    def loss(self) -> Loss | None:
        """The reason of the loss, or None."""
        if self._loss is None and self.hold is not None and self.reasons > 0:
            loss = self.hold.loss
            if loss is not None:
                self.lose(loss)
        return self._loss

    @property
    def lost_to(self) -> str | None:
        """The new owner and its reason in words, or None."""
        loss = self.loss
        return None if loss is None else str(loss)

    def notice(self) -> None:
        """Report a loss of the claim, unless it was reported before."""
        self.loss  # noqa: B018 -- looking is what finds it

    def lose(self, loss: Loss) -> None:
        """Mark the claim as lost, and report this once."""
        if self._loss is None:
            self._loss = loss
            self.of.note_loss(self)

    def require(self) -> None:
        """Raise MotorBusyError if the claim was lost."""
        loss = self.loss
        if loss is not None:
            raise loss.busy(self.owner.name)

    def busy(self, motor: str) -> MotorBusyError:
        """Return the error for other requests while this claim is held."""
        return MotorBusyError(
            motor=motor, holder=self.who, since_ns=self.since_ns, purpose=self.purpose
        )

    # ---- leases ----

    @property
    def lease_s(self) -> float | None:
        """The lease [s], or None."""
        if self.hold is not None:
            return self.hold.lease_s
        return self._lease_ns / 1e9 if self._lease_ns else None

    @property
    def left_s(self) -> float | None:
        """The remaining time of the lease [s]; 0 if it has expired, None without a lease."""
        if self.hold is not None:
            return self.hold.left_s
        if not self._lease_ns:
            return None
        return max(0, self._end_ns - self.owner.runtime.now_ns()) / 1e9

    def set_lease(self, lease_s: float | None) -> None:
        """Set another lease, which begins now. Raises as `require`."""
        self.require()
        self._lease_ns = 0 if lease_s is None else round(lease_s * 1e9)
        if self.hold is not None:
            self._by_hold(lambda hold: hold.set_lease(lease_s))
        self.renew()

    def renew(self) -> None:
        """Restart the lease. Raises as `require`."""
        self.require()
        if self.hold is not None:
            self._by_hold(Hold.renew)
        else:
            self._end_ns = self.owner.runtime.now_ns() + self._lease_ns

    def use(self) -> None:
        """Restart the lease if it is due. Raises as `require`."""
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
