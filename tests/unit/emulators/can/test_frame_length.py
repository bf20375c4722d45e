import pytest
from hypothesis import event, example, given
from hypothesis import strategies as st

from motorhil.emulators.can import frame_length
from motorhil.emulators.can.frame import EFF_FLAG, ERR_FLAG, RTR_FLAG, can_id_of, pack, pack_remote
from motorhil.emulators.can.frame_length import arbitration_key, can_id_of_key, frame_bits
from tests.support.can import frame_bits as wire

# Source: can-utils canframelen.c, mode CFL_EXACT, compiled and run (can-physics.md 6.2).
# (identifier, data, shortest, exact, longest, stuff bits)
VECTORS = [
    ("000", "", 47, 53, 55, 6),
    ("080", "", 47, 51, 55, 4),
    ("7FF", "", 47, 50, 55, 3),
    ("701", "05", 55, 58, 65, 3),
    ("000", "0000000000000000", 111, 127, 135, 16),
    ("7FF", "FFFFFFFFFFFFFFFF", 111, 126, 135, 15),
    ("555", "5555555555555555", 111, 112, 135, 1),
    ("078", "3C3C3C3C3C3C3C3C", 111, 131, 135, 20),
    ("078", "0F0F0F0F0F0F0F0F", 111, 115, 135, 4),
    ("123", "00CA22FF5566AADF", 111, 115, 135, 4),
    ("201", "0F0010270000", 95, 104, 115, 9),
    ("181", "3706", 63, 66, 75, 3),
    ("601", "2B4060000F000000", 111, 122, 135, 11),
    ("02C", "0000803F00000000", 111, 124, 135, 13),
    ("00000117", "0000C738", 99, 107, 120, 8),
    ("00000000", "0000000000000000", 131, 150, 160, 19),
    ("1FFFFFFF", "FFFFFFFFFFFFFFFF", 131, 149, 160, 18),
    ("15555555", "5555555555555555", 131, 131, 160, 0),
]


def _frame(identifier: str, data: str) -> bytes:
    extended = EFF_FLAG if len(identifier) == 8 else 0
    return pack(int(identifier, 16) | extended, bytes.fromhex(data))


@pytest.mark.parametrize(("identifier", "data", "low", "exact", "high", "stuff"), VECTORS)
def test_length_equals_can_utils(identifier, data, low, exact, high, stuff):
    assert frame_bits(_frame(identifier, data)) == exact
    assert exact - low == stuff


@given(wire.fields())
@example(wire.Fields(0x000, False, False, 0, b""))
@example(wire.Fields(0x7FF, False, True, 8, b""))
@example(wire.Fields(0x1FFFFFFF, True, True, 0, b""))
def test_length_equals_bitwise_construction(frame):
    sent = wire.on_the_wire(frame)
    event(f"{'extended' if frame.extended else 'base'} {'remote' if frame.remote else 'data'}")
    assert frame_bits(frame.can_frame()) == len(sent) + wire.INTERMISSION


@pytest.mark.parametrize(("identifier", "data", "low", "exact", "high", "stuff"), VECTORS)
def test_bitwise_construction_equals_can_utils(identifier, data, low, exact, high, stuff):
    data_bytes = bytes.fromhex(data)
    extended = len(identifier) == 8
    frame = wire.Fields(int(identifier, 16), extended, False, len(data_bytes), data_bytes)
    assert len(wire.on_the_wire(frame)) + wire.INTERMISSION == exact


def test_run_ending_with_last_crc_bit_is_stuffed():
    # Rare, so searched for: 1 in 16 frames ends its CRC sequence with five equal bits.
    found = 0
    for identifier in range(0x100):
        frame = wire.Fields(identifier, False, False, 1, b"\x00")
        body = wire.stuffed(wire.with_crc(wire.unstuffed(frame)))
        if body[-6:] in ("000001", "111110"):
            found += 1
            assert frame_bits(frame.can_frame()) == len(body) + 13
    assert found > 5


@given(wire.fields())
def test_length_is_within_bounds_of_davis(frame):
    # Source: Davis et al. 2007: g + 8n + 13 and as much plus floor((g + 8n - 1) / 4).
    stuffable = (54 if frame.extended else 34) + 8 * len(frame.data)
    low = stuffable + 13
    assert low <= frame_bits(frame.can_frame()) <= low + (stuffable - 1) // 4


@given(wire.fields(), wire.fields())
@example(wire.Fields(5, False, False, 0, b""), wire.Fields(5, False, True, 0, b""))
@example(wire.Fields(5, False, True, 0, b""), wire.Fields(5 << 18, True, False, 0, b""))
@example(wire.Fields(6, True, False, 0, b""), wire.Fields(6, True, True, 0, b""))
def test_lower_key_wins_wired_and(one, other):
    first = wire.arbitration_field(one)
    second = wire.arbitration_field(other)
    key = arbitration_key(one.can_frame())
    other_key = arbitration_key(other.can_frame())
    for bit, other_bit in zip(first, second, strict=False):
        if bit != other_bit:
            assert (key < other_key) is (bit == "0")
            return
    assert first == second
    assert key == other_key


def test_data_beats_remote_beats_extended_with_equal_11_bits():
    rivals = [
        pack(0x123),
        pack_remote(0x123),
        pack(0x123 << 18 | EFF_FLAG),
        pack_remote(0x123 << 18 | EFF_FLAG),
    ]
    keys = [arbitration_key(frame) for frame in rivals]
    assert keys == sorted(keys)
    assert len(set(keys)) == 4


@given(wire.fields())
def test_can_id_is_recovered_from_key(frame):
    can_frame = frame.can_frame()
    assert can_id_of_key(arbitration_key(can_frame)) == can_id_of(can_frame)


@pytest.mark.parametrize(
    ("frame", "told"),
    [
        (b"", "16 bytes here, or 72 in CAN FD, not 0"),
        (bytes(17), "not 17"),
        (bytes.fromhex("81010000 09000000 0000000000000000"), "not 9"),
        (bytes.fromhex("00080000 00000000 0000000000000000"), "800h has more than 11 bits"),
        (pack(0x181 | ERR_FLAG), "error message"),
    ],
)
def test_unsendable_frame_is_refused(frame, told):
    with pytest.raises(ValueError, match=told):
        frame_bits(frame)


def test_padding_and_unused_bytes_are_not_on_wire():
    clean = bytes.fromhex("81010000 02000000 3706000000000000")
    dirty = bytes.fromhex("81010000 02FFFFFF 3706FFFFFFFFFFFF")
    assert frame_bits(clean) == frame_bits(dirty) == 66


def test_header_cache_is_bounded_without_effect_on_results():
    before = [frame_bits(pack(identifier)) for identifier in range(0x10)]
    for identifier in range(5000):
        frame_bits(pack(identifier | EFF_FLAG))
    assert [frame_bits(pack(identifier)) for identifier in range(0x10)] == before
    assert len(frame_length._headers) <= 4096


@given(st.integers(0, 0x7FF), st.integers(0, 8))
def test_remote_frame_is_as_long_as_empty_data_frame(identifier, length):
    frame = pack_remote(identifier, length)
    assert can_id_of(frame) == identifier | RTR_FLAG
    assert 47 <= frame_bits(frame) <= 55
