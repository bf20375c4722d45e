"""Packets of Protocol 2.0: bytes of the maker's manual, and of the maker's SDK (4.1.0).

Of the two restored from errata: Fast Bulk Read and Backup restore, whose CRC the manual misprints.
"""

import pytest

from motorhil.emulators.dynamixel.packets import Packet, Receiver, crc16, packet, status

STATUSES = [
    (1, 0, "06 04 26", "FFFFFD000107005500060426655D"),
    (2, 0, "06 04 26", "FFFFFD0002070055000604266F6D"),
    (1, 0, "B0 04 34", "FFFFFD000107005500B00434B2D4"),
    (1, 0, "A6 00 00 00", "FFFFFD000108005500A60000008CC0"),
    (1, 0, "FF FF FF FF", "FFFFFD000108005500FFFFFFFF9638"),
    (1, 0x80, "A6 00 00 00", "FFFFFD000108005580A60000008F7C"),
    (1, 0, "", "FFFFFD000104005500A10C"),
    (1, 0x80, "", "FFFFFD000104005580A28F"),
    *(
        (1, error, "", f"FFFFFD0001040055{tail}")
        for error, tail in enumerate(
            ("01A48C", "02AE8C", "03AB0C", "04BA8C", "05BF0C", "06B50C", "07B08C"), 1
        )
    ),
    (1, 0x87, "", "FFFFFD000104005587B30F"),
    (2, 0, "1F 08 00 00", "FFFFFD0002080055001F080000BABE"),
    (1, 0, "77 00", "FFFFFD0001060055007700C369"),
    (2, 0, "24", "FFFFFD000205005500248BA9"),
    (1, 0, "FF FF FD FF", "FFFFFD000109005500FFFFFDFDFFDA9E"),
    (1, 0, "FF FF FD FF FF FD", "FFFFFD00010C005500FFFFFDFDFFFFFDFD1916"),
    (1, 0, "FF FF FD FD", "FFFFFD000109005500FFFFFDFDFDD51E"),
]
INSTRUCTIONS = [
    (1, 0x01, "", "FFFFFD0001030001194E"),
    (0xFE, 0x01, "", "FFFFFD00FE0300013142"),
    (1, 0x02, "84 00 04 00", "FFFFFD0001070002840004001D15"),
    (1, 0x02, "46 00 01 00", "FFFFFD0001070002460001003CA3"),
    (1, 0x03, "40 00 01", "FFFFFD0001060003400001DB66"),
    (1, 0x03, "74 00 00 02 00 00", "FFFFFD0001090003740000020000CA89"),
    (1, 0x03, "74 00 00 08 00 00", "FFFFFD00010900037400000800004289"),
    (1, 0x03, "74 00 FF FF FF FF", "FFFFFD00010900037400FFFFFFFFC889"),
    (1, 0x03, "0B 00 05", "FFFFFD00010600030B00055CE3"),
    (1, 0x03, "08 00 03", "FFFFFD000106000308000374E3"),
    (1, 0x03, "07 00 02", "FFFFFD0001060003070002BD63"),
    (1, 0x03, "09 00 00", "FFFFFD00010600030900006963"),
    (1, 0x03, "66 00 9C FF", "FFFFFD000107000366009CFF406F"),
    (1, 0x03, "68 00 EC FF FF FF", "FFFFFD00010900036800ECFFFFFFD3D5"),
    (1, 0x03, "6C 00 0A 00 00 00 64 00 00 00", "FFFFFD00010D00036C000A000000640000004236"),
    (1, 0x03, "62 00 05", "FFFFFD000106000362000568E4"),
    (1, 0x03, "A8 00 84 00", "FFFFFD0001070003A80084006365"),
    (1, 0x04, "68 00 C8 00 00 00", "FFFFFD00010900046800C8000000AE8E"),
    (1, 0x05, "", "FFFFFD000103000502CE"),
    (0xFE, 0x05, "", "FFFFFD00FE0300052AC2"),
    (1, 0x08, "", "FFFFFD00010300082F4E"),
    (1, 0x10, "01 44 58 4C 22", "FFFFFD00010800100144584C22B1DC"),
    (1, 0x06, "01", "FFFFFD000104000601A1E6"),
    (1, 0x06, "02", "FFFFFD000104000602ABE6"),
    (1, 0x06, "FF", "FFFFFD0001040006FFA664"),
    (1, 0x20, "01 43 54 52 4C", "FFFFFD0001080020014354524C16F5"),
    (1, 0x20, "02 43 54 52 4C", "FFFFFD0001080020024354524C9EF5"),
    (0xFE, 0x82, "84 00 04 00 01 02", "FFFFFD00FE090082840004000102CEFA"),
    (0xFE, 0x83, "74 00 04 00 01 96 00 00 00 02 AA 00 00 00",
     "FFFFFD00FE11008374000400019600000002AA0000008287"),
    (0xFE, 0x92, "01 90 00 02 00 02 92 00 01 00", "FFFFFD00FE0D0092019000020002920001001A05"),
    (0xFE, 0x93, "01 20 00 02 00 A0 00 02 1F 00 01 00 50",
     "FFFFFD00FE1000930120000200A000021F00010050B768"),
    (0xFE, 0x8A, "84 00 04 00 03 07 04", "FFFFFD00FE0A008A8400040003070420F2"),
    (0xFE, 0x9A, "03 84 00 04 00 07 7C 00 02 00 04 92 00 01 00",
     "FFFFFD00FE12009A0384000400077C0002000492000100DA2D"),
    (1, 0x03, "74 00 FF FF FD FF", "FFFFFD00010A00037400FFFFFDFDFF23E5"),
]  # fmt: skip


