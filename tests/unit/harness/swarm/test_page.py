"""Page of a campaign: contents, escapes, and that it asks for nothing."""

import base64
import hashlib
import re
from dataclasses import replace
from html.parser import HTMLParser

import pytest

from motorhil.harness.rig.config.toml import RigError
from motorhil.harness.swarm.kept import keep, record_of
from motorhil.harness.swarm.plan import Program
from motorhil.harness.swarm.report.page import page_of, write_page
from motorhil.harness.swarm.report.processes import Processes, processes_of
from motorhil.harness.swarm.report.progress import Progress
from motorhil.harness.swarm.row import CANARY, Result, Row
from motorhil.harness.swarm.summary import summary_of
from tests.support.recordings.handmade import Recorded
from tests.support.swarm.campaigns import FOUND, PLAN, PROFILE, failure, written

NOW = 1_796_000_000.0
ALONE = Processes()
VOID = {"meta", "link", "br"}
ROWS = [
    FOUND,
    Row(0, Result.PASSED, met=(("retried", 1), ("late", 0)), acts=(("drop", 2), ("cut", 0))),
    Row(1, Result.PASSED, new=("4 after the start | drop 580h",), ended_by="LinkError"),
    failure(3),
    failure(2, "limit-position", "a & b"),
]


class Page(HTMLParser):
    """Checks that elements are nested, and collects texts, elements and attributes."""

    def __init__(self, text):
        super().__init__()
        self.open, self.texts, self.elements = [], [], []
        self.feed(text)
        assert self.open == []

    def handle_starttag(self, tag, attrs):
        self.elements.append((tag, dict(attrs)))
        if tag not in VOID:
            self.open.append(tag)

    def handle_startendtag(self, tag, attrs):
        self.elements.append((tag, dict(attrs)))

    def handle_endtag(self, tag):
        assert self.open.pop() == tag

    def handle_data(self, data):
        if self.open and self.open[-1] != "style":
            self.texts.append(data)

    @property
    def text(self):
        return "|".join(text.strip() for text in self.texts if text.strip())


def page(tmp_path, rows=ROWS, kept=(), plan=PLAN, progress=None, processes=ALONE, **options):
    given = tmp_path, plan, summary_of(rows), kept, progress or Progress(), processes, NOW
    return page_of(*given, **options)


def test_page_shows_results_causes_and_coverage(tmp_path):
    seen = {0: 1.0, 1: 2.0, 3: 130.0, 2: 5.0}
    progress = Progress(10, NOW - 140.0, NOW, 130.0, True, ((0.0, 1.0), (130.0, 2.0)), seen)
    found = Page(page(tmp_path, progress=progress))
    for expected in (
        *("rig|rig.toml", "program|errand:run", "motorhil|1.0 abc", "worlds|4 of 10 asked for"),
        *("canary|found by always, limit-velocity", "began|2026-11-30", "took|2 min"),
        *(
            "pass|2|fail|2|timeout|0|killed|0|cancelled|0",
            "limit-position | a & b | -|World 2: the second",
        ),
        *("1 pair met", "cut|1|0|0", "drop|3|3|4", "retried|1", "LinkError|1"),
        *("condition that was never true|late", "disturbance that never struck|cut"),
        "a & b|1|2|5 s",
        *("operation enabled", "The results of 6 worlds are missing"),
    ):
        assert expected in found.text, expected
    assert sum(tag == "polyline" for tag, _ in found.elements) == 2


def test_each_cause_has_one_sentence(tmp_path):
    kept = [keep(failure(3), PLAN, tmp_path)]
    text = Page(page(tmp_path, kept=kept)).text
    assert re.findall(r"\|World (\d): ", text) == ["2", "3"]


def test_page_of_empty_campaign_is_whole(tmp_path):
    found = Page(page(tmp_path, []))
    assert "canary|has not run yet" in found.text
    assert "No world has failed" in found.text


def test_page_says_which_worlds_ran_alone(tmp_path):
    rows = [Row(seed, Result.PASSED) for seed in (3, 8, 16, 19, 24, 35)]
    rows += [Row(CANARY, Result.FAILED), failure(51), Row(67, Result.KILLED)]
    processes = processes_of(PLAN, written(tmp_path / "batches", rows))
    assert processes == Processes(32, (16, 24, 51, 67))  # 8 and 24 share a process
    text = Page(page(tmp_path, rows, processes=processes)).text
    assert "Up to 32 worlds have shared a process." in text
    assert "4 worlds alone|Seeds 16, 24, 51, 67." in text


def test_page_says_that_a_program_keeps_state(tmp_path):
    results = written(tmp_path / "state", [Row(19, Result.PASSED), Row(35, Result.PASSED)])
    results.begin_alone(Row(35, Result.FAILED), (1, 1))
    results.append([Row(35, Result.FAILED)])
    text = Page(page(tmp_path, processes=processes_of(PLAN, results))).text
    assert "The result of seed 35 depends on the worlds before it. The program keeps" in text


