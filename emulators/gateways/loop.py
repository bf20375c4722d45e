"""Loop that runs a world and its gateways by the wall clock.

This is the only module of the package that reads a clock. The loop waits for the next event or for
input, whichever comes first. Late events run in the order of their due times.
"""

import select
import time
from collections.abc import Callable, Sequence
from typing import Protocol, final

from motorhil.emulators.simulation.event_queue import EventQueue

_IDLE_S = 0.5
_BACKLOGGED_S = 0.002


class Source(Protocol):
    """A source of input: a socket, or another object with a descriptor (a pseudo-terminal)."""

    def fileno(self) -> int:
        """Return the descriptor to wait for."""


class Gateway(Protocol):
    """An outside party that talks to the world; called by the loop, in its thread."""

    def sources(self) -> Sequence[Source]:
        """Return the sources to watch now; the same object as before only if unchanged."""

    def readable(self, source: Source) -> None:
        """Process input from this source."""

    def backlogged(self) -> bool:
        """Return whether output waits for a reader."""

    def close(self) -> None:
        """Close all resources."""


@final
class WallLoop:
    """A loop that runs a world's events in wall time and serves gateways.

    Attributes:
        late_ns_max: the greatest delay of an event so far [ns].
    """

    def __init__(self, queue: EventQueue) -> None:
        self._queue = queue
        self._gateways: list[Gateway] = []
        # By descriptor, for select(): it waits for 0.1 ms where epoll has millisecond steps.
        self._watched: dict[int, tuple[Gateway, Source]] = {}
        self._woken_by: list[int] = []
        self._descriptors: list[int] = []  # both together
        self._last: list[Sequence[Source]] = []  # sources of each gateway in the last step
        self._start_ns = time.monotonic_ns() - queue.now_ns
        self.late_ns_max: int = 0

    def add(self, gateway: Gateway) -> None:
        """Add a gateway."""
        self._gateways.append(gateway)
        self._last.append(())

    def wake_on(self, descriptor: int) -> None:
        """Wake also when this descriptor (a process's pidfd, for example) becomes readable."""
        self._woken_by.append(descriptor)
        self._descriptors.append(descriptor)

    def forget(self, descriptor: int) -> None:
        """Stop waking on this descriptor."""
        self._woken_by.remove(descriptor)
        self._descriptors.remove(descriptor)

    def start(self) -> None:
        """Start the wall time now."""
        self._start_ns = time.monotonic_ns() - self._queue.now_ns

    def run(self, done: Callable[[], bool]) -> None:
        """Serve until `done()` returns True; it is called at least twice a second."""
        while not done():
            self.step(_IDLE_S)

    def step(self, longest_s: float) -> None:
        """Process everything due, then wait once for more, at most `longest_s` [s]."""
        queue = self._queue
        now_ns = time.monotonic_ns() - self._start_ns
        due_ns = queue.next_time_ns()
        if due_ns is not None and now_ns - due_ns > self.late_ns_max:
            self.late_ns_max = now_ns - due_ns
        queue.run_until(now_ns)
        due_ns = queue.next_time_ns()
        wait_s = longest_s
        if due_ns is not None:
            elapsed_ns = time.monotonic_ns() - self._start_ns
            wait_s = min(longest_s, max(0, due_ns - elapsed_ns) / 1e9)
        if self._look_at_gateways():
            wait_s = min(wait_s, _BACKLOGGED_S)
        for descriptor in select.select(self._descriptors, (), (), wait_s)[0]:
            heard = self._watched.get(descriptor)
            if heard is not None:
                queue.run_until(time.monotonic_ns() - self._start_ns)
                heard[0].readable(heard[1])

    def _look_at_gateways(self) -> bool:
        """Watch the present sources. Return whether output of a gateway waits for a reader."""
        is_backlogged, is_new = False, False
        for place, gateway in enumerate(self._gateways):
            sources = gateway.sources()
            if sources is not self._last[place]:
                self._last[place], is_new = sources, True
            is_backlogged = gateway.backlogged() or is_backlogged
        if is_new:
            self._watched = {
                source.fileno(): (gateway, source)
                for gateway, sources in zip(self._gateways, self._last, strict=True)
                for source in sources
            }
            self._descriptors = [*self._woken_by, *self._watched]
        return is_backlogged

    def close(self) -> None:
        """Close all gateways."""
        for gateway in self._gateways:
            gateway.close()
