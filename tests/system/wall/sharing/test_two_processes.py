"""Two programs that share a motor, one of them killed: no remains."""

import os
import re
import resource
import select
import signal
import subprocess
import sys
import tempfile
from contextlib import suppress
from pathlib import Path

import pytest

from motorhil.harness.cli import demo_two_processes as two_processes
from motorhil.motorapi.locking.lock_status import read_process
from motorhil.traces.mcap.reader import read_trace
from motorhil.traces.schema import LockAction
from motorhil.traces.semantics.ownership import Ended, read_ownership
from tests.support.forking.client import executing
from tests.support.line_programs import LONG_S

pytestmark = pytest.mark.wall

DEMO = (sys.executable, "-m", "motorhil", "demo", "--two-processes")


class Demo:
    """The running demo, with its temporary files in a separate folder."""

    def __init__(self, folder, **options):
        self.temporary = folder / "tmp"
        self.temporary.mkdir()
        self.record = folder / "out" / "demo.mcap"
        with executing():  # the environment of a forked process does not show in /proc
            self.process = subprocess.Popen(
                [*DEMO, "-o", str(self.record)],
                env={**os.environ, "TMPDIR": str(self.temporary)},
                stdout=subprocess.PIPE,
                stderr=subprocess.PIPE,
                text=True,
                **options,
            )
        self.told = []

    def hear(self, text):
        """Wait until it has printed a line with this text."""
        while True:
            assert select.select([self.process.stderr], [], [], LONG_S)[0], self.told
            line = self.process.stderr.readline()
            assert line, self.told
            self.told.append(line)
            if text in line:
                return

    def programs(self):
        """Return the pipes that show the end of each of its two programs."""
        pid = self.process.pid
        with open(f"/proc/{pid}/task/{pid}/children") as children:
            pids = [int(word) for word in children.read().split()]
        assert len(pids) == 2
        return [os.pidfd_open(pid) for pid in pids]

    def end(self):
        """Return (standard output, standard error) to its end."""
        out, err = self.process.communicate(timeout=2 * LONG_S)
        return out, "".join(self.told) + err


@pytest.fixture
def demo():
    running = []

    def start(**options):
        running.append(Demo(Path(folder), **options))
        return running[-1]

    with tempfile.TemporaryDirectory(dir="/tmp") as folder:  # sockets need short names
        yield start
        for one in running:
            one.process.kill()
            one.process.communicate()


def left_behind(demo):
    """Return the running processes that the demo has started, itself included."""
    mark = f"TMPDIR={demo.temporary}".encode()
    left = []
    for folder in Path("/proc").glob("[0-9]*"):
        with suppress(OSError):  # it has just ended
            if mark in (folder / "environ").read_bytes().split(b"\0"):
                left.append(folder.name)
    return left


def ended(programs):
    """Return whether all of them end soon, in any way."""
    try:
        return all(select.select([program], [], [], LONG_S)[0] for program in programs)
    finally:
        for program in programs:
            os.close(program)


def test_surviving_program_finishes_and_the_record_says_why(demo):
    running = demo()
    out, err = running.end()
    assert running.process.returncode == 0, err
    assert re.search(r"^ *\d+\.\d{3} s  demo    kills mast_program.py, which moves pan$", err, re.M)
    assert "driving has driven the manoeuvre" in err
    record = read_ownership(running.record)
    assert record.contradictions == ()
    tenures = record.tenures["pan"]
    (died,) = [one for one in tenures if one.ended is Ended.DIED]
    (killed_ns,) = events(running.record, "kills mast_program.py")
    (left_ns,) = events(running.record, f"mast_program.py[{died.pid}] has left, and has not given")
    assert died.from_ns <= killed_ns <= died.to_ns
    assert killed_ns <= left_ns  # and the two notices may come in either order
    assert (died.program, died.purpose.split()[0]) == ("mast_program.py", "panorama")
    after = tenures[tenures.index(died) + 1 :]
    looks = ["a look along the crab", "a look along the turn"]
    assert [one.purpose for one in after] in (looks, looks[1:])  # it may have had to wait only once
    assert {one.program for one in after} == {"driving_program.py"}
    assert {one.pid for one in after} != {died.pid}
    waiting = [event for event in record.events if event.action is LockAction.WAITING]
    assert any(event.time_ns <= killed_ns and event.pid == after[0].pid for event in waiting)
    for one in tenures:  # all of it is told, from the record alone
        row = rf"^ *{one.from_ns / 1e9:.3f} .*{one.program} +{one.pid} +{one.purpose} +(\d+)  "
        found = re.search(row + one.ended.value, out, re.M)
        assert int(found[1]) > 0, one
    assert list(running.temporary.iterdir()) == []


