"""SocketCAN error messages in words, compared with linux/can/error.h and Wireshark."""

import shutil
import struct
import subprocess

import pytest
from hypothesis import given
from hypothesis import strategies as st

from motorhil.harness.cli.main import main
from motorhil.harness.replay.verdict import meaning_in
from motorhil.traces.can_frame import ERR, classic, flexible
from motorhil.traces.decoding.can_errors import bus_error
from motorhil.traces.decoding.canopen import CanopenDecoder
from motorhil.traces.decoding.narrative import Story
from motorhil.traces.formats.frames import Frame
from motorhil.traces.formats.pcap_can import write_pcapng
from motorhil.traces.mcap.reader import read_trace
from motorhil.traces.mcap.writer import TraceWriter
from motorhil.traces.schema import CAN_FRAME, Direction, Schema
from motorhil.traces.semantics.diff import Tolerance, differences, told_by_nodes

RIG = b'[bus.can0]\nbitrate_bit_s = 500_000\n[controller.left]\nbus = "can0"\nnode_id = 3\n'
TOLD = [
    (0x204, "0020000000008000", "error passive by sending (TEC 128, REC 0)"),
    (0x204, "001000000000007F", "error passive by receiving (TEC 0, REC 127)"),
    (0x004, "0030000000000000", "error passive"),
    (0x204, "0008000000006000", "error warning by sending (TEC 96, REC 0)"),
    (0x004, "0004000000000000", "error warning by receiving"),
    (0x204, "004000000000005F", "error active again (TEC 0, REC 95)"),
    (0x004, "0001000000000000", "receive buffer overflow"),
    (0x004, "0002000000000000", "transmit buffer overflow"),
    (0x004, "0000000000000000", "controller problem"),
    (0x240, "000000000000FF00", "bus-off (TEC 255, REC 0)"),
    (0x040, "0000000000000000", "bus-off"),
    (0x100, "0000000000000000", "restarted"),
    (0x0A8, "0000801900000000", "bus error while sending, in the ACK slot, no acknowledgement"),
    (0x088, "0000021800000000", "form error while receiving, in the CRC delimiter"),
    (0x088, "0000040A00000000", "stuff error while receiving, in the data"),
    (0x088, "0000880F00000000", "no dominant bit could be sent while sending, in the ident"),
    (0x008, "0000900200000000", "no recessive bit could be sent while sending, in the ident"),
    (0x088, "0000010000000000", "bit error while receiving"),
    (0x080, "0000000000000000", "bus error"),
    (0x002, "0700000000000000", "arbitration lost in bit 7"),
    (0x002, "0000000000000000", "arbitration lost"),
    (0x001, "0000000000000000", "transmission timed out"),
    (0x010, "0000000074000000", "transceiver: CANH no wire, CANL short to ground"),
    (0x400, "0000000000000000", "class 400h"),
]


def frame(classes, data):
    return classic(ERR | classes, bytes.fromhex(data))


@pytest.mark.parametrize(("classes", "data", "words"), TOLD)
def test_error_message_in_words(classes, data, words):
    told = bus_error(frame(classes, data))
    assert (told.text + told.counted).startswith(words)
    said = CanopenDecoder().decode(frame(classes, data))
    assert said.text.startswith(f"error frame: {words}")


def test_error_message_names_node_and_sender():
    decoder = CanopenDecoder({3: "left"})
    said = decoder.decode(frame(0x204, "0020000000008000"), "left")
    assert said.node == 3
    assert said.text == "error frame of left (3): error passive by sending (TEC 128, REC 0)"
    said = decoder.decode(frame(0x040, "00" * 8), "host")
    assert (said.node, said.text) == (None, "error frame of host: bus-off")


@given(st.integers(0, 0x1FFF_FFFF), st.binary(max_size=8), st.sampled_from([16, 72]))
def test_any_error_message_or_long_frame_is_decoded(can_id, data, size):
    whole = struct.pack("<IB3x", can_id | ERR, len(data)) + data
    said = CanopenDecoder().decode(whole.ljust(size, b"\0"), "left")
    assert said.text != "error frame of left: "
    assert all(fact.text for fact in said.facts)
    assert CanopenDecoder().decode(whole[:3] + b"\0" + whole[4:].ljust(68, b"\0")).text


