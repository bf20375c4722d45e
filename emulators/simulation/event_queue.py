"""Event queue of a simulated world: the order of all events.

The order of events is (time, order of requests): two events at the same nanosecond run in the order
in which they were requested. This module does not read a clock; the caller that runs the queue
decides the speed.
"""

from bisect import bisect_left, insort
from collections.abc import Callable
from typing import Final, final

Action = Callable[[int], None]

UNSET: Final = -1  # in place of a time: none


@final
class Alarm:
    """One re-settable deadline; its action is called with the time once, when it is due.

    `time_ns` is the due time, which all may read; it and `action` are written here only.
    """

    def __init__(self, queue: "EventQueue", action: Action) -> None:
        self._queue = queue
        self.action = action
        self.time_ns: int = UNSET

    def set(self, time_ns: int | None) -> None:
        """Run the action at `time_ns` [ns], or not at all (None); replaces the previous setting.

        Setting the same time again keeps the turn. A time in the past means now.
        """
        self.move(UNSET if time_ns is None else time_ns)

    def move(self, time_ns: int) -> None:
        """Set the time, with UNSET for None."""
        before_ns = self.time_ns
        if time_ns == before_ns:
            return
        queue = self._queue
        if before_ns != UNSET:
            if UNSET != time_ns <= queue.now_ns == before_ns:
                return
            queue.drop(self)
        if time_ns == UNSET:
            self.time_ns = UNSET
            return
        if time_ns < queue.now_ns:
            time_ns = queue.now_ns
        self.time_ns = time_ns
        first = queue.first
        if first is None:
            if not queue.times or time_ns < queue.times[0]:
                queue.first = self
                return
        elif time_ns < first.time_ns:
            queue.enter(first, ahead=True)
            queue.first = self
            return
        queue.enter(self)

    def due_ns(self) -> int | None:
        """Return when the action will run [ns], or None."""
        return None if self.time_ns == UNSET else self.time_ns


@final
class EventQueue:
    """Alarms by time, and those of one time in the order of requests.

    Many alarms share a time, and few are set at once: a sorted list of the times costs fewer
    comparisons than a heap of alarms. The next alarm stays out of both once it is known, because a
    bus sets and runs its own alarm many times before any other. Other modules may only read
    `now_ns`; the rest belongs to this module.
    """

    def __init__(self) -> None:
        self.now_ns: int = 0
        self.first: Alarm | None = None  # before all others; None: the first of the first time
        self.times: list[int] = []  # of all others, sorted
        self._alarms: dict[int, list[Alarm]] = {}  # by time

    def alarm(self, action: Action) -> Alarm:
        """Return a new alarm, not set yet."""
        return Alarm(self, action)

    def drop(self, alarm: Alarm) -> None:
        """Remove an alarm."""
        if self.first is alarm:
            self.first = None
            return
        alarms = self._alarms[alarm.time_ns]
        alarms.remove(alarm)
        if not alarms:
            del self._alarms[alarm.time_ns]
            del self.times[bisect_left(self.times, alarm.time_ns)]

    def enter(self, alarm: Alarm, ahead: bool = False) -> None:
        """Sort an alarm in, behind those of the same time or ahead of them."""
        time_ns = alarm.time_ns
        alarms = self._alarms.get(time_ns)
        if alarms is None:
            self._alarms[time_ns] = [alarm]
            insort(self.times, time_ns)
        elif ahead:
            alarms.insert(0, alarm)
        else:
            alarms.append(alarm)

    def next_time_ns(self) -> int | None:
        """Return the time of the next event [ns], or None if there is none."""
        next_ns = self.next_ns()
        return None if next_ns == UNSET else next_ns

    def next_ns(self) -> int:
        """Return `next_time_ns`, with UNSET for None."""
        first = self.first
        if first is not None:
            return first.time_ns
        times = self.times
        if not times:
            return UNSET
        time_ns = times[0]
        alarms = self._alarms[time_ns]
        if len(alarms) == 1:
            self.first = alarms[0]
            del self._alarms[time_ns]
            del times[0]
        else:
            self.first = alarms.pop(0)
        return time_ns

    def run_next(self) -> bool:
        """Advance to the next event and run it; return False if there is none."""
        if self.first is None:
            self.next_ns()
        first = self.first
        if first is None:
            return False
        self.first = None
        time_ns = first.time_ns
        self.now_ns = time_ns
        first.time_ns = UNSET
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
