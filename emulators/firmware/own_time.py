"""A controller that lives by its own clock: the world tells it true time, it hears its own.

The controller inside knows nothing of this; what it must be told at its making is how fast its
clock runs (`Oscillator.rate`), for its plant moves in true time. Where the clock shows the true
time there is nothing to translate, and the controller hangs on the bus itself.
"""

from collections.abc import Mapping, Sequence
from typing import Final, final

from emulators.controller import Controller
from emulators.firmware.late_wakes import LateWakes
from emulators.plant.oscillator import ONE, Oscillator

_UNKNOWN: Final = -1


@final
class OwnTime:
    """Implements `emulators.controller.Controller` around one.

    Attributes:
        inner: the controller; all its times are those of `oscillator`.
    """

    def __init__(self, inner: Controller, oscillator: Oscillator) -> None:
        self.inner: Controller = inner
        self.oscillator: Final[Oscillator] = oscillator
        self._error: Final[int] = oscillator.error_1e12
        self._phase_ns: Final[int] = oscillator.phase_ns
        self._asked_ns: int = _UNKNOWN  # the deadline last translated, and into what
        self._answered_ns: int = _UNKNOWN

    def start(self, now_ns: int) -> None:
        """Power comes on."""
        self.inner.start(self._own_ns(now_ns))

    def receive(self, data: bytes, now_ns: int) -> None:
        """A frame was on the medium."""
        self.inner.receive(data, self._own_ns(now_ns))

    def sent(self, data: bytes, now_ns: int) -> bool | None:
        """An own frame left the medium."""
        return self.inner.sent(data, self._own_ns(now_ns))

    def wants_sent(self) -> bool:
        """As the controller does."""
        return self.inner.wants_sent()

    def next_deadline_ns(self) -> int | None:
        """The first true time at which its clock shows what it waits for."""
        own_ns = self.inner.next_deadline_ns()
        if own_ns is None:
            return None
        if own_ns != self._asked_ns:
            self._asked_ns = own_ns
            self._answered_ns = self.oscillator.true_ns(own_ns)
        return self._answered_ns

    def expire(self, now_ns: int) -> None:
        """Do what is due by its own clock."""
        self.inner.expire(self._own_ns(now_ns))

    def take_output(self) -> Sequence[bytes]:
        """The controller's frames."""
        return self.inner.take_output()

    def take_events(self) -> Sequence[tuple[str, str]]:
        """The controller's events."""
        return self.inner.take_events()

    def stimulate(self, name: str, value: float, now_ns: int) -> None:
        """A physical input of the controller has this value; ValueError as from it."""
        self.inner.stimulate(name, value, self._own_ns(now_ns))

    def snapshot(self, now_ns: int) -> Mapping[str, float]:
        """The truth inside, as of the last of its own ticks that lies behind `now_ns`."""
        return self.inner.snapshot(self._own_ns(now_ns))

    def identifiers(self) -> Sequence[int] | None:
        """As the controller's."""
        return self.inner.identifiers()

    def identifiers_revision(self) -> int:
        """As the controller's."""
        return self.inner.identifiers_revision()

    def _own_ns(self, now_ns: int) -> int:
        """As `Oscillator.own_ns`, once per frame."""
        return self._phase_ns + now_ns + now_ns * self._error // ONE


def on_own_time(controller: Controller, oscillator: Oscillator) -> Controller:
    """The controller with such a clock: as it is, where the clock has nothing wrong with it."""
    if oscillator.jitter_ns:
        controller = LateWakes(controller, oscillator.jitter_ns, oscillator.jitter_seed)
    return controller if oscillator.shows_true_time() else OwnTime(controller, oscillator)
