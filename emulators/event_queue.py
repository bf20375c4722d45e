"""The one agenda of a simulated world: what happens next, and whose turn it is.

An event's turn is (time, order of asking): two events at the same nanosecond run in the order in
which they were asked for. Nothing here reads a clock: whoever runs the queue decides how fast.
"""

from collections.abc import Callable
from heapq import heappop, heappush
from typing import Final, final

Action = Callable[[int], None]

UNSET: Final = -1  # in place of a time: none


@final
class Alarm:
    """One re-settable deadline; its action is called with the time once, when it is due.

    `time_ns`, when it will ring, is for all to read; it, `action` and `turn` are this module's.
    """

    def __init__(self, queue: "EventQueue", action: Action) -> None:
        self._queue = queue
        self.action = action
        self.time_ns = UNSET
        self.turn = UNSET

    def set(self, time_ns: int | None) -> None:
        """The action runs at `time_ns` [ns], or not at all (None); replaces what was set before.

        Setting the same time again keeps the turn. A time already past means now.
        """
        self.move(UNSET if time_ns is None else time_ns)

    def move(self, time_ns: int) -> None:
        """As `set`, with UNSET for None."""
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
        """When the action will run [ns]; None if it will not."""
        return None if self.time_ns == UNSET else self.time_ns


@final
class EventQueue:
    """A heap of alarms keyed (time_ns, order of asking). Costs O(log n) per event, n = alarms set.

    The alarm whose turn is next stays out of the heap once it is known: a bus sets and rings its
    own again and again before anybody else's. All but `now_ns` belongs to this module; that is for
    all to read, the queue writes it.
    """

    def __init__(self) -> None:
        self.now_ns = 0
        self.asked = 0
        self.first: Alarm | None = None  # before all in the heap; None: whoever is first in there
        self.heap: list[tuple[int, int, Alarm]] = []  # also what was set again or taken back since

    def alarm(self, action: Action) -> Alarm:
        """A new alarm, not set yet."""
        return Alarm(self, action)

    def next_time_ns(self) -> int | None:
        """The time of the next event [ns]; None if nothing is asked for."""
        next_ns = self.next_ns()
        return None if next_ns == UNSET else next_ns

    def next_ns(self) -> int:
        """As `next_time_ns`, with UNSET for None."""
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
        """Time has moved to the next event and it has run; False if there is none."""
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
        """All events up to and including `time_ns` have run, and it is `time_ns`."""
        next_ns = self.next_ns()
        while next_ns != UNSET and next_ns <= time_ns:
            self.run_next()
            next_ns = self.next_ns()
        if time_ns > self.now_ns:
            self.now_ns = time_ns
