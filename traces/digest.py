"""Digest of a recording, which depends only on its messages."""

import hashlib
import os
import struct

from traces.errors import TraceError
from traces.reader import read_trace

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