def received(data: bytes, *, receiver: Receiver | None = None) -> list[Packet]:
    return list((receiver or Receiver()).feed(data, 0, 0))


def test_crc_of_check_string_is_that_of_buypass():
    assert crc16(b"123456789") == (0xFEE8).to_bytes(2, "little")


@pytest.mark.parametrize(("unit", "error", "data", "expected"), STATUSES)
def test_status_has_the_bytes_of_the_maker(unit, error, data, expected):
    assert status(unit, error, bytes.fromhex(data)).hex().upper() == expected
    whole = bytes((error,)) + bytes.fromhex(data)
    assert received(bytes.fromhex(expected)) == [Packet(unit, 0x55, whole)]


@pytest.mark.parametrize(("unit", "instruction", "data", "expected"), INSTRUCTIONS)
def test_instruction_has_the_bytes_of_the_maker(unit, instruction, data, expected):
    parameters = bytes.fromhex(data)
    assert packet(unit, instruction, parameters).hex().upper() == expected
    assert received(bytes.fromhex(expected)) == [Packet(unit, instruction, parameters)]


def test_receiver_takes_bytes_one_by_one_after_junk():
    receiver = Receiver()
    told = bytes.fromhex(
        "00 FF FF" + "FFFFFD00010300082F4E" + "FFFFFD00010300012A".replace(" ", "")
    )
    found = [one for byte in told for one in receiver.feed(bytes((byte,)), 0, 0)]
    assert found == [Packet(1, 8, b"")]


def test_receiver_takes_an_unstuffed_mark_as_data():
    sent = bytes.fromhex("FFFFFD00010900037400FFFFFDFFCB05")  # as the maker's SDK sends it
    assert received(sent) == [Packet(1, 3, bytes.fromhex("7400FFFFFDFF"))]


def test_receiver_drops_a_packet_with_a_wrong_crc():
    receiver = Receiver()
    assert received(bytes.fromhex("FFFFFD00010300012E4E"), receiver=receiver) == []
    assert receiver.invalid == 1
    assert received(bytes.fromhex("FFFFFD00010300082F4E"), receiver=receiver) == [Packet(1, 8, b"")]


@pytest.mark.parametrize(("pause_ns", "count"), [(1_500_000, 1), (1_500_001, 0)])
def test_receiver_forgets_a_beginning_after_a_pause(pause_ns, count):
    receiver, sent = Receiver(), bytes.fromhex("FFFFFD00010300082F4E")
    assert not list(receiver.feed(sent[:5], 0, 50_000))
    found = list(receiver.feed(sent[5:], 50_000 + pause_ns, 100_000 + pause_ns))
    assert len(found) == count
    assert receiver.dropped == 1 - count


@pytest.mark.parametrize("length", ["0000", "0200", "0104", "FFFF"])
def test_receiver_skips_headers_with_impossible_lengths(length):
    sent = bytes.fromhex("FFFFFD0001" + length) + bytes.fromhex("FFFFFD00010300082F4E")
    assert received(sent) == [Packet(1, 8, b"")]
