"""Efficient waiting for events of several motors.

Conditions are evaluated after every event of a rig, so they must be fast. A motor whose changes are
counted is examined only after a change.
"""

from collections.abc import Callable
from typing import Final, final

LOOK_PERIOD_S: Final = 0.01
"""The check period [s] where no event reports a change: motors without a change counter, for
callbacks; the end of low-level access.
"""


@final
class News:
    """A counter of changes in the knowledge of a physical motor. The source of a change counts it.

    Attributes:
        count: compared by waiters. An increment is sufficient if no motion can have ended.
        listeners: called by `grow`; they check for the end of a motion.
    """

    def __init__(self) -> None:
        self.count = 0
        self.listeners: list[Callable[[], None]] = []

    def grow(self) -> None:
        """Count a complete change that may have ended a motion, and call the listeners."""
        self.count += 1
        if self.listeners:
            for listener in self.listeners.copy():
                listener()


@final
class Awaited:
    """An awaited event; `is_over` checks for it, and may raise."""

    def __init__(self, news: News | None, is_over: Callable[[], bool]) -> None:
        self.counts = news is not None
        self.news = News() if news is None else news
        self.seen = -1  # last count seen; unchanged without a counter
        self.is_over = is_over

    def looks_over(self) -> bool:
        """Return True if the event has happened, as of the latest change."""
        if self.counts:
            if self.news.count == self.seen:
                return False
            self.seen = self.news.count
        return self.is_over()


@final
class Waiting:
    """Several awaited events; `going` contains those still to come."""

    def __init__(self, awaited: list[Awaited]) -> None:
        self.going = awaited

    def all_over(self) -> bool:
        """Return True if all events have happened; past ones are not checked again."""
        for one in self.going:
            if one.news.count != one.seen:
                self.going = [other for other in self.going if not other.looks_over()]
                return not self.going
        return not self.going