_WIRESHARK = {  # Wireshark's field, and our words for the same
    "can.err.busoff": "bus-off",
    "can.err.restarted": "restarted",
    "can.err.ack": "no acknowledgement",
    "can.err.lostarb": "arbitration lost",
    "can.err.tx_timeout": "timed out",
    "can.err.ctrl.rx_overflow": "receive buffer overflow",
    "can.err.ctrl.tx_overflow": "transmit buffer overflow",
    "can.err.ctrl.active": "error active again",
    "can.err.prot.type.bit": "bit error",
    "can.err.prot.type.form": "form error",
    "can.err.prot.type.stuff": "stuff error",
    "can.err.prot.type.bit0": "no dominant bit",
    "can.err.prot.type.bit1": "no recessive bit",
    "can.err.prot.type.overload": "overload",
    "can.err.prot.type.tx": "while sending",
}


@pytest.mark.skipif(shutil.which("tshark") is None, reason="needs tshark")
def test_wireshark_decodes_each_bit_the_same(tmp_path):
    """All bits of each byte, one by one; without counters, a class since Linux 5.19."""
    ones = [frame(classes & 0x1FF, data) for classes, data, _ in TOLD if classes & 0x1FF]
    ones += [frame(0x004, f"00{1 << bit:02x}" + "00" * 6) for bit in range(7)]
    ones += [frame(0x088, f"0000{1 << bit:02x}" + "00" * 5) for bit in range(8)]
    path = tmp_path / "a.pcapng"
    with path.open("wb") as file:
        write_pcapng(file, ["can0"], iter(Frame(1, "can0", one) for one in ones))
    fields = [word for name in _WIRESHARK for word in ("-e", name)]
    done = subprocess.run(
        ["tshark", "-n", "-r", str(path), "-T", "fields", "-E", "separator=;", *fields],
        capture_output=True,
        text=True,
        check=True,
    )
    rows = [line.split(";") for line in done.stdout.splitlines()]
    assert len(rows) == len(ones)
    seen = set()
    for row, one in zip(rows, ones, strict=True):
        text = bus_error(one).text
        for value, (name, words) in zip(row, _WIRESHARK.items(), strict=True):
            assert (value in ("1", "True")) is (words in text), (one.hex(), name, text)
            if value in ("1", "True"):
                seen.add(name)
    assert seen == set(_WIRESHARK)


def recorded(path, *told):
    """Record (error message or frame, sender) at 1 s, 2 s, ... on a bus with a drive "left"."""
    with TraceWriter(path, {"run": {}}) as writer:
        writer.attach("one.toml", RIG, "application/toml")
        bus = writer.channel("/can/can0", Schema.of(CAN_FRAME))
        for second, (one, sender) in enumerate(told, 1):
            source = writer.source(bus, sender, Direction.RECEIVED)
            writer.extend([(source, second * 1_000_000_000, one)])
    return path


PASSIVE = frame(0x204, "0020000000008000")
PASSIVE_132 = frame(0x204, "0020000000008400")
OFF = frame(0x240, "000000000000FF00")


def test_story_error_message_names_node_without_identifier(tmp_path, capsys):
    path = str(recorded(tmp_path / "a.mcap", (PASSIVE, "left"), (classic(0x204, b""), "left")))
    with read_trace(path) as trace:
        error, plain = Story(trace).lines()
    assert (error.identifier, error.names, error.said.node) == (None, ("left",), 3)
    assert plain.identifier == 0x204
    assert main(["show", path, "--node", "3"]) == 0
    assert capsys.readouterr().out == (
        "    1.000000000  can0      error frame of left (3): "
        "error passive by sending (TEC 128, REC 0)\n"
    )
    assert main(["show", path, "--id", "204"]) == 0
    assert capsys.readouterr().out.count("\n") == 1


def test_semantic_diff_compares_states_not_counters(tmp_path):
    one = meaning_in(recorded(tmp_path / "a.mcap", (PASSIVE, "left"), (PASSIVE, "host")), "diff")
    same = meaning_in(
        recorded(tmp_path / "b.mcap", (PASSIVE_132, "left"), (PASSIVE, "host")), "diff"
    )
    other = meaning_in(recorded(tmp_path / "c.mcap", (PASSIVE, "left"), (OFF, "host")), "diff")
    assert differences(one, same, Tolerance()) == []
    (found,) = differences(one, other, Tolerance())
    assert str(found) == (
        "can0, CAN controller of host: CAN controller of host = error passive by sending "
        "(TEC 128, REC 0) at 2.000000 s, but CAN controller of host = bus-off "
        "(TEC 255, REC 0) at 2.000000 s"
    )
    assert told_by_nodes(other).items == {}


def test_fd_frame_is_decoded_completely():
    data = bytes(range(64))
    said = CanopenDecoder().decode(flexible(0x181, 3, data))
    assert said.text == f"id 181h CAN FD BRS ESI, 64 bytes: {data.hex(' ').upper()}"
    assert CanopenDecoder().decode(flexible(0x181, 0, b"")).text == (
        "id 181h CAN FD, 0 bytes: no data"
    )
