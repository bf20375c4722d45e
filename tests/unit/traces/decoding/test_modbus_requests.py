"""Modbus from captures: ADUs, malformed data, requests with their responses."""

from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st

from motorhil.traces.formats.modbus import Adu, Malformed, adus
from motorhil.traces.formats.pcap import Capture
from motorhil.traces.formats.tcp import Piece, pieces
from tests.support.recordings.captures import THERE
from tests.unit.traces.formats.pairing import paired

BACK = THERE.back


def mbap(transaction, unit, pdu, protocol=0, length=None):
    data = bytes.fromhex(pdu)
    size = len(data) + 1 if length is None else length
    head = b"".join(number.to_bytes(2, "big") for number in (transaction, protocol, size))
    return head + bytes((unit,)) + data


def sent(*parts, way=THERE):
    """Return pieces of one direction, a millisecond apart."""
    return [Piece(way, n * 1_000_000, data, n, 0) for n, data in enumerate(parts, 1)]


READ = mbap(1, 2, "03 0000 0001")


@given(st.sets(st.integers(1, 2 * len(READ) - 1), max_size=5))
def test_adu_in_pieces_and_several_in_one_are_found(cuts):
    stream, at = READ + READ, sorted(cuts)
    parts = [stream[low:high] for low, high in zip([0, *at], [*at, len(stream)], strict=True)]
    found = list(adus(sent(*parts)))
    assert [(adu.unit, adu.transaction, adu.pdu.hex()) for adu in found] == [
        (2, 1, "0300000001")
    ] * 2
    assert found[-1].time_ns == len(parts) * 1_000_000


def test_direction_follows_from_port():
    (request,), (response,) = adus(sent(READ)), adus(sent(mbap(1, 2, "83 02"), way=BACK))
    assert request.to_server
    assert not request.is_exception
    assert response.is_exception
    assert list(adus(sent(READ), port=1502)) == []


@pytest.mark.parametrize(
    "bad", [mbap(1, 2, "03", protocol=16), mbap(1, 2, "03", length=0), mbap(1, 2, "03", length=255)]
)
def test_invalid_header_is_reported_next_segment_read(bad):
    found = list(adus(sent(bad + READ, READ)))
    assert [type(one) for one in found] == [Malformed, Adu]
    assert found[0].data == bad + READ


def test_bytes_after_an_adu_do_not_affect_the_next():
    found = list(adus(sent(READ + b"\x01\x02", READ)))
    assert [type(one) for one in found] == [Adu, Malformed, Adu]


def test_missing_bytes_within_adu_are_reported():
    first, second = sent(READ[:8], READ)
    gap = Piece(second.way, second.time_ns, second.data, second.packet, 4)
    assert [type(one) for one in adus([first, gap])] == [Malformed, Adu]
    assert [type(one) for one in adus([first])] == [Malformed]


def adu(transaction, pdu, to_server=True, unit=1, time_ns=0):
    way = THERE if to_server else BACK
    return Adu(time_ns, way, to_server, transaction, unit, bytes.fromhex(pdu))


def test_responses_can_come_in_any_order():
    asked = [adu(n, f"03 {n:04X} 0001") for n in (1, 2, 3)]
    answers = [adu(n, "03 02 0000", False, time_ns=n * 1000) for n in (3, 1)]
    found = paired([*asked, *answers])
    assert [exchange.delay_s for exchange in found.exchanges] == [1e-6, None, 3e-6]
    assert (found.answered, found.reused, found.strays) == (2, 0, ())


def test_reused_transaction_is_reported():
    found = paired([adu(1, "03 0000 0001"), adu(1, "03 0005 0001"), adu(1, "03 02 0000", False)])
    assert [(e.response is not None, e.reused) for e in found.exchanges] == [
        (False, True),
        (True, False),
    ]


@pytest.mark.parametrize(
    "answer",
    [adu(2, "03 02 0000", False), adu(1, "04 02 0000", False), adu(1, "03 02 0000", False, 7)],
)
def test_response_to_another_request_is_stray(answer):
    found = paired([adu(1, "03 0000 0001"), answer])
    assert found.strays == (answer,)
    assert found.answered == 0


# --- real captures, described in ../shared/data/traffic/INDEX.md


def read(shared: Path, name: str):
    capture = Capture(shared / "data/traffic" / f"{name}.pcap")
    packets = list(capture.packets())
    found = list(adus(pieces(packets)))
    assert capture.problems == []
    return packets, found


@pytest.mark.data
def test_real_gateway_with_requests_in_flight(shared):
    packets, found = read(shared, "modbus_gateway_units1237_pipelined")
    pairing = paired(found)
    assert len(packets) == 4901
    assert len(pairing.exchanges) == 2382
    assert pairing.answered == 1592
    assert {exchange.request.unit for exchange in pairing.exchanges} == {1, 2, 3, 7}
    assert {exchange.request.pdu[0] for exchange in pairing.exchanges} == {3, 4}
    delays = sorted(e.delay_s for e in pairing.exchanges if e.delay_s is not None)
    assert f"{delays[len(delays) // 2]:.2f} {delays[-1]:.1f}" == "0.45 5.1"
    # INDEX treats all connections between two addresses as one: 120 identifiers reused while
    # unanswered there, and 670 never answered
    assert len(pairing.exchanges) - pairing.answered == 120 + 670


@pytest.mark.data
def test_real_plant(shared):
    packets, found = read(shared, "modbus_plant1_tcp")
    pairing = paired(found)
    assert len(packets) == 15387
    assert sum(len(p.data) > 54 and _has_payload(p.data) for p in packets) == 11889
    assert not any(isinstance(one, Malformed) for one in found)
    assert {exchange.request.pdu[0] for exchange in pairing.exchanges} == {1, 2, 4, 15, 16}
    assert len({e.request.way.target for e in pairing.exchanges if e.request.way}) > 10
    assert not any(adu.is_exception for adu in found if isinstance(adu, Adu))
    assert (len(pairing.exchanges), pairing.answered, len(pairing.strays)) == (7990, 7983, 3)


@pytest.mark.data
def test_real_capture_with_crafted_errors(shared):
    packets, found = read(shared, "modbus_quickdraw_part1")
    assert len(packets) == 118
    assert sum(_has_payload(p.data) for p in packets) == 50
    assert sum(adu.is_exception for adu in found if isinstance(adu, Adu)) == 14
    told = [one.problem for one in found if isinstance(one, Malformed)]
    assert len(told) == 6
    assert sum("protocol 0, length 34820" in problem for problem in told) == 2
    assert sum("protocol 16" in problem for problem in told) == 2


def _has_payload(frame: bytes) -> bool:
    """Return True if an Ethernet frame with IPv4 and TCP carries payload."""
    ip = frame[14:]
    head = (ip[0] & 15) * 4
    return int.from_bytes(ip[2:4], "big") - head - (ip[head + 12] >> 4) * 4 > 0
