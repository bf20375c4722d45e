"""Recorded error frames are not traffic and do not change a replay."""

import pytest

from motorhil.harness.oracles.judge import judge
from motorhil.harness.replay.host import DrivenRig, compared, drive
from motorhil.harness.replay.rig import with_recorded
from motorhil.harness.replay.verdict import unanswered
from motorhil.harness.rig.rig import Rig
from motorhil.traces.can_frame import ERR, classic
from motorhil.traces.exchange.recording import exchanges_of
from motorhil.traces.mcap.reader import read_trace
from motorhil.traces.mcap.writer import TraceWriter
from motorhil.traces.schema import Direction, encode_can_frame
from motorhil.traces.semantics.diff import Tolerance
from tests.support.golden import GOLDEN, described, golden
from tests.support.recordings.altered import traffic

HEARD, OWN = Direction.RECEIVED, Direction.TRANSMITTED
ERRORS = [  # some with the bits of NMT, SYNC, or an SDO of node 1, read as identifiers
    (classic(ERR | 0x204, bytes.fromhex("0008000000006000")), "left", HEARD),
    (classic(ERR | 0x0A8, bytes.fromhex("0000801900000000")), "host", OWN),
    (classic(ERR | 0x080, bytes.fromhex("0000000000000000")), "left", HEARD),
    (classic(ERR, bytes.fromhex("0181000000000000")), "host", OWN),
    (classic(ERR | 0x601, bytes.fromhex("2340600006000000")), "host", OWN),
    (classic(ERR | 0x581, bytes.fromhex("6040600000000000")), "left", HEARD),
]
EVERY = 7


@pytest.fixture
def told(tmp_path):
    """Return the golden recording of two drives, with an error frame after each seventh frame."""
    with (
        golden("cia402") as path,
        read_trace(path) as trace,
        TraceWriter(tmp_path / "told.mcap", trace.metadata) as writer,
    ):
        for one in trace.attachments:
            writer.attach(one.name, one.data, one.media_type, one.log_time_ns)
        channels, frames = {}, 0
        for channel, time_ns, payload in trace.messages():
            if channel.number not in channels:
                channels[channel.number] = writer.channel(channel.topic, channel.schema)
            writer.write(channels[channel.number], time_ns, payload)
            if channel.topic == "/can/can0":
                frames += 1
                if not frames % EVERY:
                    frame, sender, direction = ERRORS[frames // EVERY % len(ERRORS)]
                    error = encode_can_frame(frame, sender, direction)
                    writer.write(channels[channel.number], time_ns, error)
    assert frames > len(ERRORS) * EVERY
    return tmp_path / "told.mcap"


def test_error_frames_do_not_change_recorded_devices(told, tmp_path):
    with golden("cia402") as path, read_trace(path) as plain, read_trace(told) as trace:
        assert exchanges_of(trace).logs == exchanges_of(plain).logs
    again = tmp_path / "again.mcap"
    with Rig(with_recorded(described("cia402"), told), record=again) as rig:
        GOLDEN["cia402"][2](rig)
        assert unanswered(rig) == []
    with golden("cia402") as path:
        assert traffic(again) == traffic(path)


def test_error_frames_are_not_awaited_or_sent_by_the_host(told, tmp_path):
    live = tmp_path / "live.mcap"
    with Rig(described("cia402"), record=live) as rig:
        player = drive(DrivenRig(rig), told).player
    objects, differing = compared(told, live, player.pairs, Tolerance())
    assert (player.missed, differing) == ([], [])
    assert {one.label: one.share for one in objects if one.share < 1.0} == {}


def test_error_frames_only_add_a_judging_oracle(told):
    with golden("cia402") as path:
        before = {one.oracle: one for one in judge(path)}
    after = {one.oracle: one for one in judge(told)}
    changed = [name for name in before if before[name] != after[name]]
    assert changed == ["error-states"]
    assert after["error-states"].looked > 5
