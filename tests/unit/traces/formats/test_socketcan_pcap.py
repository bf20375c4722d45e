"""CAN frames in captures. Source: tcpdump.org's link types; verified with tshark if installed."""

import shutil
import struct
import subprocess

import pytest

from motorhil.traces import can_frame
from motorhil.traces.can_frame import classic, flexible, remote
from motorhil.traces.formats import frames as traffic
from motorhil.traces.formats.frames import Findings, Frame
from motorhil.traces.formats.pcap_can import captured_frames, write_pcapng
from motorhil.traces.schema import Direction
from tests.support.recordings.captures import block, enhanced, interface, pcap, section

R, T, U = Direction.RECEIVED, Direction.TRANSMITTED, Direction.UNKNOWN
EXT = 0x1ABCDEF0 | can_frame.EFF
CLASSIC = bytes.fromhex("00000123 02 000000 0102 000000000000")
FD = bytes.fromhex("9ABCDEF0 0C 050000") + bytes(range(12))
RTR = bytes.fromhex("40000123 03 000000")


def read(tmp_path, data):
    path = tmp_path / "some.pcap"
    path.write_bytes(data)
    findings = Findings()
    return [tuple(frame)[:4] for frame in captured_frames(str(path), findings, 1 << 28)], findings


def test_pcap_of_socketcan_is_read(tmp_path):
    packets = [(7, 5, CLASSIC), (7, 6, FD), (7, 7, RTR)]
    frames, findings = read(tmp_path, pcap(packets, magic=0xA1B23C4D, link_type=227))
    assert findings.problems == []
    assert frames == [
        (7_000_000_005, "can0", classic(0x123, b"\1\2"), U),
        (7_000_000_006, "can0", flexible(EXT, 1, bytes(range(12))), U),
        (7_000_000_007, "can0", remote(0x123, 3), U),
    ]


def cooked(link_type, order, kind, protocol):
    """Return a packet of SLL or SLL2: its identifier is in the order of the capturing machine."""
    if link_type == 113:
        head = struct.pack(">HHH8sH", kind, 280, 0, b"", protocol)
    else:
        head = struct.pack(">HHIHBB8s", protocol, 0, 1, 280, kind, 0, b"")
    if protocol == 0x0D:
        return head + struct.pack(order + "IBB2x64s", 0x123, 12, 0, bytes(range(12)))
    return head + struct.pack(order + "IB3x8s", 0x123, 2, b"\1\2")


@pytest.mark.parametrize("link_type", [113, 276])
@pytest.mark.parametrize("order", ["<", ">"])
def test_cooked_capture_has_directions(tmp_path, link_type, order):
    kinds = [(1, 0x0C), (4, 0x0D), (0, 0x0800)]
    packets = [(at, 0, cooked(link_type, order, *one)) for at, one in enumerate(kinds)]
    data = pcap(packets, link_type=link_type, order=order)
    frames, findings = read(tmp_path, data)
    assert [frame[2:] for frame in frames] == [
        (classic(0x123, b"\1\2"), R),
        (flexible(0x123, 0, bytes(range(12))), T),
    ]
    assert findings.notes == ["1 packets are not CAN frames (cooked), and are omitted"]
    if shutil.which("tshark") is not None:
        path = tmp_path / "some.pcap"
        told = subprocess.run(["tshark", "-r", path], capture_output=True, text=True, check=True)
        assert told.stdout.count("(0x123)") == 2


@pytest.mark.parametrize("order", ["<", ">"])
def test_pcapng_has_names_and_directions(tmp_path, order):
    name = struct.pack(order + "HH", 2, 5) + b"drive" + bytes(3) + struct.pack(order + "HH", 0, 0)
    data = section(order) + interface(227, order=order) + interface(227, name, order)
    data += enhanced(5, CLASSIC, 1, order) + enhanced(6, CLASSIC, 0, order)
    head = struct.pack(order + "IIIII", 1, 0, 7, len(CLASSIC), len(CLASSIC))
    flags = struct.pack(order + "HHI", 2, 4, 2)
    data += block(6, head + CLASSIC + flags, order)
    frames, findings = read(tmp_path, data)
    assert findings.problems == []
    assert [(time, bus, way) for time, bus, _, way in frames] == [
        (5000, "drive", U),
        (6000, "can0", U),
        (7000, "drive", T),
    ]


def test_cut_packets_are_reported_and_rest_is_read(tmp_path):
    packets = [(1, 0, CLASSIC), (2, 0, CLASSIC[:9], 16), (3, 0, b"abc"), (4, 0, CLASSIC)]
    frames, findings = read(tmp_path, pcap(packets, link_type=227)[:-3])
    assert len(frames) == 1
    assert [line for line, _ in findings.problems] == [2, 3, 0]
    assert "1 of 2 bytes, which were not captured" in findings.problems[0].text
    assert "3 bytes before the end of a packet" in findings.problems[2].text


@pytest.mark.skipif(shutil.which("tshark") is None, reason="needs tshark")
def test_tshark_reads_written_file(tmp_path):
    path = tmp_path / "out.pcapng"
    told = [
        Frame(1_700_000_000_123_456_789, "can0", classic(0x123, b"\1\2"), R),
        Frame(1_700_000_001_000_000_000, "drive", classic(EXT, b""), T),
        Frame(1_700_000_002_000_000_000, "can0", remote(0x701, 1)),
        Frame(1_700_000_003_000_000_000, "can0", flexible(0x77, 1, bytes(range(12))), R),
        Frame(1_700_000_003_000_000_001, "drive", flexible(EXT, 2, bytes(64)), T),
        Frame(1_700_000_004_000_000_000, "can0", classic(can_frame.ERR | 4, bytes(8)), R),
    ]
    with path.open("wb") as file:
        write_pcapng(file, ["can0", "drive"], iter(told))
    names = "frame.time_epoch frame.interface_name can.id can.len canfd.flags.brs canfd.flags.esi"
    fields = [word for name in names.split() for word in ("-e", name)]
    command = ["tshark", "-r", str(path), "-T", "fields", "-E", "separator=;", *fields]
    done = subprocess.run(command, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    said = done.stdout
    rows = [line.split(";") for line in said.splitlines()]
    assert [row[0] for row in rows] == [traffic.decimal(frame.time_ns) for frame in told]
    assert [row[1] for row in rows] == ["can0", "drive", "can0", "can0", "drive", "can0"]
    assert [int(row[2], 0) for row in rows[:5]] == [0x123, 0x1ABCDEF0, 0x701, 0x77, 0x1ABCDEF0]
    assert [row[3] for row in rows[:5]] == ["2", "0", "1", "12", "64"]
    marks = [[value in ("1", "True") for value in row[4:]] for row in rows]
    assert marks[3:5] == [[True, False], [False, True]]
