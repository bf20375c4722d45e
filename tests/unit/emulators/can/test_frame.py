import socket
import struct

import pytest

from motorhil.emulators.can.frame import (
    EFF_FLAG,
    ERR_FLAG,
    FRAME_BYTES,
    RTR_FLAG,
    as_driven,
    can_id_of,
    data_of,
    pack,
    pack_remote,
)


def test_frame_equals_linux_can_frame():
    # Source: include/uapi/linux/can.h, little endian host; the layout of python-can's socketcan
    # interface, struct "<IBB2x8s" (length and two fields that stay 0).
    assert pack(0x181, b"\x01\x02") == bytes.fromhex("81010000 02000000 0102000000000000")
    assert pack(0x181, b"\x01\x02") == struct.pack("<IBBBB8s", 0x181, 2, 0, 0, 0, b"\x01\x02")
    assert len(pack(0)) == FRAME_BYTES == 16


def test_flags_equal_linux():
    assert EFF_FLAG == socket.CAN_EFF_FLAG
    assert RTR_FLAG == socket.CAN_RTR_FLAG
    assert ERR_FLAG == socket.CAN_ERR_FLAG


def test_identifier_and_data_make_round_trip():
    frame = pack(0x1ABCDEF0 | EFF_FLAG, b"abcdefgh")
    assert can_id_of(frame) == 0x9ABCDEF0
    assert data_of(frame) == b"abcdefgh"
    assert data_of(pack(0x10)) == b""


def test_remote_frame_has_length_without_data():
    frame = pack_remote(0x701, 8)
    assert frame == bytes.fromhex("01070040 08000000 0000000000000000")
    assert data_of(frame) == b""


@pytest.mark.parametrize(
    ("call", "told"),
    [
        (lambda: pack(0x181, bytes(9)), "9 bytes"),
        (lambda: pack(0x800), "800h"),
        (lambda: pack_remote(0x181, 9), "9"),
        (lambda: pack_remote(0x181, -1), "-1"),
    ],
)
def test_oversized_content_is_refused(call, told):
    with pytest.raises(ValueError, match=told):
        call()


@pytest.mark.parametrize(
    ("frame", "sent"),
    [
        # python-can 4.6.1 writes the DLC into len8_dlc, too; drivers leave garbage after the data.
        ("81010000 02112202 0102ffffffffffff", "81010000 02000000 0102000000000000"),
        ("81010040 04112204 0102030405060708", "81010040 04000000 0000000000000000"),
        ("56341280 08112208 0102030405060708", "56341280 08000000 0102030405060708"),
    ],
)
def test_frame_from_outside_is_sent_without_its_padding(frame, sent):
    assert as_driven(bytes.fromhex(frame)) == bytes.fromhex(sent)


@pytest.mark.parametrize("frame", ["81010000 09000000", "81010040 09000000", "01080000 00000000"])
def test_frame_from_outside_that_no_bus_carries_is_refused(frame):
    with pytest.raises(ValueError, match=r"limit is 8|0\.\.8|11 bits"):
        as_driven(bytes.fromhex(frame).ljust(16, b"\0"))
