"""Campaigns in worker processes: what dies, hangs or stops, and what then is in the results."""

import json
import os
import shutil
import signal
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import pytest

from motorhil.harness import examples
from motorhil.harness.rig.config.toml import RigError
from motorhil.harness.swarm.campaign import Campaign, seeds_of, with_profile
from motorhil.harness.swarm.engine import (
    WorkerProcess,
    end_workers,
    local,
    run_chunk,
    worker_pids,
)
from motorhil.harness.swarm.plan import FUNCTION, Program, plan_of
from motorhil.harness.swarm.results import create, open_results
from motorhil.harness.swarm.row import CANARY, Result, Row
from tests.support.command_line import beside, environment, has_ended, in_another_process

pytestmark = pytest.mark.wall

PROGRAMS = """\
import os, signal, subprocess, sys
from pathlib import Path
from motorhil import sometimes


def once(name):
    try:
        Path(name).touch(exist_ok=False)
    except FileExistsError:
        return False
    return True


def calm(rig):
    rig.runtime.run_for(0.01)


def wild(rig):
    calm(rig)
    seed = rig.seed
    if seed == 1:
        os._exit(7)
    if seed == 2:
        os.kill(os.getpid(), signal.SIGSEGV)
    if seed == 3:
        while True:
            pass
    if seed == 4:
        while True:
            rig.runtime.run_for(1.0)
    if seed == 5:
        command = [sys.executable, "-c", "import signal; signal.pause()"]
        one = subprocess.Popen(command)
        two = subprocess.Popen(command, start_new_session=True)
        Path("left").write_text(f"{one.pid} {two.pid}")
    if seed == 6:
        os.closerange(0, 256)
    if seed == 7 and os.fork() == 0:
        signal.pause()
    if seed == 8:
        os.kill(os.getpid(), signal.SIGKILL)
    if seed == 9 and once("killed-9"):
        os.kill(os.getpid(), signal.SIGKILL)
    if seed == 10:
        sys.exit(5)
    if seed == 11:
        print("never seen", sys.stdin.read(), flush=True)


def deadly(rig):
    calm(rig)
    if rig.seed in (3, 20) and once(f"worker-{rig.seed}"):
        os.kill(os.getppid(), signal.SIGKILL)


def wordy(rig):
    calm(rig)
    sometimes(rig.seed % 2, "x" * 2_000)


def broken(rig):
    print("printed by the program")
    assert rig.seed < 0, "broken anyway"


def waiting(rig):
    calm(rig)
    if rig.seed == 2:
        command = [sys.executable, "-c", "import signal; signal.pause()"]
        pids = [os.getpid(), os.getppid(), subprocess.Popen(command).pid]
        pids.append(subprocess.Popen(command, start_new_session=True).pid)
        with open("pids", "w") as file:
            file.write(" ".join(map(str, pids)))
        signal.pause()
"""
KEEPING = """\
import email, os, signal, subprocess, sys, threading
from motorhil import always, sometimes

COUNT = 0


def calm(rig):
    rig.runtime.run_for(0.01)


def counting(rig):
    global COUNT
    calm(rig)
    COUNT += 1
    always(COUNT == 1, "first")


def hiding(rig):  # in a module of Python
    calm(rig)
    email.count = getattr(email, "count", 0) + 1
    sometimes(email.count > 5, "sixth")


def blaming(rig):
    calm(rig)
    email.count = getattr(email, "count", 0) + 1
    always(email.count < 5, "fewer")


def dying(rig):
    calm(rig)
    email.count = getattr(email, "count", 0) + 1
    if email.count > 5:
        os._exit(1)


def leaving(rig):
    calm(rig)
    number = rig.seed // 16 % 6
    sometimes(os.getcwd() == "/", "elsewhere")
    sometimes("LEFT" in os.environ, "set")
    sometimes(signal.getsignal(signal.SIGUSR1) == signal.SIG_IGN, "ignored")
    sometimes(threading.active_count() > 1, "threads")
    if number == 0:
        os.chdir("/")
    if number == 1:
        os.environ["LEFT"] = "1"
    if number == 2:
        signal.signal(signal.SIGUSR1, signal.SIG_IGN)
    if number == 3:
        threading.Thread(target=signal.pause, daemon=True).start()
    if number == 4:
        os.open("/", os.O_RDONLY)
    if number == 5:
        subprocess.Popen([sys.executable, "-c", "import signal; signal.pause()"])


def daring(rig):
    calm(rig)
    if rig.seed == 64:
        code = "import os, signal; os.fork() and os._exit(0); print(os.getpid()); signal.pause()"
        command = [sys.executable, "-uc", code]
        left = subprocess.Popen(command, stdout=subprocess.PIPE, start_new_session=True)
        with open("left", "wb") as file:
            file.write(left.stdout.readline())
        left.wait()
        left.stdout.close()
    if rig.seed > 64:
        with open("left") as file:
            sometimes(os.path.exists(f"/proc/{file.read().strip()}"), "orphan")
"""
ALWAYS = "[swarm]\nend_s = 5.0\n"


