"""The live view over HTTP: who may read it, growing files, slow pages, reconnects without a gap."""

from contextlib import ExitStack

import pytest

from motorhil.harness.view import server as view_server
from motorhil.harness.view.stream import Event
from tests.support.view.growing import TOKEN, Events, free_port, get, served
from tests.support.view.page_model import Page

pytestmark = pytest.mark.wall


def event(fields):
    return Event(fields["id"], fields["event"], fields["data"])


def until(events, page, messages):
    """Take events until the page has this number of messages."""
    while page.messages < messages:
        page.take(event(events.next()))
    return page


def test_page_events_and_report_need_the_token(growing):
    with served(growing.path) as server:
        for path in ("/", "/events", "/report", "/?token=wrong", "/events?token="):
            status, _, body = get(server.port, path)
            assert (status, body[:6]) == (403, b"token:")
        status, headers, body = get(server.port, f"/?token={TOKEN}")
        assert (status, headers["Content-Type"]) == (200, "text/html; charset=utf-8")
        assert headers["Cache-Control"] == "no-store"
        assert b"connect-src 'self'" in body
        assert b"@@" not in body
        assert get(server.port, f"/report?token={TOKEN}")[2] == b"the report"
        assert get(server.port, f"/other?token={TOKEN}")[0] == 404
        assert server.address == f"http://127.0.0.1:{server.port}/?token={TOKEN}"


def test_stretch_needs_two_times(growing):
    growing.grow(2)
    with served(growing.path) as server:
        path = f"/stretch?token={TOKEN}"
        assert get(server.port, "/stretch?from=0&to=1")[0] == 403
        for times in ("", "&from=0", "&from=x&to=1", "&from=2&to=1", "&from=nan&to=nan"):
            assert get(server.port, path + times)[0] == 400
        for times in ("&from=0&to=1", "&from=-inf&to=inf", "&from=1e300&to=1e300"):
            assert get(server.port, path + times)[0] == 200


def test_other_sites_are_refused(growing):
    with served(growing.path) as server:
        path = f"/events?token={TOKEN}"
        assert get(server.port, path, Host="evil.example")[0] == 403
        assert get(server.port, path, Host=f"evil.example:{server.port}")[0] == 403
        assert get(server.port, path, Origin="http://evil.example")[0] == 403
        own = f"http://127.0.0.1:{server.port}"
        assert get(server.port, f"/?token={TOKEN}", Origin=own)[0] == 200


def test_complete_file_is_one_picture_and_its_end(demo):
    with served(demo) as server, Events(server.port) as events:
        first, last, end = events.next(), events.next(), events.next()
        assert (first["event"], end) == ("whole", None)
        assert list(last) == ["event", "data"] or list(last) == ["event", "data:"]
        assert last["event"] == "over"
        assert Page().take(event(first)).messages == 27_999


def test_growing_file_is_seen_as_it_grows(growing):
    with served(growing.path) as server, Events(server.port) as events:
        growing.grow()
        page = Page().take(event(events.next()))
        seen = page.messages
        assert seen > 0
        for _ in range(3):
            growing.grow()
            seen = until(events, page, seen + 1).messages
        growing.complete()
        until(events, page, 27_999)
        assert events.next()["event"] == "over"


def test_page_that_reconnects_gets_the_events_after_its_last(growing):
    with served(growing.path) as server:
        with Events(server.port) as events:
            growing.grow()
            page = Page().take(event(events.next()))
        with Events(server.port) as watching:
            other, positions = Page().take(event(watching.next())), []
            growing.grow(12)
            while other.messages < 15_000:
                positions.append(other.take(event(watching.next())).position)
            again = []
            with Events(server.port, page.position) as events:
                while page.position != other.position:
                    again.append(page.take(event(events.next())).position)
    assert again == positions  # the same events, not a new picture
    assert page.lines == other.lines
    assert page.loads == other.loads
    assert page.bars == other.bars


def test_page_reconnects_to_a_new_server_without_a_gap(growing):
    port = free_port()
    growing.grow(4)
    with served(growing.path, port) as server, Events(server.port) as events:
        page = Page().take(event(events.next()))
    growing.grow(4)
    with served(growing.path, port) as server, Events(server.port, page.position) as events:
        again = event(events.next())
        assert again.kind == "whole"  # the new server has no events from before it was started
        seen = page.take(again).messages
        growing.complete()
        until(events, page, 27_999)
        assert seen < page.messages
    with served(growing.path, port) as server, Events(server.port, page.position) as events:
        assert events.next()["event"] == "over"  # all of it is in the page already


def test_slow_page_delays_no_other(growing):
    with served(growing.path) as server, ExitStack() as slow:
        for _ in range(3):
            slow.enter_context(Events(server.port, room=4_096))  # takes nothing
        with Events(server.port) as events:
            growing.grow()
            page = Page().take(event(events.next()))
            growing.complete()
            until(events, page, 27_999)


def test_pages_beyond_the_limit_are_refused(growing, monkeypatch):
    monkeypatch.setattr(view_server, "PAGES_MAX", 2)
    with served(growing.path) as server, Events(server.port), Events(server.port):
        status, _, body = get(server.port, f"/events?token={TOKEN}")
        assert (status, body) == (503, b"events: 2 pages are open already; close one")


def test_overwritten_file_is_told_to_the_page(growing):
    with served(growing.path) as server, Events(server.port) as events:
        growing.grow(2)
        events.next()
        growing.path.write_bytes(growing.path.read_bytes()[:100])
        told = events.next()
        while told["event"] != "problem":
            told = events.next()
        assert "has become shorter" in told["data"]
