"""The picture of a page: the same, whenever it was sent, and in however many pieces."""

import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st

from motorhil.harness.view import increments
from motorhil.harness.view.session import PERIOD_NS, Session, Subject
from motorhil.harness.view.stream import Event
from motorhil.traces.schema import MOTOR_LOCK, LockAction
from tests.support.recordings.handmade import MS, Recorded, S
from tests.support.view.page_model import Page, opened, points

_TICK_S = 1e-7  # more than two ticks of a recording of minutes


def told(attachments, messages, cuts):
    """Feed the messages in pieces; return the page of the events, and one that opens at the end."""
    session, page, begun = Session(Subject("demo", attachments)), Page(), 0
    for number, end in enumerate((*cuts, len(messages))):
        session.feed(messages[begun:end])
        begun = end
        before = session.stream.position
        session.advance(number * S)
        for event in session.stream.after(before) if before != session.stream.position else ():
            page.take(event)
    return page, Page().take(session.whole(10**12))


def test_stretch_has_all_points_of_its_time(demo_messages, monkeypatch):
    attachments, messages = demo_messages()
    session = Session(Subject("demo", attachments))
    session.feed(messages)
    full = Page().take(session.whole(S))
    monkeypatch.setattr(increments, "POINTS_MAX", 2_000)
    coarse = Page().take(session.whole(2 * S))
    stretch, arrays = opened(Event("", "", session.stretch(4.0, 4.5)))
    places = {place: name for name, place in zip(full.lines, full.places(), strict=True)}
    compared = 0
    for one in stretch["lines"]:
        name = places[tuple(one["at"])]
        found = points(one, arrays, stretch["time"]["tick_s"])
        inside = [point for point in full.lines[name] if 4.0 + _TICK_S < point[0] < 4.5 - _TICK_S]
        fine = [point for point in found if 4.0 + _TICK_S < point[0] < 4.5 - _TICK_S]
        assert close(fine, inside), name
        few = [point for point in coarse.lines[name] if 4.0 < point[0] < 4.5]
        compared += len(inside) > 2 * len(few) > 0
    assert compared > 10


def close(one, other):
    """Compare points: times within two ticks, values as exact as 32 bits are."""
    one, other = np.array(one), np.array(other)
    return one.shape == other.shape and np.allclose(one, other, rtol=1e-6, atol=1e-6)


def same_bars(one, other):
    """Compare rows; a bar may have been cut in two of the same word, or end at its begin."""
    for row in (one, other):
        row[:] = [bar for bar in row if bar[1] - bar[0] > _TICK_S]
    return len(one) == len(other) and all(
        a[2:] == b[2:] and close(a[:2], b[:2]) for a, b in zip(one, other, strict=True)
    )


@settings(max_examples=8)
@given(cuts=st.lists(st.integers(2_500, 4_999), max_size=15, unique=True))
def test_news_lead_to_the_whole_picture(demo_messages, cuts):
    attachments, messages = demo_messages()
    messages = messages[:3_500] + messages[12_000:13_500]
    limit, increments.NEWS_POINTS = increments.NEWS_POINTS, 10**6  # so that nothing is reduced
    try:
        page, fresh = told(attachments, messages, sorted(cuts))
    finally:
        increments.NEWS_POINTS = limit
    assert page.position == fresh.position
    assert page.messages == len(messages)
    assert page.lines.keys() == fresh.lines.keys()
    for name, line in fresh.lines.items():
        assert close(page.lines[name], line), name
    assert page.loads == fresh.loads
    assert all(same_bars(page.bars[key], row) for key, row in fresh.bars.items())
    assert [one[1:] for one in page.incidents] == [one[1:] for one in fresh.incidents]
    assert "more" in page.kinds or len(cuts) < 15


def test_most_events_of_a_steady_rig_are_news(demo_messages):
    attachments, messages = demo_messages()
    page, _ = told(attachments, messages, range(400, len(messages), 400))
    assert page.kinds[0] == "whole"
    assert page.kinds.count("whole") < len(page.kinds) / 4
    assert page.kinds[-20:].count("whole") == 0


