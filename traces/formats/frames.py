"""Common data types of all CAN traffic formats, and findings of a reader.

A frame is Linux's `struct can_frame` or `struct canfd_frame`, as in recordings. Time stamps stay
integers from the source's digits to the target's.
"""

import re
from collections.abc import Iterable, Iterator, Sequence
from functools import cache
from typing import Final, NamedTuple, Protocol, final

from motorhil.traces.can_frame import EFF, EFF_MASK, ERR, SFF_MASK
from motorhil.traces.schema import Direction

NS: Final = 1_000_000_000
TIME_MAX: Final = (1 << 64) - 1  # an MCAP log time has 64 bits
_BUS_NUMBER: Final = re.compile(r"can(0|[1-9]\d{0,4})")


class Frame(NamedTuple):
    """A recorded frame: log time [ns], bus, can_frame or canfd_frame, direction, sender."""

    time_ns: int
    bus: str
    frame: bytes
    direction: Direction = Direction.UNKNOWN
    sender: str = ""


class Problem(NamedTuple):
    """Something that could not be read or written: its line, packet or frame number, and text."""

    line: int
    text: str


@final
class Findings:
    """Findings about a source while it is read.

    Attributes:
        frames: number of frames read.
        problems: unreadable parts, in file order.
        notes: remarks for users of the frames, each once.
        comments: number of comment lines and line ends.
        unstamped: number of frames without a time; theirs is 0.
        backward: number of frames with an earlier time than their predecessor.
        largest_step_back_ns: the largest such difference.
        line: the number of the line being read.
    """

    def __init__(self) -> None:
        self.frames: int = 0
        self.problems: list[Problem] = []
        self.notes: list[str] = []
        self.comments = 0
        self.unstamped = 0
        self.backward: int = 0
        self.largest_step_back_ns: int = 0
        self.line = 0

    def note(self, text: str) -> None:
        """Add a note, unless it is already there."""
        if text not in self.notes:
            self.notes.append(text)

    def problem(self, line: int, text: str) -> None:
        """Add a problem."""
        self.problems.append(Problem(line, text))

    def watched(self, frames: Iterable[Frame]) -> Iterator[Frame]:
        """Yield the frames, counting them and comparing their times."""
        before = 0
        for frame in frames:
            self.frames += 1
            step_ns = frame.time_ns - before
            if step_ns < 0 and self.frames > 1:
                self.backward += 1
                self.largest_step_back_ns = max(self.largest_step_back_ns, -step_ns)
            before = frame.time_ns
            yield frame


class LineReader(Protocol):
    """Reader of a line-based format; `name` is that of the format."""

    name: str

    def take(self, line: str, findings: Findings) -> Sequence[Frame]:
        """Return the frames of a line, () if it is not a row.

        Raises:
            ValueError: the row is unreadable; the message is the reason.
        """
        ...


def read_lines(lines: Iterable[str], reader: LineReader, findings: Findings) -> Iterator[Frame]:
    """Yield the frames in these lines; an unreadable line becomes a problem."""
    for number, line in enumerate(lines, 1):
        findings.line = number
        try:
            found = reader.take(line, findings)
        except ValueError as error:
            findings.problem(number, f"{error}: {shown(line)}")
            continue
        yield from found


def shown(line: str, width: int = 60) -> str:
    """Return a line for display: printable characters only, and shortened."""
    text = "".join(c if c.isprintable() else "." for c in line.strip())
    return f"'{text}'" if len(text) <= width else f"'{text[:width]}...'"


def identifier(digits: str) -> int:
    """Return a can_id: up to four digits 11 bit, more digits 29 bit or an error class.

    Raises:
        ValueError: not an identifier, or more than 29 bits.
    """
    value = int(digits, 16)
    if len(digits) == 8 and value & ERR and not value & EFF:
        return value
    if value > EFF_MASK:
        raise ValueError(f"identifier {digits} has more than 29 bits")
    return value | EFF if len(digits) > 4 or value > SFF_MASK else value


def decimal_ns(text: str, digits: int = 9) -> int:
    """Convert a decimal number of units of 10^digits ns, exactly; truncate below 1 ns.

    Raises:
        ValueError: not a number, negative, or too large for a log time.
    """
    whole, _, fraction = text.partition(".")
    if not whole.isdecimal() or (fraction and not fraction.isdecimal()):
        raise ValueError(f"not a time stamp: {shown(text, 24)}")
    return log_time(int(whole + fraction[:digits].ljust(digits, "0")))


def log_time(time_ns: int) -> int:
    """Return the time, which a recording can hold [ns since 1970].

    Raises:
        ValueError: it is too early or too late.
    """
    if 0 <= time_ns <= TIME_MAX:
        return time_ns
    bound = "beyond the year 2554" if time_ns > 0 else "before 1970"
    raise ValueError(f"a time stamp {bound}: {time_ns} ns")


def decimal(time_ns: int, places: int = 9, unit_ns: int = NS) -> str:
    """Return a time as a decimal number, truncated to `places` decimals."""
    whole, rest = divmod(time_ns, unit_ns)
    digits = len(str(unit_ns)) - 1
    return f"{whole}.{rest:0{digits}d}"[: len(str(whole)) + 1 + places]


def date_ns(year: int, month: int, day: int) -> int:
    """Return the start of a day (Gregorian, UTC) since 1970 [ns]."""
    year, month = (year, month) if month > 2 else (year - 1, month + 12)
    days = 365 * year + year // 4 - year // 100 + year // 400 + (153 * (month - 3) + 2) // 5 + day
    return (days - 719_469) * 86_400 * NS


def date_of(time_ns: int) -> tuple[int, int, int]:
    """Return year, month and day of a time since 1970 (Gregorian, UTC)."""
    days = time_ns // (86_400 * NS) + 719_468
    era, of_era = divmod(days, 146_097)
    year = (of_era - of_era // 1460 + of_era // 36_524 - of_era // 146_096) // 365
    of_year = of_era - (365 * year + year // 4 - year // 100)
    month = (5 * of_year + 2) // 153
    day = of_year - (153 * month + 2) // 5 + 1
    month = month + 3 if month < 10 else month - 9
    return era * 400 + year + (month <= 2), month, day


def one_word(name: str) -> str:
    """Return a bus name as one word: blanks and unprintable characters become "_"."""
    return "".join(c if c.isprintable() and not c.isspace() else "_" for c in name) or "_"


@cache
def bus_number(bus: str) -> int | None:
    """Return N + 1 for a bus named canN; None for another name, or beyond 16 bit."""
    match = _BUS_NUMBER.fullmatch(bus)
    return int(match[1]) + 1 if match and int(match[1]) < 0xFFFF else None


def bus_numbers(buses: Sequence[str]) -> dict[str, int]:
    """Return channels from 1 for formats without names: canN is N + 1, others get free numbers."""
    numbers: dict[str, int] = {}
    for bus in buses:
        number = bus_number(bus)
        if number is not None:
            numbers[bus] = number
    free = 1
    for bus in buses:
        if bus not in numbers:
            while free in numbers.values():
                free += 1
            numbers[bus] = free
    return numbers
