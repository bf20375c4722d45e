"""The one agenda of a simulated world: what happens next, and whose turn it is.

An event's turn is (time, order of asking): two events at the same nanosecond run in the order in
which they were asked for. Nothing here reads a clock: whoever runs the queue decides how fast.
"""

from collections.abc import Callable
from heapq import heappop, heappush
from typing import final

Action = Callable[[int], None]

_UNSET = -1


@final
class Alarm:
    """One re-settable deadline; its action is called with the time once, when it is due."""

    def __init__(self, queue: "EventQueue", action: Action) -> None:
        self._queue = queue
        self._action = action
        self._due_ns = _UNSET
        self._turn = _UNSET

    def set(self, time_ns: int | None) -> None:
        """The action runs at `time_ns` [ns], or not at all (None); replaces what was set before.

        Setting the same time again keeps the turn. A time already past means now.
        """
        queue = self._queue
        if time_ns is None:
            self._due_ns = _UNSET
            self._turn = _UNSET
            return
        if time_ns < queue.now_ns:
            time_ns = queue.now_ns
        if time_ns == self._due_ns:
            return
        self._due_ns = time_ns
        queue.asked += 1
        self._turn = queue.asked
        heappush(queue.heap, (time_ns, self._turn, self))

    def due_ns(self) -> int | None:
        """When the action will run [ns]; None if it will not."""
        return None if self._due_ns == _UNSET else self._due_ns

    def is_turn(self, turn: int) -> bool:
        """Whether a heap entry with this turn is still what was asked for last."""
        return self._turn == turn

    def ring(self, now_ns: int) -> None:
        """Run the action; it may set the alarm again."""
        self._due_ns = _UNSET
        self._turn = _UNSET
        self._action(now_ns)


@final
class EventQueue:
    """A heap of alarms keyed (time_ns, order of asking). Costs O(log n) per event, n = alarms set.

    `heap` and `asked` belong to this module; `now_ns` is for all to read, the queue writes it.
    """

    def __init__(self) -> None:
        self.now_ns = 0
        self.asked = 0
        self.heap: list[tuple[int, int, Alarm]] = []

    def alarm(self, action: Action) -> Alarm:
        """A new alarm, not set yet."""
        return Alarm(self, action)

    def next_time_ns(self) -> int | None:
        """The time of the next event [ns]; None if nothing is asked for."""
        heap = self.heap
        while heap:
            entry = heap[0]
            if entry[2].is_turn(entry[1]):
                return entry[0]
            heappop(heap)  # set again or taken back since
        return None

    def run_next(self) -> bool:
        """Time has moved to the next event and it has run; False if there is none."""
        heap = self.heap
        while heap:
            time_ns, turn, alarm = heappop(heap)
            if alarm.is_turn(turn):
                self.now_ns = time_ns
                alarm.ring(time_ns)
                return True
        return False

    def run_until(self, time_ns: int) -> None:
        """All events up to and including `time_ns` have run, and it is `time_ns`."""
        next_ns = self.next_time_ns()
        while next_ns is not None and next_ns <= time_ns:
            self.run_next()
            next_ns = self.next_time_ns()
        if time_ns > self.now_ns:
            self.now_ns = time_ns
