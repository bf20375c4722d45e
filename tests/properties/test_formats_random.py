"""Random traffic survives conversion to a format and back, with the same digest."""

import tempfile
from pathlib import Path

import can
import pytest
from hypothesis import event, given
from hypothesis import strategies as st

from motorhil.harness.recording.conversion import convert
from motorhil.traces import can_frame
from motorhil.traces.can_frame import classic, flexible, remote
from motorhil.traces.digest import digest
from motorhil.traces.formats import frames as traffic
from motorhil.traces.formats.frames import Frame
from motorhil.traces.formats.registry import WRITABLE, Feature, record_frames
from motorhil.traces.schema import Direction
from tests.support.recordings.formats import WRITTEN, in_order_of

BLF = next(form for form in WRITABLE if form.name == "blf")
NAMES = st.text(st.characters(categories=("L", "N", "P", "S")), min_size=1, max_size=8)
TEXT = st.text(st.characters(categories=("L", "N", "P", "S", "Zs")), max_size=8)
BEGINS_NS = st.sampled_from([0, 999, 10**9, 1_700_000_000_123_456_789, 16_000_000_000 * 10**9])
SINCE_NS = st.integers(0, 10**6) | st.integers(0, 10**10) | st.integers(0, 10**17)


@st.composite
def identifiers(draw):
    if draw(st.booleans()):
        return draw(st.integers(0, can_frame.SFF_MASK))
    return draw(st.integers(0, can_frame.EFF_MASK)) | can_frame.EFF


@st.composite
def contents(draw, holds):
    kinds = ["data", "data"]
    kinds += [name for name in ("REMOTE", "FD", "ERROR_FRAMES") if Feature[name] in holds]
    kind = draw(st.sampled_from(kinds))
    event(kind)
    if kind == "REMOTE":
        return remote(draw(identifiers()), draw(st.integers(0, 8)))
    if kind == "FD":
        size = draw(st.sampled_from(can_frame.FD_LENGTHS))
        data = draw(st.binary(min_size=size, max_size=size))
        return flexible(draw(identifiers()), draw(st.integers(0, 3)), data)
    if kind == "ERROR_FRAMES":  # Linux has 8 bytes in each, and names a class at least
        told = draw(st.integers(1, can_frame.EFF_MASK))
        return classic(told | can_frame.ERR, draw(st.binary(min_size=8, max_size=8)))
    return classic(draw(identifiers()), draw(st.binary(max_size=8)))


@st.composite
def recordings(draw, holds):
    unit_ns = 1 if Feature.NANOSECONDS in holds else 1000
    begin_ns = draw(BEGINS_NS)
    bus = st.sampled_from(["can0", "can1", "can2", "can65534"])
    if Feature.BLANKS in holds:
        bus |= TEXT
    elif Feature.BUS_NAMES in holds:
        bus |= NAMES
    ways = [Direction.RECEIVED, Direction.TRANSMITTED] * (Feature.DIRECTION in holds)
    ways += [Direction.UNKNOWN] * (Feature.UNDIRECTED in holds)
    one = st.builds(
        Frame,
        SINCE_NS.map(lambda since_ns: (begin_ns + since_ns) // unit_ns * unit_ns),
        bus,
        contents(holds),
        st.sampled_from(ways),
        TEXT if Feature.SENDER in holds else st.just(""),
    )
    frames = draw(st.lists(one, min_size=1, max_size=12))
    return in_order_of(holds, frames)


@pytest.mark.parametrize("form", WRITTEN)
@given(st.data())
def test_conversion_and_back_keeps_digest(form, data):
    frames = data.draw(recordings(form.holds))
    with tempfile.TemporaryDirectory() as name:
        paths = [Path(name) / file for file in ("a.mcap", "b" + form.ending, "c.mcap")]
        record_frames(paths[0], frames, {})
        there = convert(paths[0], paths[1], form.name)
        back = convert(paths[1], paths[2], "mcap")
        assert there.lost == {}
        assert there.findings.problems == back.findings.problems == []
        assert digest(paths[0]) == digest(paths[2])


@given(recordings(BLF.holds))
def test_python_can_reads_same_frames_from_blf(frames):
    with tempfile.TemporaryDirectory() as name:
        paths = [Path(name) / file for file in ("a.mcap", "b.blf")]
        record_frames(paths[0], frames, {})
        convert(paths[0], paths[1], "blf")
        with can.BLFReader(paths[1]) as reader:
            assert reader.object_count == len(frames)
            assert reader.file_size == paths[1].stat().st_size
            found = list(reader)
    assert [told(message) for message in found] == [expected(frame) for frame in frames]
    for message, frame in zip(found, frames, strict=True):
        assert message.timestamp == pytest.approx(frame.time_ns / 1e9, rel=1e-15, abs=1e-9)


def told(message):
    return (
        message.channel,
        message.arbitration_id,
        message.is_extended_id,
        message.is_remote_frame,
        message.is_error_frame,
        (message.is_fd, message.bitrate_switch, message.error_state_indicator),
        message.dlc,
        bytes(message.data),
        message.is_rx or message.is_error_frame,
    )


def expected(frame):
    one = can_frame.fields(frame.frame)
    is_error = one.can_id & can_frame.ERR != 0
    flags = one.fd, one.flags & can_frame.BRS != 0, one.flags & can_frame.ESI != 0
    return (
        traffic.bus_number(frame.bus) - 1,
        one.identifier,
        one.can_id & can_frame.EFF != 0,
        one.can_id & can_frame.RTR != 0,
        is_error,
        flags,
        one.length,
        one.data,
        is_error or frame.direction is not Direction.TRANSMITTED,
    )
