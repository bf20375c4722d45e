"""CAN traffic in our recordings: reading and writing."""

import os
from collections.abc import Iterable, Iterator
from typing import Final

from traces.chunk import Entry
from traces.frame_decoder import FrameDecoder
from traces.reader import Trace
from traces.schema import CAN_FRAME, Direction, Schema
from traces.traffic import Findings, Frame
from traces.writer import TraceWriter

_PREFIX: Final = "/can/"
_BATCH: Final = 8192


def recorded_frames(trace: Trace, findings: Findings) -> Iterator[Frame]:
    """Yield the CAN frames of a recording in written order; other messages become notes.

    Raises:
        TraceError: a chunk is damaged.
    """
    left_out: dict[str, int] = {}
    known: dict[int, str | None] = {}
    decode = FrameDecoder().decode
    for number, (channel, time_ns, payload) in enumerate(trace.messages(), 1):
        bus = known.get(channel.number, "")
        if bus == "":
            ours = channel.schema is not None and channel.schema.name == CAN_FRAME.name
            bus = channel.topic.removeprefix(_PREFIX) if ours else None
            known[channel.number] = bus
        if bus is None:
            left_out[channel.topic] = left_out.get(channel.topic, 0) + 1
            continue
        try:
            frame, direction, sender = decode(payload)
        except ValueError as error:
            findings.problem(number, f"{channel.topic}: {error}")
            continue
        yield Frame(time_ns, bus, frame, direction, sender)
    for topic, count in left_out.items():
        findings.note(f"{topic}: {count} messages are not CAN frames, and are omitted")
    if trace.cut is not None and trace.cut.messages_missing:
        findings.problem(0, str(trace.cut))


def record_frames(
    target: str | os.PathLike[str], frames: Iterable[Frame], metadata: dict[str, dict[str, str]]
) -> tuple[str, ...]:
    """Record these frames in this order; return the buses.

    Raises:
        TraceError: the recording cannot be written.
    """
    with TraceWriter(target, metadata) as writer:
        channels: dict[str, int] = {}
        sources: dict[tuple[str, str, Direction], int] = {}
        entries: list[Entry] = []
        schema = Schema.of(CAN_FRAME)
        for time_ns, bus, frame, direction, sender in frames:
            key = (bus, sender, direction)
            source = sources.get(key)
            if source is None:
                if bus not in channels:
                    channels[bus] = writer.channel(_PREFIX + bus, schema)
                source = sources[key] = writer.source(channels[bus], sender, direction)
            entries.append((source, time_ns, frame))
            if len(entries) >= _BATCH:
                writer.extend(entries)
                entries = []
        writer.extend(entries)
    return tuple(channels)
