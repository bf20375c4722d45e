"""Stand-ins for `time` and `datetime`, which give parties the rig's clock.

The clock of `datetime` and `date` cannot be replaced, so two other classes stand in for them. They
create the library's own objects, and accept them in isinstance().
"""

import sys
import time
import warnings
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from datetime import UTC, date, datetime, tzinfo
from time import struct_time
from typing import Any, Final, final

from motorhil.harness.virtual_time.runtime import VirtualRuntime
from motorhil.harness.virtual_time.stdlib.threads import (
    Program,
    caller_is_outside,
    party_here,
    program_here,
)

UPTIME_NS: Final = 100_000 * 10**9
_SLEEP_NS_MIN: Final = 1_000
_CPU_CLOCKS: Final = ("CLOCK_PROCESS_CPUTIME_ID", "CLOCK_THREAD_CPUTIME_ID")
_WALL_CLOCKS: Final = ("CLOCK_REALTIME", "CLOCK_TAI")
_sleep = time.sleep


def _program(depth: int = 2) -> Program | None:
    """Return the program of the caller `depth` levels up, or None if it uses the wall clock."""
    program = program_here()
    return None if program is None or caller_is_outside(depth + 1) else program


def _reading_ns(program: Program) -> int:
    party = party_here()
    assert party is not None
    return program.look(party)


def seconds_here() -> float | None:
    """Return time.time() for the caller's caller, or None if it uses the wall clock."""
    program = _program(3)
    return None if program is None else _reading_ns(program) / 1e9


def sleep(seconds: float, /) -> None:
    """Sleep for `seconds` [s] of the rig's time, at least 1 us."""
    program = _program()
    if program is None or not seconds >= 0:
        _sleep(seconds)  # raises for invalid durations
        return
    party = party_here()
    assert party is not None
    program.runtime.run_for(program.from_now_s(party, max(seconds, _SLEEP_NS_MIN / 1e9)))


_watched: list[VirtualRuntime] = []  # of open rigs; the first sleep of each is the last told


@contextmanager
def sleep_watched(runtime: VirtualRuntime) -> Iterator[None]:
    """Warn once of `time.sleep` in a party of this runtime: virtual time stands still in it."""
    _watched.append(runtime)
    _bind_sleep(_watched_sleep)
    try:
        yield
    finally:
        with suppress(ValueError):  # it was told, and is not watched any longer
            _watched.remove(runtime)
        if not _watched:
            _bind_sleep(_sleep)


@contextmanager
def sleep_unwatched() -> Iterator[None]:
    """Bind the original `time.sleep` within the block, whose user replaces it."""
    _bind_sleep(_sleep)
    try:
        yield
    finally:
        if _watched:
            _bind_sleep(_watched_sleep)


def _bind_sleep(own: Callable[[float], None]) -> None:
    for place in (time, sys.modules.get("__main__")):
        if getattr(place, "sleep", None) in (_sleep, _watched_sleep):
            setattr(place, "sleep", own)  # noqa: B010 -- `time` declares it as a function


def _watched_sleep(seconds: float, /) -> None:
    """As time.sleep; warn once of a party that expects virtual time to pass meanwhile."""
    for runtime in list(_watched):
        if runtime.party_of_thread() is not None and not caller_is_outside(2):
            _watched.remove(runtime)
            warnings.warn(
                f"time.sleep({seconds:g}) lets no virtual time pass in the open rig; write"
                f" rig.runtime.run_for({seconds:g}), or run the program with 'motorhil run RIG"
                " SCRIPT', which replaces time.sleep (in pytest: the fixture virtual_time)",
                stacklevel=2,
            )
    _sleep(seconds)


@final
class _Clock:
    """A clock of base + the rig's time, in ns (None) or in units of `unit` ns.

    As the original, and unlike a function, it does not become a method where a class has bound it.
    """

    def __init__(self, original: Callable[[], Any], base_ns: int, unit: float | None) -> None:
        self._original = original
        self._base_ns = base_ns
        self._unit = unit
        self.__name__ = self.__qualname__ = original.__name__
        self.__doc__ = f"As time.{original.__name__}, by the rig's clock."

    def __call__(self) -> Any:
        program = _program()
        if program is None:
            return self._original()
        now_ns = self._base_ns + _reading_ns(program)
        return now_ns if self._unit is None else now_ns / self._unit


def _clock_gettime(
    original: Callable[[int], Any], unit: float | None
) -> Callable[[int], int | float]:
    bases = {getattr(time, name): 0 for name in (*_WALL_CLOCKS, *_CPU_CLOCKS)}

    def clock_gettime(clk_id: int, /) -> Any:
        program = _program()
        if program is None:
            return original(clk_id)
        now_ns = bases.get(clk_id, UPTIME_NS) + _reading_ns(program)
        return now_ns if unit is None else now_ns / unit

    return clock_gettime


def _calendar(original: Callable[..., Any]) -> Callable[..., Any]:
    """Return a stand-in for localtime, gmtime or ctime, whose default is the rig's time."""

    def convert(seconds: float | None = None, /) -> Any:
        if seconds is None:
            program = _program()
            if program is not None:
                seconds = _reading_ns(program) / 1e9
        return original(seconds)

    return convert


def _formatted(original: Callable[..., str], leading: int) -> Callable[..., str]:
    """Return a stand-in for strftime (one leading argument) or asctime (none) with that default."""

    def convert(*words: Any) -> str:
        if len(words) == leading:
            program = _program()
            if program is not None:
                now: struct_time = _localtime(_reading_ns(program) / 1e9)
                words = (*words, now)
        return original(*words)

    return convert


_localtime = time.localtime


def stand_ins() -> list[tuple[object, object]]:
    """Return (original, stand-in) for the functions of module `time`."""
    pairs: list[tuple[object, object]] = [(_sleep, sleep)]
    for name, base_ns in (
        ("time", 0),
        ("monotonic", UPTIME_NS),
        ("perf_counter", UPTIME_NS),
        ("process_time", 0),
        ("thread_time", 0),
    ):
        original, original_ns = getattr(time, name), getattr(time, f"{name}_ns")
        pairs.append((original, _Clock(original, base_ns, 1e9)))
        pairs.append((original_ns, _Clock(original_ns, base_ns, None)))
    pairs.append((time.clock_gettime, _clock_gettime(time.clock_gettime, 1e9)))
    pairs.append((time.clock_gettime_ns, _clock_gettime(time.clock_gettime_ns, None)))
    pairs += [(name, _calendar(name)) for name in (time.localtime, time.gmtime, time.ctime)]
    pairs.append((time.strftime, _formatted(time.strftime, 1)))
    pairs.append((time.asctime, _formatted(time.asctime, 0)))
    return pairs


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


def date_stand_ins() -> list[tuple[object, object]]:
    """Return (original, stand-in) for the classes of module `datetime`."""
    return [(datetime, Datetime), (date, Date)]