@pytest.fixture
def folder(tmp_path, monkeypatch):
    """Return a folder with a rig and programs, where the tests run."""
    home = tmp_path / "here"
    home.mkdir()
    source = Path(examples.__file__).parent
    shutil.copy(source / "wheel_model.toml", home)
    (home / "rig.toml").write_text((source / "two_wheels.toml").read_text() + ALWAYS)
    (home / "app.py").write_text(PROGRAMS)
    (home / "keeping.py").write_text(KEEPING)
    monkeypatch.chdir(home)
    yield home
    end_workers()


def plan(name, wall_s=60.0, module="app"):
    program = Program(FUNCTION, f"{module}:{name}")
    return with_profile(plan_of(Path("rig.toml"), program, (), wall_s))


def campaign(plan, results, seeds, *, workers=1, part=(1, 1), on_rows=lambda rows: None):
    with local(workers) as engine:
        try:
            Campaign(plan, results, engine, workers, part=part).run(seeds, on_rows)
        finally:
            end_workers()


def lines(*folders):
    """Return all rows of some folders, sorted."""
    paths = [path for folder in folders for path in sorted(Path(folder).glob("rows*.jsonl"))]
    return sorted(line for path in paths for line in path.read_text().splitlines())


def test_program_does_its_worst_and_costs_only_its_own_world(folder):
    results = create(folder / "out", plan("wild", wall_s=3.0))
    campaign(open_results(folder / "out")[0], results, range(12))
    told = {seed: (row.result, row.oracle, row.text) for seed, row in results.rows.items()}
    left = Result.FAILED, "exit"
    assert told[0][0] is Result.PASSED
    assert told[1] == (*left, "the program left its process with status 7")
    assert told[2] == (*left, "the program crashed by SIGSEGV")
    assert told[3][:2] == (Result.TIMEOUT, "end")
    assert "3 s of wall time" in told[3][2]
    assert told[4] == (
        *(Result.TIMEOUT, "end"),
        "still runs after 5 s; expected an end; see end_s of [swarm]",
    )
    assert told[5][0] is Result.PASSED
    assert all(has_ended(int(pid)) for pid in (folder / "left").read_text().split())
    assert told[6][:2] == left
    assert "closed file descriptors" in told[6][2]
    assert told[7][0] is Result.PASSED
    assert told[8] == (Result.KILLED, "", "killed by SIGKILL")
    assert told[9][0] is Result.PASSED
    assert told[10] == (*left, "exit status 5; expected 0")
    assert told[11][0] is Result.PASSED


def test_worker_that_is_killed_loses_and_repeats_nothing(folder):
    one = plan("deadly")
    killed = create(folder / "killed", one)
    campaign(one, killed, range(24), workers=2)
    assert (folder / "worker-3").exists()
    assert (folder / "worker-20").exists()
    calm = create(folder / "calm", one)
    campaign(one, calm, range(24))
    assert len(lines("killed")) == 24
    assert lines("killed") == lines("calm")


