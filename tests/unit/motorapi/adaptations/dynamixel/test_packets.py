"""The host's codec against bytes of the maker's manual and of the maker's SDK (4.1.0)."""

import pytest

from motorhil.motorapi.adaptations.dynamixel.packets import (
    DynamixelCodec,
    DynamixelRefused,
    Request,
    Status,
    read_of,
    write_of,
)
from motorhil.motorapi.api import Exchange

REQUESTS = [
    (1, Request(1), "FFFFFD0001030001194E"),
    (1, read_of(132, 4), "FFFFFD0001070002840004001D15"),
    (1, write_of(116, b"\0\2\0\0"), "FFFFFD0001090003740000020000CA89"),
    (1, write_of(116, b"\xff\xff\xfd\xff"), "FFFFFD00010A00037400FFFFFDFDFF23E5"),
    (1, Request(8), "FFFFFD00010300082F4E"),
    (254, Request(0x83, bytes.fromhex("740004000196000000 02AA000000")),
     "FFFFFD00FE11008374000400019600000002AA0000008287"),
]  # fmt: skip
STATUSES = [
    ("FFFFFD000107005500060426655D", 3, Status(0, False, bytes.fromhex("060426"))),
    ("FFFFFD000108005580A60000008F7C", 4, Status(0, True, bytes.fromhex("A6000000"))),
    ("FFFFFD000109005500FFFFFDFDFFDA9E", 4, Status(0, False, bytes.fromhex("FFFFFDFF"))),
    ("FFFFFD00010C005500FFFFFDFDFFFFFDFD1916", 6, Status(0, False, bytes.fromhex("FFFFFD" * 2))),
    ("FFFFFD000104005587B30F", 0, Status(7, True, b"")),
]


@pytest.mark.parametrize(("unit", "request_", "expected"), REQUESTS)
def test_request_has_the_bytes_of_the_maker(unit, request_, expected):
    codec = DynamixelCodec("line")
    assert codec.encode(Exchange(request_, unit, 0.1)).hex().upper() == expected


@pytest.mark.parametrize(("data", "count", "expected"), STATUSES)
def test_status_is_found_after_junk_and_echo(data, count, expected):
    codec, exchange = DynamixelCodec("line"), Exchange(Request(2, count=count), 1, 0.1)
    before = bytes.fromhex(
        "00FFFF" + "FFFFFD0001070002840004001D15" + "FFFFFD0002080055001F080000BABE"
    )
    found = [codec.feed(bytes((byte,)), exchange) for byte in before + bytes.fromhex(data)]
    assert found[-1] == expected
    assert set(found[:-1]) == {None}
    assert codec.answers(expected, exchange.request)


def test_status_with_a_wrong_crc_is_no_answer():
    codec, exchange = DynamixelCodec("line"), Exchange(Request(1, count=3), 1, 0.1)
    assert codec.feed(bytes.fromhex("FFFFFD000107005500060426655E"), exchange) is None


def test_status_of_another_length_is_no_answer():
    codec = DynamixelCodec("line")
    assert not codec.answers(Status(0, False, b"\0\0"), read_of(132, 4))


def test_error_of_a_status_names_request_and_reason():
    codec, exchange = DynamixelCodec("line"), Exchange(write_of(11, b"\4"), 1, 0.1)
    error = codec.refusal(exchange, Status(7, False, b""))
    assert isinstance(error, DynamixelRefused)
    assert str(error) == (
        "line unit 1: write at 11 refused: no access: read-only, unknown, or locked while torque is"
        " on (error 7)"
    )
    assert codec.refusal(exchange, Status(0, True, b"")) is None
