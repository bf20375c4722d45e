"""Waiting for what several motors do. It is asked after every event of a rig, so it answers fast.

A motor is looked at when there is news of it, and only then, if somebody counts its news.
"""

from collections.abc import Callable
from typing import Final, final

LOOK_PERIOD_S: Final = 0.01
"""How often is looked at what nobody tells of: a motor whose hardware counts no news, for a
callback's sake; whether low-level access is over."""


@final
class News:
    """How often what is known of a physical motor has changed. Whoever changes it counts.

    Attributes:
        count: who waits compares it. Counting alone will do where a motion cannot have ended.
        listeners: are told by `grow`; they look whether a motion has ended by that.
    """

    def __init__(self) -> None:
        self.count = 0
        self.listeners: list[Callable[[], None]] = []

    def grow(self) -> None:
        """It has changed, so that a motion may have ended. Called when all of the change is in."""
        self.count += 1
        if self.listeners:
            for listener in self.listeners.copy():
                listener()


@final
class Awaited:
    """Something that is waited for; `is_over` looks whether it is over, and may raise."""

    def __init__(self, news: News | None, is_over: Callable[[], bool]) -> None:
        self.counts = news is not None
        self.news = News() if news is None else news
        self.seen = -1  # of the news; stays so, if nobody counts them
        self.is_over = is_over

    def looks_over(self) -> bool:
        """Whether it is over by the latest news."""
        if self.counts:
            if self.news.count == self.seen:
                return False
            self.seen = self.news.count
        return self.is_over()


@final
class Waiting:
    """All that is waited for at once; `going` is what is not over yet."""

    def __init__(self, awaited: list[Awaited]) -> None:
        self.going = awaited

    def all_over(self) -> bool:
        """Whether nothing goes on; what is over is not looked at again."""
        for one in self.going:
            if one.news.count != one.seen:
                self.going = [other for other in self.going if not other.looks_over()]
                return not self.going
        return not self.going