def test_workers_parts_and_resumption_change_no_row(folder):
    one, seeds = plan("calm"), seeds_of(0, 20)
    campaign(one, create(folder / "whole", one), seeds)
    campaign(one, create(folder / "two", one), seeds, workers=2)
    for number in (1, 2):
        campaign(one, create(folder / f"part-{number}", one), seeds, part=(number, 2))
    left = iter((1, 7))  # rows until Ctrl-C
    create(folder / "cut", one)
    while True:
        planned, results = open_results(folder / "cut")
        most = len(results.rows) + next(left, 1000)

        def interrupted(rows, results=results, most=most):
            if len(results.rows) >= most:
                raise KeyboardInterrupt

        try:
            campaign(planned, results, seeds, on_rows=interrupted)
        except KeyboardInterrupt:
            continue
        break
    whole = lines("whole")
    assert len(whole) == 21
    assert lines("two") == whole
    assert lines("part-1", "part-2") == whole
    assert lines("cut") == whole
    (canary,) = [row for row in open_results(folder / "cut")[1].rows.values() if row.seed == CANARY]
    assert "always" in canary.text


def test_worker_of_another_build_refuses(folder):
    one = replace(plan("calm"), build="another build")
    with pytest.raises(RigError, match=r"a worker refuses: motorhil here is .*another build"):
        campaign(one, create(folder / "out", one), range(4))
    assert worker_pids() == []


def test_rig_or_program_that_changed_is_refused(folder):
    assert in_another_process("swarm", "rig.toml", "app:calm", "--seeds", "2").returncode == 0
    program = folder / "app.py"
    program.write_text(program.read_text() + "# changed\n")
    again = ("swarm", "rig.toml", "app:calm", "--seeds", "4", "--resume")
    refused = in_another_process(*again)
    assert refused.returncode == 2
    assert "was begun with another contents" in refused.stderr


def test_program_that_fails_undisturbed_is_refused_unheard(folder):
    refused = in_another_process("swarm", "rig.toml", "app:broken")
    assert refused.returncode == 2
    assert "fails without any disturbance: AssertionError: broken anyway" in refused.stderr
    assert "printed by the program" not in refused.stdout + refused.stderr
    assert not (folder / "out").exists()


def test_shrinking_outlives_its_worker(folder):
    request = {"try": 3, "world": []}
    table = plan("deadly").as_table()
    try:
        (line,) = run_chunk(table, request)
        assert (folder / "worker-3").exists()
        assert run_chunk(table, request) == [line]
    finally:
        end_workers()


@pytest.fixture
def started(monkeypatch):
    """Return the worker processes that were started, as a list that grows."""
    found = []

    class Worker(subprocess.Popen):
        def __init__(self, *words, **options):
            super().__init__(*words, **options)
            found.append(self)

    monkeypatch.setattr(subprocess, "Popen", Worker)
    return found


def test_campaign_goes_on_in_the_process_of_its_undisturbed_run(folder, started):
    one = plan("calm")
    campaign(one, create(folder / "out", one), range(8))
    assert len(started) == 1
    campaign(one, create(folder / "again", one), range(8))  # which has ended with the first one
    assert len(started) == 2
    assert lines("out") == lines("again")
    assert all(has_ended(worker.pid) for worker in started)


def test_campaign_of_another_program_starts_its_own_process(folder, started):
    one = plan("deadly")
    plan("calm")
    campaign(one, create(folder / "out", one), range(2))
    assert len(started) == 3  # that of each undisturbed run, and one more
    assert all(has_ended(worker.pid) for worker in started)


def test_ctrl_c_leaves_no_process_and_whole_results(folder):
    os.mkfifo("pids")
    words = ("swarm", "rig.toml", "app:waiting", "--seeds", "8", "--workers", "1")
    with beside(*words) as running:
        pids = [int(pid) for pid in Path("pids").read_text().split()]
        running.send_signal(signal.SIGINT)
        _, told = running.communicate(timeout=60)
    assert running.returncode == 130
    assert "go on with --resume" in told
    assert all(has_ended(pid) for pid in pids)
    assert len(pids) == 4
    open_results(folder / "out" / "swarm")


LIMITED = """\
import resource, sys
resource.setrlimit(resource.RLIMIT_FSIZE, (int(sys.argv.pop(1)), -1))
from motorhil.__main__ import start
sys.exit(start())
"""


def limited(limit, *words):
    """Run the command line where no file can be longer than a limit [bytes]."""
    command = [sys.executable, "-c", LIMITED, str(limit), *words]
    return subprocess.run(
        command, env=environment(), capture_output=True, text=True, timeout=120, check=False
    )