def test_news_are_bounded_whatever_the_rate(demo_messages, monkeypatch):
    attachments, messages = demo_messages()
    monkeypatch.setattr(increments, "NEWS_POINTS", 500)
    session, page = Session(Subject("demo", attachments)), Page()
    session.feed(messages[:20_000])
    page.take(session.whole(0))
    before = sum(map(len, page.lines.values()))
    session.feed(messages[20_000:])
    session.advance(PERIOD_NS)
    page.take(session.stream.after(session.stream.after("")[0].position)[0])
    assert page.kinds == ["whole", "more"]
    assert page.messages == len(messages)
    assert 100 < sum(map(len, page.lines.values())) - before <= 500 + 2 * len(page.lines)


def test_equal_positions_mean_equal_messages(tmp_path, session_of):
    def recorded(name, value):
        one = Recorded(tmp_path / name)
        one.position(0, "left_wheel", 0.0).position(MS, "left_wheel", value)
        return session_of(one.close())

    positions = []
    for name, value in (("a.mcap", 1.0), ("b.mcap", 1.0), ("c.mcap", 2.0)):
        session, messages = recorded(name, value)
        session.feed(messages[:1])
        first = session.position
        session.feed(messages[1:])
        positions.append((first, session.position))
    assert positions[0] == positions[1]
    assert positions[0][0] == positions[2][0]
    assert positions[0][1] != positions[2][1]


def test_event_is_due_after_a_period_or_at_once_with_an_error(tmp_path, session_of):
    one = Recorded(tmp_path / "a.mcap")
    one.position(0, "left_wheel", 0.0).position(MS, "left_wheel", 1.0)
    one.position(2 * MS, "left_wheel", 2.0)
    one.frame(3 * MS, 0x701, "05").frame(4 * MS, 0x081, "3023050000000000")  # an emergency
    session, messages = session_of(one.close())
    session.feed(messages[:1])
    assert session.is_due(0)
    session.advance(0)
    assert not session.is_due(10 * PERIOD_NS)  # nothing is new
    session.feed(messages[1:2])
    assert not session.is_due(PERIOD_NS - 1)
    assert session.is_due(PERIOD_NS)
    session.advance(PERIOD_NS)
    session.feed(messages[2:4])
    assert not session.is_due(PERIOD_NS + 1)
    session.feed(messages[4:])
    assert session.is_due(PERIOD_NS + 1)


def test_owner_of_a_motor_is_the_latest_one(tmp_path, session_of):
    one = Recorded(tmp_path / "a.mcap")

    def lock(time_ns, action, owner):
        values = {"action": int(action), "owner": owner, "pid": 7, "program": owner, "token": 1}
        one.message(time_ns, "/motor/left_wheel/lock", MOTOR_LOCK, values)

    lock(0, LockAction.TAKEN, "first")
    one.position(S, "left_wheel", 1.0)
    lock(2 * S, LockAction.RELEASED, "first")
    session, messages = session_of(one.close())
    page, owners = Page(), []
    for number, message in enumerate(messages):
        before = session.stream.position
        session.feed([message])
        session.advance(number * S)
        for event in session.stream.after(before):
            page.take(event)
        owners.append(page.presence["left_wheel"]["owner"])
    assert owners == ["first [7]", "first [7]", ""]


def test_fault_is_in_the_row_of_its_motor(tmp_path, session_of):
    one = Recorded(tmp_path / "a.mcap")
    one.frame(0, 0x701, "05").frame(MS, 0x702, "05").frame(2 * MS, 0x081, "3023050000000000")
    session, messages = session_of(one.close())
    session.feed(messages)
    page = Page().take(session.whole(0))
    assert page.presence["left_wheel"]["place"] == "can0 1"
    assert "2330h" in page.presence["left_wheel"]["fault"]
    assert page.presence["right_wheel"]["fault"] == ""
