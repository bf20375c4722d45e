"""Live view in Debian's Chromium: a growing file, reconnects, keys, sizes, the tree of names."""

import json

import pytest

from motorhil.harness.view import increments
from tests.support.view.growing import free_port, served

pytestmark = pytest.mark.wall

ALL = 27_999  # messages of the demo
# Everything that a page has drawn from, in a form to compare.
PICTURE = """JSON.stringify({
  lines: [...lines].map(([place, one]) => [place, one.t.length, one.v.reduce((a, b) => a + b, 0)]),
  loads: traffics.map((one) => [one.name, one.frames, one.sums[one.ends.length], one.counts
    ? one.counts.reduce((a, b) => a + b, 0) : one.ends.length]),
  bars: panels.filter((p) => p instanceof TimelinePanel).map((p) => p.rows.map((row) =>
    [row.name, [...row.word].map((word, i) => [p.told.words[word], row.to[i] - row.from[i] > 1e-6])
      .filter((one) => one[1]).map((one) => one[0])])),
  incidents: report.incidents.list.map((one) => one.slice(1)),
})"""


def has(browser, messages):
    browser.wait(f"Number(document.documentElement.dataset.messages) >= {messages}")


def state(browser):
    return browser.run("document.documentElement.dataset.live")


def shown(browser):
    return browser.run("[view.from, view.to]")


def test_picture_grows_into_that_of_the_complete_file(page, growing, monkeypatch):
    monkeypatch.setattr(increments, "NEWS_POINTS", 10**6)  # so that nothing is reduced
    with served(growing.path) as server:
        growing.grow()
        one = page(server)
        for _ in range(6):
            seen = one.run("Number(document.documentElement.dataset.messages || 0)")
            growing.grow(2)
            has(one, seen + 1)
        growing.complete()
        one.wait("document.documentElement.dataset.live === 'complete'")
        has(one, ALL)
        assert one.run("Number(document.documentElement.dataset.events)") > 6
        grown = json.loads(one.run(PICTURE))
        page(server)
        has(one, ALL)
        assert one.run("Number(document.documentElement.dataset.events)") == 1
        whole = json.loads(one.run(PICTURE))
    assert grown["bars"] == whole["bars"]
    assert grown["incidents"] == whole["incidents"]
    assert grown["loads"] == whole["loads"]
    for (place, count, total), (other, all_, sum_) in zip(
        grown["lines"], whole["lines"], strict=True
    ):
        assert (place, count) == (other, all_)
        assert total == pytest.approx(sum_, rel=1e-3, abs=1e-2)  # 32-bit values


def test_axis_moves_with_the_newest_and_stays_when_paused(page, growing):
    with served(growing.path) as server:
        growing.grow(4)
        one = page(server)
        has(one, 1)
        one.run("$('window').value = '2'; $('window').dispatchEvent(new Event('change'))")
        before = shown(one)
        assert before[1] == pytest.approx(one.run("SPAN"), rel=0.05)
        growing.grow(3)
        one.wait(f"view.to > {before[1] + 1}")
        one.key(" ")
        assert state(one) == "paused"
        held, seen = shown(one), one.run("Number(document.documentElement.dataset.messages)")
        growing.grow(3)
        has(one, seen + 1)
        assert shown(one) == held
        one.key("l")
        assert state(one) == "live"
        assert shown(one)[1] > held[1] + 1


def test_page_survives_a_restart_of_the_server(page, growing):
    port = free_port()
    growing.grow(5)
    with served(growing.path, port) as server:
        one = page(server)
        has(one, 1)
        seen = one.run("Number(document.documentElement.dataset.messages)")
    one.wait("document.documentElement.dataset.live === 'reconnecting'")
    growing.grow(5)
    with served(growing.path, port):
        has(one, seen + 1)
        growing.complete()
        has(one, ALL)
        one.wait("document.documentElement.dataset.live === 'complete'")
        frames = one.run("traffics.map((one) => one.frames)")
    assert frames == [10_437, 7_352]


def test_trigger_stops_the_picture_at_a_fault(page, growing):
    with served(growing.path) as server:
        growing.grow(1)
        one = page(server)
        one.run("$('trigger').value = 'any'; $('trigger-text').value = 'NMT command'")
        one.run("$('trigger').dispatchEvent(new Event('change'))")
        has(one, 1)
        growing.complete()
        has(one, ALL)
        text = one.run("$('state').textContent")
    assert text.startswith("stopped at ")
    assert "NMT command" in text


def test_find_shows_only_what_has_the_text(page, demo):
    with served(demo) as server:
        one = page(server)
        has(one, ALL)

        def found(text):
            one.run(f"$('find').value = {text!r}; $('find').dispatchEvent(new Event('input'))")
            return one.run(
                "[[...document.querySelectorAll('#presence-table tbody tr')],"
                " [...document.querySelectorAll('.motor')]]"
                ".map((rows) => rows.filter((row) => !row.hidden).length)"
            )

        assert found("pan") == [1, 1]
        assert found("607A") == [0, 14]
        assert found("node 127") == [2, 0]
        assert found("") == [16, 14]


