"""Frames in words; the bytes are those of CiA 301 and 402-2, or of a recording."""

import struct

import pytest

from motorhil.traces.decoding.canopen import CanopenDecoder
from motorhil.traces.decoding.events import Kind
from motorhil.traces.decoding.objects import ObjectNames


def frame(identifier, data="", flags=0):
    content = bytes.fromhex(data)
    return struct.pack("<IB3x8s", identifier | flags, len(content), content)


def told(*frames, decoder=None):
    decoder = decoder or CanopenDecoder({5: "pan"})
    return [decoder.decode(frame(*one)).text for one in frames]


@pytest.mark.parametrize(
    ("one", "text"),
    [
        ((0x000, "0105"), "NMT to pan (5): start"),
        ((0x000, "8100"), "NMT to all nodes: reset node"),
        ((0x705, "00"), "pan (5) has booted"),
        ((0x706, "05"), "node 6 is operational"),
        ((0x705, "7F"), "pan (5) is pre-operational"),
        ((0x080,), "SYNC"),
        ((0x080, "07"), "SYNC 7"),
        (
            (0x085, "1186210000000000"),
            "pan (5) emergency 8611h following error, error register 21h",
        ),
        ((0x605, "4041600000000000"), "SDO to pan (5): read 6041h statusword"),
        (
            (0x585, "4B41600037160000"),
            "SDO pan (5): 6041h statusword = 1637h operation enabled, target reached, bit 12",
        ),
        (
            (0x585, "8000100000000206"),
            "SDO pan (5): abort of 1000h device type: "
            "object does not exist in the object dictionary (06020000h)",
        ),
        ((0x605, "2B40600006000000"), "SDO to pan (5): write 6040h controlword = 0006h shutdown"),
        ((0x605, "237A60009CFFFFFF"), "SDO to pan (5): write 607Ah target position = -100"),
        ((0x605, "23022001E8030000"), "SDO to pan (5): write 2002h:1 = 000003E8h"),
        ((0x185, "3702"), "pan (5) TPDO 1: 37 02 (its mapping is not in the recording)"),
        ((0x7EA, "0102"), "id 7EAh: 01 02"),
        ((0x040, "", 0x2000_0000), "error frame: bus-off"),
        ((0x1ABCDEF0, "01 02", 0x8000_0000), "id 1ABCDEF0h: 01 02"),
    ],
)
def test_frame_in_words(one, text):
    assert told(one) == [text]


def test_segmented_upload_shows_whole_value_at_end():
    frames = [  # CiA 301, SDO upload of 1008h "motorhil!" in two segments
        (0x605, "4008100000000000"),
        (0x585, "4108100009000000"),
        (0x605, "6000000000000000"),
        (0x585, "006D6F746F726869"),
        (0x605, "7000000000000000"),
        (0x585, "1B6C210000000000"),
    ]
    assert told(*frames) == [
        "SDO to pan (5): read 1008h manufacturer device name",
        "SDO pan (5): begins upload of 1008h manufacturer device name, 9 bytes",
        "SDO to pan (5): requests the next segment of 1008h manufacturer device name",
        "SDO pan (5): uploads a segment of 1008h manufacturer device name: 6D 6F 74 6F 72 68 69",
        "SDO to pan (5): requests the next segment of 1008h manufacturer device name",
        "SDO pan (5): uploads a segment of 1008h manufacturer device name: 6C 21; "
        'whole = "motorhil!"',
    ]


def test_segmented_download_is_fact_when_confirmed():
    decoder = CanopenDecoder()
    facts = [
        decoder.decode(frame(*one)).facts
        for one in [
            (0x605, "2101200009000000"),
            (0x585, "6001200000000000"),
            (0x605, "0031323334353637"),
            (0x585, "2000000000000000"),
            (0x605, "1B38390000000000"),
            (0x585, "3000000000000000"),
        ]
    ]
    assert [len(one) for one in facts] == [0, 0, 0, 0, 0, 1]
    assert (facts[5][0].value, facts[5][0].told_to) == (b"123456789", True)


def test_block_segments_are_not_commands():
    frames = [  # CiA 301, SDO block download of 2001h, one block of two segments
        (0x605, "C20120000C000000"),
        (0x585, "A001200007000000"),
        (0x605, "0140404040404040"),  # 40h would be the beginning of an upload
        (0x605, "8240404040400000"),
        (0x585, "A202070000000000"),
        (0x605, "C900000000000000"),
        (0x585, "A100000000000000"),
    ]
    for text in told(*frames):
        assert "block transfer of 2001h" in text


MAPPING = [  # as the demo's host reads and writes it: TPDO 1 of node 5 is 6041h, 6064h
    (0x605, "2F001A0000000000"),
    (0x585, "60001A0000000000"),
    (0x605, "23001A0110004160"),
    (0x585, "60001A0100000000"),
    (0x605, "23001A0220006460"),
    (0x585, "60001A0200000000"),
    (0x605, "2F001A0002000000"),
    (0x585, "60001A0000000000"),
]


def test_pdo_is_decoded_by_recorded_mapping():
    decoder = CanopenDecoder({5: "pan"})
    told(*MAPPING, decoder=decoder)
    assert told((0x185, "3706FFFFFFFF"), decoder=decoder) == [
        "pan (5) TPDO 1: 6041h statusword = 0637h operation enabled, target reached, "
        "6064h position actual value = -1"
    ]
    text = told((0x185, "3706"), decoder=decoder)[0]
    assert text.endswith("6064h = missing: the PDO is too short")


