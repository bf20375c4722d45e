"""Stand-ins for `datetime` and `date`, which give parties the rig's date.

The clock of these classes cannot be replaced, so two other classes stand in for them. They create
the library's own objects, and accept them in isinstance().
"""

from datetime import UTC, date, datetime, tzinfo
from typing import Any

from harness.virtual_program.clocks import seconds_here


class _Face(type):
    """Metaclass of a class that accepts instances of `original` as its own."""

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
        return "original" in vars(cls)  # a program's own subclass is an ordinary class


class Datetime(datetime, metaclass=_Face):
    """Stand-in for datetime.datetime."""

    original = datetime

    def __new__(cls, *words: Any, **named: Any) -> Any:
        """Return the library's object, or an instance of the program's subclass."""
        return datetime.__new__(datetime if cls is Datetime else cls, *words, **named)

    @classmethod
    def now(cls, tz: tzinfo | None = None) -> Any:
        """Return the current time by the rig's clock."""
        now_s = seconds_here()
        return datetime.now(tz) if now_s is None else cls.fromtimestamp(now_s, tz)

    @classmethod
    def today(cls) -> Any:
        """Return the current local time by the rig's clock."""
        now_s = seconds_here()
        return datetime.now() if now_s is None else cls.fromtimestamp(now_s)  # noqa: DTZ005 -- local, as its

    @classmethod
    def utcnow(cls) -> Any:
        """Return the current UTC time by the rig's clock, without a time zone."""
        now_s = seconds_here()
        now = datetime.now(UTC) if now_s is None else cls.fromtimestamp(now_s, UTC)
        return now.replace(tzinfo=None)


class Date(date, metaclass=_Face):
    """Stand-in for datetime.date."""

    original = date

    def __new__(cls, *words: Any, **named: Any) -> Any:
        """Return the library's object, or an instance of the program's subclass."""
        return date.__new__(date if cls is Date else cls, *words, **named)

    @classmethod
    def today(cls) -> Any:
        """Return the current date by the rig's clock."""
        now_s = seconds_here()
        return date.today() if now_s is None else cls.fromtimestamp(now_s)  # noqa: DTZ011 -- the original


def stand_ins() -> list[tuple[object, object]]:
    """Return (original, stand-in) for the classes of module `datetime`."""
    return [(datetime, Datetime), (date, Date)]
