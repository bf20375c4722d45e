"""Modbus lines as pcapng, readable by Wireshark and by our reader."""

import shutil
import struct
import subprocess
import tempfile
from pathlib import Path

import pytest
from hypothesis import event, given
from hypothesis import strategies as st

from motorhil.harness.recording.conversion import MODBUS_PCAPNG, convert
from motorhil.traces.can_frame import classic
from motorhil.traces.digest import digest
from motorhil.traces.errors import TraceError
from motorhil.traces.formats.frames import Frame
from motorhil.traces.formats.modbus import RecordedAdu
from motorhil.traces.formats.pcap import Capture
from motorhil.traces.formats.pcap_modbus import AduFeature, record_adus
from motorhil.traces.formats.registry import record_frames
from motorhil.traces.protobuf import encode
from motorhil.traces.schema import MODBUS_ADU, Direction

R, T = Direction.RECEIVED, Direction.TRANSMITTED
S = 1_000_000_000
# Bytes: MODBUS Messaging on TCP/IP V1.0b and MODBUS over Serial Line V1.02, read of 2 registers.
REQUEST = bytes.fromhex("0007 0000 0006 01 03 0010 0002")
RESPONSE = bytes.fromhex("0007 0000 0007 01 03 04 00000001")
RTU_REQUEST = bytes.fromhex("01 03 0010 0002 C5CE")
RTU_RESPONSE = bytes.fromhex("01 03 04 0000 0001 3BF3")


def adu(time_ns, line, direction, sender, data, *, tcp=True, **more):
    values = {"direction": int(direction)} | ({"sender": sender} if sender else {})
    values |= {"start_ns": time_ns, "end_ns": time_ns} | ({"tcp": True} if tcp else {})
    return RecordedAdu(time_ns, line, encode(MODBUS_ADU, values | {"data": data} | more))


def there_and_back(folder, adus):
    """Return the conversion's result, and True if the digest is the same after reading it again."""
    paths = [Path(folder) / name for name in ("a.mcap", "b.pcapng", "c.mcap")]
    record_adus(paths[0], iter(adus), {})
    there = convert(paths[0], paths[1], "pcapng")
    back = convert(paths[1], paths[2], "mcap")
    assert back.findings.problems == []
    return there, digest(paths[0]) == digest(paths[2])


@st.composite
def mbap(draw):
    pdu = draw(st.binary(min_size=1, max_size=253))
    head = struct.pack(">HHHB", draw(st.integers(0, 3)), 0, len(pdu) + 1, draw(st.integers(0, 255)))
    return head + pdu


ADDRESSES = ["10.0.0.1", "141.81.0.10", "fe80::1"]
LINES = st.sampled_from([*ADDRESSES, "gateway", "rs 485"])
SENDERS = st.sampled_from(
    [
        "host",
        "lift",
        "",
        "10.0.0.1:502",
        "10.0.0.9:40000",
        "10.1.0.1:49152",
        "fe80::9:40001",
        "gateway:99999",
        "a:b",
    ]
)
ON_TCP = st.builds(adu, st.integers(0, 2**63 - 1), LINES, st.sampled_from([R, T]), SENDERS, mbap())


@st.composite
def on_a_serial_line(draw):
    data = draw(st.binary(min_size=1, max_size=256))
    way = draw(st.sampled_from([R, T]))
    line = draw(LINES)
    return adu(draw(st.integers(0, 2**63 - 1)), line, way, draw(SENDERS), data, tcp=False)


@given(st.lists(ON_TCP | on_a_serial_line(), min_size=1, max_size=12))
def test_recorded_adus_survive_export(adus):
    with tempfile.TemporaryDirectory() as folder:
        there, same = there_and_back(folder, adus)
    event(f"{len(there.buses)} lines")
    assert there.findings.problems == []
    assert there.lost == {}
    assert same


def test_features_not_stored_are_reported(tmp_path):
    late = adu(9 * S, "rs485", T, "host", RTU_REQUEST, tcp=False, start_ns=1)
    spoiled = adu(10 * S, "rs485", R, "", RTU_RESPONSE, tcp=False, spoiled=True)
    there, same = there_and_back(tmp_path, [late, spoiled])
    assert there.lost == {AduFeature.BIT_TIMES: 1, AduFeature.SPOILED: 1}
    assert not same


@pytest.mark.parametrize(
    ("spoilt", "why"),
    [
        (adu(0, "g", T, "host", REQUEST[:-1]), "5 bytes of an ADU of 6"),
        (adu(0, "g", T, "host", b"\0\1\0\1\0\2\1\3"), "not Modbus/TCP: 00 01 00 01 00 02 01"),
        (adu(0, "g", T, "host", b""), "not Modbus/TCP: "),
        (adu(0, "g", Direction.UNKNOWN, "host", REQUEST), "an ADU without a direction"),
    ],
)
def test_ambiguous_adu_is_omitted_and_reported(tmp_path, spoilt, why):
    there, same = there_and_back(tmp_path, [spoilt, adu(1, "g", T, "host", REQUEST)])
    ((number, text),) = there.findings.problems
    assert number == 1
    assert why in text
    assert not same


