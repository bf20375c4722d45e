"""Wall-time buses of a replayed host, and the record of their frames."""

from threading import Event
from uuid import uuid4

import can
import pytest

from motorhil.harness.recording.sources import PlaceError, parse_place, places_of_buses
from motorhil.harness.replay.real_bus import DrivenBuses
from motorhil.traces.can_frame import classic
from motorhil.traces.formats.frames import Findings
from motorhil.traces.formats.registry import recorded_frames
from motorhil.traces.mcap.reader import read_trace
from motorhil.traces.mcap.records import MAGIC
from motorhil.traces.schema import Direction
from tests.support.golden import golden

pytestmark = pytest.mark.wall


class Hearing:
    """A stand-in for the player; `then` handles a frame."""

    def __init__(self, then=lambda: None):
        self.frames = []
        self.has_heard = Event()
        self.then = then

    def heard(self, bus, frame, now_ns, transmitted):
        self.frames.append((bus, frame, transmitted))
        self.has_heard.set()
        self.then()


@pytest.fixture
def channel():
    return f"test-{uuid4()}"


@pytest.fixture
def peer(channel):
    with can.Bus(interface="virtual", channel=channel) as bus:
        yield bus


def opened(channel, live, recording, bitrate_bit_s=None):
    return DrivenBuses({"can0": parse_place(f"virtual:{channel}")}, bitrate_bit_s, live, recording)


def told(data):
    return can.Message(arbitration_id=0x185, data=data, is_extended_id=False)


def test_sent_and_received_frames_are_recorded_with_sender(channel, peer, tmp_path):
    live = tmp_path / "live.mcap"
    with golden("cia402") as path, opened(channel, live, path) as driven:
        hearing = Hearing()
        driven.listen("can0", hearing)
        driven.send("can0", classic(0x205, b"\x0f"))
        assert peer.recv(30.0).arbitration_id == 0x205
        driven.runtime.wait_until(hearing.has_heard.is_set, 10.0)
        hearing.has_heard.clear()
        peer.send(told(b"\x37"))
        driven.runtime.wait_until(hearing.has_heard.is_set, 10.0)
    ours, theirs = classic(0x205, b"\x0f"), classic(0x185, b"\x37")
    assert hearing.frames == [("can0", ours, True), ("can0", theirs, False)]
    with read_trace(live) as trace, golden("cia402") as path, read_trace(path) as before:
        assert [(one.frame, one.direction) for one in recorded_frames(trace, Findings())] == [
            (ours, Direction.TRANSMITTED),
            (theirs, Direction.RECEIVED),
        ]
        assert [one.name for one in trace.attachments] == [one.name for one in before.attachments]
        assert before.attachments


def test_record_is_complete_after_listening_has_ended(channel, peer, tmp_path):
    """Frames that come during closing would be written to a closed recording."""
    live = tmp_path / "live.mcap"
    is_leaving = Event()
    completed = []

    def stay():
        is_leaving.wait(10.0)
        Event().wait(0.2)  # in the right order it has no effect
        completed.append(live.read_bytes().endswith(MAGIC) and live.stat().st_size > len(MAGIC))

    with golden("cia402") as path, opened(channel, live, path) as driven:
        hearing = Hearing(stay)
        driven.listen("can0", hearing)
        peer.send(told(b"\x37"))
        assert hearing.has_heard.wait(10.0)
        is_leaving.set()
    assert completed == [False]
    assert live.read_bytes().endswith(MAGIC)


@pytest.mark.parametrize(
    ("bitrate_bit_s", "bit_ns"), [(None, 1_000), (125_000, 8_000), (500_000, 2_000)]
)
def test_bit_duration_follows_from_the_bit_rate(channel, tmp_path, bitrate_bit_s, bit_ns):
    with (
        golden("cia402") as path,
        opened(channel, tmp_path / "live.mcap", path, bitrate_bit_s) as driven,
    ):
        assert driven.bit_times_ns("can0") == (bit_ns, bit_ns)


def test_place_applies_to_its_bus_or_to_the_only_one():
    two = places_of_buses(["can1=vcan3", "can0=./hub"], ["can0", "can1"])
    assert {bus: place.channel for bus, place in two.items()} == {"can1": "vcan3", "can0": "./hub"}
    assert places_of_buses(["vcan3"], ["can0"])["can0"].channel == "vcan3"


@pytest.mark.parametrize(
    ("texts", "why"),
    [
        (["vcan3"], "the recording has frames of can0, can1; write --on can0=WHERE"),
        (["can7=vcan3"], "the recording has frames of can0, can1; write --on can0=WHERE"),
        (["can0=vcan3", "can0=vcan4"], "--on can0=vcan4: can0 has a destination already"),
    ],
)
def test_place_for_an_unknown_bus_or_twice_is_refused(texts, why):
    with pytest.raises(PlaceError, match=why):
        places_of_buses(texts, ["can0", "can1"])
