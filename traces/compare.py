"""First difference between two recordings, message by message."""

import os
from dataclasses import dataclass
from itertools import zip_longest
from typing import final

from traces.reader import TraceMessage, read_trace


@final
@dataclass(frozen=True, slots=True)
class Mismatch:
    """The first pair of different messages; None: that recording has ended.

    Attributes:
        number: the number of the message, from 0.
        first, second: the messages as (topic, log time [ns], payload).
    """

    number: int
    first: tuple[str, int, bytes] | None
    second: tuple[str, int, bytes] | None

    def __str__(self) -> str:
        return f"message {self.number}: {_text(self.first)} against {_text(self.second)}"


def first_mismatch(
    first: str | os.PathLike[str], second: str | os.PathLike[str]
) -> Mismatch | None:
    """Return the first difference; None if the messages (and so the digests) are the same.

    Cut files are compared as far as they go.

    Raises:
        TraceError: one of them cannot be read, or is damaged.
    """
    with read_trace(first) as left, read_trace(second) as right:
        pairs = zip_longest(left.messages(), right.messages())
        for number, (one, other) in enumerate(pairs):
            if _plain(one) != _plain(other):
                return Mismatch(number, _plain(one), _plain(other))
    return None


def _plain(message: TraceMessage | None) -> tuple[str, int, bytes] | None:
    return None if message is None else (message[0].topic, message[1], message[2])


def _text(message: tuple[str, int, bytes] | None) -> str:
    if message is None:
        return "the end"
    topic, time_ns, payload = message
    return f"{topic} at {time_ns / 1e9:.9f} s, {payload.hex()}"