def test_page_of_long_worlds_says_that_each_ran_alone(tmp_path):
    long = replace(PROFILE, traffic=(replace(PROFILE.traffic[0], frames=20_000),))
    plan = replace(PLAN, profile=long)
    text = Page(page(tmp_path, processes=processes_of(plan, written(tmp_path / "x", ROWS)))).text
    assert "Each world has run in a process of its own." in text
    assert "worlds alone" not in text


def test_running_page_loads_itself_again_and_says_so(tmp_path):
    def reloads(text):
        return [one for tag, one in Page(text).elements if one.get("http-equiv") == "refresh"]

    running, over = page(tmp_path, is_running=True), page(tmp_path)
    assert len(reloads(running)) == 1
    assert "The campaign runs: this page loads itself again" in Page(running).text
    assert reloads(over) == []
    assert "The campaign" not in Page(over).text
    cut = page(tmp_path, progress=Progress(10, NOW, NOW, 1.0, False))
    assert reloads(cut) == []
    assert "The campaign is not over" in Page(cut).text


@pytest.mark.parametrize(
    ("row", "note"),
    [
        (Row(CANARY, Result.PASSED), "The planted defect was not found"),
        (Row(8, Result.KILLED), "Something outside killed 1 world"),
    ],
)
def test_page_tells_doubts(tmp_path, row, note):
    assert note in Page(page(tmp_path, [row])).text
    assert note not in Page(page(tmp_path)).text


def test_page_asks_for_nothing(tmp_path):
    kept = [keep(failure(3), PLAN, tmp_path)]
    text = page(tmp_path, kept=kept)
    policy = re.search(r'Content-Security-Policy" content="([^"]*)"', text)[1]
    style = re.search("<style>(.*)</style>", text, re.DOTALL)[1]
    digest = base64.b64encode(hashlib.sha256(style.encode()).digest()).decode()
    assert policy.startswith("default-src 'none'; ")
    assert f"style-src 'sha256-{digest}';" in policy
    assert not re.search(r"://|@import|url\(|<script|<img|style=", text)
    links = [one["href"] for tag, one in Page(text).elements if "href" in one]
    assert links[0] == "data:,"
    assert all((tmp_path / link).is_file() and link[0] != "/" for link in links[1:])
    assert len(links) == 3


def test_texts_of_programs_are_escaped(tmp_path):
    evil = "</title><script>alert(1)</script>\x1b\u202e'\""
    kept = [keep(failure(3, text=evil), PLAN, tmp_path)]
    rows = [
        failure(3, evil, evil),
        Row(4, Result.PASSED, met=((evil, 0),), ended_by=evil, acts=((evil, 1),)),
        Row(5, Result.PASSED, met=((evil + "2", 1),)),
        replace(FOUND, text=f"always {evil}"),
    ]
    plan = replace(PLAN, rig=evil, program=Program("function", evil, (evil,)), build=evil)
    text = page(tmp_path, rows, kept, plan)
    elements = {tag for tag, _ in Page(text).elements}
    assert not elements & {"script", "b"}
    assert "\x1b" not in text
    assert "\u202e" not in text


def test_wide_parts_scroll_by_themselves_on_a_narrow_screen(tmp_path):
    """No element but those in `.wide` and `pre` may be wider than a screen of 320 px."""
    text = page(tmp_path, kept=[keep(failure(3), PLAN, tmp_path)])
    assert '<meta name="viewport" content="width=device-width, initial-scale=1">' in text
    for found in re.finditer("<(table|svg)", text):
        before = text[: found.start()]
        assert re.search(r'<(div|figure) class="wide">$', before), before[-80:]
    assert ".wide { overflow-x: auto }" in text
    assert "prefers-color-scheme: dark" in text


def test_kept_failure_has_a_picture_of_its_moment(tmp_path):
    row = failure(3)
    record = Recorded(record_of(row, tmp_path))
    for number in range(40):
        record.position(number * 50_000_000, "left", number / 10)
    record.event(1_052_000_000, "fault 4310h", "left").close()
    found = Page(page(tmp_path, kept=[keep(row, PLAN, tmp_path)]))
    assert "position of left [rad or m]" in found.text
    assert "1.052100 s" in found.text
    assert "1.052000 s  events" in found.text
    classes = [one.get("class") for tag, one in found.elements if tag == "g"]
    assert "moment" in classes
    links = [one["href"] for tag, one in found.elements if tag == "a"]
    assert links[2].endswith(".mcap")


@pytest.mark.parametrize("content", [b"", b"no recording\n", b"\x89MCAP0\r\n damaged"])
def test_damaged_recording_leaves_the_page_without_picture(tmp_path, content):
    row = failure(3)
    record_of(row, tmp_path).write_bytes(content)
    found = Page(page(tmp_path, kept=[keep(row, PLAN, tmp_path)]))
    assert "Kept failures" in found.text
    assert "moment" not in [one.get("class") for _, one in found.elements]


def test_page_is_written_whole_or_not_at_all(tmp_path):
    assert write_page(tmp_path, page(tmp_path)) == tmp_path / "index.html"
    assert [path.name for path in tmp_path.iterdir()] == ["index.html"]
    with pytest.raises(RigError, match=r"index\.html: cannot be written: No such file"):
        write_page(tmp_path / "gone", page(tmp_path))