def events(path, text):
    """Return the time of the event whose text contains this."""
    with read_trace(path) as trace:
        return [
            time_ns for _, time_ns, data in trace.messages(["/events"]) if text.encode() in data
        ]


@pytest.mark.parametrize(
    ("number", "status"), [(signal.SIGINT, 130), (signal.SIGTERM, 143), (signal.SIGHUP, 129)]
)
def test_signal_ends_its_programs_and_leaves_nothing(demo, number, status):
    before = signal.signal(number, signal.SIG_DFL)  # the caller of the tests may ignore it (nohup)
    running = demo()
    signal.signal(number, before)
    running.hear("panorama 1")
    assert len(left_behind(running)) == 3
    running.process.send_signal(number)
    out, err = running.end()
    assert left_behind(running) == []
    assert running.process.returncode == status
    assert "Traceback" not in out + err
    assert list(running.temporary.iterdir()) == []
    with read_trace(running.record) as trace:
        assert trace.cut is None


def test_killed_demo_ends_its_programs_and_is_cleaned_up_next(demo, monkeypatch):
    running = demo()
    running.hear("panorama 1")
    programs = running.programs()
    running.process.kill()
    assert ended(programs)
    (left,) = running.temporary.iterdir()
    monkeypatch.setattr(tempfile, "tempdir", str(running.temporary))
    living = running.temporary / f"motorhil-demo-{os.getpid()}-{read_process(os.getpid())[1]}-x"
    living.mkdir()
    running.process.wait()
    with two_processes.private_folder() as folder:
        assert folder.is_dir()
        assert not left.exists()
        assert living.is_dir()
    assert list(running.temporary.iterdir()) == [living]


def test_full_disk_is_one_line_and_leaves_nothing(demo):
    size = 60_000  # of 30 kB a second

    def small_disk():
        resource.setrlimit(resource.RLIMIT_FSIZE, (size, size))

    running = demo(preexec_fn=small_disk)
    _, err = running.end()
    assert left_behind(running) == []
    assert running.process.returncode == 2
    assert "Traceback" not in err
    assert f"{running.record}" in err.splitlines()[-1]
    assert list(running.temporary.iterdir()) == []


def test_folder_unusable_for_sockets_is_one_line(tmp_path):
    far = tmp_path / ("x" * 100)
    far.mkdir()
    done = subprocess.run(
        [*DEMO, "-o", str(tmp_path / "demo.mcap")],
        env={**os.environ, "TMPDIR": str(far)},
        capture_output=True,
        text=True,
        check=False,
    )
    assert (done.returncode, done.stdout) == (2, "")
    (line,) = done.stderr.splitlines()
    assert line.endswith("path too long; set TMPDIR to a folder with a shorter name")
    assert list(far.iterdir()) == []


def test_single_process_option_is_refused_with_two(tmp_path):
    done = subprocess.run([*DEMO, "--realtime"], capture_output=True, text=True, check=False)
    assert (done.returncode, done.stdout) == (2, "")
    assert done.stderr == "motorhil demo: --two-processes takes only --seed and -o\n"
