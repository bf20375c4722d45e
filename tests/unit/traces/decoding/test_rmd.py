"""Frames of a MyActuator RMD in words; the maker's own examples.

Source: MyActuator, Servo Motor Control Protocol V4.2 (2024-05).
"""

import pytest

from motorhil.traces.can_frame import EFF, classic
from motorhil.traces.decoding.rmd import build

DECODE = build(1)
MOTION = "temperature = 50 C, current = 1 A, speed = 500 deg/s, angle = 45 deg"


@pytest.mark.parametrize(
    ("can_id", "data", "text"),
    [
        (0x141, "4200000000000000", "read acceleration: index = 0"),
        (0x241, "4200000010270000", "read acceleration answered: index = 0, value = 10000 deg/s^2"),
        (0x141, "4303000010270000", "write acceleration: index = 3, value = 10000 deg/s^2"),
        (0x241, "6000000010270000", "encoder position answered: position = 10000 pulses"),
        (0x241, "6400000010270000", "zero here answered: position = 10000 pulses"),
        (0x241, "90003308BE2C8B24", "single-turn encoder answered: position = 2099 pulses"),
        (0x241, "92000000A08C0000", "multi-turn angle answered: angle = 360 deg"),
        (0x241, "9400000000001027", "single-turn angle answered: angle = 100 deg"),
        (
            0x241,
            "9A320001E5010400",
            "status 1 answered: temperature = 50 C, brake released = 1, voltage = 48.5 V,"
            " errors = under voltage",
        ),
        (0x241, "9C326400F4012D00", f"status 2 answered: {MOTION}"),
        (
            0x241,
            "9D32C20B10FAC0F9",
            "status 3 answered: temperature = 50 C, phase A = 30.1 A, phase B = -15.2 A,"
            " phase C = -16 A",
        ),
        (0x141, "A10000009CFF0000", "torque current: current = -1 A"),
        (0x141, "A2000000F0D8FFFF", "speed: speed = -100 deg/s"),
        (
            0x241,
            "A2329CFF0CFED3FF",
            "speed answered: temperature = 50 C, current = -1 A, speed = -500 deg/s,"
            " angle = -45 deg",
        ),
        (0x141, "A400F4016073FFFF", "absolute position: speed limit = 500 deg/s, angle = -360 deg"),
        (
            0x141,
            "A601F401A08C0000",
            "single-turn position: direction = 1, speed limit = 500 deg/s, angle = 360 deg",
        ),
        (
            0x141,
            "A800F401A08C0000",
            "incremental position: speed limit = 500 deg/s, angle = 360 deg",
        ),
        (0x241, "7000000000000003", "operating mode answered: mode = 3"),
        (0x241, "B20000002E893401", "software date answered: date = 20220206"),
        (0x141, "B3000000E8030000", "interruption time: time = 1 s"),
        (0x241, "B558385332563130", "model answered: model = X8S2V10"),
        (0x280, "8000000000000000", "shutdown to all"),
        (0x300, "7900000000000002", "CAN ID: read = 0, ID = 2"),
        (0x241, "F100000000000000", "communication interrupted"),
        (  # the text of the manual has 9.99 rad, 1.021 rad/s, 10.012, 1, 10.004 N m
            0x401,
            "E66682E052333B55",
            "motion mode: p = 10 rad, v = 1.022 rad/s, kp = 10.01 N m/rad, kd = 1 N m s/rad,"
            " t = 10 N m",
        ),
        (
            0x501,
            "01E66582EB550000",
            "motion mode answered: p = 10 rad, v = 1.022 rad/s, t = 10 N m",
        ),
        (0x401, "E666", "motion mode: not decodable: 2 bytes; expected 8"),
        (0x141, "9C00", "status 2: not decodable: 2 bytes; expected 8"),
    ],
)
def test_frame_of_rmd_is_told_in_words(can_id, data, text):
    assert str(DECODE(classic(can_id, bytes.fromhex(data)))) == text


@pytest.mark.parametrize("can_id", [0x142, 0x242, EFF | 0x141, 0x402, 0x502])
def test_frame_of_others_is_left_alone(can_id):
    assert DECODE(classic(can_id, bytes.fromhex("9C00000000000000"))) is None
