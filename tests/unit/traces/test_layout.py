"""Layouts of frames as text."""

import pytest

from motorhil.traces.api import Layout, Signal, layouts


def test_values_follow_one_another_unless_a_place_is_given():
    layout = Layout("temperature i8 C; +1; voltage u16/10 V; @6 errors u16")
    assert layout.size == 8
    assert list(layout.signals(bytes.fromhex("FE 00 E501 0000 0400"))) == [
        Signal("temperature", -2, "C"),
        Signal("voltage", 48.5, "V"),
        Signal("errors", 4, ""),
    ]


def test_type_order_and_scale_of_a_value():
    data = bytes.fromhex("3FC00000 0102 03")
    layout = Layout("speed f32 rev/s; delay u16*2 us; share u8*0.5", "big")
    assert [signal.value for signal in layout.signals(data)] == [1.5, 516, 1.5]
    assert repr([signal.value for signal in layout.signals(data)]) == "[1.5, 516, 1.5]"


def test_unit_may_have_two_words():
    assert Layout("winding temperature u8 deg C").items[0].unit == "deg C"


def test_missing_bytes_count_as_0():
    assert [one.value for one in Layout("a u8; b i16").signals(b"\x01\x02")] == [1, 2]


def test_table_has_a_message_a_line_and_layouts_between_bars():
    found = layouts("A1 speed: rpm i16 |\n  rpm i16;\n  current i16/100 A\n76 reset:", base=16)
    name, (request, answer) = found[0xA1]
    assert (name, request.size, answer.size) == ("speed", 2, 4)
    assert found[0x76][1][0].items == {}


def test_part_without_a_type_is_refused():
    with pytest.raises(ValueError, match='"voltage V" is not a value; expected "name u16/10 unit"'):
        Layout("current i16 A; voltage V")
