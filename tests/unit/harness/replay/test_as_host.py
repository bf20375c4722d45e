"""Recorded hosts against a rig: transmission times, errors, and comparison."""

import json
import shutil

import pytest

from motorhil.harness.replay.host import DrivenRig, compared, drive
from motorhil.harness.rig.rig import Rig
from motorhil.traces.can_frame import classic
from motorhil.traces.exchange.recording import exchanges_of
from motorhil.traces.mcap.reader import read_trace
from motorhil.traces.mcap.writer import TraceWriter
from motorhil.traces.schema import CAN_FRAME, Direction, Schema, decode_can_frame
from motorhil.traces.semantics.diff import Tolerance
from tests.support.golden import FOLDER
from tests.support.recordings.altered import copied, traffic
from tests.support.recordings.handmade import MS, Recorded, S

SET_POINT = classic(0x205, b"\x0f\0")
RESET_ALL = classic(0x000, b"\x81\0")  # CiA 301, NMT: reset node, to all
# With a silent node that acknowledges.
EMPTY = "bus.can0 = {{ bitrate_bit_s = {}, node.ear.silent = true }}\n"


@pytest.fixture
def folder(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    shutil.copy(FOLDER / "cia402.mcap", tmp_path / "bench.mcap")
    return tmp_path


def recording(path, times_ns, metadata):
    """Record set-points of a host at these times."""
    with TraceWriter(path, metadata) as writer:
        channel = writer.channel("/can/can0", Schema.of(CAN_FRAME))
        source = writer.source(channel, "host", Direction.TRANSMITTED)
        writer.extend([(source, time_ns, SET_POINT) for time_ns in times_ns])
    return path


def driven(folder, path, bitrate_bit_s, **options):
    (folder / "empty.toml").write_text(EMPTY.format(bitrate_bit_s))
    with Rig.open(folder / "empty.toml") as rig:
        return drive(DrivenRig(rig), path, **options).player


@pytest.mark.parametrize("bitrate_bit_s", [125_000, 1_000_000])
def test_frames_are_sent_on_time_at_any_bit_rate(folder, bitrate_bit_s):
    times_ns = [10 * MS, 20 * MS, 400 * MS]
    path = recording(folder / "a.mcap", times_ns, {"run": {}})
    assert driven(folder, path, bitrate_bit_s).pairs == [(at, at) for at in times_ns]


def test_recording_without_rig_begins_with_first_frame(folder):
    """A frame of 2 bytes at 1 Mbit/s takes 60 to 74 us; the first frame is sent at once."""
    path = recording(folder / "a.mcap", [1_000 * S, 1_000 * S + 10 * MS], {})
    (_, first), (_, second) = driven(folder, path, 1_000_000).pairs
    assert 60_000 <= first <= 74_000
    assert second - first == 10 * MS


def test_missing_bus_is_reported_with_available_ones(folder, say):
    (folder / "empty.toml").write_text("bus.arm.bitrate_bit_s = 1_000_000\n")
    status, out, err = say("replay", "bench.mcap", "--as", "host", "--rig", "empty.toml")
    assert (status, out) == (2, "")
    assert "the recorded host sends on 'can0', but empty.toml has no such bus or line" in err
    assert "available: arm" in err


def hosts_frames(path):
    told = [decode_can_frame(payload) for _, payload in traffic(path, "/can/can0")]
    return [one.frame for one in told if one.direction is Direction.TRANSMITTED]


def test_reset_option_sends_reset_first(folder, say):
    words = ("replay", "bench.mcap", "--as", "host", "-o", "live.mcap")
    say(*words)
    assert RESET_ALL not in hosts_frames("live.mcap")
    say(*words, "--reset")
    assert hosts_frames("live.mcap")[0] == RESET_ALL
    assert hosts_frames("live.mcap")[1:] == hosts_frames("bench.mcap")


def altered(folder, node, head, byte, flip):
    """Copy the recording with one flipped byte in one answer of a node."""
    done = []

    def change(number, topic, time_ns, payload):
        is_it = payload[1:5] == bytes([0x80 + node, 5, 0, 0]) and payload[-8:-4] == head
        if topic != "/can/can0" or not is_it or done:
            return payload
        done.append(number)
        at = len(payload) - 4 + byte
        return payload[:at] + bytes([payload[at] ^ flip]) + payload[at + 1 :]

    copied(folder / "bench.mcap", folder / "altered.mcap", change)
    assert done


def test_one_different_answer_fails_with_its_object(folder, say):
    """The answer is node 2's supported drive modes, read once; all else is unchanged."""
    altered(folder, 2, b"\x43\x02\x65\x00", 0, 0x01)
    words = ("replay", "altered.mcap", "--as", "host")
    status, out, _ = say(*words)
    assert status == 1
    assert out.rstrip().endswith("1 differences, 0 times waited in vain")
    (row,) = [line for line in out.splitlines() if " 0.0 %" in line]
    assert "node 2 (right), 6502h supported drive modes" in row
    assert "100.0 %" in out
    status, out, _ = say(*words, "--json")
    told = json.loads(out)
    assert (status, len(told["differences"])) == (1, 1)
    assert [one["share"] for one in told["objects"] if one["share"] < 1.0] == [0.0]


def test_tolerance_is_a_share_of_the_quantitys_range(folder, say):
    """Node 1's position demand value is off by 1024 of 42017 increments."""
    altered(folder, 1, b"\x43\x62\x60\x00", 1, 0x04)
    words = ("replay", "altered.mcap", "--as", "host")
    assert say(*words)[0] == 1
    assert say(*words, "--tolerance", "0.2")[0] == 0


def test_speed_option_shortens_pauses(folder, say):
    recording(folder / "a.mcap", [10 * MS, 1_010 * MS], {"run": {}})
    (folder / "empty.toml").write_text(EMPTY.format(1_000_000))
    words = ("replay", "a.mcap", "--as", "host", "--rig", "empty.toml", "-o", "live.mcap")
    assert say(*words, "--speed", "10")[0] == 3  # no device is there, so nothing was compared
    first, second = (time_ns for time_ns, _ in traffic("live.mcap", "/can/can0"))
    assert 99 * MS < second - first < 101 * MS


def test_rig_and_buses_together_are_refused(folder, say):
    (folder / "empty.toml").write_text("bus.can0.bitrate_bit_s = 1_000_000\n")
    words = ("--rig", "empty.toml", "--on", "virtual:1")
    status, out, err = say("replay", "bench.mcap", "--as", "host", *words)
    assert (status, out) == (2, "")
    assert err == "motorhil replay: --on and --rig exclude each other; give one of them\n"


SINGLE = """\
bus.can0.bitrate_bit_s = 1_000_000
[controller.single]
kind = "cia402"
bus = "can0"
node_id = 1
plant = { preset = "wheel_60w" }
"""


def test_missed_answer_fails_without_differences(folder, say):
    """With zero patience, each answer arrives after its deadline."""
    (folder / "single.toml").write_text(SINGLE)
    ask, kind = (classic(0x601, bytes.fromhex("4000100000000000")), "4300100092010200")
    with TraceWriter(folder / "a.mcap", {"run": {}}) as writer:
        channel = writer.channel("/can/can0", Schema.of(CAN_FRAME))
        host = writer.source(channel, "host", Direction.TRANSMITTED)
        node = writer.source(channel, "", Direction.RECEIVED)
        answer = classic(0x581, bytes.fromhex(kind))
        for source, time_ms, frame in (
            (node, 300, classic(0x701, b"\0")),
            (host, 2_000, ask),
            (node, 2_001, answer),
            (host, 2_100, ask),
        ):
            writer.extend([(source, time_ms * MS, frame)])
    words = ("replay", "a.mcap", "--as", "host", "--rig", "single.toml")
    status, out, _ = say(*words)
    assert (status, out.rstrip()[-37:]) == (0, "0 differences, 0 times waited in vain"), out
    status, out, _ = say(*words, "--patience", "0")
    assert "0 differences, 2 times waited in vain" in out
    assert status == 1


def test_same_values_later_are_not_different(folder):
    def moved(name, late_ns):
        one = Recorded(folder / name)
        for number in range(20):
            value = (number * number * 50).to_bytes(4, "little").hex()
            one.sdo(number * 100 * MS + late_ns, 1, "40646000", f"43646000{value}")
        one.close()
        return folder / name

    early, late = moved("early.mcap", 0), moved("late.mcap", S)
    objects, differing = compared(early, late, [(0, S), (3 * S, 4 * S)], Tolerance())
    assert differing == []
    assert [one.share for one in objects] == [1.0]
    assert compared(early, late, [], Tolerance())[1] != []


CHECK = """\
import can
with can.Bus() as bus:
    bus.send(can.Message(arbitration_id=0x601, data=bytes.fromhex("4018100700000000"),
                         is_extended_id=False))
    bus.recv(1.0)
"""


def test_as_device_with_rig_option_uses_that_rig(folder, say):
    """The rig has only one of the two recorded devices."""
    (folder / "check.py").write_text(CHECK)
    (folder / "one.toml").write_text(SINGLE)
    words = ("replay", "bench.mcap", "--as", "device", "check.py", "--rig", "one.toml")
    status, _, err = say(*words, "--seed", "5", "--set-points", "any")
    assert status == 1
    assert "1 recorded controller: 1 of 1 commands not in the recording" in err
    assert "single at " in err
    again = err.splitlines()[-1]
    assert again == (
        "again: motorhil replay bench.mcap --as device check.py --seed 5 --rig one.toml "
        "--set-points any"
    )


def test_truncated_recording_is_reported(folder, say):
    """Only its end is missing; everything else is present and agrees."""
    (folder / "cut.mcap").write_bytes((folder / "bench.mcap").read_bytes()[:-20])
    status, _, err = say("replay", "cut.mcap", "--as", "host")
    assert status == 0
    assert err.startswith("motorhil replay: cut.mcap: cut at byte ")
    assert say("replay", "bench.mcap", "--as", "host")[2] == ""


STREAM = """\
import can
with can.Bus() as bus:
    bus.send(can.Message(arbitration_id={identifier}, data=bytes.fromhex("{data}"),
                         is_extended_id=False))
    bus.recv(0.01)
"""


def test_other_set_points_pass_with_any_set_points(folder, say):
    """The first PDO to the I/O node has its set-points inverted."""
    path = FOLDER / "software.mcap"
    with read_trace(path) as trace:
        (log,) = exchanges_of(trace, any_set_point=True).logs.values()
    (identifier, [(_, mask), *_]), *_ = log.masks.items()
    frames = [one for one in hosts_frames(path) if one[:2] == identifier.to_bytes(2, "little")]
    size = frames[0][4]
    data = bytes(a ^ b ^ 0xFF for a, b in zip(frames[0][8 : 8 + size], mask, strict=False))
    (folder / "stream.py").write_text(STREAM.format(identifier=identifier, data=data.hex()))
    words = ("replay", str(path), "--as", "device", "--partial", "stream.py")
    assert say(*words)[0] == 1
    assert say(*words, "--set-points", "any")[0] == 0