def test_messages_show_period_and_data(page, demo):
    with served(demo) as server:
        one = page(server)
        has(one, ALL)
        one.run("document.querySelectorAll('#tables details')[1].open = true")
        one.wait("document.querySelectorAll('#identifiers-table tbody tr').length > 60")
        row = one.run(
            "[...[...document.querySelectorAll('#identifiers-table tbody tr')]"
            ".find((row) => row.cells[1].textContent === '181h').cells].map((c) => c.textContent)"
        )
    assert row[:4] == ["can0", "181h", "TPDO 1 drive_fl", "887"]
    assert row[4].endswith(" ms")
    assert len(row[6].split()) == 6


def test_zoom_into_a_reduced_picture_gets_all_points(page, demo, monkeypatch):
    shown_points = """(() => {
      const line = [...lines.values()].reduce((a, b) => b.points > a.points ? b : a);
      return line.t.filter((at) => at > 4.0 && at < 4.5).length; })()"""
    with served(demo) as server:
        one = page(server)
        has(one, ALL)
        every = one.run(shown_points)
        monkeypatch.setattr(increments, "POINTS_MAX", 2_000)
        page(server)
        has(one, ALL)
        few = one.run(shown_points)
        assert 0 < 2 * few < every
        one.run("setRange(4.0, 4.5)")
        one.wait("document.documentElement.dataset.detail")
        assert one.run(shown_points) == every
        one.run("setRange(0, SPAN)")
        assert one.run(shown_points) == few


def test_keyboard_alone_suffices(page, demo):
    with served(demo) as server:
        one = page(server)
        has(one, ALL)
        reached = []
        for _ in range(45):
            one.call("Input.dispatchKeyEvent", type="keyDown", key="Tab", code="Tab")
            one.call("Input.dispatchKeyEvent", type="keyUp", key="Tab", code="Tab")
            reached.append(one.run("document.activeElement.id || document.activeElement.tagName"))
        wanted = {"pause", "window", "trigger", "trigger-text", "find", "report", "charts", "from"}
        assert wanted - set(reached) == set()
        one.run("document.activeElement.blur()")
        one.key("/")
        assert one.run("document.activeElement.id") == "find"


@pytest.mark.parametrize(("width", "height"), [(320, 640), (800, 600), (1400, 900), (3840, 2160)])
def test_page_fits_every_width(page, demo, width, height):
    with served(demo) as server:
        page_ = page(server)
        page_.size(width, height)
        has(page_, ALL)
        page_.settle()
        assert page_.run("document.documentElement.scrollWidth") <= width
        outside = page_.run(
            "[...document.querySelectorAll('#live > *')].filter((one) => one.offsetParent"
            " && one.getBoundingClientRect().right > innerWidth + 1).map((one) => one.id)"
        )
        assert outside == []


def test_dark_and_light_have_their_colours(page, demo):
    with served(demo) as server:
        one = page(server)
        has(one, ALL)
        colours = []
        for scheme in ("light", "dark"):
            one.media(prefers_color_scheme=scheme)
            one.settle()
            colours.append(one.run("getComputedStyle(document.body).backgroundColor"))
            assert one.run(
                "theme.paper === getComputedStyle(document.documentElement)"
                ".getPropertyValue('--paper').trim()"
            )
    assert colours == ["rgb(255, 255, 255)", "rgb(15, 20, 25)"]


def test_every_control_has_a_name_for_a_screen_reader(page, demo):
    with served(demo) as server:
        one = page(server)
        has(one, ALL)
        tree = one.call("Accessibility.getFullAXTree")["nodes"]

    def value(node, key):
        return node.get(key, {}).get("value", "")

    seen = [node for node in tree if not node.get("ignored")]
    roles = {"button", "combobox", "searchbox", "textbox", "link", "table", "image", "toolbar"}
    nameless = [
        (value(node, "role"), node.get("backendDOMNodeId"))
        for node in seen
        if value(node, "role") in roles - {"table"} and not value(node, "name")
    ]
    assert nameless == []
    names = {(value(node, "role"), value(node, "name")) for node in seen}
    assert ("status", "") in names or any(role == "status" for role, _ in names)
    assert ("rowheader", "drive_fl") in names
    assert ("columnheader", "heartbeat") in names
    assert ("button", "pause") in names


def test_text_from_a_bus_is_text(page, tmp_path):
    from tests.support.recordings.handmade import MS, Recorded

    bad = "<img src=x onerror=alert(1)><script>document.title='owned'</script>"
    path = Recorded(tmp_path / "bad.mcap").event(0, bad, bad).event(MS, bad).close()
    with served(path) as server:
        one = page(server)
        has(one, 2)
        assert one.run("document.title") == "live"
        assert one.run("document.querySelectorAll('img, #list script').length") == 0
        assert bad in one.run("document.querySelector('#list').textContent")
