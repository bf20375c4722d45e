"""A recorded run in Wireshark's CANopen dissector: nothing malformed, and equal content.

Needs `tshark` (Debian package of that name) in PATH. Record, mcap's own reader, pcap, tshark:
between the bus and the dissector, only the recorder is our code.
"""

import struct
from collections import Counter
from collections.abc import Iterator
from pathlib import Path

import pytest
from mcap.reader import make_reader
from mcap_protobuf.decoder import DecoderFactory

from motorhil.harness.rig.config.scaffold import EXAMPLES
from motorhil.harness.rig.rig import Rig
from motorhil.motorapi import ControlMode, Motor, TrapezoidalTrajectory
from tests.support.cia402.bench import Bench
from tests.support.dissector import COLUMNS, capture, collect_sent, complaints, dissected
from tests.support.dissector import tshark as program

FIELDS = (
    "canopen.node_id",
    "canopen.nmt_ctrl.cd",
    "canopen.nmt_guard.state",
    "canopen.em.err_code",
    "canopen.em.err_reg",
    "canopen.sdo.main_idx",
    "canopen.sdo.abort_code",
)


@pytest.fixture(scope="module")
def tshark() -> str:
    found = program()
    if found is None:
        pytest.skip("tshark is not installed: apt-get install tshark")
    return found


@pytest.fixture(scope="module")
def run(tmp_path_factory: pytest.TempPathFactory, tshark: str) -> list[dict[str, str]]:
    """Run bring-up, a joint motion, homing, fault, reset, an abort and a reboot: row by row."""
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
        left.hardware.node.bus.nmt(0x81, 2)
        rig.runtime.run_for(0.5)
    (folder / "run.pcap").write_bytes(capture(frames_of(folder / "run.mcap")))
    return dissected(tshark, folder / "run.pcap", (*COLUMNS, *FIELDS))


def frames_of(record: Path) -> Iterator[bytes]:
    with record.open("rb") as file:
        reader = make_reader(file, decoder_factories=[DecoderFactory()])
        for _, _, _, can in reader.iter_decoded_messages(topics=["/can/can0"]):
            assert not can.extended
            assert not can.remote
            yield struct.pack("<IB3x8s", can.id, len(can.data), can.data)


def test_every_frame_is_well_formed_canopen(run):
    assert len(run) > 400
    assert all(row["canopen.function_code"] for row in run)
    assert [row for row in run if row["_ws.malformed"] or row["_ws.expert.message"]] == []


@pytest.mark.parametrize(
    ("frame", "fault"),
    [
        ((0x581, b"\x43\x00"), "Malformed"),  # an SDO of two bytes
        ((0x081, b"\x10\x81\x11"), "Malformed"),  # an EMCY of three
        ((0x701, b"\x05\x00"), "error control of 2 bytes"),
        ((0x7A1, bytes(8)), "not CANopen"),
    ],
)
def test_planted_foreign_frame_is_detected(tshark, tmp_path, frame, fault):
    good = [(0x581, bytes.fromhex("4300100092010200")), (0x181, b"\x50\x02"), (0x701, b"\x00")]
    sent = [struct.pack("<IB3x8s", can_id, len(data), data) for can_id, data in (*good, frame)]
    (told,) = complaints(tshark, sent, tmp_path)
    assert told.startswith(f"{frame[0]:03X}#{frame[1].hex().upper()}: ")
    assert fault in told


@pytest.mark.pure("compiled cores cannot be tapped")
def test_every_kind_of_node_frame_is_collected():
    sent: set[bytes] = set()
    end = collect_sent(sent)
    bench = Bench()
    bench.operational()
    end()
    assert sent >= {
        struct.pack("<IB3x8s", can_id, len(data), data) for _, can_id, data in bench.sent
    }
    assert len(sent) > 1
    before = len(sent)
    bench.enable()
    assert len(sent) == before


def values(run: list[dict[str, str]], field: str, node: int) -> list[int]:
    wanted = f"{node:#010x}"
    return [int(r[field], 16) for r in run if r[field] and r["canopen.node_id"] == wanted]


def test_wireshark_content_equals_recording(run):
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
    # the host's first requests met a booting drive; it has every requested object
    assert set(values(run, "canopen.sdo.abort_code", 1)) == {0x0504_0000}
    read = values(run, "canopen.sdo.main_idx", 1)
    assert {0x1000, 0x1018, 0x1017, 0x6040, 0x6502} <= set(read)
