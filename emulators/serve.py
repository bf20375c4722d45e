"""Wall time: the same world, its events run when the wall clock says so.

The only place of this package that reads a clock. The loop waits for the next event or for input,
whichever comes first; what came late is done in the order in which it was due.
"""

import select
import time
from collections.abc import Callable, Sequence
from operator import is_
from typing import final

from emulators.event_queue import EventQueue
from emulators.gateway import Gateway, Source

_IDLE_S = 0.5
_BACKLOGGED_S = 0.002


@final
class WallLoop:
    """Runs a world's events in wall time and lets gateways talk to it.

    Attributes:
        late_ns_max: the most an event has been late so far [ns].
    """

    def __init__(self, queue: EventQueue) -> None:
        self._queue = queue
        self._gateways: list[Gateway] = []
        # By descriptor, for select(): it waits for 0.1 ms where epoll has millisecond steps.
        self._watched: dict[int, tuple[Gateway, Source]] = {}
        self._woken_by: list[int] = []
        self._descriptors: list[int] = []  # both together
        self._last: list[Sequence[Source]] = []  # what each gateway had to watch
        self._start_ns = time.monotonic_ns() - queue.now_ns
        self.late_ns_max = 0

    def add(self, gateway: Gateway) -> None:
        """The gateway takes part from now on."""
        self._gateways.append(gateway)

    def wake_on(self, descriptor: int) -> None:
        """The loop also wakes when this descriptor (a process's pidfd, say) becomes readable."""
        self._woken_by.append(descriptor)
        self._descriptors.append(descriptor)

    def forget(self, descriptor: int) -> None:
        """The loop no longer wakes on this descriptor."""
        self._woken_by.remove(descriptor)
        self._descriptors.remove(descriptor)

    def start(self) -> None:
        """Wall time counts from now."""
        self._start_ns = time.monotonic_ns() - self._queue.now_ns

    def run(self, done: Callable[[], bool]) -> None:
        """Serve until `done()`; it is asked at least twice a second."""
        while not done():
            self.step(_IDLE_S)

    def step(self, longest_s: float) -> None:
        """Everything due now has happened, then one wait of at most `longest_s` [s] for more."""
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
        self._watch()
        for one in self._gateways:
            if one.backlogged():
                wait_s = min(wait_s, _BACKLOGGED_S)
        for descriptor in select.select(self._descriptors, (), (), wait_s)[0]:
            heard = self._watched.get(descriptor)
            if heard is not None:
                queue.run_until(time.monotonic_ns() - self._start_ns)
                heard[0].readable(heard[1])

    def _watch(self) -> None:
        now = [gateway.sources() for gateway in self._gateways]
        if len(now) == len(self._last) and all(map(is_, now, self._last)):
            return
        self._last = now
        self._watched = {
            source.fileno(): (gateway, source)
            for gateway, sources in zip(self._gateways, now, strict=True)
            for source in sources
        }
        self._descriptors = [*self._woken_by, *self._watched]

    def close(self) -> None:
        """All gateways are closed."""
        for gateway in self._gateways:
            gateway.close()
