"""Event queue of a simulated world: the order of all events.

The order of events is (time, order of requests): two events at the same nanosecond run in the order
in which they were requested. This module does not read a clock; the caller that runs the queue
decides the speed.
"""

from collections.abc import Callable
from heapq import heappop, heappush
from typing import Final, final

Action = Callable[[int], None]

UNSET: Final = -1  # in place of a time: none


@final
class Alarm:
    """One re-settable deadline; its action is called with the time once, when it is due.

    `time_ns` is the due time, which all may read; it, `action` and `turn` are written here only.
    """

    def __init__(self, queue: "EventQueue", action: Action) -> None:
        self._queue = queue
        self.action = action
        self.time_ns: int = UNSET
        self.turn: int = UNSET

    def set(self, time_ns: int | None) -> None:
        """Run the action at `time_ns` [ns], or not at all (None); replaces the previous setting.

        Setting the same time again keeps the turn. A time in the past means now.
        """
        self.move(UNSET if time_ns is None else time_ns)

    def move(self, time_ns: int) -> None:
        """Set the time, with UNSET for None."""
        if time_ns == self.time_ns:
            return
        queue = self._queue
        first = queue.first
        if time_ns == UNSET:
            self.time_ns = UNSET
            self.turn = UNSET
            if first is self:
                queue.first = None
            return
        if time_ns < queue.now_ns:
            time_ns = queue.now_ns
            if time_ns == self.time_ns:
                return
        self.time_ns = time_ns
        queue.asked += 1
        self.turn = queue.asked
        heap = queue.heap
        if first is None or first is self:
            if not heap or time_ns < heap[0][0]:
                queue.first = self
                return
            queue.first = None
        elif time_ns < first.time_ns:
            heappush(heap, (first.time_ns, first.turn, first))
            queue.first = self
            return
        heappush(heap, (time_ns, self.turn, self))

    def due_ns(self) -> int | None:
        """Return when the action will run [ns], or None."""
        return None if self.time_ns == UNSET else self.time_ns


@final
class EventQueue:
    """A heap of alarms keyed (time_ns, order of requests); O(log n) per event, n = alarms set.

    The next alarm stays out of the heap once it is known, because a bus sets and runs its own alarm
    many times before any other. Other modules may only read `now_ns`; the rest belongs to this
    module.
    """

    def __init__(self) -> None:
        self.now_ns: int = 0
        self.asked = 0
        self.first: Alarm | None = None  # before all in the heap; None: the first in the heap
        self.heap: list[tuple[int, int, Alarm]] = []  # includes alarms that were reset since

    def alarm(self, action: Action) -> Alarm:
        """Return a new alarm, not set yet."""
        return Alarm(self, action)

    def next_time_ns(self) -> int | None:
        """Return the time of the next event [ns], or None if there is none."""
        next_ns = self.next_ns()
        return None if next_ns == UNSET else next_ns

    def next_ns(self) -> int:
        """Return `next_time_ns`, with UNSET for None."""
        first = self.first
        if first is not None:
            return first.time_ns
        heap = self.heap
        while heap:
            _, turn, alarm = heappop(heap)
            if alarm.turn == turn:
                self.first = alarm
                return alarm.time_ns
        return UNSET

    def run_next(self) -> bool:
        """Advance to the next event and run it; return False if there is none."""
        first = self.first
        if first is None:
            self.next_ns()
            first = self.first
            if first is None:
                return False
        self.first = None
        time_ns = first.time_ns
        self.now_ns = time_ns
        first.time_ns = UNSET
        first.turn = UNSET
        first.action(time_ns)
        return True

    def run_until(self, time_ns: int) -> None:
        """Run all events up to and including `time_ns` and advance to it."""
        next_ns = self.next_ns()
        while next_ns != UNSET and next_ns <= time_ns:
            self.run_next()
            next_ns = self.next_ns()
        if time_ns > self.now_ns:
            self.now_ns = time_ns
