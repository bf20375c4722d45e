"""Packet captures of all kinds are read as far as they are intact."""

import struct

import pytest
from hypothesis import given
from hypothesis import strategies as st

from motorhil.traces.errors import TraceError
from motorhil.traces.formats.pcap import Capture, PcapngWriter
from motorhil.traces.schema import Direction
from tests.support.recordings.captures import block, enhanced, interface, pcap, section

TWO = [(7, 5, b"first"), (8, 999_999, b"second!")]


def written(tmp_path, data):
    path = tmp_path / "some.pcap"
    path.write_bytes(data)
    return path


def facts(capture):
    return [(p.number, p.time_ns, p.data) for p in capture.packets()]


@pytest.mark.parametrize("order", ["<", ">"])
@pytest.mark.parametrize(("magic", "fraction_ns"), [(0xA1B2C3D4, 1000), (0xA1B23C4D, 1)])
def test_pcap_either_byte_order_and_resolution(tmp_path, order, magic, fraction_ns):
    capture = Capture(written(tmp_path, pcap(TWO, order, magic, link_type=101)))
    assert facts(capture) == [
        (1, 7_000_000_000 + 5 * fraction_ns, b"first"),
        (2, 8_000_000_000 + 999_999 * fraction_ns, b"second!"),
    ]
    assert [packet.link_type for packet in capture.packets()] == [101, 101]
    assert capture.problems == []


def test_bits_beside_link_type_are_ignored(tmp_path):
    capture = Capture(written(tmp_path, pcap(TWO, link_type=0x5000_0001)))  # length of the FCS
    assert {packet.link_type for packet in capture.packets()} == {1}


def test_uncaptured_part_of_packet_is_reported(tmp_path):
    capture = Capture(written(tmp_path, pcap([(0, 0, b"head", 1500)])))
    assert [packet.missing for packet in capture.packets()] == [1496]


@pytest.mark.parametrize("order", ["<", ">"])
def test_pcapng_is_read(tmp_path, order):
    microseconds = enhanced(7_000_005, b"first", order=order)
    data = section(order) + interface(order=order) + microseconds
    data += block(0x0BAD, b"of another kind", order)
    resolution = struct.pack(order + "HHB3x", 9, 1, 9)  # nanoseconds
    offset = struct.pack(order + "HHq", 14, 8, 100)
    end = struct.pack(order + "HH", 0, 0)
    data += interface(101, resolution + offset + end, order) + enhanced(5, b"second", 1, order)
    data += block(3, struct.pack(order + "I", 6) + b"simple", order)
    capture = Capture(written(tmp_path, data))
    assert facts(capture) == [
        (1, 7_000_005_000, b"first"),
        (2, 100_000_000_005, b"second"),
        (3, 0, b"simple"),
    ]
    assert [packet.link_type for packet in capture.packets()] == [1, 101, 1]
    assert capture.problems == []


def test_pcapng_time_units_can_be_powers_of_two(tmp_path):
    options = struct.pack("<HHB3x", 9, 1, 0x80 | 10)  # 1/1024 s
    data = section() + interface(1, options) + enhanced(1536, b"x")
    assert facts(Capture(written(tmp_path, data))) == [(1, 1_500_000_000, b"x")]


def test_pcapng_section_has_own_order_and_interfaces(tmp_path):
    data = section() + interface() + enhanced(1, b"a")
    data += section(">") + interface(101, order=">") + enhanced(2, b"b", order=">")
    capture = Capture(written(tmp_path, data))
    assert [(p.time_ns, p.link_type) for p in capture.packets()] == [(1000, 1), (2000, 101)]


@pytest.mark.parametrize("kind", ["pcap", "pcapng"])
def test_capture_cut_anywhere_is_read_up_to_cut(tmp_path, kind):
    if kind == "pcap":
        head, parts = pcap([]), [pcap([one])[24:] for one in TWO]
    else:
        head, parts = section() + interface(), [enhanced(1, b"first"), enhanced(2, b"second!")]
    whole = head + b"".join(parts)
    for size in range(4, len(whole) + 1):
        capture = Capture(written(tmp_path, whole[:size]))
        found = [packet.data for packet in capture.packets()]
        ends = [len(head), len(head) + len(parts[0]), len(whole)]
        assert found == [b"first", b"second!"][: sum(size >= end for end in ends[1:])]
        at_a_seam = size in ends or (kind == "pcapng" and size == len(section()))
        assert (capture.problems == []) is at_a_seam, size


def test_packet_of_missing_interface_is_skipped(tmp_path):
    data = section() + interface() + enhanced(1, b"a", which=3) + enhanced(2, b"b")
    capture = Capture(written(tmp_path, data))
    assert [packet.data for packet in capture.packets()] == [b"b"]
    assert "interface 3" in capture.problems[0]


@pytest.mark.parametrize("data", [b"", b"GIF89a", b"\x0a\x0d"])
def test_file_other_than_capture_is_refused(tmp_path, data):
    with pytest.raises(TraceError, match=r"some\.pcap: is neither pcap nor pcapng"):
        Capture(written(tmp_path, data))
    with pytest.raises(TraceError, match="cannot be read: no such file"):
        Capture(tmp_path / "missing.pcap")


@given(st.binary(max_size=200), st.sampled_from([pcap(TWO), section() + interface()]))
def test_damage_never_raises(tmp_path_factory, noise, start):
    path = tmp_path_factory.mktemp("damaged") / "some.pcap"
    path.write_bytes(start + noise)
    for packet in Capture(path).packets():
        assert packet.number >= 1


@pytest.mark.parametrize(
    ("offset_s", "bound"), [(-1, "before 1970"), (1 << 35, "beyond the year 2554")]
)
def test_packet_before_or_after_what_a_recording_can_hold_is_skipped(tmp_path, offset_s, bound):
    options = struct.pack("<HHq", 14, 8, offset_s)
    data = (
        section() + interface(1, options) + enhanced(5, b"a") + interface() + enhanced(1, b"b", 1)
    )
    capture = Capture(written(tmp_path, data))
    assert [packet.data for packet in capture.packets()] == [b"b"]
    assert f"a time stamp {bound}: " in capture.problems[0]


def test_name_beyond_the_length_of_an_option_is_refused(tmp_path):
    with (tmp_path / "some.pcapng").open("wb") as file:
        writer = PcapngWriter(file)
        assert writer.interface(227, "a" * 65_535) == 0
        with pytest.raises(TraceError, match="65536 bytes; expected at most 65535; write mcap"):
            writer.interface(227, "a" * 65_536)
        with pytest.raises(TraceError, match="70000 bytes"):
            writer.packet(0, 0, b"", Direction.RECEIVED, "a" * 70_000)
    assert len([*Capture(tmp_path / "some.pcapng").packets()]) == 0
