"""Periodic actions on the wall clock, in one thread while there are any."""

import threading
from collections.abc import Callable
from heapq import heappop, heappush
from typing import Final, final

_LOOK_AGAIN_S: Final = 0.1
"""The delay after which the thread notices that its last timer was cancelled [s]."""


@final
class Timer:
    """An action that repeats until it is cancelled."""

    def __init__(self, period_ns: int, action: Callable[[], None]) -> None:
        self.period_ns = period_ns
        self.action = action
        self.cancelled = False

    def cancel(self) -> None:
        """Cancel the timer; cancelling again does nothing."""
        self.cancelled = True

    def run(self) -> None:
        """Run the action, unless the timer was cancelled at the last moment."""
        if not self.cancelled:
            self.action()


@final
class Timers:
    """All timers of one runtime, in a heap with key (due time, order of creation).

    Args:
        now_ns: the clock.
        run: runs an action as a callback.
    """

    def __init__(
        self, now_ns: Callable[[], int], run: Callable[[Callable[[], None]], None]
    ) -> None:
        self._now_ns = now_ns
        self._run = run
        self._changed = threading.Condition()
        self._heap: list[tuple[int, int, Timer]] = []
        self._asked = 0
        self._thread: threading.Thread | None = None
        self._closed = False

    def add(self, period_ns: int, action: Callable[[], None]) -> Timer:
        """Run `action` every `period_ns` [ns] from now, first after one period."""
        timer = Timer(period_ns, action)
        with self._changed:
            self._push(self._now_ns() + period_ns, timer)
            if self._thread is None:
                self._thread = threading.Thread(
                    target=self._work, name="motorapi timers", daemon=True
                )
                self._thread.start()
            self._changed.notify()
        return timer

    def close(self) -> list[threading.Thread]:
        """Stop all timers. Return the thread that is still to end, if any."""
        with self._changed:
            self._closed = True
            self._changed.notify()
            return [] if self._thread is None else [self._thread]

    def _push(self, due_ns: int, timer: Timer) -> None:
        self._asked += 1
        heappush(self._heap, (due_ns, self._asked, timer))

    def _work(self) -> None:
        timer = self._next()
        while timer is not None:
            self._run(timer.run)
            timer = self._next()

    def _next(self) -> Timer | None:
        """Wait for the next timer that is due and return it; None without timers."""
        with self._changed:
            while True:
                while self._heap and self._heap[0][2].cancelled:
                    heappop(self._heap)
                if self._closed or not self._heap:
                    self._thread = None
                    return None
                due_ns, _, timer = self._heap[0]
                now_ns = self._now_ns()
                if due_ns > now_ns:
                    self._changed.wait(min((due_ns - now_ns) / 1e9, _LOOK_AGAIN_S))
                    continue
                heappop(self._heap)
                missed = (now_ns - due_ns) // timer.period_ns
                self._push(due_ns + (missed + 1) * timer.period_ns, timer)
                return timer
