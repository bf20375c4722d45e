"""Times on the command line: a span of a recording, by seconds or dates.

Times of a recording count from the start of its rig, or from 1970. A number is a time of the
recording; if those count from 1970, a small number counts from the recording's beginning.
"""

import argparse
from collections.abc import Callable
from datetime import UTC, datetime, timedelta
from typing import Final, final

from motorhil.frozen import frozen
from motorhil.harness.cli.options import time_ns
from motorhil.harness.recording.conversion import open_recording
from motorhil.traces.errors import TraceError
from motorhil.traces.files import MEMORY_MAX

_NS: Final = 1_000_000_000
_DATED_NS: Final = 100_000_000 * _NS  # of 1973: no rig runs so long, and no bus was CAN before
_EPOCH: Final = datetime(1970, 1, 1, tzinfo=UTC)
Span = tuple[int, int]


@final
@frozen
class Moment:
    """A time as it was written.

    Attributes:
        text: the words of the user.
        ns: the time [ns]: since 1970 for a date.
        is_date: True for a date with its time.
    """

    text: str
    ns: int
    is_date: bool

    def within(self, path: str, span: Span) -> int:
        """Return the time in a recording with this span [ns].

        Raises:
            TraceError: it is a date, and the times of the recording do not count from 1970.
        """
        is_dated = span[0] >= _DATED_NS
        if self.is_date and not is_dated:
            what = f"{self.text!r} is a date, but its times do not count from 1970"
            raise TraceError(path, what, remedy=f"give seconds; {range_text(span)}")
        return span[0] + self.ns if is_dated and self.ns < _DATED_NS else self.ns


def moment(text: str) -> Moment:
    """Read seconds, or a date with its time (ISO 8601, UTC without an offset), for argparse."""
    if "-" not in text[1:]:
        return Moment(text, time_ns(text), False)
    try:
        found = datetime.fromisoformat(text)
    except ValueError:
        raise argparse.ArgumentTypeError(
            f"{text!r} is not a time; say seconds, such as 12.5, or 2026-11-27T10:00:00"
        ) from None
    at = found if found.tzinfo is not None else found.replace(tzinfo=UTC)
    return Moment(text, (at - _EPOCH) // timedelta(microseconds=1) * 1000, True)


def add_span(parser: argparse._ActionsContainer) -> None:
    """Add `--from`, `--to` and `--last`, which `span_of` reads."""
    seconds = "seconds of the recording, or from its beginning; or a date, 2026-11-27T10:00:00"
    parser.add_argument(
        "--from", type=moment, dest="from_at", metavar="T", help=f"from this time: {seconds}"
    )
    parser.add_argument(
        "--to", type=moment, dest="to_at", metavar="T", help="before this time, likewise"
    )
    parser.add_argument(
        "--last", type=time_ns, dest="last_ns", metavar="S", help="only the last S seconds"
    )


def has_span(options: argparse.Namespace) -> bool:
    """Return True if a part of the recording is asked for."""
    return any(one is not None for one in (options.from_at, options.to_at, options.last_ns))


def span_in(path: str, options: argparse.Namespace, memory_max: int = MEMORY_MAX) -> Span | None:
    """Return the span of a recording [ns] if a part of it is asked for; None: not asked, or empty.

    Raises:
        TraceError: the recording cannot be read.
    """
    if not has_span(options):
        return None
    with open_recording(path, memory_max=memory_max) as trace:
        return trace.span_ns()


def span_of(
    options: argparse.Namespace, path: str, span: Span | None, tell: Callable[[str], object]
) -> tuple[int | None, int | None]:
    """Return from when (inclusive) and until when (exclusive) a recording is asked for [ns].

    Args:
        options: of the command line.
        path: the recording, for messages.
        span: the first and last time of the recording [ns]; None: it is empty.
        tell: called with a sentence if the recording has nothing at that time.

    Raises:
        TraceError: a time does not suit the recording.
    """
    if span is None:
        return None, None
    from_ns = None if options.from_at is None else options.from_at.within(path, span)
    to_ns = None if options.to_at is None else options.to_at.within(path, span)
    if options.last_ns is not None:
        from_ns = max(from_ns or 0, span[1] - options.last_ns)
    for word, outside in (
        ("--from", from_ns is not None and from_ns > span[1]),
        ("--to", to_ns is not None and to_ns <= span[0]),
    ):
        if outside:
            tell(f"{path}: nothing at that time ({word}): {range_text(span)}")
    if from_ns is not None and to_ns is not None and to_ns <= from_ns:
        tell(
            f"{path}: nothing is between --from {from_ns / _NS:.9g} s and --to {to_ns / _NS:.9g} s"
        )
    return from_ns, to_ns


def range_text(span: Span) -> str:
    """Return the range of a recording in words; with dates if its times count from 1970."""
    first, last = (f"{one // _NS}.{one % _NS:09d}".rstrip("0").rstrip(".") for one in span)
    text = f"the recording is from {first} s to {last} s"
    if span[0] < _DATED_NS:
        return text
    dates = (_EPOCH + timedelta(microseconds=one // 1000) for one in span)
    return text + " (" + " to ".join(one.isoformat().replace("+00:00", "Z") for one in dates) + ")"
