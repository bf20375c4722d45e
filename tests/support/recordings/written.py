"""Recordings for the tests of this package."""

import struct

from motorhil.traces.mcap.writer import TraceWriter
from motorhil.traces.schema import CAN_FRAME, LOG, Direction, Schema

MS = 1_000_000
SECOND = 1_000_000_000


def can_frame(can_id, data=b""):
    return struct.pack("<IB3x8s", can_id, len(data), data)


def counted_frame(number):
    """Return a unique frame."""
    return can_frame(0x181 + number % 3, struct.pack("<Q", number * 0x9E3779B97F4A7C15 % 2**64))


class Recording:
    """A writer with two CAN channels and events, and the entries written so far."""

    def __init__(self, target, metadata=None, compact=False):
        self.writer = TraceWriter(target, metadata, compact)
        self.can = [self.writer.channel(f"/can/can{i}", Schema.of(CAN_FRAME)) for i in (0, 1)]
        self.events = self.writer.channel("/events", Schema.of(LOG))
        self.sources = [
            self.writer.source(self.can[0], "left", Direction.RECEIVED),
            self.writer.source(self.can[0], "host", Direction.TRANSMITTED),
            self.writer.source(self.can[1], "right", Direction.RECEIVED),
        ]
        self.entries = []

    def fill(self, count, step_ns, first=0):
        """Write frames of all sources, and some events, `step_ns` apart."""
        entries = []
        for number in range(first, first + count):
            time_ns = number * step_ns
            if number % 10 == 9:
                entries.append((-self.events, time_ns, b"\x1a\x04" + struct.pack("<I", number)))
            else:
                entries.append((self.sources[number % 3], time_ns, counted_frame(number)))
        self.entries += entries
        self.writer.extend(entries)
        return self


def write(path, count=100, step_ns=50 * MS, compact=False):
    recording = Recording(path, {"run": {"seed": "1"}}, compact)
    recording.fill(count, step_ns)
    recording.writer.close()
    return recording
