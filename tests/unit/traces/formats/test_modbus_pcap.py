"""Conversion of captured Modbus/TCP. Bytes: MODBUS Messaging on TCP/IP V1.0b."""

import pytest

from motorhil.harness.recording.conversion import convert
from motorhil.traces.errors import TraceError
from motorhil.traces.mcap.reader import read_trace
from motorhil.traces.protobuf import decode
from motorhil.traces.schema import MODBUS_ADU, Direction
from tests.support.recordings.captures import SYN, ethernet, ip4, pcap, tcp

REQUEST = bytes.fromhex("0007 0000 0006 01 03 0010 0002")
RESPONSE = bytes.fromhex("0007 0000 0007 01 03 04 00000001")


def there(sequence, data, flags=0x10):
    return ethernet(ip4(tcp(sequence, data, flags)))


def back(sequence, data, flags=0x10):
    segment = tcp(sequence, data, flags, source=502, target=40000)
    return ethernet(ip4(segment, source="10.0.0.2", target="10.0.0.1"))


@pytest.fixture
def capture(tmp_path):
    path = tmp_path / "some.pcap"
    packets = [there(9, b"", SYN), back(99, b"", SYN), there(10, REQUEST[:5])]
    packets += [there(15, REQUEST[5:]), back(100, RESPONSE), there(22, b"\0\1\0\1\0\6\1\3")]
    path.write_bytes(pcap([(n, 0, packet) for n, packet in enumerate(packets)]))
    return path


def test_every_adu_is_recorded_as_on_the_wire(tmp_path, capture):
    done = convert(capture, tmp_path / "a.mcap", "mcap")
    assert done.buses == ("10.0.0.2",)
    assert done.findings.frames == 2
    ((packet, why),) = done.findings.problems
    assert packet == 6
    assert "protocol 1" in why
    with read_trace(tmp_path / "a.mcap") as trace:
        found = [(c.topic, t, decode(MODBUS_ADU, payload)) for c, t, payload in trace.messages()]
    assert [(topic, time_ns) for topic, time_ns, _ in found] == [
        ("/modbus/10.0.0.2", 3_000_000_000),
        ("/modbus/10.0.0.2", 4_000_000_000),
    ]
    assert [adu["data"] for _, _, adu in found] == [REQUEST, RESPONSE]
    assert [adu["direction"] for _, _, adu in found] == [Direction.TRANSMITTED, Direction.RECEIVED]
    assert [adu["sender"] for _, _, adu in found] == ["10.0.0.1:40000", "10.0.0.2:502"]
    assert all(adu["tcp"] for _, _, adu in found)


def test_can_format_cannot_store_modbus(tmp_path, capture):
    with pytest.raises(TraceError, match=r"holds Modbus, which asc cannot; .* mcap or pcapng"):
        convert(capture, tmp_path / "a.asc", "asc")


def test_capture_without_can_or_modbus_is_refused(tmp_path):
    (tmp_path / "other.pcap").write_bytes(pcap([(0, 0, ethernet(b"?", kind=0x88CC))]))
    with pytest.raises(TraceError, match="neither CAN frames nor Modbus"):
        convert(tmp_path / "other.pcap", tmp_path / "a.mcap", "mcap")


@pytest.mark.data
@pytest.mark.parametrize(
    ("name", "adus", "problems"),
    [  # of the gateway: 2382 requests, 1592 responses (INDEX), and one unsolicited response
        ("modbus_gateway_units1237_pipelined", 2382 + 1592 + 1, 0),
        ("modbus_quickdraw_part1", 46, 6),
        # INDEX counts packets with data: 11889; many contain several ADUs, and tshark counts 15976
        ("modbus_plant1_tcp", 15976, 0),
    ],
)
def test_real_capture_has_expected_adus(shared, tmp_path, name, adus, problems):
    done = convert(shared / f"data/traffic/{name}.pcap", tmp_path / "a.mcap", "mcap")
    assert (done.findings.frames, len(done.findings.problems)) == (adus, problems)
