"""What each format holds is held: what it can hold comes back, what it cannot is told as lost."""

import can
import pytest

from harness.conversion import convert
from tests.architecture.checkout import CHECKOUT
from tests.traces.recordings import write
from traces import traffic
from traces.digest import digest
from traces.errors import TraceError
from traces.formats import IN_WORDS, WRITABLE, Feature, Survey, open_source
from traces.schema import Direction
from traces.traffic import Findings, Frame, classic, flexible, remote
from traces.traffic_mcap import record_frames

SINCE_1970_NS = 1_700_000_000_123_456_000
R, T = Direction.RECEIVED, Direction.TRANSMITTED
EXT = 0x1ABCDEF0 | traffic.EFF
FORMAT_OF = {form.ending: form.name for form in WRITABLE}
BASE = [
    Frame(SINCE_1970_NS, "can0", classic(0x123, b"\1\2\3"), R),
    Frame(SINCE_1970_NS + 1000, "can1", classic(EXT, bytes(range(8))), R),
    Frame(SINCE_1970_NS + 999_000, "can0", classic(0x10 | traffic.EFF, b""), R),
    Frame(SINCE_1970_NS + 3_600_000_000_000, "can0", classic(0x7FF, b"\xff"), R),
]
WITH = {
    Feature.NANOSECONDS: [Frame(SINCE_1970_NS + 1, "can0", classic(1, b""), R)],
    Feature.BUS_NAMES: [Frame(SINCE_1970_NS, "drive-bus", classic(1, b""), R)],
    Feature.BLANKS: [Frame(SINCE_1970_NS, "drive bus", classic(1, b""), R)],
    Feature.DIRECTION: [Frame(SINCE_1970_NS, "can0", classic(1, b""), T)],
    Feature.UNDIRECTED: [Frame(SINCE_1970_NS, "can0", classic(1, b""))],
    Feature.SENDER: [Frame(SINCE_1970_NS, "can0", classic(1, b""), R, "left")],
    Feature.REMOTE: [
        Frame(SINCE_1970_NS, "can0", remote(can_id, length), R)
        for can_id in (0x701, EXT)
        for length in (0, 1, 8)
    ],
    Feature.FD: [
        Frame(SINCE_1970_NS, "can0", flexible(can_id, flags, bytes(range(size))), R)
        for can_id in (0x701, EXT)
        for flags in range(4)
        for size in (0, 7, 8, 12, 64)
    ],
    Feature.ERROR_FRAMES: [
        Frame(SINCE_1970_NS, "can0", classic(traffic.ERR | 0x44, bytes(range(8))), R),
        Frame(SINCE_1970_NS, "can0", classic(traffic.ERR | 0x88, bytes(8)), R),
    ],
}


def there_and_back(tmp_path, frames, form):
    """(digest before, digest after, what was said to be lost)."""
    paths = [tmp_path / name for name in ("a.mcap", "b" + form.ending, "c.mcap")]
    record_frames(paths[0], frames, {})
    there = convert(paths[0], paths[1], form.name)
    back = convert(paths[1], paths[2], "mcap")
    assert there.findings.problems == []
    assert back.findings.problems == []
    return digest(paths[0]), digest(paths[2]), there.lost


@pytest.mark.parametrize("form", WRITABLE, ids=lambda form: form.name)
def test_every_format_holds_the_common_frame(tmp_path, form):
    before, after, lost = there_and_back(tmp_path, BASE, form)
    assert before == after
    assert set(lost) <= {Feature.DIRECTION}


@pytest.mark.parametrize("form", WRITABLE, ids=lambda form: form.name)
@pytest.mark.parametrize("feature", list(Feature), ids=lambda feature: feature.name)
def test_the_digest_stays_just_where_the_table_says_so(tmp_path, form, feature):
    before, after, lost = there_and_back(tmp_path, BASE + WITH[feature] + BASE, form)
    assert (before == after) is (feature in form.holds)
    assert (feature in lost) is (feature not in form.holds)
    assert set(lost) <= {feature, Feature.BUS_NAMES}


@pytest.mark.parametrize("form", WRITABLE, ids=lambda form: form.name)
@pytest.mark.parametrize("step_ns", [1000, -5_000_000_000])
def test_times_from_0_and_times_that_go_back_are_held_by_all(tmp_path, form, step_ns):
    frames = [
        Frame(10_000_000_000 + n * step_ns, "can0", classic(n, bytes([n])), R) for n in range(3)
    ]
    if step_ns > 0:
        frames.insert(0, Frame(0, "can0", classic(9, b""), R))
    before, after, _ = there_and_back(tmp_path, frames, form)
    assert before == after


def test_the_page_on_conversion_tells_what_each_format_does_not_hold():
    rows = ["| format | ending | does not hold |", "| --- | --- | --- |"]
    for form in WRITABLE:
        lacks = [feature for feature in Feature if feature not in form.holds]
        if Feature.BUS_NAMES in lacks:
            lacks.remove(Feature.BLANKS)  # they go with the names
        told = ", ".join(IN_WORDS[feature] for feature in lacks) or "nothing is lost"
        rows.append(f"| {form.name} | `{form.ending}` | {told} |")
    assert (
        "\n".join(rows) + "\n\n" in (CHECKOUT / "docs/how-to/convert-a-recording.md").read_text()
    ), "\n".join(rows)


def test_a_survey_tells_every_feature():
    survey = Survey()
    for frames in WITH.values():
        for frame in frames:
            survey.add(frame)
    assert set(survey.counts) == set(Feature)


def test_what_is_no_frame_is_left_out_of_an_export_and_told(tmp_path):
    write(tmp_path / "run.mcap")
    findings = Findings()
    frames = list(open_source(tmp_path / "run.mcap").frames(findings))
    assert len(frames) == 90
    assert findings.notes == ["/events: 10 messages are no CAN frames, and left out"]


@pytest.mark.parametrize(
    "content", [b"", b"# nothing\n", b"time,angle\n0.1,0.2\n", b"\x00\xff" * 50]
)
def test_what_holds_no_traffic_is_refused(tmp_path, content):
    (tmp_path / "some.txt").write_bytes(content)
    with pytest.raises(TraceError, match=r"some\.txt: (is empty|holds no CAN traffic)"):
        open_source(tmp_path / "some.txt")


@pytest.mark.parametrize("ending", [".log", ".trc", ".asc", ".blf"])
def test_python_can_reads_what_is_written(tmp_path, ending):
    frames = BASE + WITH[Feature.DIRECTION] + WITH[Feature.REMOTE]
    record_frames(tmp_path / "a.mcap", frames, {})
    convert(tmp_path / "a.mcap", tmp_path / f"b{ending}", FORMAT_OF[ending])
    options = {"relative_timestamp": False} if ending == ".asc" else {}
    with can.LogReader(tmp_path / f"b{ending}", **options) as reader:
        found = list(reader)
    told = [traffic.fields(frame.frame) for frame in frames]
    assert [message.arbitration_id for message in found] == [one.identifier for one in told]
    assert [bytes(message.data) for message in found] == [one.data for one in told]
    assert [message.is_rx for message in found] == [frame.direction is R for frame in frames]
    assert [message.is_remote_frame for message in found] == [
        one.can_id & traffic.RTR != 0 for one in told
    ]
    assert [message.dlc for message in found] == [one.length for one in told]
    # its stamps are floats, and it takes the date in an ASC file for local time
    since = [m.timestamp - found[0].timestamp for m in found]
    want = [(frame.time_ns - frames[0].time_ns) / 1e9 for frame in frames]
    assert since == pytest.approx(want, abs=1e-6)
