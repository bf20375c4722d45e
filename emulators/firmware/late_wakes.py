"""A controller whose timers fire late by a little, each time by another: jitter of its wake-ups.

What it waits for by the time d of its own clock happens at d plus a lateness of 0 to `jitter_ns`.
The lateness is a pure function of the run's seed, the controller's name and d, so nobody who looks
changes it. Whether it adds up is the controller's affair: a heartbeat that counts from the last one
does. What comes from outside is heard at its time, after what is overdue then has been done.
"""

from collections.abc import Mapping, Sequence
from typing import Final, final

from emulators.controller import Controller

_BITS_64: Final = (1 << 64) - 1


def lateness_ns(seed: int, due_ns: int, jitter_ns: int) -> int:
    """0..jitter_ns, evenly spread; the finalizer of SplitMix64 (Steele, Lea, Flood, 2014)."""
    z = (seed + due_ns * 0x9E3779B97F4A7C15) & _BITS_64
    z = ((z ^ (z >> 30)) * 0xBF58476D1CE4E5B9) & _BITS_64
    z = ((z ^ (z >> 27)) * 0x94D049BB133111EB) & _BITS_64
    return (z ^ (z >> 31)) % (jitter_ns + 1)


@final
class LateWakes:
    """Implements `emulators.controller.Controller` around one.

    Attributes:
        inner: the controller; what it is told of the time is true of its own clock.
    """

    def __init__(self, inner: Controller, jitter_ns: int, seed: int) -> None:
        self.inner: Controller = inner
        self._jitter_ns: Final[int] = jitter_ns
        self._seed: Final[int] = seed
        self._told_ns: int = 0  # the latest time that the controller has heard

    def start(self, now_ns: int) -> None:
        """Power comes on."""
        self._told_ns = now_ns
        self.inner.start(now_ns)

    def receive(self, data: bytes, now_ns: int) -> None:
        """A frame was on the medium."""
        self._catch_up(now_ns)
        self.inner.receive(data, now_ns)

    def sent(self, data: bytes, now_ns: int) -> bool | None:
        """An own frame left the medium."""
        is_late = self._catch_up(now_ns)
        comes = self.inner.sent(data, now_ns)
        return True if is_late else comes

    def wants_sent(self) -> bool:
        """As the controller does."""
        return self.inner.wants_sent()

    def next_deadline_ns(self) -> int | None:
        """What the controller waits for, and so much later."""
        due_ns = self.inner.next_deadline_ns()
        if due_ns is None:
            return None
        return due_ns + lateness_ns(self._seed, due_ns, self._jitter_ns)

    def expire(self, now_ns: int) -> None:
        """Do what was due a little ago."""
        self._told_ns = now_ns
        self.inner.expire(now_ns)

    def take_output(self) -> Sequence[bytes]:
        """The controller's frames."""
        return self.inner.take_output()

    def take_events(self) -> Sequence[tuple[str, str]]:
        """The controller's events."""
        return self.inner.take_events()

    def stimulate(self, name: str, value: float, now_ns: int) -> None:
        """A physical input of the controller has this value; ValueError as from it."""
        self._catch_up(now_ns)
        self.inner.stimulate(name, value, now_ns)

    def snapshot(self, now_ns: int) -> Mapping[str, float]:
        """The truth inside; while a wake-up is overdue, as of when it was due.

        For whoever looks must not let the motor pass what the controller has yet to see.
        """
        due_ns = self.inner.next_deadline_ns()
        if due_ns is not None and due_ns < now_ns:
            now_ns = due_ns if due_ns > self._told_ns else self._told_ns
        return self.inner.snapshot(now_ns)

    def identifiers(self) -> Sequence[int] | None:
        """As the controller's."""
        return self.inner.identifiers()

    def identifiers_revision(self) -> int:
        """As the controller's."""
        return self.inner.identifiers_revision()

    def _catch_up(self, now_ns: int) -> bool:
        """Do what is overdue, if anything is."""
        self._told_ns = now_ns
        due_ns = self.inner.next_deadline_ns()
        if due_ns is None or due_ns >= now_ns:
            return False
        self.inner.expire(now_ns)
        return True
