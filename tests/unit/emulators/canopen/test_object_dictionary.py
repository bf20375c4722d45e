"""Types, ranges and access; bytes are checked against canopen's encoding."""

import math
import struct

import pytest
from canopen.objectdictionary import ODVariable
from hypothesis import given
from hypothesis import strategies as st

from motorhil.emulators.canopen.object_dictionary import (
    DataType,
    ObjectDictionary,
    Variable,
    decode,
    encode,
    integer_range,
    is_integer,
    length_bits,
    zero,
)

NUMBERS = [data_type for data_type in DataType if is_integer(data_type)]
# canopen has no number type for these two: it leaves them as bytes
CANOPEN_NUMBERS = [t for t in NUMBERS if "TIME" not in t.name]


def canopens(data_type: int) -> ODVariable:
    variable = ODVariable("x", 0x2000, 0)
    variable.data_type = data_type
    return variable


@pytest.mark.parametrize("data_type", CANOPEN_NUMBERS, ids=lambda t: t.name)
def test_range_ends_encode_as_in_canopen(data_type):
    low, high = integer_range(data_type)
    for value in (low, 0, high):
        raw = encode(data_type, value)
        assert raw == canopens(data_type).encode_raw(value)
        assert decode(data_type, raw) == value
    for value in (low - 1, high + 1):
        with pytest.raises(ValueError, match="does not fit"):
            encode(data_type, value)


@given(st.sampled_from(NUMBERS), st.data())
def test_every_number_makes_round_trip(data_type, data):
    value = data.draw(st.integers(*integer_range(data_type)))
    raw = encode(data_type, value)
    assert len(raw) == (length_bits(data_type) + 7) // 8
    assert decode(data_type, raw) == value


@pytest.mark.parametrize(
    ("data_type", "value", "raw"),
    [
        (DataType.INTEGER8, -1, "FF"),  # two's complement, little endian (CiA 301, 7.1.4)
        (DataType.INTEGER24, -2, "FE FF FF"),
        (DataType.INTEGER32, -(1 << 31), "00 00 00 80"),
        (DataType.UNSIGNED24, 0x123456, "56 34 12"),
        (DataType.REAL32, 6.25, "00 00 C8 40"),  # the example of CiA 301, 7.1.4.6
        (DataType.REAL64, 1.0, "00 00 00 00 00 00 F0 3F"),
        (DataType.VISIBLE_STRING, b"abc", "61 62 63"),
        (DataType.DOMAIN, b"", ""),
    ],
)
def test_values_encode_as_in_standard(data_type, value, raw):
    assert encode(data_type, value) == bytes.fromhex(raw)
    assert decode(data_type, bytes.fromhex(raw)) == value


@given(st.floats(width=32) | st.floats())
def test_reals_are_ieee_754_and_large_ones_are_refused(value):
    assert encode(DataType.REAL64, value) == struct.pack("<d", value)
    try:
        expected = struct.pack("<f", value)
    except OverflowError:
        with pytest.raises(ValueError, match="does not fit"):
            encode(DataType.REAL32, value)
    else:
        assert encode(DataType.REAL32, value) == expected
        assert math.isnan(value) or decode(DataType.REAL32, expected) == pytest.approx(
            value, rel=1e-6, abs=1e-44
        )  # REAL32 has 24 bits of mantissa


@pytest.mark.parametrize(
    ("data_type", "value"),
    [(DataType.UNSIGNED8, b"\x01"), (DataType.UNSIGNED8, 1.5), (DataType.VISIBLE_STRING, 5)],
)
def test_value_of_wrong_kind_is_type_error(data_type, value):
    with pytest.raises(TypeError):
        encode(data_type, value)
    assert not Variable(0x2000, 0, data_type).can_hold(value)


def test_wrong_number_of_bytes_is_refused():
    with pytest.raises(ValueError, match="takes 2 bytes"):
        decode(DataType.UNSIGNED16, b"\x01")


