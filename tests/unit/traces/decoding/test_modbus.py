"""ADUs in words; the bytes are the examples of MODBUS Application Protocol V1.1b3."""

import pytest

from motorhil.traces.decoding.events import Kind
from motorhil.traces.decoding.modbus import ModbusDecoder
from motorhil.traces.formats.modbus import Adu, Malformed, adu_of, adus, crc16
from motorhil.traces.formats.pcap import Capture
from motorhil.traces.formats.tcp import pieces

MS = 1_000_000


def exchange(request, response, unit=1, decoder=None):
    decoder = decoder or ModbusDecoder({1: "pan"})
    asked = decoder.decode(Adu(0, None, True, 0, unit, bytes.fromhex(request)))
    return asked, decoder.decode(Adu(4 * MS, None, False, 0, unit, bytes.fromhex(response)))


@pytest.mark.parametrize(
    ("request_pdu", "response_pdu", "asked", "told"),
    [  # sections 6.1 to 6.17 of the specification
        (
            *("0100130013", "0103CD6B05", "read 19 coils from 0013h"),
            "coil 0013h = on off on on off off on on on on off on off on on off and 3 more",
        ),
        (
            *("03006B0003", "0306022B00000064", "read 3 registers from 006Bh"),
            "register 006Bh = 022Bh 0000h 0064h",
        ),
        ("0400080001", "0402000A", "read input register 0008h", "input register 0008h = 000Ah"),
        ("0500ACFF00", "0500ACFF00", "write coil 00ACh = on", "takes coil 00ACh = on"),
        (
            *("0600010003", "0600010003", "write register 0001h = 0003h"),
            "takes register 0001h = 0003h",
        ),
        (
            *("0F0013000A02CD01", "0F0013000A"),
            "write coil 0013h = on off on on off off on on on off",
            "takes coil 0013h = on off on on off off on on on off",
        ),
        (
            *("100001000204000A0102", "1000010002", "write register 0001h = 000Ah 0102h"),
            "takes register 0001h = 000Ah 0102h",
        ),
        (
            *("16000400F20025", "16000400F20025"),
            "mask register 0004h, and 00F2h, or 0025h",
            "answers function (16h): 00 04 00 F2 00 25",
        ),
        (
            *("170003000600 0E0003 06 00FF00FF00FF", "170C00FE0ACD00010003000D00FF"),
            "write register 000Eh = 00FFh 00FFh 00FFh, then read 6 registers from 0003h",
            "register 0003h = 00FEh 0ACDh 0001h 0003h 000Dh 00FFh",
        ),
        (
            *("0104A10001", "8102", "read coil 04A1h"),
            "refuses read coil 04A1h: exception 2, illegal data address",
        ),
        (  # telegrams of igus, Operating Manual dryve D1 V2.4, pages 104 to 110
            *("2B0D0000006041000000 0002", "2B0D0000006041000000 00024006"),
            "read object 6041h statusword",
            "object 6041h statusword = 0640h (switch on disabled, target reached)",
        ),
        (
            *("2B0D010000609201000000 0418150000", "2B0D010000609201000000 00"),
            "write object 6092h:1 feed = 5400",
            "takes object 6092h:1 feed = 5400",
        ),
        (
            *("2B0D010000604000000000 020F01", "AB02"),
            "write object 6040h controlword = 010Fh (enable operation, halt)",
            "refuses write object 6040h controlword = 010Fh (enable operation, halt): exception 2,"
            " illegal data address",
        ),
        (
            *("2B0D0000006061000000 0001", "2B0D0000006061000000 000106"),
            "read object 6061h modes of operation display",
            "object 6061h modes of operation display = 6 (hm (homing))",
        ),
        (  # wrong byte count
            *("2B0D0000006041000000 0002", "2B0D0000006041000000 000240"),
            "read object 6041h statusword",
            "answers encapsulated interface (2Bh): 0D 00 00 00 60 41 00 00 00 00 02 40",
        ),
    ],
)
def test_request_and_response_in_words(request_pdu, response_pdu, asked, told):
    first, second = exchange(request_pdu, response_pdu)
    assert first.text == f"Modbus to pan (unit 1): {asked}"
    assert second.text == f"Modbus pan (unit 1): {told} (after 4.000 ms)"


def test_read_and_written_values_are_facts():
    _, read = exchange("0300100002", "030400010002")
    assert [(fact.subject, fact.value, fact.told_to) for fact in read.facts] == [
        ("register 0010h", 1, False),
        ("register 0011h", 2, False),
    ]
    asked, written = exchange("0600010003", "0600010003")
    assert asked.facts == ()  # not before it is confirmed
    assert [(fact.subject, fact.value, fact.told_to) for fact in written.facts] == [
        ("register 0001h", 3, True)
    ]


def test_broadcast_is_fact_at_once():
    decoder = ModbusDecoder()
    said = decoder.decode(Adu(0, None, True, 0, 0, bytes.fromhex("0600010003")))
    assert [fact.value for fact in said.facts] == [3]


@pytest.mark.parametrize("response", ["0400080001", "0604", "03060001"])
def test_response_of_wrong_format_gives_no_facts(response):
    _, said = exchange("0300100002", response)
    assert said.kind is Kind.MODBUS_RESPONSE
    assert said.facts == ()


def test_response_of_another_unit_is_unexpected():
    decoder = ModbusDecoder()
    decoder.decode(Adu(0, None, True, 0, 1, bytes.fromhex("0300100001")))
    said = decoder.decode(Adu(MS, None, False, 0, 2, bytes.fromhex("03020001")))
    assert "response without a request" in said.text
    assert said.facts == ()


def test_serial_bytes_with_correct_crc_are_adu():
    # MODBUS over Serial Line V1.02, 6.2.2: the CRC of 02 07 is 1241h, low byte first on the wire
    assert crc16(bytes((2, 7))) == 0x1241
    adu = adu_of(5, bytes.fromhex("02074112"), tcp=False, to_server=True)
    assert adu == Adu(5, None, True, 0, 2, b"\x07")
    for broken in ("02074113", "0207"):
        found = adu_of(5, bytes.fromhex(broken), tcp=False, to_server=True)
        assert isinstance(found, Malformed)


def test_tcp_bytes_with_correct_length_are_adu():
    data = bytes.fromhex("1234 0000 0006 11 03006B0003")
    adu = adu_of(5, data, tcp=True, to_server=True)
    assert (adu.transaction, adu.unit, adu.pdu.hex()) == (0x1234, 0x11, "03006b0003")
    assert isinstance(adu_of(5, data[:-1], tcp=True, to_server=True), Malformed)


@pytest.mark.data
def test_real_gateway_answers_match_index(shared):
    path = shared / "data/traffic/modbus_gateway_units1237_pipelined.pcap"
    decoder = ModbusDecoder()
    texts = [
        decoder.decode(adu) for adu in adus(pieces(Capture(path).packets())) if isinstance(adu, Adu)
    ]
    requests = [said for said in texts if said.kind is Kind.MODBUS_REQUEST]
    answers = [said for said in texts if said.kind is Kind.MODBUS_RESPONSE and said.facts]
    assert (len(requests), len(answers)) == (2382, 1592)  # ../shared/data/traffic/INDEX.md