def test_frames_and_adus_need_separate_files(tmp_path):
    record_frames(tmp_path / "can.mcap", [Frame(0, "can0", classic(1, b""))], {})
    with pytest.raises(TraceError, match="holds no Modbus"):
        convert(tmp_path / "can.mcap", tmp_path / "x.pcapng", MODBUS_PCAPNG)


@pytest.mark.data
def test_real_capture_survives_export(shared, tmp_path):
    name = "data/traffic/modbus_gateway_units1237_pipelined.pcap"
    convert(shared / name, tmp_path / "a.mcap", "mcap")
    there = convert(tmp_path / "a.mcap", tmp_path / "b.pcapng", "pcapng")
    convert(tmp_path / "b.pcapng", tmp_path / "c.mcap", "mcap")
    assert there.lost == {}
    assert there.findings.problems == []
    assert digest(tmp_path / "a.mcap") == digest(tmp_path / "c.mcap")


# ------------------------------------------------------------------- as read by Wireshark


def internet_sum(data):
    """Return 0 if the check sum in the data is correct (RFC 1071, by its definition)."""
    total = sum(
        int.from_bytes(data[n : n + 2].ljust(2, b"\0"), "big") for n in range(0, len(data), 2)
    )
    return 0xFFFF - total % 0xFFFF if total % 0xFFFF else 0


def test_check_sums_and_sequence_numbers_are_correct(tmp_path):
    adus = [adu(n, "gate", (T, R)[n % 2], "host", (REQUEST, RESPONSE)[n % 2]) for n in range(4)]
    there_and_back(tmp_path, adus)
    packets = [packet.data for packet in Capture(tmp_path / "b.pcapng").packets()]
    for data in packets:
        assert internet_sum(data[14:34]) == 0
        assert internet_sum(data[26:34] + struct.pack(">II", len(data) - 34, 6) + data[34:]) == 0
    numbers = [struct.unpack(">II", data[38:46]) for data in packets]
    assert numbers == [(1, 1), (1, 13), (13, 14), (14, 25)]


@pytest.fixture(scope="module")
def tshark():
    found = shutil.which("tshark")
    if found is None:
        pytest.skip("tshark is not installed: apt-get install tshark")
    return found


def dissected(tshark, path, *fields):
    words = [
        word for field in ("_ws.malformed", "_ws.expert.message", *fields) for word in ("-e", field)
    ]
    command = [tshark, "-n", "-r", str(path), "-T", "fields", "-E", "separator=;", *words]
    command += ["-o", "tcp.check_checksum:TRUE", "-o", "ip.check_checksum:TRUE"]
    command += ["-d", "rtacser.data,mbrtu", "-o", "mbrtu.crc_verification:TRUE"]
    done = subprocess.run(command, capture_output=True, text=True, timeout=200)
    assert done.returncode == 0, done.stderr
    return [line.split(";") for line in done.stdout.splitlines()]


@pytest.mark.parametrize("line", ["gateway", "141.81.0.10", "fe80::1"])
def test_wireshark_reads_modbus_on_tcp(tshark, tmp_path, line):
    adus = [adu(S + n, line, (T, R)[n % 2], "host", (REQUEST, RESPONSE)[n % 2]) for n in range(4)]
    there_and_back(tmp_path, adus)
    names = (
        "frame.time_epoch mbtcp.trans_id modbus.func_code modbus.response_time frame.interface_name"
    )
    rows = dissected(tshark, tmp_path / "b.pcapng", *names.split())
    assert {(row[0], row[1]) for row in rows} == {
        ("", "host")
    }  # comments are "expert" messages, too
    assert [row[2] for row in rows] == [f"1.00000000{n}" for n in range(4)]
    assert [row[3:5] for row in rows] == [["7", "3"]] * 4
    assert [bool(row[5]) for row in rows] == [False, True, False, True]  # paired with requests
    assert [row[6] for row in rows] == [line] * 4


def test_wireshark_reads_serial_line(tshark, tmp_path):
    adus = [
        adu(n, "rs485", way, "", data, tcp=False)
        for n, (way, data) in enumerate(
            [(T, RTU_REQUEST), (R, RTU_RESPONSE), (R, RTU_RESPONSE[:-1])]
        )
    ]
    there_and_back(tmp_path, adus)
    names = "rtacser.eventtype mbrtu.unit_id modbus.func_code mbrtu.crc16.status"
    rows = dissected(tshark, tmp_path / "b.pcapng", *names.split())
    assert [row[2:] for row in rows[:2]] == [["0x03", "1", "3", "1"], ["0x04", "1", "3", "1"]]
    assert rows[2][5] != "1"  # the deliberate error
