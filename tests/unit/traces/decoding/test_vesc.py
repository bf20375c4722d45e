"""Frames of a VESC in words; golden frames of the firmware's layouts.

Source: vedderb/bldc b9d287b3 (firmware 7.01), documentation/comm_can.md.
"""

import pytest

from motorhil.traces.can_frame import EFF, classic
from motorhil.traces.decoding.vesc import build

DECODE = build(23)


@pytest.mark.parametrize(
    ("can_id", "data", "text"),
    [
        (0x117, "0000C738", "SET_CURRENT: current = 51 A"),
        (0x017, "00004E20", "SET_DUTY: duty = 0.2"),
        (0x217, "00001388", "SET_CURRENT_BRAKE: current = 5 A"),
        (0x317, "00000BB8", "SET_RPM: erpm = 3000"),
        (0x417, "055D4A80", "SET_POS: position = 90 deg"),
        (0xA17, "FFFF3CB0", "SET_CURRENT_REL: share = -0.5"),
        (0x1FF, "0000C738", "SET_CURRENT to all: current = 51 A"),
        (0x917, "FFFFF448FF83FEBF", "STATUS: erpm = -3000, current = -12.5 A, duty = -0.321"),
        (
            0x1017,
            "00FDFC13000C464B",
            "STATUS_4: MOSFET temperature = 25.3 C, motor temperature = -100.5 C,"
            " input current = 1.2 A, position = 359.9 deg",
        ),
        (0x1B17, "FFFFFFD601E10000", "STATUS_5: tachometer = -42, input voltage = 48.1 V"),
        (0x1117, "FD", "PING: from = 253"),
        (0x12FD, "1700", "PONG to 253: from = 23, hardware type = 0"),
        (0x817, "FD0000", "PROCESS_SHORT_BUFFER: from = 253, mode = 0, packet = FW_VERSION"),
        (0x817, "FD0004", "PROCESS_SHORT_BUFFER: from = 253, mode = 0, packet = GET_VALUES"),
        (
            0x8FD,
            "1701320000800005",
            "PROCESS_SHORT_BUFFER to 253: from = 23, mode = 1, packet = GET_VALUES_SELECTIVE,"
            " fault = over temp FET",
        ),
        (0x517, "0001020304050607", "FILL_RX_BUFFER: offset = 0"),
        (
            0x717,
            "FD000013ACCC",
            "PROCESS_RX_BUFFER: from = 253, mode = 0, length = 19, crc = 44236",
        ),
        (0x3917, "3630", "NOTIFY_BOOT: hardware = 60"),
        (0x3817, "", "POLL_ROTOR_POS"),
        (0x3817, "00895440", "POLL_ROTOR_POS: position = 90 deg"),
        (0x317, "0BB8", "SET_RPM: not decodable: 2 bytes; expected 4"),
    ],
)
def test_frame_of_vesc_is_told_in_words(can_id, data, text):
    assert str(DECODE(classic(EFF | can_id, bytes.fromhex(data)))) == text


@pytest.mark.parametrize("can_id", [EFF | 0x118, EFF | 0x1_0117, 0x117, EFF | 0x6317, EFF | 0x12FD])
def test_frame_of_others_is_left_alone(can_id):
    assert DECODE(classic(can_id, bytes((24, 0, 0, 0)))) is None
