import struct

import pytest

from motorhil.harness.cli.record import Progress
from motorhil.harness.recording.writer import FLUSH_NS, Pump, Series, opener
from motorhil.traces.digest import digest
from motorhil.traces.errors import TraceError
from motorhil.traces.formats.frames import Findings
from motorhil.traces.formats.registry import recorded_frames
from motorhil.traces.mcap.reader import read_trace
from motorhil.traces.schema import Direction, Level
from tests.support.recordings.written import MS, can_frame, counted_frame

S = 1_000_000_000


class Told:
    """Sink that keeps a pump's messages."""

    def __init__(self):
        self.entries, self.flushes, self.facts = [], 0, None

    def extend(self, entries):
        self.entries += entries

    def flush(self):
        self.flushes += 1
        self.flushed = len(self.entries)

    def close(self, facts):
        self.facts = facts


def frames(source, *times):
    return [(source, time_ns, can_frame(0x100 + source)) for time_ns in times]


def times(pump, told):
    pump._hand_over()
    return [time_ns for _, time_ns, _ in told.entries]


def test_pump_two_buses_are_ordered_across_rounds():
    told = Told()
    pump = Pump(["can0", "can1"], told)
    # The round began at 10. can0 was read first. can1 was read later, when the frames of 11 and 12
    # had arrived. can0's frame of 11 arrives only in the next round.
    assert pump.take([frames(0, 1, 5, 9), frames(2, 2, 8, 11, 12)], began_ns=10) == 7
    assert times(pump, told) == [1, 2, 5, 8, 9]
    pump.take([frames(0, 11, 13), frames(2, 14)], began_ns=15)
    assert times(pump, told) == [1, 2, 5, 8, 9, 11, 11, 12, 13, 14]
    assert pump.frames == [5, 5]
    assert (pump.first_ns, pump.last_ns) == (1, 14)


def test_pump_two_buses_are_ordered_within_a_round():
    told = Told()
    pump = Pump(["can0", "can1"], told)
    pump.take([frames(0, 1, 5), frames(2, 2, 3)], began_ns=10)
    assert times(pump, told) == [1, 2, 3, 5]
    assert (pump.first_ns, pump.last_ns) == (1, 5)


def test_pump_future_stamp_waits_one_round_only():
    told = Told()
    pump = Pump(["can0", "can1"], told)
    pump.take([frames(0, 900), []], began_ns=10)
    assert times(pump, told) == []
    pump.take([[], []], began_ns=20)
    assert times(pump, told) == [900]


def test_pump_close_records_held_frames():
    told = Told()
    pump = Pump(["can0", "can1"], told)
    pump.take([frames(0, 900), []], began_ns=10)
    pump.close({"lost": {"can0": "0"}})
    assert times(pump, told) == [900]
    assert told.facts == {"lost": {"can0": "0"}}


def test_pump_silent_bus_is_flushed_after_one_second():
    told = Told()
    pump = Pump(["can0"], told)
    pump.tick(0)
    assert told.flushes == 0
    pump.take([frames(0, 5 * S)], began_ns=5 * S)
    pump.take([frames(0, 5 * S + 1)], began_ns=5 * S + 1)
    pump.tick(5 * S + FLUSH_NS - 1)
    assert told.flushes == 0
    pump.tick(5 * S + FLUSH_NS)
    assert (told.flushes, told.flushed) == (1, 2)
    pump.tick(9 * S)
    assert told.flushes == 1  # nothing new


def test_pump_busy_bus_is_not_flushed_by_tick():
    told = Told()
    pump = Pump(["can0"], told)
    for time_ns in range(0, 5 * S, 10 * MS):
        pump.take([frames(0, time_ns)], began_ns=time_ns + MS)
        pump.tick(time_ns + MS)
    assert told.flushes == 0


def test_pump_losses_are_counted_and_recorded_in_place(tmp_path):
    path = str(tmp_path / "a.mcap")
    pump = Pump(["can0"], Series(path, opener(["can0"], {}, compact=False)))
    pump.take([frames(0, 1 * S)], began_ns=1 * S)
    pump.lost(0, 7, 2 * S)
    pump.lost(0, 7, 3 * S)
    pump.event(4 * S, Level.ERROR, "can0", "is down")
    pump.close({"lost": {"can0": "7"}})
    with read_trace(path) as trace:
        messages = [(c.topic, t, p) for c, t, p in trace.messages()]
        assert [m[:2] for m in messages] == [
            ("/can/can0", 1 * S),
            ("/events", 2 * S),
            ("/events", 4 * S),
        ]
        assert b"7 frames were lost here" in messages[1][2]
        assert trace.metadata["lost"] == {"can0": "7"}
    assert pump.dropped == [7]


# --- files


def recorded(path):
    with read_trace(path) as trace:
        assert trace.cut is None
        return [tuple(frame)[:4] for frame in recorded_frames(trace, Findings())]


