"""The page of a campaign in Debian's Chromium: from disk, by keyboard, narrow and dark."""

import os

import pytest

from motorhil.harness.swarm.kept import keep, kept_in, record_of
from motorhil.harness.swarm.report.page import page_of, write_page
from motorhil.harness.swarm.report.processes import processes_of
from motorhil.harness.swarm.report.progress import Progress
from motorhil.harness.swarm.row import Result, Row
from motorhil.harness.swarm.summary import summary_of
from tests.support.browser import started
from tests.support.recordings.handmade import Recorded
from tests.support.swarm.campaigns import FOUND, PLAN, failure, written

pytestmark = pytest.mark.wall

NOW = 1_796_000_000.0
LONG = "a_name_without_any_place_to_break_" * 12


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """Return the folder of a campaign with two causes, one of them kept with its recording."""
    folder = tmp_path_factory.mktemp("campaign")
    rows = [FOUND, failure(3), failure(18, "limit-position", LONG)]
    rows += [Row(seed, Result.PASSED, met=((LONG, 0), ("a retry", 1))) for seed in range(4, 40, 2)]
    results = written(folder / "swarm", [one for one in rows if one.seed != 18 or one.is_bad])
    record = Recorded(record_of(failure(3), results.folder))
    for number in range(40):
        record.position(number * 50_000_000, "left", number / 10)
    record.event(1_052_000_000, "fault 4310h", "left").close()
    keep(failure(3), PLAN, results.folder)
    progress = Progress(50, NOW - 60, NOW, 60.0, True, ((0.0, 1.0), (60.0, 2.0)), {3: 1.0})
    kept, summary = kept_in(results.folder), summary_of(results.rows.values())
    processes = processes_of(PLAN, results)
    write_page(
        results.folder,
        page_of(results.folder, PLAN, summary, kept, progress, processes, NOW),
    )
    return results.folder


@pytest.fixture(scope="module")
def browser(tmp_path_factory):
    yield from started(tmp_path_factory)


@pytest.fixture
def page(browser, folder):
    """Open the page from disk; check that it asks for nothing but itself, without any error."""
    address = (folder / "index.html").as_uri()
    browser.call("Page.navigate", url="about:blank")
    browser.begin_anew()
    browser.call("Page.navigate", url=address)
    browser.wait("document.readyState === 'complete' && document.querySelector('#facts')")
    yield browser
    assert [one for one in browser.requests if one not in (address, "data:,")] == []
    assert browser.errors == []


def test_page_from_disk_shows_the_campaign(page):
    heads = page.run("[...document.querySelectorAll('h2')].map((one) => one.textContent)")
    assert heads == [
        *("Results", "Processes", "Causes of failures", "Kept failures"),
        *("Coverage", "Disturbances", "Reached", "Never reached"),
    ]
    assert page.run("document.querySelectorAll('svg').length") >= 2
    assert page.run("document.querySelectorAll('script, img, iframe').length") == 0
    style = "getComputedStyle(document.querySelector('main')).maxWidth"
    assert page.run(style) == "1200px"  # the policy permits the page's own style


def test_page_tells_worlds_that_ran_alone(page):
    text = page.run("[...document.querySelectorAll('section')][1].textContent")
    assert "Up to 32 worlds have shared a process." in text
    assert "Seeds 3, " in text


def test_links_lead_to_files_of_the_campaign(page, folder):
    links = page.run(
        "[...document.querySelectorAll('article a')].map((one) => decodeURI(one.href))"
    )
    assert len(links) == 3
    for link in links:
        assert os.path.isfile(link.removeprefix("file://"))
        assert link.startswith(folder.as_uri())


def test_keyboard_alone_reaches_and_opens_all(page):
    wanted = page.run("document.querySelectorAll('summary, a').length")
    reached = set()
    for _ in range(wanted + 20):
        page.key("Tab", code="Tab", windowsVirtualKeyCode=9)
        place = page.run(
            "[...document.querySelectorAll('summary, a')].indexOf(document.activeElement)"
        )
        if place >= 0 and place not in reached:
            reached.add(place)
            if page.run("document.activeElement.tagName") == "SUMMARY":
                page.key("Enter", code="Enter", windowsVirtualKeyCode=13, text="\r")
                wanted = page.run("document.querySelectorAll('summary, a').length")
    assert reached == set(range(wanted))
    assert page.run("document.querySelectorAll('details:not([open])').length") == 0
    ring = "getComputedStyle(document.activeElement).outlineStyle"
    page.run("document.querySelector('article a').focus({focusVisible: true})")
    assert page.run(ring) != "none"


@pytest.mark.parametrize(("width", "height"), [(320, 640), (800, 600), (3840, 2160)])
def test_page_fits_every_width(page, width, height):
    page.size(width, height)
    page.run("document.querySelectorAll('details').forEach((one) => { one.open = true })")
    page.settle()
    assert page.run("document.documentElement.scrollWidth") <= width
    outside = page.run(
        "[...document.querySelectorAll('main *')].filter((one) => !one.closest('.wide, pre')"
        " && one.getBoundingClientRect().right > innerWidth + 1).map((one) => one.outerHTML)"
    )
    assert outside == []


def test_dark_and_light_have_their_colours(page):
    colours = []
    for scheme in ("light", "dark"):
        page.media(prefers_color_scheme=scheme)
        page.settle()
        colours.append(
            page.run(
                "['body', 'a', 'pre', 'td'].map((one) => document.querySelector(one)).map("
                "(one) => [getComputedStyle(one).color, getComputedStyle(one).backgroundColor])"
            )
        )
    light, dark = colours
    assert [light[0][1], dark[0][1]] == ["rgb(255, 255, 255)", "rgb(15, 20, 25)"]
    assert all(bright[0] != dim[0] for bright, dim in zip(light, dark, strict=True))
