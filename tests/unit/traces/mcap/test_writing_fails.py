"""Full disks, forbidden places and killed programs: recordings stay readable."""

import errno
import io
import os
import signal
import subprocess
import sys

import pytest
from mcap.reader import make_reader

from motorhil.traces.errors import TraceError
from motorhil.traces.mcap.reader import read_trace
from motorhil.traces.mcap.writer import TraceWriter
from motorhil.traces.schema import LOG, Schema
from tests.support.recordings.written import MS, SECOND, Recording, can_frame


class SmallDisk(io.BytesIO):
    """A file on a disk of limited size; the last write before it is full is short."""

    name = "/media/stick/a.mcap"

    def __init__(self, room):
        super().__init__()
        self.room = room

    def write(self, data):
        room = self.room - self.tell()
        if room <= 0 and len(data):
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
        return super().write(bytes(data)[:room])


def seconds_until_full(disk, a_second=100):
    """Fill the disk with `a_second` messages per second; return recording and error."""
    recording = Recording(disk, compact=True)
    with pytest.raises(TraceError) as caught:  # noqa: PT012  # the loop is what is tried
        for second in range(1000):
            recording.fill(a_second, SECOND // a_second, first=a_second * second)
            recording.writer.flush()
    return recording, caught.value


def frames_in(data, path):
    path.write_bytes(data)
    with read_trace(path) as trace:
        return trace.cut, [
            (time, payload[-8:]) for c, time, payload in trace.messages() if "can" in c.topic
        ]


def test_full_disk_error_names_file_extent_and_remedy():
    _, error = seconds_until_full(SmallDisk(20_000))
    assert error.path == "/media/stick/a.mcap"
    assert str(error) == (
        "/media/stick/a.mcap: cannot be written: no space left on device; "
        "the recording holds up to 10.990 s; free space there, or record to another place"
    )


@pytest.mark.parametrize("room", range(20_000, 20_900, 50))
def test_full_disk_keeps_everything_written_before(tmp_path, room):
    disk = SmallDisk(room)
    recording, _ = seconds_until_full(disk)
    cut, found = frames_in(disk.getvalue(), tmp_path / "a.mcap")
    wanted = [(time, data[8:]) for source, time, data in recording.entries if source >= 0]
    assert found == wanted[: len(found)]
    assert len(found) >= 7 * 90
    assert len(found) % 90 == 0  # complete seconds, and no part of the one that did not fit
    assert cut is None or not cut.size or cut.messages_missing


@pytest.mark.parametrize(
    ("room_left", "ending"),
    [(0, "none"), (49, "none"), (50, "short"), (1000, "short"), (4000, "whole")],
)
def test_full_disk_with_space_for_ending_is_valid_file(tmp_path, room_left, ending):
    endless = io.BytesIO()
    recording = Recording(endless, compact=True)
    for second in range(3):
        recording.fill(1000, MS, first=1000 * second).writer.flush()
    disk = SmallDisk(len(endless.getvalue()) + room_left)
    _, error = seconds_until_full(disk, 1000)
    assert error.remedy.endswith("motorhil recover adds it") is (ending == "none")
    cut, found = frames_in(disk.getvalue(), tmp_path / "a.mcap")
    assert len(found) == 2700
    if ending == "none":
        assert cut is not None
        assert disk.getvalue() == endless.getvalue()  # the part that did not fit was removed
        return
    assert cut is None
    disk.seek(0)
    reader = make_reader(disk, validate_crcs=True)
    assert len(list(reader.iter_messages())) == 3000
    summary = reader.get_summary()
    assert (summary is None) == (ending == "short")
    assert summary is None or summary.statistics.message_count == 3000


def test_calls_after_full_disk_raise_and_close_does_not():
    disk = SmallDisk(3_000)
    recording, error = seconds_until_full(disk)
    size = len(disk.getvalue())
    for call in (
        lambda: recording.writer.can_frame(0, 1, can_frame(1)),
        lambda: recording.writer.channel("/x", Schema.of(LOG)),
        lambda: recording.writer.attach("x", b""),
        lambda: recording.writer.advance(10**18),
    ):
        with pytest.raises(TraceError) as caught:
            call()
        assert caught.value is error
    recording.writer.close()
    assert len(disk.getvalue()) == size
    assert recording.writer.error is error


def test_full_disk_at_close_is_reported():
    disk = SmallDisk(1_400)
    recording = Recording(disk).fill(100, 10 * MS)
    with pytest.raises(TraceError, match="no space left"):
        recording.writer.close()
    recording.writer.close()


def test_disk_without_space_is_reported_at_once():
    with pytest.raises(TraceError, match="the recording holds nothing yet"):
        TraceWriter(SmallDisk(10))


def test_device_writing_single_bytes_gets_whole_file(tmp_path):
    class Slow(io.BytesIO):
        def write(self, data):
            return super().write(bytes(data)[:1])

    slow, quick = Slow(), io.BytesIO()
    for file in (slow, quick):
        Recording(file).fill(50, 50 * MS).writer.close()
    assert slow.getvalue() == quick.getvalue()


def test_missing_folder_is_reported_with_mkdir_command(tmp_path):
    with pytest.raises(TraceError) as caught:
        TraceWriter(tmp_path / "no" / "such" / "a.mcap")
    folder = tmp_path / "no" / "such"
    assert str(caught.value) == (
        f"{folder}/a.mcap: cannot be written: no such file or directory; "
        f"make the folder first: mkdir -p {folder}"
    )


@pytest.mark.parametrize("place", ["", "/proc/a.mcap"])
def test_invalid_place_is_refused_by_name(tmp_path, place):
    path = place or str(tmp_path)
    with pytest.raises(
        TraceError, match=r"cannot be written: .*; name a file in a folder"
    ) as caught:
        TraceWriter(path)
    assert caught.value.path == path


CHILD = """
import resource, sys
from tests.support.recordings.written import Recording
from motorhil.traces.errors import TraceError
recording = Recording(sys.argv[1])
limit = int(sys.argv[2])
if limit:
    resource.setrlimit(resource.RLIMIT_FSIZE, (limit, limit))
try:
    for number in range(0, 100_000_000, 50):
        recording.entries.clear()
        recording.fill(50, 10_000_000, first=number)
        print((number + 49) * 10_000_000, flush=True)
except TraceError as error:
    print(error)
    recording.writer.close()
"""


def test_file_size_limit_is_reported_and_keeps_messages(tmp_path):
    path = tmp_path / "a.mcap"
    command = [sys.executable, "-c", CHILD, path, "60000"]
    done = subprocess.run(command, capture_output=True, text=True, check=True)
    *times, error = done.stdout.splitlines()
    assert error.startswith(
        f"{path}: cannot be written: file too large; the recording holds up to "
    )
    assert path.stat().st_size <= 60_000
    with read_trace(path) as trace:
        last = max(time for _, time, _ in trace.messages())
    assert f"up to {last / 1e9:.3f} s" in error
    assert int(times[-1]) - last <= SECOND


@pytest.mark.wall
def test_killed_program_leaves_file_up_to_last_second(tmp_path):
    path = tmp_path / "a.mcap"
    command = [sys.executable, "-c", CHILD, path, "0"]
    with subprocess.Popen(command, stdout=subprocess.PIPE, text=True) as child:
        assert child.stdout is not None
        recorded_ns = 0
        while recorded_ns < 20 * SECOND:
            recorded_ns = int(child.stdout.readline())
        child.send_signal(signal.SIGKILL)
    assert child.returncode == -signal.SIGKILL
    with read_trace(path) as trace:
        times = [time for _, time, _ in trace.messages()]
        assert trace.cut is not None
    assert times == [10 * MS * number for number in range(len(times))]  # none is missing between
    assert times[-1] >= recorded_ns - SECOND


# --- files that are not ours


@pytest.mark.parametrize("content", [b"[rig]\nname = 'mine'\n", b"x", b"\x89MCAP1\r\n"])
def test_file_other_than_recording_is_not_overwritten(tmp_path, content):
    path = tmp_path / "rig.toml"
    path.write_bytes(content)
    with pytest.raises(TraceError) as caught:
        TraceWriter(path)
    told = f"{path}: is not a recording, and would be overwritten; name another file"
    assert str(caught.value) == told
    assert path.read_bytes() == content


def test_old_recording_and_empty_file_are_overwritten(tmp_path):
    path = tmp_path / "a.mcap"
    path.touch()
    for count in (100, 1):
        recording = Recording(path)
        recording.fill(count, MS)
        recording.writer.close()
    with read_trace(path) as trace:
        assert trace.cut is None
        assert len([1 for c, _, _ in trace.messages() if "can" in c.topic]) == 1


def test_recording_being_written_is_not_overwritten(tmp_path):
    path = tmp_path / "a.mcap"
    recording = Recording(path)
    recording.fill(10, MS)
    for _ in range(2):
        with pytest.raises(TraceError, match="is being written by another program"):
            TraceWriter(path)
    recording.writer.close()
    with read_trace(path) as trace:
        assert trace.cut is None
    TraceWriter(path).close()


@pytest.mark.parametrize("device", ["/dev/null", "/dev/stdout"])
def test_device_accepts_recording(device):
    code = f"from motorhil.traces.mcap.writer import TraceWriter; TraceWriter({device!r}).close()"
    subprocess.run([sys.executable, "-c", code], check=True, stdout=subprocess.DEVNULL)
