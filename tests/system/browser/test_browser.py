"""Page in Debian's Chromium without a network: drawing, zoom, pan, cursor.

Needs `chromium` (Debian package of that name) in PATH.
"""

import re

import pytest

from motorhil.harness.cli.main import main
from motorhil.traces.mcap.writer import TraceWriter
from motorhil.traces.schema import GROUP_SYNC, MOTOR_LOCK
from tests.support.browser import started
from tests.support.recordings.handmade import MS, Recorded

pytestmark = pytest.mark.wall

SECTIONS = [
    "incidents",
    "states",
    "load",
    "groups",
    "locks",
    "motors",
    "identifiers",
    "nmt",
    "modes",
]


@pytest.fixture(scope="module")
def browser(tmp_path_factory):
    yield from started(tmp_path_factory)


@pytest.fixture
def opened(browser, demo_page):
    """Open the demo's page; check afterwards that there were no errors and no requests."""
    browser.begin_anew()
    assert browser.open(demo_page) == "ready"
    yield browser
    assert browser.errors == []
    assert browser.requests == [demo_page.as_uri()]
    assert browser.run("document.documentElement.dataset.error || ''") == ""


def shown(browser):
    return tuple(browser.run("[view.from, view.to]"))


def centre_of(browser, panel):
    """Scroll a panel into view and return the centre of its plot."""
    where = (
        "(() => { const p = panels.find(p => p.canvas.dataset.panel.startsWith("
        + repr(panel)
        + "));"
        " p.canvas.scrollIntoView({block: 'center'}); const b = p.canvas.getBoundingClientRect();"
        " return [b.left + gutter + plotWidth / 2, b.top + b.height / 2]; })()"
    )
    found = browser.run(where)
    browser.settle()
    return found


def test_all_panels_are_drawn_over_the_whole_recording(opened):
    sections = opened.run("[...document.querySelectorAll('#charts > section')].map(s => s.id)")
    assert sections == SECTIONS
    drawn = opened.drawn()
    # 1 of incidents, 3 timelines, 2 loads, 3 groups, 2 of identifiers, modes; 4 for each motor.
    assert len(drawn) == 12 + 4 * 14
    assert all(count > 0 for count, _, _ in drawn.values())
    assert {(begin < 0.0, end > 17.9) for _, begin, end in drawn.values()} == {(True, True)}
    assert drawn["load of can0 over time"][0] == 10_437
    assert drawn["load of can1 by identifier"][0] == 7_352


def test_moving_motor_has_coloured_pixels(opened):
    """Each line's colour covers hundreds of pixels, more than grid lines."""
    colours = opened.run(
        "(() => { const own = p => p.canvas.dataset.panel.startsWith('pan, position');"
        " const c = panels.find(own).canvas;"
        " const d = c.getContext('2d').getImageData(0, 0, c.width, c.height).data; const n = {};"
        " for (let i = 0; i < d.length; i += 4) if (d[i + 3] > 250)"
        " { const k = [d[i], d[i+1], d[i+2]].join(); n[k] = (n[k] || 0) + 1; } return n; })()"
    )
    assert colours["213,94,0"] > 300  # the demand, vermilion of Okabe and Ito
    assert colours["0,114,178"] > 100  # the actual position, blue, beside the demand


