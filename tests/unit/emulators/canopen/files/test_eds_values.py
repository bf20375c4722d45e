"""Values, types, limits and access in EDS files, with and without repair."""

import pytest

from motorhil.emulators.canopen.object_dictionary import DataType
from tests.support.canopen.eds_texts import GOOD, line_of, variable, warned


@pytest.mark.parametrize(
    ("text", "value"),
    [
        ("0xFD", -3),  # hexadecimals of signed types are two's complement
        ("-3", -3),
        ("0x7F", 127),
        ("-0x03", -3),
        ("0x80", -128),
        ("$NODEID+0x10", 0x15),
        ("0x10+$NodeId", 0x15),
        ("$nodeid + 16", 0x15),
        ("$NODEID", 5),
        ("00", 0),
        ("  7  ", 7),
        ("", None),
    ],
)
def test_plain_value_gives_no_remark(read, text, value):
    device = read(GOOD + variable(f"DefaultValue={text}"))
    assert warned(device) == []
    entry = device.dictionary().get(0x6060)
    assert entry.value == (0 if value is None else value)
    assert entry.has_default == (value is not None)


@pytest.mark.parametrize(
    ("text", "value"),
    [
        ("0xFD ; two's complement", -3),
        ("5;five", 5),
        ("5 // five", 5),
        ("5 # five", 5),
        ("253", -3),  # decimal, but clearly meant as two's complement
        ("0xFFFFFFFD", -3),  # written for 32 bits
        ("010", 8),  # CiA 306: octal
        ("08", 8),
        ("10h", 16),
        ('"5"', 5),
        ("5.0", 5),
        ("true", 1),
        ("$NODEID+1 ; mine", 6),
    ],
)
def test_repaired_value_gives_remark(read, text, value):
    whole = GOOD + variable(f"DefaultValue={text}")
    device = read(whole)
    assert device.dictionary().get(0x6060).value == value
    assert [line for line, _ in warned(device)] == [line_of(whole, f"DefaultValue={text}")]


@pytest.mark.parametrize("text", ["five", "0xZ", "300", "0x1FF", "-129", "$NODEID*2", "1 2", "5.5"])
def test_unreadable_value_is_refused_with_line(refused, text):
    whole = GOOD + variable(f"DefaultValue={text}")
    line, _ = refused(whole)
    assert line == line_of(whole, f"DefaultValue={text}")


def test_limits_are_twos_complement(read):
    device = read(GOOD + variable("LowLimit=0x80\nHighLimit=0x7F\nDefaultValue=-128"))
    entry = device.dictionary().get(0x6060)
    assert (entry.low, entry.high) == (-128, 127)
    assert warned(device) == []


@pytest.mark.parametrize(
    ("limits", "expected", "words"),
    [
        ("LowLimit=0\nHighLimit=0xFF\nDefaultValue=0", (None, None), "leave no value"),
        ("LowLimit=0\nHighLimit=0\nDefaultValue=6", (None, None), "left out"),
        ("LowLimit=0\nHighLimit=9\nDefaultValue=10", (0, 9), "outside"),
        ("LowLimit=none\nHighLimit=9", (None, 9), "left out"),
        ("LowLimit=-1000\nHighLimit=9", (None, 9), "left out"),
    ],
)
def test_senseless_limits_are_left_out_with_warning(read, limits, expected, words):
    whole = GOOD + variable(limits)
    device = read(whole)
    entry = device.dictionary().get(0x6060)
    assert (entry.low, entry.high) == expected
    ((line, text),) = warned(device)
    assert line == line_of(whole, "LowLimit")
    assert words in text


def test_parameter_value_in_dcf_overrides_default_value(read):
    device = read(GOOD + variable("DefaultValue=8\nParameterValue=50"))
    assert device.dictionary().get(0x6060).default == 50
    device = read(GOOD + variable("ParameterValue=\nDefaultValue=8"))
    assert device.dictionary().get(0x6060).default == 8


def test_compact_sub_objects_are_expanded(read):
    text = """
[1016]
ParameterName=Consumer heartbeat time
ObjectType=0x8
DataType=0x0007
AccessType=rw
DefaultValue=0
CompactSubObj=3
[1016Name]
NrOfEntries=1
2=The host
[1016Value]
NrOfEntries=1
2=0x007F0096
"""
    device = read(GOOD + text)
    assert warned(device) == []
    od = device.dictionary()
    assert [od.integer(0x1016, sub, 9) for sub in range(4)] == [3, 0, 0x7F0096, 0]
    assert od.get(0x1016, 2).name == "The host"
    assert od.get(0x1016, 0).access == "ro"
    assert od.get(0x1016, 4) is None


@pytest.mark.parametrize(
    ("old", "new"),
    [
        ("DataType=0x0002\n", ""),
        ("AccessType=rww", "AccessType=sometimes"),
        ("DataType=0x0002", "DataType=seven"),
    ],
)
def test_invalid_object_is_refused(refused, old, new):
    whole = GOOD + variable("").replace(old, new)
    line, _ = refused(whole)
    assert line == line_of(whole, new or "[6060]")


@pytest.mark.parametrize(
    ("old", "new", "access"),
    [
        ("AccessType=rww\n", "", "rw"),
        ("AccessType=rww", "AccessType=read-only", "ro"),
        ("AccessType=rww", "AccessType=R/W", "rw"),
    ],
)
def test_access_synonym_gives_warning(read, old, new, access):
    device = read(GOOD + variable("").replace(old, new))
    assert device.dictionary().get(0x6060).access == access
    assert len(warned(device)) == 1


def test_unknown_data_type_is_domain(read):
    device = read(GOOD + variable("").replace("DataType=0x0002", "DataType=0x0040"))
    assert device.dictionary().get(0x6060).data_type == DataType.DOMAIN
    assert len(warned(device)) == 1


@pytest.mark.parametrize(
    ("data_type", "text", "value"),
    [
        (0x08, "1.5", 1.5),
        (0x08, "0", 0.0),
        (0x09, "C5-E 2; Rev #1", b"C5-E 2; Rev #1"),
        (0x0A, "0102FF", b"\x01\x02\xff"),
        (0x0F, "01 02", b"\x01\x02"),
        (0x01, "1", 1),
        (0x15, "0xFFFFFFFFFFFFFFFF", -1),
    ],
)
def test_values_of_other_types_are_read(read, data_type, text, value):
    whole = variable(f"DefaultValue={text}").replace("0x0002", f"0x{data_type:04X}")
    device = read(GOOD + whole)
    assert device.dictionary().get(0x6060).value == value
    assert warned(device) == []


@pytest.mark.parametrize(
    ("data_type", "text", "value"),
    [(0x08, "1,5", 1.5), (0x08, "0x3FC00000", 1.5), (0x05, "-1", 255), (0x0F, "xy", b"xy")],
)
def test_values_of_other_types_are_repaired(read, data_type, text, value):
    whole = variable(f"DefaultValue={text}").replace("0x0002", f"0x{data_type:04X}")
    device = read(GOOD + whole)
    assert device.dictionary().get(0x6060).value == value
    assert len(warned(device)) == 1