@pytest.mark.parametrize("data_type", DataType, ids=lambda t: t.name)
def test_variable_without_value_is_zero(data_type):
    variable = Variable(0x2000, 0, data_type)
    assert variable.value == zero(data_type)
    assert not variable.has_default
    assert variable.upload() == bytes((length_bits(data_type) + 7) // 8)


def test_boolean_takes_lowest_bit():
    variable = Variable(0x2000, 0, DataType.BOOLEAN)
    assert variable.download(b"\x03") == 0
    assert variable.value == 1


def test_unknown_access_is_refused():
    with pytest.raises(ValueError, match="rwx"):
        Variable(0x2000, 0, DataType.UNSIGNED8, access="rwx")


def test_oversized_default_is_refused():
    with pytest.raises(ValueError, match="does not fit"):
        Variable(0x2000, 0, DataType.UNSIGNED8, default=256)
    with pytest.raises(ValueError, match="does not fit"):
        Variable(0x2000, 0, DataType.INTEGER8).set_default(200)


def test_absent_object_works_invisibly():
    od = ObjectDictionary()
    hidden = od.ensure(0x605A, 0, DataType.INTEGER16, 2)
    assert hidden.value == 2
    assert od.get(0x605A) is None
    assert not od.has_index(0x605A)
    assert od.ensure(0x605A, 0, DataType.INTEGER16, 5) is hidden
    assert od.integer(0x605A, 0, 9) == 2
    hidden.value = 6
    od.reset()
    assert hidden.value == 2


def test_visible_object_keeps_stated_default():
    od = ObjectDictionary()
    stated = od.add(Variable(0x605A, 0, DataType.INTEGER16, default=6))
    silent = od.add(Variable(0x605D, 0, DataType.INTEGER16))
    assert od.ensure(0x605A, 0, DataType.INTEGER16, 2) is stated
    assert od.ensure(0x605D, 0, DataType.INTEGER16, 1) is silent
    assert (stated.value, silent.value) == (6, 1)


def test_reset_takes_range_of_indices():
    od = ObjectDictionary()
    for index in (0x0FFF, 0x1000, 0x1FFF, 0x2000):
        od.add(Variable(index, 0, DataType.UNSIGNED8, default=1)).value = 9
    od.reset(0x1000, 0x1FFF)
    assert [variable.value for variable in od] == [9, 1, 1, 9]


def test_variables_are_iterated_by_index_and_sub_index():
    od = ObjectDictionary()
    for index, subindex in ((0x6040, 0), (0x1018, 2), (0x1018, 0), (0x1018, 1)):
        od.add(Variable(index, subindex, DataType.UNSIGNED8))
    assert [(v.index, v.subindex) for v in od] == [
        (0x1018, 0), (0x1018, 1), (0x1018, 2), (0x6040, 0),
    ]  # fmt: skip
    assert od.subindices(0x1018) == (0, 1, 2)
    assert od.indices() == (0x1018, 0x6040)


def test_dictionaries_of_one_pattern_share_nothing():
    pattern = ObjectDictionary()
    for subindex in (2, 0, 1):
        made = pattern.add(Variable(0x2000, subindex, DataType.UNSIGNED8, "x", limits=(1, 9)))
        made.set_default(5)
    pattern.get(0x2000, 1).follows_node_id = True
    first, second = ObjectDictionary(pattern), ObjectDictionary(pattern)
    first.node_id = 1
    assert (first.indices(), first.subindices(0x2000)) == ((0x2000,), (0, 1, 2))
    assert first.integer(0x2000, 2, 0) == 5
    assert first.get(0x2000, 2).download(b"\x07") == 0
    assert first.get(0x2000, 2).download(b"\x0a") != 0  # beyond its limit
    first.add(Variable(0x2001, 0, DataType.UNSIGNED8, "y"))
    first.follow(3)
    assert [(one.index, one.subindex, one.value) for one in second] == [
        (0x2000, subindex, 5) for subindex in (0, 1, 2)
    ]
    assert [one.value for one in first] == [5, 5, 7, 0]
    assert [one.default for one in first] == [5, 7, 5, 0]
    first.reset()
    assert [one.value for one in first] == [5, 7, 5, 0]
