"""Digest of a recording, and the first difference between two recordings.

Both depend only on the messages: on topic, log time and payload, in the order written.
"""

import hashlib
import os
import struct
from itertools import zip_longest
from typing import final

from motorhil.frozen import frozen
from motorhil.traces.errors import TraceError
from motorhil.traces.files import MEMORY_MAX
from motorhil.traces.mcap.reader import TraceMessage, read_trace

_LENGTH = struct.Struct("<I")
_TIME_AND_LENGTH = struct.Struct("<QI")


def digest(path: str | os.PathLike[str]) -> str:
    """Return the SHA-256 (hex) over the messages in the order in which they were written.

    It covers topic, log time and payload of each message, unambiguously delimited. It does not
    depend on chunks, compression, metadata, attachments, channel numbers or the writer.

    Raises:
        TraceError: the file cannot be read, is damaged, or was cut, so that messages are missing.
    """
    state = hashlib.sha256()
    with read_trace(path) as trace:
        if trace.cut is not None and trace.cut.messages_missing:
            raise TraceError(
                trace.path,
                f"has no digest: {trace.cut}",
                remedy="record it again, or compare what is left message by message",
            )
        topics: dict[int, bytes] = {}
        parts: list[bytes] = []
        for channel, time_ns, payload in trace.messages():
            topic = topics.get(channel.number)
            if topic is None:
                name = channel.topic.encode()
                topic = topics[channel.number] = _LENGTH.pack(len(name)) + name
            parts += (topic, _TIME_AND_LENGTH.pack(time_ns, len(payload)), payload)
            if len(parts) > 30_000:
                state.update(b"".join(parts))
                parts.clear()
        state.update(b"".join(parts))
    return state.hexdigest()


@final
@frozen
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
    first: str | os.PathLike[str], second: str | os.PathLike[str], memory_max: int = MEMORY_MAX
) -> Mismatch | None:
    """Return the first difference; None if the messages (and so the digests) are the same.

    Cut files are compared as far as they go. `memory_max` bounds what a chunk may become.

    Raises:
        TraceError: one of them cannot be read, or is damaged.
    """
    with read_trace(first, memory_max) as left, read_trace(second, memory_max) as right:
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
