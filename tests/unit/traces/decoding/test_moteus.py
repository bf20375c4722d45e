"""The decoder of a moteus, compared with mjbots' own library, and on a recording of its bus."""

import re
from math import isnan

import moteus
import pytest
from hypothesis import given
from hypothesis import strategies as st

from motorhil.traces.can_frame import EFF, FD_LENGTHS, classic, flexible, remote
from motorhil.traces.decoding.moteus import build
from motorhil.traces.decoding.narrative import BusMessage

DECODE = build(1)
UNSCALED = {*range(0x010, 0x01F), 0x02C, 0x130, 0x131}  # by the library, not by the documents


def frame(can_id, data):
    length = next(one for one in FD_LENGTHS if one >= len(data))
    flag = EFF if can_id > 0x7FF else 0
    return flexible(can_id | flag, 1, bytes(data).ljust(length, b"\x50"))


@pytest.mark.parametrize(
    ("can_id", "data", "text"),
    [
        (
            0x8001,
            "01000a07206000200150ff140400130d",
            "Query: mode = position, position command = 0.0096 rev, velocity command = 0.072 rev/s,"
            " feedforward torque = -1.76 N·m, read = 000h to 003h as int16,"
            " read = 00Dh to 00Fh as int8",
        ),
        (
            0x100,
            "2404000a005000000170ff230d181400",
            "Reply: mode = position, position = 0.008 rev, velocity = 0.064 rev/s,"
            " torque = -1.44 N·m, voltage = 12 V, temperature = 20 °C, fault = 0",
        ),
        (0x0001, "010000", "Command: mode = stopped"),
        (0x0001, "400107642073746f700a", r"Command: channel 1 = d stop\n"),
        (0x8001, "420130", "Query: poll of channel 1 = 48 bytes"),
        (0x0100, "4101044f4b0d0a", r"Reply: channel 1 = OK\r\n"),
        (0x807F, "11d802", "Query: read = 158h as int8"),
        (0x0100, "300102310901", "Reply: write of 001h refused = not writable, read of 009h "
         "refused = unknown"),
        (0x0100, "210f26", "Reply: fault = 38 (over-temperature)"),
        (0x0001, "60", "Command: not decodable: subframe 60h is not known"),
        (0x0100, "2104", "Reply: not decodable: the frame ends within a subframe"),
    ],
)  # fmt: skip
def test_frame_is_told_in_words(can_id, data, text):
    assert str(DECODE(frame(can_id, bytes.fromhex(data)))) == text


def test_frames_of_others_are_not_told():
    assert DECODE(frame(0x8002, b"\x11\x00")) is None
    assert DECODE(frame(0x0200, b"\x21\x00\x0a")) is None
    assert DECODE(remote(0x001, 2)) is None
    assert str(DECODE(classic(0x001, b"\x01\x00\x00"))) == "Command: mode = stopped"


@given(
    register=st.sampled_from([int(one) for one in moteus.Register if one != 0x110]),
    kind=st.integers(0, 3),
    value=st.integers(-(1 << 31), (1 << 31) - 1),
)
def test_registers_are_scaled_as_by_the_library(register, kind, value):
    size = (1, 2, 4, 4)[kind]
    raw = value.to_bytes(4, "little", signed=True)[:size]
    low, high = register & 0x7F, register >> 7
    number = bytes((low | 0x80, high)) if high else bytes((low,))
    data = bytes((0x21 + 4 * kind,)) + number + raw
    if register in UNSCALED and kind < 3:
        return
    wanted = moteus.parse_registers(data).response[register]
    (told,) = DECODE(frame(0x100, data)).signals
    if isinstance(told.value, str):
        return  # a mode or a fault in words
    assert told.value == pytest.approx(wanted, rel=1e-6, nan_ok=True) or isnan(wanted)


@given(st.sampled_from([0x0001, 0x8001, 0x0100, 0x807F]), st.binary(max_size=64))
def test_any_data_is_told(can_id, data):
    message = DECODE(frame(can_id, data))
    assert isinstance(message, BusMessage)
    assert str(message)


@pytest.mark.data
def test_recorded_bus_is_decoded(shared):
    path = shared / "data" / "traffic" / "moteus_dynamometer_canfd_candump.txt"
    if not path.is_file():
        pytest.skip(f"no {path.name}")
    decoders = [build(node) for node in (1, 2)]
    found = {"Command": 0, "Query": 0, "Reply": 0}
    for line in path.read_text().splitlines():
        match = re.match(r"\s*can\d\s+([0-9A-F]+)\s+\[\d+\]\s+([0-9A-F ]+)", line)
        if match is None:
            continue
        data = frame(int(match[1], 16), bytes.fromhex(match[2]))
        messages = [one for one in (decode(data) for decode in decoders) if one is not None]
        assert len(messages) == 1
        assert not messages[0].problem
        found[messages[0].name] += 1
    assert found["Query"] == pytest.approx(found["Reply"], abs=2)
    assert all(found.values())