def test_rows_that_cannot_be_written_are_told_and_resumed(folder):
    words = ("swarm", "rig.toml", "app:wordy", "--seeds", "32", "--workers", "1", "-o", "out")
    full = limited(40_000, *words)
    assert full.returncode == 2, full.stderr
    assert "rows.jsonl: cannot be written: File too large" in full.stderr
    assert "--resume" in full.stderr
    written = lines("out")
    assert 0 < len(written) < 33
    assert in_another_process(*words, "--resume").returncode == 0
    assert len(lines("out")) == 33
    assert set(written) < set(lines("out"))


def test_records_that_cannot_be_written_are_no_results(folder):
    full = limited(2_000, "swarm", "rig.toml", "app:calm", "--workers", "1", "-o", "out")
    assert full.returncode == 2
    assert "run.mcap: cannot be written: file too large" in full.stderr
    assert not (folder / "out").exists()


# --- worlds that share a process


LANE = range(0, 12 * 16, 16)
"""Seeds of one lane, which are one batch."""


def alone(one, folder, seeds):
    """Return the rows of a campaign whose worlds have a process each."""
    results = create(folder, one)
    results.begin_alone(Row(-2, Result.PASSED), (1, 1))
    campaign(one, results, seeds)
    return (folder / "alone.jsonl").read_text()


def test_worlds_share_processes_and_no_variable_of_a_module(folder):
    one = plan("counting", module="keeping")
    results = create(folder / "out", one)
    campaign(one, results, LANE)
    assert one.batch() > len(LANE)
    assert not results.is_alone
    assert {row.result for row in results.rows.values()} == {Result.PASSED}


@pytest.mark.parametrize("name", ["leaving", "daring", "dying"])
def test_world_that_leaves_anything_or_dies_changes_no_other(folder, name):
    one = plan(name, module="keeping")
    results = create(folder / "out", one)
    campaign(one, results, LANE)
    assert not results.is_alone
    assert (folder / "out/rows.jsonl").read_text() == alone(one, folder / "alone", LANE)


def test_program_that_keeps_state_is_told_and_runs_alone(folder):
    one = plan("hiding", module="keeping")
    seeds = range(0, 33 * 16, 16)
    results = create(folder / "out", one)
    told = []
    campaign(one, results, seeds, on_rows=told.extend)
    last = seeds[one.batch() - 1]
    assert results.is_alone
    assert results.shown_by == last
    assert len(told) == len(results.rows) == len(seeds)
    text = (folder / "out/alone.jsonl").read_text()
    assert text == alone(one, folder / "alone", seeds)
    _, again = open_results(folder / "out")
    assert (again.is_alone, again.shown_by, again.rows) == (True, last, results.rows)
    begun = ("swarm", "rig.toml", "keeping:hiding", "--no-guidance", "-o", "out", "--resume")
    done = in_another_process(*begun, "--seeds", "4", "--first", "1", "--json")
    assert f"seed {last}: its result depends on the worlds before it" in done.stderr
    assert json.loads(done.stdout)["alone"] is True
    assert len((folder / "out/alone.jsonl").read_text().splitlines()) == len(seeds) + 5


def test_failure_by_the_worlds_before_is_none(folder):
    one = plan("blaming", module="keeping")
    results = create(folder / "out", one)
    campaign(one, results, range(3, 12 * 16, 16))
    assert results.is_alone
    assert {row.result for row in results.rows.values()} == {Result.PASSED}


def test_folder_that_a_killed_worker_left_is_removed_later(folder, tmp_path, monkeypatch):
    monkeypatch.setenv("TMPDIR", str(tmp_path))
    table = plan("calm").as_table()
    end_workers()
    first = WorkerProcess(table)
    (left,) = tmp_path.glob("motorhil-swarm-*")
    os.utime(left, (0, 0))
    WorkerProcess(table).close()
    assert left.exists()  # it is in use
    os.kill(first.pid, signal.SIGKILL)
    first.close()
    own = tmp_path / "motorhil-swarm-results"
    own.mkdir()
    (own / "plan.json").write_text("{}")
    for one in (left, own):
        os.utime(one, (0, 0))
    WorkerProcess(table).close()
    assert list(tmp_path.glob("motorhil-swarm-*")) == [own]
