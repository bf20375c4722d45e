"""CAN traffic out of recordings of ours, and into them."""

import os
from collections.abc import Iterable, Iterator
from typing import Final, final

from traces.chunk import Entry
from traces.fields import can_frame_prefix, decode_can_frame
from traces.reader import Trace
from traces.schema import CAN_FRAME, Direction, Schema
from traces.traffic import Findings, Frame
from traces.writer import TraceWriter

_PREFIX: Final = "/can/"
_BATCH: Final = 8192
_REMEMBERED: Final = 1 << 16


@final
class FrameDecoder:
    """Takes apart what begins like a message before it without looking at it again.

    All but the data of a message that our writer has written is the same for one identifier, sender
    and length, and stands in front of the data.
    """

    def __init__(self) -> None:
        self._known: dict[tuple[bytes, int], tuple[bytes, bytes, bytes, Direction, str]] = {}

    def frame(self, payload: bytes, time_ns: int, bus: str) -> Frame:
        """Raises ValueError: the payload is no CanFrame."""
        key = (payload[:5], len(payload))
        before = self._known.get(key)
        if before is not None and payload.startswith(before[0]):
            prefix, head, padding, direction, sender = before
            frame = head + payload[len(prefix) :] + padding
            return Frame(time_ns, bus, frame, direction, sender)
        told = decode_can_frame(payload)
        head = told.frame[:8]
        sender_bytes = told.sender.encode()
        prefix, length = can_frame_prefix(head, len(told.frame), sender_bytes, told.direction)
        if len(prefix) + length == len(payload) and payload.startswith(prefix):
            if len(self._known) >= _REMEMBERED:
                self._known.clear()
            padding = bytes(len(told.frame) - 8 - length)
            self._known[key] = (prefix, head, padding, told.direction, told.sender)
        return Frame(time_ns, bus, told.frame, told.direction, told.sender)


def recorded_frames(trace: Trace, findings: Findings) -> Iterator[Frame]:
    """The CAN frames of a recording, in the order they were written; what else it has is noted.

    Raises:
        TraceError: a chunk is damaged.
    """
    left_out: dict[str, int] = {}
    known: dict[int, str | None] = {}
    decoder = FrameDecoder()
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
            yield decoder.frame(payload, time_ns, bus)
        except ValueError as error:
            findings.problem(number, f"{channel.topic}: {error}")
    for topic, count in left_out.items():
        findings.note(f"{topic}: {count} messages are no CAN frames, and left out")
    if trace.cut is not None and trace.cut.messages_missing:
        findings.problem(0, str(trace.cut))


def record_frames(
    target: str | os.PathLike[str], frames: Iterable[Frame], metadata: dict[str, dict[str, str]]
) -> tuple[str, ...]:
    """A recording holds these frames, in this order; the buses.

    Raises:
        TraceError: it cannot be written.
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
