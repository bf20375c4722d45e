"""Reassembly of TCP connections under any network behaviour."""

import pytest
from hypothesis import event, given
from hypothesis import strategies as st

from motorhil.traces.formats.tcp import Way, pieces
from tests.support.recordings.captures import ACK, SYN, THERE, ethernet, ip4, ip6, packet, tcp

TEXT = bytes(range(48))


def captured(*segments):
    return [packet(n, ethernet(ip4(segment)), 1) for n, segment in enumerate(segments, 1)]


def joined(found):
    return b"".join(piece.data for piece in found)


@given(st.data(), st.sampled_from([0, 1000, 2**32 - 20]))
def test_sent_bytes_are_there_once_in_order(data, first):
    cuts = sorted(data.draw(st.sets(st.integers(1, len(TEXT) - 1), max_size=6)))
    parts = [
        (low, TEXT[low:high]) for low, high in zip([0, *cuts], [*cuts, len(TEXT)], strict=True)
    ]
    again = data.draw(st.lists(st.sampled_from(parts), max_size=4))
    longer = [(at, TEXT[at : at + len(part) + 2]) for at, part in again]
    overlapping = longer + [
        (max(0, at - 3), TEXT[max(0, at - 3) : at + len(part)]) for at, part in again
    ]
    order = data.draw(st.permutations([*parts, *again, *overlapping]))
    event(f"{len(order)} segments")
    start = tcp(first - 1, b"", SYN)
    found = list(pieces(captured(start, *(tcp(first + at, part) for at, part in order))))
    assert joined(found) == TEXT
    assert all(piece.data for piece in found[1:])
    assert [piece.gap for piece in found] == [-1] + [0] * (len(found) - 1)


def test_longer_of_two_trimmed_segments_is_used():
    parts = (4, b"456"), (5, b"567"), (3, b"345"), (0, b"012")
    segments = [tcp(7 + at, part) for at, part in parts]
    found = list(pieces(captured(tcp(6, b"", SYN), *segments)))
    assert joined(found) == b"01234567"


def test_capture_starting_in_connection_begins_there():
    found = list(pieces(captured(tcp(500, b"abc"), tcp(503, b"def"))))
    assert joined(found) == b"abcdef"
    assert [piece.way for piece in found] == [THERE, THERE]
    assert [piece.time_ns for piece in found] == [1_000_000, 2_000_000]


def test_missing_segment_is_reported_at_end():
    found = list(pieces(captured(tcp(0, b"abc"), tcp(5, b"fgh"))))
    assert [(piece.data, piece.gap) for piece in found] == [(b"abc", 0), (b"fgh", 2)]


def test_missing_segment_is_not_awaited_for_ever():
    def endless():
        yield tcp(0, b"abc")
        for n in range(1000):
            yield tcp(5 + n, b"x")
        raise AssertionError("a thousand segments later nothing was told")

    frames = (packet(n, ethernet(ip4(segment))) for n, segment in enumerate(endless(), 1))
    stream = pieces(frames)
    assert next(stream).data == b"abc"
    assert next(stream).gap == 2


def test_new_connection_on_same_ports_is_separate():
    found = list(pieces(captured(tcp(0, b"abc"), tcp(7000, b"", SYN), tcp(7001, b"new"))))
    assert [(piece.data, piece.gap) for piece in found] == [(b"abc", 0), (b"", -1), (b"new", 0)]


@pytest.mark.parametrize(
    ("data", "link_type"),
    [
        (ethernet(ip4(tcp(0, b"abc"))), 1),
        (ethernet(ip4(tcp(0, b"abc", options=b"\x01" * 12))), 1),
        (ethernet(ip4(tcp(0, b"abc")) + bytes(6)), 1),  # padded to the shortest frame
        (ethernet(ip4(tcp(0, b"abc")), tags=b"\x88\xa8\x00\x05\x81\x00\x00\x07"), 1),
        (bytes(14) + b"\x08\x00" + ip4(tcp(0, b"abc")), 113),
        (b"\x08\x00" + bytes(18) + ip4(tcp(0, b"abc")), 276),
        (b"\x02\x00\x00\x00" + ip4(tcp(0, b"abc")), 0),
        (ip4(tcp(0, b"abc")), 101),
    ],
)
def test_all_encapsulations_are_read(data, link_type):
    assert joined(pieces([packet(1, data, link_type)])) == b"abc"


def test_ipv6_is_read():
    found = list(pieces([packet(1, ethernet(ip6(tcp(0, b"abc")), 0x86DD))]))
    assert [(piece.way, piece.data) for piece in found] == [(Way("::1", 40000, "::2", 502), b"abc")]
    assert str(found[0].way.back) == "::2:502 > ::1:40000"


@pytest.mark.parametrize(
    ("data", "link_type"),
    [
        (ethernet(ip4(bytes(8), kind=17)), 1),  # UDP
        (ethernet(ip4(tcp(0, b"abc"), fragment=0x2000)), 1),
        (ethernet(b"", 0x0806), 1),
        (ethernet(ip4(tcp(0, b"", ACK)[:12])), 1),
        (b"", 1),
        (ip4(tcp(0, b"abc")), 147),  # unknown link type
    ],
)
def test_packet_without_tcp_segment_is_skipped(data, link_type):
    assert list(pieces([packet(1, data, link_type)])) == []


@given(st.lists(st.binary(max_size=80), max_size=5), st.sampled_from([0, 1, 101, 113, 276]))
def test_damage_never_raises(packets, link_type):
    list(pieces(packet(n, data, link_type) for n, data in enumerate(packets, 1)))


def test_longer_of_two_waiting_segments_is_used():
    found = pieces(captured(tcp(0, b"", SYN), tcp(4, b"d"), tcp(4, b"def"), tcp(1, b"abc")))
    assert joined(found) == b"abcdef"
