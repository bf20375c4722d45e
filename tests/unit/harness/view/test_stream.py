"""Events by position: a page that reconnects gets the events after its last one, or none."""

import pytest
from hypothesis import given
from hypothesis import strategies as st

from motorhil.harness.view.stream import Event, Stream


def stream(count, **limits):
    one = Stream(**limits)
    for number in range(1, count + 1):
        one.append(Event(f"{number}-x", "more", f"data {number}"))
    return one


@given(st.integers(1, 40), st.data())
def test_page_that_reconnects_anywhere_misses_nothing(count, data):
    one = stream(count)
    at = data.draw(st.integers(1, count))
    found = one.after(f"{at}-x")
    assert [event.position for event in found] == [f"{n}-x" for n in range(at + 1, count + 1)]


@pytest.mark.parametrize("position", ["", "3-y", "11-x", "-1"])
def test_position_of_another_history_has_no_events(position):
    assert stream(10, events_max=5).after(position) is None


def test_positions_before_the_kept_events_have_none():
    one = stream(10, events_max=5)
    assert one.after("4-x") is None
    assert len(one.after("5-x")) == 5


def test_events_beyond_the_byte_limit_are_dropped():
    one = stream(10, bytes_max=12)
    assert one.after("8-x") is None
    assert [event.data for event in one.after("9-x")] == ["data 10"]


def test_text_is_one_server_sent_event():
    assert Event("7-ab", "more", "abc=").text() == b"id: 7-ab\nevent: more\ndata: abc=\n\n"