def test_single_sample_among_thousands_is_visible(browser, tmp_path):
    """A spike of one sample, with two dozen samples per pixel, rises above all others."""
    one = Recorded(tmp_path / "a.mcap")
    for number in range(24_000):
        one.position(number * MS, "left_wheel", 1.0 if number == 12_345 else 0.0)
    path = one.close()
    assert main(["report", path]) == 0
    browser.errors.clear()
    browser.open((tmp_path / "a.mcap").with_suffix(".html"))
    heights = browser.run(
        "(() => { const own = p => p.canvas.dataset.panel.startsWith('left_wheel, position');"
        " const c = panels.find(own).canvas, w = plotWidth - 8; const out = [];"
        " const d = c.getContext('2d').getImageData(gutter + 4, 0, w, c.height).data;"
        " for (let y = 0; y < c.height; y++) { let n = 0;"
        "   for (let i = 4 * w * y; i < 4 * w * (y + 1); i += 4)"
        "     if (d[i] < 90 && d[i + 2] > 120 && d[i + 3] > 60) n++;"
        "   out.push(n); } return out; })()"
    )
    assert browser.errors == []
    upper = heights[8 : len(heights) // 2]
    assert all(0 < count < 6 for count in upper)  # a thin line over the full height
    assert max(heights) > 500  # and the long one at 0


def test_range_in_the_address_is_drawn(opened, demo_page):
    opened.requests.clear()
    opened.call("Page.navigate", url="about:blank")
    opened.requests.clear()
    opened.open(demo_page, "#t=2.060,2.061")
    opened.requests[:] = [one.partition("#")[0] for one in opened.requests]
    assert shown(opened) == pytest.approx((2.060, 2.061), abs=1e-9)
    drawn = opened.drawn()
    # can0 carries few frames between these times, each with its true length.
    assert 0 < drawn["load of can0 by identifier"][0] < 20


def test_keys_zoom_pan_and_reset(opened):
    opened.run("charts.focus()")
    begin, end = shown(opened)
    opened.key("+")
    assert shown(opened)[1] - shown(opened)[0] == pytest.approx((end - begin) / 2)
    inner = shown(opened)
    opened.key("ArrowRight")
    assert shown(opened)[0] == pytest.approx(inner[0] + 0.2 * (inner[1] - inner[0]))
    opened.key("-")
    opened.key("0")
    assert shown(opened) == pytest.approx((begin, end))
    opened.key("w")
    opened.key("Backspace")
    assert shown(opened) == pytest.approx((begin, end))
    opened.key("n")  # the first warning after the middle, or none
    opened.key("p")
    assert opened.run("cursor") is not None
    opened.key("?")
    assert opened.run("document.getElementById('help').open")
    opened.run("document.getElementById('help').close()")


def test_zoom_redraws_every_visible_panel(opened):
    opened.run("setRange(3, 4)")
    opened.settle()
    drawn = opened.drawn()
    assert drawn["load of can0 over time"][1:] == pytest.approx((3.0, 4.0))
    assert drawn["load of can0 over time"][0] < 1000
    # A panel further down is drawn with the same range when it becomes visible.
    name = next(one for one in drawn if one.startswith("tilt, position"))
    assert drawn[name][2] > 17
    opened.run("document.querySelector('[data-motor=tilt]').scrollIntoView()")
    opened.settle()
    assert opened.drawn()[name][1:] == pytest.approx((3.0, 4.0))


def test_drag_zooms_to_the_dragged_range(opened):
    x, y = centre_of(opened, "load of can0 over")
    middle = sum(shown(opened)) / 2
    opened.mouse("mouseMoved", x, y)
    opened.mouse("mousePressed", x, y, button="left", clickCount=1)
    opened.mouse("mouseMoved", x + 100, y, button="left")
    opened.mouse("mouseReleased", x + 100, y, button="left", clickCount=1)
    opened.settle()
    begin, end = shown(opened)
    assert begin == pytest.approx(middle, abs=0.05)
    assert 1 < end - begin < 3


def test_wheel_zooms_with_ctrl_and_scrolls_without(opened):
    x, y = centre_of(opened, "load of can0 over")
    begin, end = shown(opened)
    opened.mouse("mouseWheel", x, y, deltaX=0, deltaY=-120, modifiers=2)  # with Ctrl
    opened.settle()
    zoomed = shown(opened)
    assert zoomed[1] - zoomed[0] < 0.7 * (end - begin)
    assert sum(zoomed) == pytest.approx(begin + end, abs=0.05)
    opened.mouse("mouseWheel", x, y, deltaX=0, deltaY=120)
    opened.settle()
    assert shown(opened) == zoomed


def test_cursor_reads_the_same_time_in_every_panel(opened, demo):
    """The displayed position equals the one from another reader."""
    from mcap.reader import make_reader
    from mcap_protobuf.decoder import DecoderFactory

    x, y = centre_of(opened, "drive_fl, position")
    opened.mouse("mouseMoved", x, y)
    opened.settle()
    at = opened.run("cursor")
    assert at == pytest.approx(sum(shown(opened)) / 2, abs=0.02)
    lines = opened.run(
        "[...panels.find(p => p.canvas.dataset.panel.startsWith('drive_fl, position'))"
        ".reading.querySelectorAll('.line')].map(l => l.textContent)"
    )
    told = next(line for line in lines if line.startswith("true (plant)"))
    value = float(re.search(r"\)([\d.]+) rad", told)[1])
    with demo.open("rb") as file:
        reader = make_reader(file, decoder_factories=[DecoderFactory()])
        points = [
            (message.log_time / 1e9, decoded.position_rad)
            for _, _, message, decoded in reader.iter_decoded_messages(
                topics=["/controller/drive_fl/truth"]
            )
        ]
    before = max(point for point in points if point[0] <= at)
    after = min(point for point in points if point[0] > at)
    assert before[1] - 1e-4 <= value <= after[1] + 1e-4
    assert after[1] - before[1] > 1e-3  # it moves there, so a wrong time would be visible
    load = opened.run(
        "panels.find(p => p.canvas.dataset.panel === 'load of can0 over time').reading.textContent"
    )
    opened.run("scrollTo(0, 0)")
    assert "shown range, on average5.6" in load or "shown range, on average5.7" in load


def test_quantities_and_motors_can_be_filtered(opened):
    seen = "panels.filter(p => p.row.offsetParent).length"
    before = opened.run(seen)
    opened.run(
        "[...document.querySelectorAll('#quantities button')]"
        ".find(b => b.textContent === 'velocity').click()"
    )
    assert opened.run(seen) == before - 14
    opened.run("filter.value = 'STEER'; filter.dispatchEvent(new Event('input')); 0")
    assert opened.run("document.querySelectorAll('.motor:not([hidden])').length") == 6


@pytest.mark.parametrize("width", [1800, 1000, 420, 320])
@pytest.mark.parametrize("scheme", ["light", "dark"])
def test_page_fits_the_window_in_light_and_dark(opened, width, scheme):
    opened.media(prefers_color_scheme=scheme)
    opened.size(width, 900)
    opened.settle()
    assert opened.run("document.documentElement.scrollWidth") <= width
    paper = opened.run("getComputedStyle(document.body).backgroundColor")
    assert (paper == "rgb(255, 255, 255)") == (scheme == "light")
    # All text is readable: WCAG's contrast of 4.5 for text, 3 for lines.
    contrast = (
        "(name, other) => { const l = n => { const v = parseInt(theme[n].slice(1), 16);"
        " return [v >> 16, v >> 8 & 255, v & 255].map(c => c / 255)"
        " .map(c => c <= 0.04045 ? c / 12.92 : ((c + 0.055) / 1.055) ** 2.4)"
        " .reduce((s, c, i) => s + c * [0.2126, 0.7152, 0.0722][i], 0); };"
        " const [a, b] = [l(name), l(other)].sort((x, y) => y - x);"
        " return (a + 0.05) / (b + 0.05); }"
    )
    for name, least in (("ink", 7), ("soft", 4.5), ("actual", 3), ("demand", 3), ("truth", 3)):
        assert opened.run(f"({contrast})('{name}', 'paper')") >= least, name


def test_before_print_everything_is_drawn_on_white(opened):
    opened.media(prefers_color_scheme="dark")
    opened.settle()
    opened.run("setRange(5, 6)")
    opened.settle()
    colours = "[theme.paper, getComputedStyle(document.body).backgroundColor]"
    dark = opened.run(colours)
    opened.run("dispatchEvent(new Event('beforeprint')); 0")
    assert {(begin, end) for _, begin, end in opened.drawn().values()} == {(5.0, 6.0)}
    assert opened.run(colours) == ["#ffffff", "rgb(255, 255, 255)"]
    opened.run("dispatchEvent(new Event('afterprint')); 0")
    assert opened.run(colours) == dark != ["#ffffff", "rgb(255, 255, 255)"]


def test_reduced_page_has_the_same_load(browser, demo, demo_page, tmp_path):
    from motorhil.harness.report.collect import collect
    from motorhil.harness.report.document import document_of
    from motorhil.harness.report.page import render
    from motorhil.traces.mcap.reader import read_trace

    with read_trace(demo) as trace:
        made = document_of(trace, collect(trace), "reduced", points_max=3_000, frames_max=4_000)
    page = tmp_path / "reduced.html"
    page.write_text(render(*made), "utf-8")
    asked = "traffics.map(t => [t.load(0, SPAN), t.load(5, 10), t.byLabel(0, SPAN)[1][2]])"
    browser.errors.clear()
    browser.open(page)
    reduced = browser.run(asked)
    assert all(count > 0 for count, _, _ in browser.drawn().values())
    browser.open(demo_page)
    exact = browser.run(asked)
    assert browser.errors == []
    for one, other in zip(reduced, exact, strict=True):
        assert one == pytest.approx(other, rel=0.03)  # cells at the end count in part


def test_markup_in_names_is_escaped(browser, tmp_path):
    """Names of motors, events and files are foreign text and must not be executed."""
    evil = "</script><script>document.title='taken'</script><img src=x onerror=alert(1)>@@packed@@"
    path = tmp_path / "a.mcap"
    one = Recorded(path)
    one.event(5 * MS, evil, evil).position(1 * MS, evil, 1.0).position(9 * MS, evil, 2.0)
    one.message(2 * MS, f"/motor/{evil}/lock", MOTOR_LOCK, {"action": 1, "owner": evil})
    sync = {"phase": 1, "motor": [evil], "offset_s": [0.0], "skew_s": 0.001, "method": evil}
    one.message(3 * MS, f"/group/{evil}/sync", GROUP_SYNC, sync)
    one.close()
    page = tmp_path / "a.html"
    assert main(["report", str(path), "-o", str(page), "--title", evil]) == 0
    browser.errors.clear()
    assert browser.open(page) == "ready"
    assert browser.errors == []
    assert browser.run("document.title") == evil
    assert browser.run("document.images.length") == 0
    assert browser.run("document.querySelector('#list td:last-child').textContent") == evil


@pytest.mark.parametrize("messages", [0, 1])
def test_page_of_empty_recording_opens(browser, tmp_path, messages):
    path = tmp_path / "a.mcap"
    if messages:
        Recorded(path).frame(MS, 0x100, "00").close()
    else:
        TraceWriter(path).close()
    assert main(["report", str(path)]) == 0
    browser.errors.clear()
    assert browser.open(path.with_suffix(".html")) == "ready"
    assert browser.errors == []


def test_page_with_corrupted_data_reports_it(browser, demo_page, tmp_path):
    text = demo_page.read_text("utf-8")
    broken = tmp_path / "broken.html"
    broken.write_text(text.replace('id="packed">', 'id="packed">AAAA', 1), "utf-8")
    browser.errors.clear()
    browser.open(broken)
    assert "cannot be drawn" in browser.run("document.getElementById('notes').textContent")


def test_page_policy_refuses_requests_of_its_script(browser, demo_page):
    """The content security policy refuses a request before it is sent."""
    browser.open(demo_page)
    browser.requests.clear()
    refused = browser.run("fetch('https://example.org/').then(() => 'sent', () => 'refused')")
    assert refused == "refused"
    policy = browser.run("document.querySelector('meta[http-equiv]').content")
    assert policy.startswith("default-src 'none'; img-src data:; script-src 'sha256-")


def test_response_times_are_drawn_in_order(opened):
    """Each periodic message has a row with, from left to right, bar, bound and deadline."""
    opened.run("document.querySelector('#places a[href=\"#responses\"]').click()")
    rows = opened.run("document.querySelectorAll('#responses tr').length")
    told = opened.run("report.responses.map(bus => bus.messages.length)")
    assert len(told) == 2
    assert rows == sum(told) + 2
    first = opened.run(
        "(() => { const row = document.querySelectorAll('#responses tr')[1];"
        " const right = (kind) => row.querySelector(kind).getBoundingClientRect().right;"
        " return [row.children[0].textContent, right('.seen'), right('.bound'),"
        " right('.deadline'), row.className]; })()"
    )
    assert first[0] == "181h"
    assert first[1] < first[2] < first[3]
    assert first[4] == ""
    late = opened.run(
        "(() => { const table = document.createElement('table'), row = make('tr', table);"
        " const one = {...report.responses[0].messages[0], bound_s: null};"
        " responseRow(row, one, new TimeScale([1]));"
        " return [row.className, row.children[7].textContent]; })()"
    )
    assert late == ["late", "▲ no bound"]