def test_moved_pdo_is_found_only_at_new_identifier():
    decoder = CanopenDecoder({5: "pan"})
    told(*MAPPING, (0x605, "23001801BB010000"), (0x585, "6000180100000000"), decoder=decoder)
    assert told((0x1BB, "31020A000000"), decoder=decoder) == [
        "pan (5) TPDO 1: 6041h statusword = 0231h ready to switch on, "
        "6064h position actual value = 10"
    ]
    assert decoder.decode(frame(0x185, "3102")).kind is Kind.OTHER


def test_refused_write_does_not_change_mapping():
    decoder = CanopenDecoder({5: "pan"})
    told(*MAPPING, (0x605, "2F001A0001000000"), (0x585, "80001A0022000008"), decoder=decoder)
    assert "6064h" in told((0x185, "3706FFFFFFFF"), decoder=decoder)[0]


def test_eds_defines_vendor_objects_and_default_pdos():
    names = ObjectNames(
        "[1A00]\nParameterName=x\n[1A00sub0]\nDefaultValue=1\nDataType=0x5\n"
        "[1A00sub1]\nDefaultValue=0x20200020\nDataType=0x7\n"
        "[1800sub1]\nDefaultValue=$NODEID+0x1A0\nDataType=0x7\n"
        "[2020]\nParameterName=Winding temperature\nDataType=0x4\n"
    )
    decoder = CanopenDecoder(objects={5: names})
    assert told((0x1A5, "FEFFFFFF"), decoder=decoder) == [
        "node 5 TPDO 1: 2020h Winding temperature = -2"
    ]


@pytest.mark.parametrize(
    ("word", "mode", "text"),
    [  # CiA 402-2, command coding of the controlword
        (0x0006, 0, "shutdown"),
        (0x0007, 0, "switch on"),
        (0x000F, 0, "enable operation"),
        (0x0000, 0, "disable voltage"),
        (0x0002, 0, "quick stop"),
        (0x0080, 0, "fault reset"),
        (0x001F, 1, "enable operation, new set-point"),
        (0x007F, 1, "enable operation, new set-point, change immediately, relative"),
        (0x010F, 3, "enable operation, halt"),
        (0x001F, 6, "enable operation, start homing"),
        (0x001F, 0, "enable operation, bit 4"),
    ],
)
def test_controlword_in_words(word, mode, text):
    from motorhil.traces.decoding.cia402 import controlword_text

    assert controlword_text(word, mode) == text


@pytest.mark.parametrize(
    ("word", "mode", "text"),
    [  # CiA 402-2, state coding of the statusword
        (0x0000, 0, "not ready to switch on"),
        (0x0250, 0, "switch on disabled"),
        (0x0231, 0, "ready to switch on"),
        (0x0233, 0, "switched on"),
        (0x0237, 0, "operation enabled"),
        (0x0217, 0, "quick stop active"),
        (0x021F, 0, "fault reaction active"),
        (0x0218, 0, "fault"),
        (0x0238, 0, "fault"),
        (0x1637, 1, "operation enabled, target reached, set-point acknowledge"),
        (0x1637, 6, "operation enabled, target reached, homing attained"),
        (0x0A37, 8, "operation enabled, internal limit active"),
        (0x0027, 0, "operation enabled, no voltage, not remote"),
    ],
)
def test_statusword_in_words(word, mode, text):
    from motorhil.traces.decoding.cia402 import statusword_text

    assert statusword_text(word, mode) == text


def test_fault_reset_is_an_edge():
    decoder = CanopenDecoder({5: "pan"})
    write = [(0x605, "2B40600080000000"), (0x585, "6040600000000000")]
    texts = told(*write, *write, decoder=decoder)
    assert texts[0].endswith("0080h fault reset")
    assert texts[2].endswith("0080h fault reset, still set: no command")


@pytest.mark.parametrize(
    "reset", [(0x000, "8105"), (0x000, "8100"), (0x000, "8200"), (0x705, "00")]
)
def test_reset_node_loses_written_mapping(reset):
    decoder = CanopenDecoder({5: "pan"})
    told(*MAPPING, reset, decoder=decoder)
    assert told((0x185, "3706FFFFFFFF"), decoder=decoder) == [
        "pan (5) TPDO 1: 37 06 FF FF FF FF (its mapping is not in the recording)"
    ]
    told(*MAPPING, (0x000, "8106"), (0x706, "00"), decoder=decoder)  # a reset of another node
    assert "6064h" in told((0x185, "3706FFFFFFFF"), decoder=decoder)[0]


def test_each_axis_has_its_own_objects_and_mode():
    frames = [  # CiA 402-2: the second axis is 800h after the first
        (0x605, "2F60600003000000"),  # 6060h: pv
        (0x585, "6060600000000000"),
        (0x605, "2F60680001000000"),  # 6860h: pp
        (0x585, "6060680000000000"),
        (0x585, "4B41600037120000"),
        (0x585, "4B41680037120000"),
        (0x585, "43646800FFFFFFFF"),
    ]
    assert told(*frames)[4:] == [
        "SDO pan (5): 6041h statusword = 1237h operation enabled, speed is 0",
        "SDO pan (5): 6841h statusword, axis 2 = 1237h operation enabled, set-point acknowledge",
        "SDO pan (5): 6864h position actual value, axis 2 = -1",
    ]


def test_non_drive_has_no_drive_objects():
    decoder = CanopenDecoder({5: "pan"})
    texts = told(
        (0x605, "4000100000000000"),
        (0x585, "4300100091010300"),  # CiA 401, generic I/O
        (0x605, "2B41600037020000"),
        decoder=decoder,
    )
    assert texts[1:] == [
        "SDO pan (5): 1000h device type = 00030191h",
        "SDO to pan (5): write 6041h = 0237h",
    ]