def write_series(path, count=400, step_ns=50 * MS, batch=37, **limits):
    series = Series(str(path), opener(["can0", "arm"], {"record": {}}, compact=False), **limits)
    entries = [(k % 4, k * step_ns, counted_frame(k)) for k in range(count)]
    for start in range(0, count, batch):
        series.extend(entries[start : start + batch])
    series.close({"frames": {"can0": "x"}})
    names = ("can0", "can0", "arm", "arm")
    directions = (Direction.RECEIVED, Direction.TRANSMITTED)
    expected = [(t, names[k % 4], f, directions[k % 2]) for k, (_, t, f) in enumerate(entries)]
    return series, expected


def test_series_without_rotation_uses_given_name(tmp_path):
    series, expected = write_series(tmp_path / "run.mcap")
    assert series.paths == [str(tmp_path / "run.mcap")]
    assert recorded(series.paths[0]) == expected
    assert series.bytes == (tmp_path / "run.mcap").stat().st_size


def test_series_rotated_by_time_is_complete_without_overlap(tmp_path):
    series, expected = write_series(tmp_path / "run.mcap", rotate_ns=3 * S)
    names = [f"run-{number:04d}.mcap" for number in range(1, 8)]
    assert series.paths == [str(tmp_path / name) for name in names]
    parts = [recorded(path) for path in series.paths]
    assert [frame for part in parts for frame in part] == expected
    for part in parts:
        assert part[-1][0] - part[0][0] < 3 * S
        assert len(part) <= 60
    assert len({digest(path) for path in series.paths}) == 7
    with read_trace(series.paths[3]) as trace:
        assert [c.topic for c in trace.channels.values()] == ["/can/can0", "/can/arm", "/events"]
        assert "record" in trace.metadata


def test_series_after_long_gap_has_no_empty_files(tmp_path):
    series = Series(str(tmp_path / "a.mcap"), opener(["can0"], {}, False), rotate_ns=S)
    series.extend(frames(0, 0, 10 * S, 10 * S + 1))
    series.close({})
    assert [len(recorded(path)) for path in series.paths] == [1, 2]


def test_series_rotated_by_size_ends_after_full_chunk(tmp_path):
    series, expected = write_series(tmp_path / "run.mcap", batch=1, rotate_bytes=4000)
    sizes = [(tmp_path / path).stat().st_size for path in series.paths]
    assert len(sizes) > 3
    assert [frame for path in series.paths for frame in recorded(path)] == expected
    for path in series.paths[:-1]:
        with read_trace(path) as trace:
            *_, filling, last = sorted(chunk.offset for chunk in trace._chunks)
        assert filling < 4000 <= last  # the last chunk holds the one message that ended the file


def test_series_existing_file_is_kept_unless_overwrite(tmp_path):
    path = tmp_path / "run.mcap"
    write_series(path, 10)
    before = path.read_bytes()
    with pytest.raises(TraceError, match=r"run.mcap: exists; name another file, or give --force"):
        write_series(path, 10)
    assert path.read_bytes() == before
    write_series(path, 20, overwrite=True)
    assert len(recorded(path)) == 20
    (tmp_path / "notes.mcap").write_text("dear diary")
    with pytest.raises(TraceError, match="is not a recording, and would be overwritten"):
        write_series(tmp_path / "notes.mcap", overwrite=True)


def test_series_existing_later_file_is_refused_at_start(tmp_path):
    (tmp_path / "run-0007.mcap").write_text("from another day")
    (tmp_path / "run-x.mcap").write_text("of no number")
    with pytest.raises(TraceError, match=r"run-0007.mcap: exists"):
        write_series(tmp_path / "run.mcap", rotate_ns=3 * S)
    assert len(list(tmp_path.iterdir())) == 2
    (tmp_path / "run-0007.mcap").unlink()
    assert len(write_series(tmp_path / "run.mcap", rotate_ns=3 * S)[0].paths) == 7


def test_progress_line_is_due_four_times_a_second():
    progress = Progress(0)
    assert progress.line(249 * MS, 10, 0, 0) is None
    line = progress.line(500 * MS, 1000, 3, 3 << 20)
    assert line.split("  ")[-4:] == ["1,000 frames", "2,000 frames/s", "3 lost", "3.0 MiB"]
    assert progress.line(600 * MS, 1100, 3, 3 << 20) is None
    assert "10,000 frames/s" in progress.line(1500 * MS, 11_000, 3, 0)


def test_pump_error_and_fd_frames_are_recorded_unchanged(tmp_path):
    error = struct.pack("<IB3x8s", 0x2000_0040, 8, bytes(8))
    long = struct.pack("<IBB2x64s", 0x123, 12, 5, bytes(12))
    pump = Pump(["can0"], Series(str(tmp_path / "a.mcap"), opener(["can0"], {}, False)))
    pump.take([[(0, 1, error), (1, 2, long)]], began_ns=3)
    pump.close({})
    assert [frame[2] for frame in recorded(tmp_path / "a.mcap")] == [error, long]
