"""Soak of the live view: full buses for minutes, in bounded memory. Time is that of the frames."""

import pytest

from motorhil.harness.view.session import Session, Subject
from motorhil.traces.mcap.reader import read_trace
from motorhil.traces.mcap.writer import TraceWriter
from motorhil.traces.schema import CAN_FRAME, Direction, Schema

BUSES, IDENTIFIERS = 8, 16
FRAME_NS = 125_000  # 8 bytes at 1 Mbit/s: 125 bits with stuff bits and intermission
EVENT_NS = 100_000_000
MB = 1_000_000


@pytest.fixture
def frames(tmp_path):
    """Return a frame of each identifier on each bus, as a reader gives it."""
    path = tmp_path / "frames.mcap"
    with TraceWriter(path) as writer:
        for bus in range(BUSES):
            channel = writer.channel(f"/can/can{bus}", Schema.of(CAN_FRAME))
            source = writer.source(channel, "drive", Direction.RECEIVED)
            for number in range(IDENTIFIERS):
                head = (0x181 + number).to_bytes(4, "little") + bytes((8, 0, 0, 0))
                writer.can_frame(source, 0, head + bytes(range(number, number + 8)))
    with read_trace(path) as trace:
        return [(channel, payload) for channel, _, payload in trace.messages()]


def full_buses(frames, from_ns, to_ns):
    """Yield the frames of all buses without a gap, in order of time."""
    for time_ns in range(from_ns, to_ns, FRAME_NS):
        first = time_ns // FRAME_NS % IDENTIFIERS
        for channel, payload in frames[first::IDENTIFIERS]:
            yield channel, time_ns, payload


def memory():
    """Return the memory of this process [bytes]."""
    with open("/proc/self/statm") as file:
        return int(file.read().split()[1]) * 4096


def soaked(frames, minutes):
    """Show full buses for these minutes; return the memory after each."""
    session = Session(Subject("soak"))
    found = []
    for minute in range(minutes):
        for now_ns in range(minute * 60 * 10**9, (minute + 1) * 60 * 10**9, EVENT_NS):
            session.feed(full_buses(frames, now_ns, now_ns + EVENT_NS))
            session.advance(now_ns + EVENT_NS)
        found.append(memory())
    assert session.whole(minutes * 60 * 10**9).kind == "whole"
    return found


@pytest.mark.nightly
def test_ten_minutes_of_eight_full_buses_take_bounded_memory(frames):
    found = soaked(frames, 10)
    assert max(found[3:]) - found[2] < 40 * MB
