from random import Random

import pytest
from hypothesis import example, given
from hypothesis import strategies as st

from motorhil.emulators.can import frame_length
from motorhil.emulators.can.frame import (
    BRS,
    EFF_FLAG,
    ERR_FLAG,
    ESI,
    RTR_FLAG,
    can_id_of,
    pack,
    pack_fd,
)
from motorhil.emulators.can.frame_length import (
    LENGTHS_MASK,
    arbitration_key,
    can_id_of_key,
    frame_bits,
    measure,
    phases_of,
)
from tests.support.can import fd_frame_bits as wire_fd
from tests.support.can.fd_frame_bits import FdFields

# Source: pierremolinaro/codes-can, codes-de-calcul-canfd/CANFDFrameGenerator.h (2020), ISO CRC,
# compiled and run. (identifier, flags, data, bits incl. intermission, dynamic stuff bits, CRC)
VECTORS = [
    ("7AA", "B", "55", 70, 0, 0x6010),
    ("123", "B", "0011223344556677" * 1, 128, 2, 0x36AC),
    ("123", "", "0011223344556677" * 1, 128, 2, 0xBE40),
    ("078", "BE", "3c" * 64, 583, 4, 0x4A282),
    ("000", "B", "", 64, 2, 0x13917),
    ("7FF", "", "", 65, 3, 0x6CED),
    ("555", "", "55" * 64, 579, 0, 0x137E79),
    ("000", "B", "00" * 16, 217, 27, 0x17EC7),
    ("7FF", "B", "ff" * 20, 261, 34, 0x7446A),
    ("00000000", "B", "00" * 8, 163, 18, 0x14DBA),
    ("1FFFFFFF", "E", "ff" * 24, 322, 44, 0x1CD6D1),
    ("15555555", "B", "55" * 12, 177, 0, 0xB057),
    ("18DAF110", "B", "0123456789abcdef" * 4, 347, 5, 0x5648C),
    ("00FF00FF", "B", "1fe083" * 16, 523, 53, 0xCBD90),
]

# Source: Linux include/linux/can/length.h, computed (can-physics.md 6.3); incl. intermission.
# data bytes: (base shortest, longest, extended shortest, longest)
PUBLISHED = {
    0: (62, 67, 81, 91),
    8: (126, 147, 145, 171),
    12: (158, 187, 177, 211),
    16: (190, 227, 209, 251),
    20: (227, 272, 246, 296),
    24: (259, 312, 278, 336),
    32: (323, 392, 342, 416),
    48: (451, 552, 470, 576),
    64: (579, 712, 598, 736),
}
SEED = 20261122


def fields_of(identifier: str, flags: str, data: str) -> FdFields:
    extended = len(identifier) == 8
    return FdFields(int(identifier, 16), extended, "B" in flags, "E" in flags, bytes.fromhex(data))


def phases(frame: bytes) -> tuple[int, int]:
    return phases_of(measure(frame) & LENGTHS_MASK)


def bounds(size: int, extended: bool) -> tuple[int, int]:
    """Return bounds as PUBLISHED, for every length, by the formula of length.h."""
    stuffable = (41 if extended else 22) + 8 * size
    rest = (28 if size <= 16 else 33) + 9 + 3
    return stuffable + rest, stuffable + (stuffable - 1) // 4 + rest


@pytest.mark.parametrize(("identifier", "flags", "data", "bits", "stuff", "crc"), VECTORS)
def test_length_equals_other_generator(identifier, flags, data, bits, stuff, crc):
    frame = fields_of(identifier, flags, data)
    assert frame_bits(frame.can_frame()) == bits
    assert bits - bounds(len(frame.data), frame.extended)[0] == stuff


@pytest.mark.parametrize(("identifier", "flags", "data", "bits", "stuff", "crc"), VECTORS)
def test_bitwise_construction_equals_other_generator(identifier, flags, data, bits, stuff, crc):
    frame = fields_of(identifier, flags, data)
    sent = wire_fd.dynamically_stuffed(frame)
    assert wire_fd.stuff_bits(frame, sent) == stuff
    assert int(wire_fd.checks(frame, sent)[4:], 2) == crc
    assert len(wire_fd.on_the_wire(frame)) + 3 == bits


def test_whole_frame_equals_vector_bit_by_bit():
    # Source: as VECTORS; identifier 7AAh, BRS, data 55h, with the ACK slot dominant
    frame = fields_of("7AA", "B", "55")
    sent = wire_fd.on_the_wire(frame)
    told = "0111101010100010100001010101010000010011000001000011000101011111111111"
    assert sent[:-9] + "0" + sent[-8:] + "111" == told


