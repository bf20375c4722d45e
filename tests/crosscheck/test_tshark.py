"""A recorded run as Wireshark's CANopen dissector reads it: nothing malformed, and the same story.

Needs `tshark` (Debian package of that name) in PATH. Record, mcap's own reader, pcap, tshark: no
code of ours touches the frames between the bus and the dissector but the recorder.
"""

import shutil
import struct
import subprocess
from collections import Counter
from pathlib import Path

import pytest
from mcap.reader import make_reader
from mcap_protobuf.decoder import DecoderFactory

from harness.rig import Rig
from harness.scaffold import EXAMPLES
from motorapi import ControlMode, Motor, TrapezoidalTrajectory

FIELDS = (
    "canopen.function_code",
    "canopen.node_id",
    "canopen.nmt_ctrl.cd",
    "canopen.nmt_guard.state",
    "canopen.em.err_code",
    "canopen.em.err_reg",
    "canopen.sdo.main_idx",
    "canopen.sdo.abort_code",
)
LINKTYPE_CAN_SOCKETCAN = 227  # identifier in network byte order, see pcap-linktype


@pytest.fixture(scope="module")
def tshark() -> str:
    found = shutil.which("tshark")
    if found is None:
        pytest.skip("tshark is not installed: apt-get install tshark")
    return found


@pytest.fixture(scope="module")
def run(tmp_path_factory: pytest.TempPathFactory, tshark: str) -> list[dict[str, str]]:
    """Bring-up, a move together, homing, fault, reset, an abort, a reboot: row by row."""
    folder = tmp_path_factory.mktemp("tshark")
    with Rig.open(EXAMPLES / "two_wheels.toml", record=folder / "run.mcap") as rig:
        group = rig.groups["both"]
        group.for_each(Motor.enable)
        group.for_each(Motor.set_control_mode, ControlMode.TRAJECTORY)
        group.set_trajectory(TrapezoidalTrajectory(0.3), TrapezoidalTrajectory(-0.2))
        group.start()
        group.wait_until_done(10)
        left = rig.motors["left"]
        left.home(37)
        left.wait_until_done(1)
        rig.controllers["left"].stimulate("fault", 0x2310)
        rig.runtime.run_for(0.1)
        left.reset_fault()
        left.hardware.link.nmt(0x81, 2)
        rig.runtime.run_for(0.5)
    to_pcap(folder / "run.mcap", folder / "run.pcap")
    return dissected(tshark, folder / "run.pcap")


def to_pcap(record: Path, target: Path) -> None:
    rows = [struct.pack("<IHHiIII", 0xA1B23C4D, 2, 4, 0, 0, 65535, LINKTYPE_CAN_SOCKETCAN)]
    with record.open("rb") as file:
        reader = make_reader(file, decoder_factories=[DecoderFactory()])
        for _, _, message, can in reader.iter_decoded_messages(topics=["/can/can0"]):
            assert not can.extended
            assert not can.remote
            packet = struct.pack(">IB3x", can.id, len(can.data)) + can.data
            seconds, rest_ns = divmod(message.log_time, 1_000_000_000)
            rows.append(struct.pack("<IIII", seconds, rest_ns, len(packet), len(packet)) + packet)
    target.write_bytes(b"".join(rows))


def dissected(tshark: str, path: Path) -> list[dict[str, str]]:
    columns = ("_ws.malformed", "_ws.expert.message", *FIELDS)
    command = [tshark, "-n", "-r", str(path), "-d", "can.subdissector,canopen", "-T", "fields"]
    for column in columns:
        command += ["-e", column]
    done = subprocess.run(command, capture_output=True, text=True, timeout=60, check=True)
    return [dict(zip(columns, line.split("\t"), strict=True)) for line in done.stdout.splitlines()]


def test_every_frame_is_canopen_and_none_is_malformed(run):
    assert len(run) > 400
    assert all(row["canopen.function_code"] for row in run)
    assert [row for row in run if row["_ws.malformed"] or row["_ws.expert.message"]] == []


def test_the_planted_fault_a_cut_off_frame_is_malformed(tshark, tmp_path):
    cut = struct.pack(">IB3x", 0x601, 2) + bytes.fromhex("4000")
    head = struct.pack("<IHHiIII", 0xA1B23C4D, 2, 4, 0, 0, 65535, LINKTYPE_CAN_SOCKETCAN)
    path = tmp_path / "cut.pcap"
    path.write_bytes(head + struct.pack("<IIII", 0, 0, len(cut), len(cut)) + cut)
    (row,) = dissected(tshark, path)
    assert row["_ws.malformed"]


def values(run: list[dict[str, str]], field: str, node: int) -> list[int]:
    wanted = f"{node:#010x}"
    return [int(r[field], 16) for r in run if r[field] and r["canopen.node_id"] == wanted]


def test_wireshark_tells_the_same_story(run):
    emergencies = [values(run, field, 1) for field in ("canopen.em.err_code", "canopen.em.err_reg")]
    assert emergencies == [[0x2310, 0x0000], [0x03, 0x00]]
    assert values(run, "canopen.em.err_code", 2) == []
    beats = Counter(values(run, "canopen.nmt_guard.state", 2))
    assert beats[0x00] == 2  # boot-ups: power-on and reset node
    assert set(beats) == {0x00, 0x7F, 0x05}
    assert set(Counter(values(run, "canopen.nmt_guard.state", 127))) == {0x05}  # the host
    commands = [int(r["canopen.nmt_ctrl.cd"], 16) for r in run if r["canopen.nmt_ctrl.cd"]]
    assert commands.count(0x81) == 1
    assert set(commands) == {0x80, 0x01, 0x81}
    # the drive has no such object; and the host's first questions met a drive that still booted
    assert set(values(run, "canopen.sdo.abort_code", 1)) == {0x0602_0000, 0x0504_0000}
    read = values(run, "canopen.sdo.main_idx", 1)
    assert {0x1000, 0x1018, 0x1017, 0x6040, 0x6502} <= set(read)
