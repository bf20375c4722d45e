"""Conversion between true time and a controller's own clock.

The bus uses true time, the controller its own time. The controller does not know about the
conversion. Its constructor needs the rate of its clock (`Oscillator.rate`), because its plant moves
in true time. A controller whose clock shows true time needs no wrapper.

With jitter, a timer due at time d of the controller's own clock fires at d plus a lateness of 0 to
`jitter_ns`. The lateness is a pure function of the run's seed, the controller's name and d, so no
reader can change it. The controller decides if lateness accumulates: a heartbeat that counts from
the previous one does. Frames and stimuli arrive on time. Everything overdue is done before they are
handled.
"""

from collections.abc import Mapping, Sequence
from typing import Final, final

from motorhil.emulators.controller import Controller
from motorhil.emulators.plant.oscillator import ONE, Oscillator

_BITS_64: Final = (1 << 64) - 1

_UNKNOWN: Final = -1


def lateness_ns(seed: int, due_ns: int, jitter_ns: int) -> int:
    """Return an evenly spread value 0..jitter_ns.

    Source: the finalizer of SplitMix64 (Steele, Lea, Flood, 2014).
    """
    z = (seed + due_ns * 0x9E3779B97F4A7C15) & _BITS_64
    z = ((z ^ (z >> 30)) * 0xBF58476D1CE4E5B9) & _BITS_64
    z = ((z ^ (z >> 27)) * 0x94D049BB133111EB) & _BITS_64
    return (z ^ (z >> 31)) % (jitter_ns + 1)


@final
class LateWakes:
    """Wraps a `Controller` and delays its timers; implements `Controller` itself.

    Attributes:
        inner: the wrapped controller; all times passed to it are on its own clock.
    """

    def __init__(self, inner: Controller, jitter_ns: int, seed: int) -> None:
        self.inner: Controller = inner
        self._jitter_ns: Final[int] = jitter_ns
        self._seed: Final[int] = seed
        self._told_ns: int = 0  # the latest time passed to the controller

    def start(self, now_ns: int) -> None:
        """Power the controller on."""
        self._told_ns = now_ns
        self.inner.start(now_ns)

    def receive(self, data: bytes, now_ns: int) -> None:
        """Handle overdue timers, then pass a received frame on."""
        self._catch_up(now_ns)
        self.inner.receive(data, now_ns)

    def sent(self, data: bytes, now_ns: int) -> bool | None:
        """Handle overdue timers, then report that an own frame has been sent."""
        is_late = self._catch_up(now_ns)
        comes = self.inner.sent(data, now_ns)
        return True if is_late else comes

    def wants_sent(self) -> bool:
        """Return the controller's answer."""
        return self.inner.wants_sent()

    def next_deadline_ns(self) -> int | None:
        """Return the controller's deadline plus its lateness."""
        due_ns = self.inner.next_deadline_ns()
        if due_ns is None:
            return None
        return due_ns + lateness_ns(self._seed, due_ns, self._jitter_ns)

    def expire(self, now_ns: int) -> None:
        """Let the controller handle its overdue deadlines."""
        self._told_ns = now_ns
        self.inner.expire(now_ns)

    def take_output(self) -> Sequence[bytes]:
        """Return the controller's frames."""
        return self.inner.take_output()

    def take_events(self) -> Sequence[tuple[str, str]]:
        """Return the controller's events."""
        return self.inner.take_events()

    def stimulate(self, name: str, value: float, now_ns: int) -> None:
        """Set a physical input of the controller; ValueError as from the controller."""
        self._catch_up(now_ns)
        self.inner.stimulate(name, value, now_ns)

    def snapshot(self, now_ns: int) -> Mapping[str, float]:
        """Return the true internal state; while a timer is overdue, the state at its deadline.

        A snapshot must not advance the motor past an event that the controller has not handled yet.
        """
        due_ns = self.inner.next_deadline_ns()
        if due_ns is not None and due_ns < now_ns:
            now_ns = due_ns if due_ns > self._told_ns else self._told_ns
        return self.inner.snapshot(now_ns)

    def identifiers(self) -> Sequence[int] | None:
        """Return the controller's identifiers."""
        return self.inner.identifiers()

    def identifiers_revision(self) -> int:
        """Return the controller's revision of its identifiers."""
        return self.inner.identifiers_revision()

    def _catch_up(self, now_ns: int) -> bool:
        """Handle overdue timers; return True if there were any."""
        self._told_ns = now_ns
        due_ns = self.inner.next_deadline_ns()
        if due_ns is None or due_ns >= now_ns:
            return False
        self.inner.expire(now_ns)
        return True


