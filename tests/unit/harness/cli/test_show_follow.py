import pytest

from motorhil.harness.cli import show
from motorhil.harness.cli.show import followed, text_of
from motorhil.traces.decoding.narrative import Story
from motorhil.traces.errors import TraceError
from motorhil.traces.mcap.reader import Trace, read_trace
from tests.support.recordings.handmade import MS, Recorded, S
from tests.unit.harness.cli.test_show import recording, shown

__all__ = ["recording"]  # a fixture of test_show


def told(lines):
    return [text_of(line) for line in lines]


def growing(tmp_path, recording, steps, first=200):
    """Return a file with the recording's beginning, and a function that appends `steps` bytes."""
    with open(recording, "rb") as file:
        data = file.read()
    path = tmp_path / "growing.mcap"
    path.write_bytes(data[:first])
    waits = []

    def write_on():
        waits.append(0)
        at = path.stat().st_size
        assert at < len(data), "it waits though the file is complete"
        with path.open("ab") as file:
            file.write(data[at : at + steps])

    return path, write_on


@pytest.mark.parametrize("steps", [1, 7, 500, 100_000])
def test_growing_file_gives_every_line_once(tmp_path, recording, steps):
    with read_trace(recording) as trace:
        expected = told(Story(trace).lines())
    path, write_on = growing(tmp_path, recording, steps, first=3000)
    with read_trace(path) as trace:
        story = Story(trace)
        assert told(followed(trace, story, None, None, write_on)) == expected
        assert trace.cut is None
    assert len(expected) > 15


def test_lines_come_with_their_chunk(tmp_path):
    path = tmp_path / "live.mcap"
    live = Recorded(path)
    seconds = iter(range(1, 4))
    told_before = []

    def record_on():
        told_before.append(len(lines))
        second = next(seconds, None)
        if second is None:
            live.close()
            return
        live.frame(second * S, 0x701, "05")
        live.writer.flush()

    lines = []
    with read_trace(path) as trace:
        for line in followed(trace, Story(trace), None, None, record_on):
            lines.append(line.time_ns)
    assert lines == [1 * S, 2 * S, 3 * S]
    assert told_before == [0, 1, 2, 3]


def test_file_is_read_only_once(tmp_path, recording, monkeypatch):
    path, write_on = growing(tmp_path, recording, 400)
    read = []
    content = Trace._content
    monkeypatch.setattr(
        Trace, "_content", lambda self, chunk: read.append(chunk.offset) or content(self, chunk)
    )
    with read_trace(path) as trace:
        list(followed(trace, Story(trace), None, None, write_on))
    assert len(read) == len(set(read)) > 1


def test_time_span_and_mappings_hold_while_following(tmp_path, recording):
    with read_trace(recording) as trace:
        expected = told(Story(trace).lines(19 * S, None))
    path, write_on = growing(tmp_path, recording, 100_000, first=5000)
    with read_trace(path) as trace:
        story = Story(trace)
        found = told(followed(trace, story, 19 * S, None, write_on))
    assert [line for line in found if "statusword = 0218h" in line]
    assert len(found) == len(expected) == 2
    with read_trace(recording) as trace:
        within = told(followed(trace, Story(trace), 2 * MS, 4 * MS, write_on))
    assert len(within) == 2


def test_complete_recording_is_shown_as_without_follow(capsys, recording):
    words = (recording, "--node", "1", "--brief")
    assert shown(capsys, *words, "--follow") == shown(capsys, *words)


def test_ctrl_c_ends_follow_quietly(capsys, tmp_path, monkeypatch):
    live = Recorded(tmp_path / "live.mcap").frame(S, 0x701, "05")
    live.writer.flush()

    def interrupt():
        raise KeyboardInterrupt

    monkeypatch.setattr(show, "_wait", interrupt)
    said = shown(capsys, live.path, "--follow")
    assert "is operational" in said.out
    live.close()


def test_overwritten_file_is_reported(tmp_path, recording):
    path, _ = growing(tmp_path, recording, 1, first=3000)
    with read_trace(path) as trace, pytest.raises(TraceError, match="has become shorter"):
        list(followed(trace, Story(trace), None, None, lambda: path.write_bytes(b"")))
