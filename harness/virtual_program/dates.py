"""Dates of the rig's clock: `datetime.now()` and `date.today()`, for who is a party.

These classes cannot be told another clock, so two others stand in for them. They make the
library's own objects, and take them for theirs.
"""

from datetime import UTC, date, datetime, tzinfo
from typing import Any

from harness.virtual_program.clocks import seconds_here


class _Face(type):
    """The class of a class that takes instances of `original` for its own."""

    original: type

    def __instancecheck__(cls, instance: object) -> bool:
        return (
            isinstance(instance, cls.original)
            if cls._is_face()
            else super().__instancecheck__(instance)
        )

    def __subclasscheck__(cls, kind: type) -> bool:
        return issubclass(kind, cls.original) if cls._is_face() else super().__subclasscheck__(kind)

    def _is_face(cls) -> bool:
        return "original" in vars(cls)  # a program's own subclass is a class like any


class Datetime(datetime, metaclass=_Face):
    """As datetime.datetime."""

    original = datetime

    def __new__(cls, *words: Any, **named: Any) -> Any:
        """The library's object; of a subclass, its own."""
        return datetime.__new__(datetime if cls is Datetime else cls, *words, **named)

    @classmethod
    def now(cls, tz: tzinfo | None = None) -> Any:
        """It is that by the rig's clock."""
        now_s = seconds_here()
        return datetime.now(tz) if now_s is None else cls.fromtimestamp(now_s, tz)

    @classmethod
    def today(cls) -> Any:
        """It is that by the rig's clock."""
        now_s = seconds_here()
        return datetime.now() if now_s is None else cls.fromtimestamp(now_s)  # noqa: DTZ005 -- local, as its

    @classmethod
    def utcnow(cls) -> Any:
        """It is that by the rig's clock, in UTC, which the object does not know."""
        now_s = seconds_here()
        now = datetime.now(UTC) if now_s is None else cls.fromtimestamp(now_s, UTC)
        return now.replace(tzinfo=None)


class Date(date, metaclass=_Face):
    """As datetime.date."""

    original = date

    def __new__(cls, *words: Any, **named: Any) -> Any:
        """The library's object; of a subclass, its own."""
        return date.__new__(date if cls is Date else cls, *words, **named)

    @classmethod
    def today(cls) -> Any:
        """It is that by the rig's clock."""
        now_s = seconds_here()
        return date.today() if now_s is None else cls.fromtimestamp(now_s)  # noqa: DTZ011 -- the original


def stand_ins() -> list[tuple[object, object]]:
    """What of module `datetime` is replaced, and by what."""
    return [(datetime, Datetime), (date, Date)]
