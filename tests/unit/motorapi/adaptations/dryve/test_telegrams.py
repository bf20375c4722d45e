"""Telegrams to a dryve D1.

Expected bytes: igus, Operating Manual dryve D1 V2.4, pages 104, 105 and 110, and igus's sample
program of 2020-12-04.
"""

import pytest

from motorhil.motorapi.adaptations.dryve.hardware import written
from motorhil.motorapi.adaptations.dryve.telegrams import (
    DryveCodec,
    DryveException,
    Request,
    data_of,
)
from motorhil.motorapi.api import Exchange

STATUS = Request(0x6041, 0, 2)
ANSWER = "0F0F 0000 000F 00 2B0D 00 00 00 6041 00 0000 00 02 4006"


def of(request, transaction=0x0F0F, unit=0):
    exchange = Exchange(request, unit, 0.1)
    exchange.transaction = transaction
    return exchange


@pytest.mark.parametrize(
    ("request_", "telegram"),
    [
        (STATUS, "0000 0000 000D 00 2B 0D 00 00 00 6041 00 0000 00 02"),
        (Request(0x6061, 0, 1), "0000 0000 000D 00 2B 0D 00 00 00 6061 00 0000 00 01"),
        (Request(0x60FD, 0, 4), "0000 0000 000D 00 2B 0D 00 00 00 60FD 00 0000 00 04"),
        *(
            (
                written((0x6040, 0, 2), word),
                f"0000 0000 000F 00 2B 0D 01 00 00 6040 00 0000 00 02 {data}",
            )
            for word, data in (
                (0x0006, "06 00"),
                (0x0007, "07 00"),
                (0x000F, "0F 00"),
                (0x001F, "1F 00"),
                (0x010F, "0F 01"),
                (0x0100, "00 01"),
                (0x0080, "80 00"),
            )
        ),
        (written((0x6060, 0, 1), 6), "0000 0000 000E 00 2B 0D 01 00 00 6060 00 0000 00 01 06"),
        *(
            (
                written((index, subindex, 4), value),
                f"0000 0000 0011 00 2B 0D 01 00 00 {index:04X} {subindex:02X} 0000 00 04 {data}",
            )
            for index, subindex, value, data in (
                (0x6092, 1, 5400, "18 15 00 00"),
                (0x6099, 1, 6000, "70 17 00 00"),
                (0x609A, 0, 100_000, "A0 86 01 00"),
                (0x6081, 0, 15_000, "98 3A 00 00"),
                (0x6083, 0, 50_000, "50 C3 00 00"),
                (0x607A, 0, 25_000, "A8 61 00 00"),
            )
        ),
    ],
)
def test_request_is_telegram_of_the_maker(request_, telegram):
    assert DryveCodec("line").encode(of(request_, 0)) == bytes.fromhex(telegram)


@pytest.mark.parametrize(
    ("request_", "answer", "data"),
    [
        (STATUS, ANSWER, "40 06"),
        (STATUS, ANSWER.replace("0F0F", "0000", 1), "40 06"),  # transaction not repeated
        (STATUS, ANSWER.replace("000F 00", "000F FF", 1), "40 06"),  # other unit
        (
            Request(0x60FD, 0, 4),
            "0F0F 0000 0011 00 2B0D 000000 60FD000000 00 04 08004200",
            "08004200",
        ),
        (Request(0x6098, 0, 4), "0F0F 0000 000E 00 2B0D 000000 6098000000 00 01 25", "25"),
        (written((0x6060, 0, 1), 6), "0F0F 0000 000D 00 2B0D 010000 6060000000 00 00", ""),
        (written((0x6060, 0, 1), 6), "0F0F 0000 000E 00 2B0D 010000 6060000000 00 01 06", "06"),
    ],
)
@pytest.mark.parametrize("cut", [0, 1, 7, 13])
def test_answer_is_accepted_in_pieces(request_, answer, data, cut):
    codec, exchange = DryveCodec("line"), of(request_)
    adu = bytes.fromhex(answer)
    first = codec.feed(adu[:cut], exchange)
    found = codec.feed(adu[cut:], exchange)
    assert first is None
    assert found is not None
    assert codec.answers(found, request_)
    assert data_of(found) == bytes.fromhex(data)
    assert codec.refusal(exchange, found) is None
    assert not codec.is_inside


@pytest.mark.parametrize(
    "answer",
    [
        ANSWER.replace("6041", "6061"),  # other object
        ANSWER.replace("2B0D 00", "2B0D 01"),  # to a write
        "0F0F 0000 0010 00 2B0D 000000 6041000000 00 03 400600",  # longer than asked
        ANSWER.replace("00 02 4006", "00 01 4006"),  # byte count unlike the data
        "0F0F 0000 0004 00 2B0D 00",
        "0F0F 0000 0002 00 AB",
        "0F0F 0000 0003 00 8301",
    ],
)
def test_other_answer_is_not_taken(answer):
    codec = DryveCodec("line")
    found = codec.feed(bytes.fromhex(answer), of(STATUS))
    assert found is not None
    assert not codec.answers(found, STATUS)


def test_answer_of_other_transaction_is_dropped():
    assert DryveCodec("line").feed(bytes.fromhex(ANSWER), of(STATUS, 0x0F10)) is None


def test_drive_that_has_repeated_transactions_does_so_always():
    codec, silent = DryveCodec("line"), bytes.fromhex(ANSWER.replace("0F0F", "0000", 1))
    assert codec.feed(silent, of(STATUS)) is not None
    assert codec.feed(bytes.fromhex(ANSWER), of(STATUS)) is not None
    assert codec.feed(silent, of(STATUS)) is None


def test_bytes_without_modbus_are_kept_as_heard():
    codec = DryveCodec("line")
    assert codec.feed(b"HTTP/1.1 200 OK", of(STATUS)) is None
    assert codec.heard == b"HTTP/1.1 200 OK"
    assert not codec.is_inside


@pytest.mark.parametrize("more", ["", "0D 00 00 00 6041 00 0000 00 02"])  # some firmware sends more
def test_exception_tells_object_and_reason(more):
    codec, exchange = DryveCodec("line"), of(STATUS)
    pdu = bytes.fromhex(f"AB 02 {more}")
    found = codec.feed(bytes.fromhex("0F0F 0000") + bytes((0, len(pdu) + 1, 0)) + pdu, exchange)
    assert codec.answers(found, STATUS)
    error = codec.refusal(exchange, found)
    assert isinstance(error, DryveException)
    assert (error.code, error.request) == (2, STATUS)
    assert str(error) == "line: read 6041h:0: refused: no such object (02h)"
    assert not error.is_silence
