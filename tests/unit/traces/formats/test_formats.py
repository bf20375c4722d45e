"""Each format keeps the features it can store, and reports the others as lost."""

import can
import pytest

from motorhil.harness.recording.conversion import convert
from motorhil.traces import can_frame
from motorhil.traces.can_frame import classic, flexible, remote
from motorhil.traces.digest import digest
from motorhil.traces.errors import TraceError
from motorhil.traces.formats.frames import Findings, Frame
from motorhil.traces.formats.registry import (
    IN_WORDS,
    WRITABLE,
    Feature,
    Survey,
    open_source,
    record_frames,
)
from motorhil.traces.schema import Direction
from tests.support.checkout import CHECKOUT
from tests.support.recordings.formats import WRITTEN, in_order_of
from tests.support.recordings.written import write

SINCE_1970_NS = 1_700_000_000_123_456_000
R, T, U = Direction.RECEIVED, Direction.TRANSMITTED, Direction.UNKNOWN
EXT = 0x1ABCDEF0 | can_frame.EFF
FORMAT_OF = {form.ending: form.name for form in WRITABLE} | {".log": "candump-x"}
BASE = [
    Frame(SINCE_1970_NS, "can0", classic(0x123, b"\1\2\3"), R),
    Frame(SINCE_1970_NS + 1000, "can1", classic(EXT, bytes(range(8))), R),
    Frame(SINCE_1970_NS + 999_000, "can0", classic(0x10 | can_frame.EFF, b""), R),
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
    Feature.ORDER: [
        Frame(SINCE_1970_NS + 5000, "can0", remote(1, 0), R),
        Frame(SINCE_1970_NS + 5000, "can0", classic(1, b""), R),
        Frame(SINCE_1970_NS + 4000, "can0", classic(1, b""), R),
    ],
    Feature.ERROR_FRAMES: [
        Frame(SINCE_1970_NS, "can0", classic(can_frame.ERR | 0x44, bytes(range(8))), R),
        Frame(SINCE_1970_NS, "can0", classic(can_frame.ERR | 0x88, bytes(8)), R),
    ],
}


def there_and_back(tmp_path, frames, form):
    """Return the digests before and after, and the losses reported."""
    paths = [tmp_path / name for name in ("a.mcap", "b" + form.ending, "c.mcap")]
    record_frames(paths[0], frames, {})
    there = convert(paths[0], paths[1], form.name)
    back = convert(paths[1], paths[2], "mcap")
    assert there.findings.problems == []
    assert back.findings.problems == []
    return digest(paths[0]), digest(paths[2]), there.lost


def in_form(frame, form):
    """Return a frame without its direction, if the format cannot store that."""
    return frame if Feature.DIRECTION in form.holds else frame._replace(direction=U)


def base_of(form):
    return [in_form(one, form) for one in BASE]


@pytest.mark.parametrize("form", WRITTEN)
def test_every_format_stores_common_frame(tmp_path, form):
    before, after, lost = there_and_back(tmp_path, base_of(form), form)
    assert (before, lost) == (after, {})


@pytest.mark.parametrize("form", WRITTEN)
@pytest.mark.parametrize("feature", list(Feature), ids=lambda feature: feature.name)
def test_digest_is_kept_only_for_stored_features(tmp_path, form, feature):
    base = base_of(form)
    more = [one if feature is Feature.DIRECTION else in_form(one, form) for one in WITH[feature]]
    frames = base + more
    if feature is not Feature.ORDER:
        frames = in_order_of(form.holds, frames + base)
    before, after, lost = there_and_back(tmp_path, frames, form)
    assert (before == after) is (feature in form.holds)
    assert (feature in lost) is (feature not in form.holds)
    assert set(lost) <= {feature, Feature.BUS_NAMES}


@pytest.mark.parametrize("form", WRITTEN)
@pytest.mark.parametrize("step_ns", [1000, -5_000_000_000])
def test_zero_and_backward_times_are_stored(tmp_path, form, step_ns):
    frames = [
        Frame(10_000_000_000 + n * step_ns, "can0", classic(n, bytes([n])), R) for n in range(3)
    ]
    if step_ns > 0:
        frames.insert(0, Frame(0, "can0", classic(9, b""), R))
    frames = in_order_of(form.holds, (in_form(one, form) for one in frames))
    before, after, _ = there_and_back(tmp_path, frames, form)
    assert before == after


def test_documents_list_features_not_stored():
    rows = ["| format | ending | does not hold |", "| --- | --- | --- |"]
    for form in WRITABLE:
        lacks = [feature for feature in Feature if feature not in form.holds]
        if Feature.BUS_NAMES in lacks:
            lacks.remove(Feature.BLANKS)  # included in the names
        told = ", ".join(IN_WORDS[feature] for feature in lacks) or "nothing is lost"
        ending = f"`{form.ending}`" if form.ending else "`--to` only"
        rows.append(f"| {form.name} | {ending} | {told} |")
    assert (
        "\n".join(rows) + "\n\n" in (CHECKOUT / "docs/how-to/convert-a-recording.md").read_text()
    ), "\n".join(rows)


def test_survey_finds_every_feature():
    survey = Survey()
    for frames in WITH.values():
        for frame in frames:
            survey.add(frame)
    assert set(survey.counts) == set(Feature)


def test_messages_other_than_frames_are_noted(tmp_path):
    write(tmp_path / "run.mcap")
    findings = Findings()
    frames = list(open_source(tmp_path / "run.mcap").frames(findings))
    assert len(frames) == 90
    assert findings.notes == ["/events: 10 messages are not CAN frames, and are omitted"]


@pytest.mark.parametrize(
    "content", [b"", b"# nothing\n", b"time,angle\n0.1,0.2\n", b"\x00\xff" * 50]
)
def test_file_without_traffic_is_refused(tmp_path, content):
    (tmp_path / "some.txt").write_bytes(content)
    with pytest.raises(TraceError, match=r"some\.txt: (is empty|holds no CAN traffic)"):
        open_source(tmp_path / "some.txt")


@pytest.mark.parametrize("ending", [".log", ".trc", ".asc", ".blf"])
def test_python_can_reads_written_file(tmp_path, ending):
    frames = BASE + WITH[Feature.DIRECTION] + WITH[Feature.REMOTE]
    record_frames(tmp_path / "a.mcap", frames, {})
    convert(tmp_path / "a.mcap", tmp_path / f"b{ending}", FORMAT_OF[ending])
    options = {"relative_timestamp": False} if ending == ".asc" else {}
    with can.LogReader(tmp_path / f"b{ending}", **options) as reader:
        found = list(reader)
    told = [can_frame.fields(frame.frame) for frame in frames]
    assert [message.arbitration_id for message in found] == [one.identifier for one in told]
    assert [bytes(message.data) for message in found] == [one.data for one in told]
    assert [message.is_rx for message in found] == [frame.direction is R for frame in frames]
    assert [message.is_remote_frame for message in found] == [
        one.can_id & can_frame.RTR != 0 for one in told
    ]
    assert [message.dlc for message in found] == [one.length for one in told]
    # its stamps are floats, and it treats the date in an ASC file as local time
    since = [m.timestamp - found[0].timestamp for m in found]
    want = [(frame.time_ns - frames[0].time_ns) / 1e9 for frame in frames]
    assert since == pytest.approx(want, abs=1e-6)