@pytest.mark.parametrize("frames", [10_000, pytest.param(100_000, marks=pytest.mark.nightly)])
def test_random_lengths_equal_bitwise_construction(record_property, frames):
    """All are equal at both rates and within the published bounds; count those at the bounds."""
    random = Random(SEED)
    shortest = longest = nearly = 0
    for number in range(frames):
        frame = wire_fd.random_fd_fields(random)
        # the length does not depend on the CRC: it is computed for some only
        assert phases(frame.can_frame()) == wire_fd.phases(frame, number % 100 == 0), frame
        low, high = bounds(len(frame.data), frame.extended)
        bits = frame_bits(frame.can_frame())
        assert low <= bits <= high, frame
        shortest += bits == low
        longest += bits == high
        nearly += bits >= high - 3
    assert shortest > frames // 200
    # FDF, res, BRS are 1, 0, 1 or 1, 0, 0: no frame has all the stuff bits allowed by length.h
    assert longest == 0
    assert nearly > frames // 5000
    record_property(
        "reached the shortest, the longest, the longest but 3", (shortest, longest, nearly)
    )


def test_bounds_equal_published_ones():
    for size, (low, high, extended_low, extended_high) in PUBLISHED.items():
        assert bounds(size, False) == (low, high)
        assert bounds(size, True) == (extended_low, extended_high)


def test_data_end_is_followed_by_fixed_stuff_bit_only():
    # DLC 0 after BRS: 1 00000; and a data field that ends with five equal bits
    assert frame_bits(pack_fd(0x555)) == 62
    assert (
        frame_bits(pack_fd(0x555, b"\x00", 0)) == 70 + 2
    )  # 0 0000 in the control field, then 5 of 9
    assert frame_bits(pack_fd(0x555, b"\xe0", BRS)) == frame_bits(pack_fd(0x555, b"\xe1", BRS))


@given(st.integers(0, 0x1FFFFFFF), st.booleans(), st.sampled_from(wire_fd.LENGTHS), st.booleans())
@example(0, False, 64, True)
def test_sum_of_both_phases_is_frame_length(identifier, extended, size, switch):
    can_id = identifier | EFF_FLAG if extended else identifier & 0x7FF
    frame = pack_fd(can_id, bytes(size), BRS if switch else 0)
    assert sum(phases(frame)) == frame_bits(frame)
    assert (phases(frame)[1] > 0) is switch


@given(st.integers(0, 0x1FFFFFFF), st.booleans(), st.sampled_from([0, ESI, BRS, BRS | ESI]))
def test_fd_frame_competes_as_data_frame(identifier, extended, flags):
    can_id = identifier | EFF_FLAG if extended else identifier & 0x7FF
    key = arbitration_key(pack_fd(can_id, b"", flags))
    assert key == arbitration_key(pack(can_id))
    assert can_id_of_key(key) == can_id


def _raw(can_id: int, length: int) -> bytes:
    return can_id.to_bytes(4, "little") + bytes([length, 4]) + bytes(66)


@pytest.mark.parametrize(
    ("frame", "told"),
    [
        (_raw(0x181, 9), "9 bytes of data: a CAN FD frame has 0..8, 12"),
        (_raw(0x181, 65), "65 bytes of data"),
        (_raw(0x800, 8), "800h has more than 11 bits"),
        (_raw(0x181 | RTR_FLAG, 8), "no remote frame in CAN FD"),
        (_raw(0x181 | ERR_FLAG, 8), "error message"),
        (bytes(71), "or 72 in CAN FD, not 71"),
    ],
)
def test_unsendable_fd_frame_is_refused(frame, told):
    with pytest.raises(ValueError, match=told):
        measure(frame)


def test_padding_and_unknown_flags_are_not_on_wire():
    clean = pack_fd(0x181, b"\x37\x06", BRS)
    dirty = clean[:5] + bytes([clean[5] | 0xF8, 0xFF, 0xFF]) + b"\x37\x06" + b"\xff" * 62
    assert phases(clean) == phases(dirty)
    assert can_id_of(dirty) == 0x181


def test_header_cache_is_bounded_without_effect_on_results():
    before = [measure(pack_fd(identifier)) for identifier in range(0x10)]
    for identifier in range(9000):
        measure(pack_fd(identifier | EFF_FLAG))
    assert [measure(pack_fd(identifier)) for identifier in range(0x10)] == before
    assert len(frame_length._fd_headers) <= 4096
    assert len(frame_length._frames) <= 8192