@final
class OwnTime:
    """Wraps a `Controller` and converts all times; implements `Controller` itself.

    Attributes:
        inner: the wrapped controller; all its times are those of `oscillator`.
    """

    def __init__(self, inner: Controller, oscillator: Oscillator) -> None:
        self.inner: Controller = inner
        self.oscillator: Final[Oscillator] = oscillator
        self._error: Final[int] = oscillator.error_1e12
        self._phase_ns: Final[int] = oscillator.phase_ns
        self._asked_ns: int = _UNKNOWN  # the deadline converted last, and its result below
        self._answered_ns: int = _UNKNOWN

    def start(self, now_ns: int) -> None:
        """Power the controller on."""
        self.inner.start(self._own_ns(now_ns))

    def receive(self, data: bytes, now_ns: int) -> None:
        """Pass a received frame on."""
        self.inner.receive(data, self._own_ns(now_ns))

    def sent(self, data: bytes, now_ns: int) -> bool | None:
        """Report that an own frame has been sent."""
        return self.inner.sent(data, self._own_ns(now_ns))

    def wants_sent(self) -> bool:
        """Return the controller's answer."""
        return self.inner.wants_sent()

    def next_deadline_ns(self) -> int | None:
        """Return the first true time at which the own clock has reached the deadline."""
        own_ns = self.inner.next_deadline_ns()
        if own_ns is None:
            return None
        if own_ns != self._asked_ns:
            self._asked_ns = own_ns
            self._answered_ns = self.oscillator.true_ns(own_ns)
        return self._answered_ns

    def expire(self, now_ns: int) -> None:
        """Let the controller handle its due deadlines."""
        self.inner.expire(self._own_ns(now_ns))

    def take_output(self) -> Sequence[bytes]:
        """Return the controller's frames."""
        return self.inner.take_output()

    def take_events(self) -> Sequence[tuple[str, str]]:
        """Return the controller's events."""
        return self.inner.take_events()

    def stimulate(self, name: str, value: float, now_ns: int) -> None:
        """Set a physical input of the controller; ValueError as from the controller."""
        self.inner.stimulate(name, value, self._own_ns(now_ns))

    def snapshot(self, now_ns: int) -> Mapping[str, float]:
        """Return the true internal state, as of the last own tick at or before `now_ns`."""
        return self.inner.snapshot(self._own_ns(now_ns))

    def identifiers(self) -> Sequence[int] | None:
        """Return the controller's identifiers."""
        return self.inner.identifiers()

    def identifiers_revision(self) -> int:
        """Return the controller's revision of its identifiers."""
        return self.inner.identifiers_revision()

    def _own_ns(self, now_ns: int) -> int:
        """Return `Oscillator.own_ns`, inlined because it is called once per frame."""
        return self._phase_ns + now_ns + now_ns * self._error // ONE


def on_own_time(controller: Controller, oscillator: Oscillator) -> Controller:
    """Wrap the controller as its clock requires; return it unchanged for an ideal clock."""
    if oscillator.jitter_ns:
        controller = LateWakes(controller, oscillator.jitter_ns, oscillator.jitter_seed)
    return controller if oscillator.shows_true_time() else OwnTime(controller, oscillator)
