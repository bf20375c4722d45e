"""Command `motorhil swarm`: usage, a small campaign, and its folder afterwards."""

import json
import re
import shlex
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

from motorhil.harness.cli.main import main
from motorhil.harness.rig.config.toml import RigError
from motorhil.harness.swarm.repeat import assert_holds
from motorhil.harness.swarm.row import Result, Row
from motorhil.traces.mcap.reader import read_trace
from tests.support.command_line import environment, in_another_process
from tests.support.swarm.campaigns import FOUND, HASTY, PLAN, failure, written

SEEDS = 24


@pytest.fixture(scope="module")
def campaign(tmp_path_factory):
    """Return a folder with a campaign that has found failures, and what it printed."""
    folder = tmp_path_factory.mktemp("repository")
    with pytest.MonkeyPatch.context() as patch:
        patch.chdir(folder)
        assert main(["new", "wheels"]) == 0
        (folder / "errand.py").write_text(HASTY)
        words = ("swarm", "wheels/rig.toml", "errand:run", "--seeds", str(SEEDS), "--json")
        return folder, in_another_process(*words, "-o", "out", "--workers", "2")


@pytest.fixture
def folder(campaign, tmp_path, monkeypatch):
    """Return a copy of the campaign's folder, which is the current one."""
    shutil.copytree(campaign[0], tmp_path / "copy")
    monkeypatch.chdir(tmp_path / "copy")
    return tmp_path / "copy"


@pytest.fixture
def wheels(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    assert main(["new", "wheels"]) == 0
    capsys.readouterr()
    return tmp_path


# --- usage


RUN = ("wheels/rig.toml", "wheels/drive.py")


@pytest.mark.parametrize(
    ("words", "told"),
    [
        ((), "motorhil swarm: no rig file; name RIG and PROGRAM, or --show DIR"),
        (RUN[:1], "wheels/rig.toml: no program to run; name a script, or --pytest NODEID"),
        ((RUN[0], "absent.py"), "absent.py: no such file; name a Python program"),
        (("absent.toml", RUN[1]), "absent.toml: "),
        ((*RUN, "--pytest", "t.py"), "both PROGRAM and --pytest; give one of them"),
        (
            (*RUN, "--engine", "cloud"),
            "--engine: no engine 'cloud'; write local, index=K/N or dask",
        ),
        ((*RUN, "--engine", "local=3"), "--engine: no engine 'local=3'"),
        ((*RUN, "--engine", "index=5/4"), "expected K/N with 1 <= K <= N <= 16; write index=1/4"),
        ((*RUN, "--engine", "index=x"), "--engine: "),
        ((*RUN, "--only", "taste"), "argument --only: invalid choice: 'taste'"),
        ((*RUN, "--seeds", "0"), "argument --seeds: "),
        ((*RUN, "--resume", "-o", "absent"), "absent: has no plan.json; name the folder"),
        ((*RUN, "-o", "full"), "full: has results already; add --resume, or name another folder"),
        ((*RUN, "--resume", "-o", "full"), "full: was begun with another build; begin anew"),
        (("--show", "absent"), "absent: has no plan.json; name the folder of a campaign"),
        ((*RUN, "--show", "full"), "--show runs nothing; leave out RIG and PROGRAM"),
    ],
)
def test_wrong_usage_is_told_before_anything_runs(wheels, say, words, told):
    written(wheels / "full")
    status, out, err = say("swarm", *words)
    assert (status, out) == (2, "")
    assert told in err
    assert "Traceback" not in err
    assert not (wheels / "out").exists()


def test_program_that_fails_undisturbed_is_refused(wheels, say):
    (wheels / "sad.py").write_text("print('printed')\nraise ValueError('sad')\n")
    status, out, err = say("swarm", RUN[0], "sad.py")
    assert (status, out) == (2, "")
    assert "the program fails without any disturbance: ValueError: sad (sad.py:2)" in err
    assert "make it pass `motorhil run` first" in err
    assert not (wheels / "out").exists()


# --- a campaign


def test_campaign_prints_one_document_and_fails(campaign):
    _, done = campaign
    assert (done.returncode, done.stderr) == (1, "")
    found = json.loads(done.stdout)
    assert (found["worlds"], found["asked"], found["is_over"]) == (SEEDS, SEEDS, True)
    assert sum(found["results"].values()) == SEEDS
    assert found["results"]["fail"] > 0
    assert "always" in found["canary"]
    assert found["never"]["true"] == ["left is behind"]
    assert {cause["cause"] for cause in found["causes"]} == {one["cause"] for one in found["kept"]}
    assert all(cause["seen_s"] > 0.0 for cause in found["causes"])


def test_kept_failure_repeats_by_its_command(folder, campaign):
    for one in json.loads(campaign[1].stdout)["kept"]:
        done = in_another_process(*shlex.split(one["again"])[1:])
        assert done.returncode == 1, done.stderr
        told = one["story"].partition("; ")[2]
        assert done.stdout.splitlines()[-1] == f"{one['fragment']}: {told}"


def test_kept_test_fails_until_the_program_is_mended(folder, campaign):
    (one, *_) = json.loads(campaign[1].stdout)["kept"]
    text = "import runpy, sys; m = runpy.run_path(sys.argv[1]); m[sys.argv[2]]()"
    words = [sys.executable, "-c", text, one["test"], Path(one["test"]).stem]

    def tested():
        return subprocess.run(words, env=environment(), capture_output=True, text=True)

    done = tested()
    assert done.returncode == 1
    assert "AssertionError: always at " in done.stderr
    program = folder / "errand.py"
    program.write_text(program.read_text().replace("always(abs", "True or always(abs"))
    assert tested().returncode == 0


def test_kept_recording_is_that_of_the_small_world(folder, campaign):
    for one in json.loads(campaign[1].stdout)["kept"]:
        with read_trace(one["record"]) as trace:
            begins_ns, ends_ns = trace.span_ns()
        assert begins_ns <= one["at_ns"] <= ends_ns + 1_000_000_000
    page = (folder / "out/index.html").read_text()
    assert (
        page.count('class="moment"')
        == page.count("<article>")
        == len(json.loads(campaign[1].stdout)["kept"])
    )
    assert "position of left" in page


def test_times_are_not_among_the_rows(folder):
    rows = (folder / "out/rows.jsonl").read_text()
    assert not re.search(r'"at":|"wall', rows)
    assert '"ended":true' in (folder / "out/times.jsonl").read_text().splitlines()[-1]


def test_fragment_that_cannot_be_read_is_wrong_usage(folder, say):
    (folder / "world.toml").write_text('[[fault]]\nbus = "can9"\nkind = "drop"\n')
    words = "swarm", "wheels/rig.toml", "errand:run", "--world", "world.toml"
    status, out, err = say(*words)
    assert (status, out) == (2, "")
    assert "can9" in err
    with pytest.raises(RigError, match="can9"):
        assert_holds(
            folder / "wheels/rig.toml",
            "function",
            "errand:run",
            seed=1,
            world=folder / "world.toml",
        )


def test_one_world_prints_one_line_or_one_document(folder, capfd):
    (folder / "world.toml").write_text("")
    (folder / "calm.py").write_text("print('said')\n")
    words = ["swarm", "wheels/rig.toml", "calm.py", "--world", "world.toml"]
    assert main(words) == 0
    assert capfd.readouterr().out == "said\nworld.toml: passes; 0 s simulated\n"
    assert main([*words, "--json"]) == 0
    out, err = capfd.readouterr()
    assert json.loads(out)["result"] == "pass"
    assert err == "said\n"


def test_page_of_broken_campaign_does_not_reload(wheels):
    (wheels / "out").mkdir()
    (wheels / "out/rows.jsonl").symlink_to("/dev/full")
    done = in_another_process("swarm", *RUN, "--seeds", "2", "-o", "out", "--workers", "1")
    assert done.returncode == 2
    assert "out/rows.jsonl: cannot be written: " in done.stderr
    page = (wheels / "out/index.html").read_text()
    assert 'http-equiv="refresh"' not in page
    assert "The results of 2 worlds are missing" in page


def test_resumed_campaign_keeps_what_it_has_kept(folder, campaign):
    before = {path: path.stat().st_mtime_ns for path in (folder / "out/failures").iterdir()}
    words = ("swarm", "wheels/rig.toml", "errand:run", "--seeds", str(SEEDS), "--json")
    done = in_another_process(*words, "-o", "out", "--resume")
    assert done.returncode == 1, done.stderr
    found, first = json.loads(done.stdout), json.loads(campaign[1].stdout)
    assert (found["kept"], found["results"]) == (first["kept"], first["results"])
    after = {path: path.stat().st_mtime_ns for path in (folder / "out/failures").iterdir()}
    assert after == before


# --- --show


def test_show_prints_what_the_campaign_printed(folder, campaign, say):
    status, out, err = say("swarm", "--show", "out", "--json")
    assert (status, err) == (1, "")
    assert json.loads(out) == json.loads(campaign[1].stdout)


def test_show_writes_only_the_page(folder, say):
    with (folder / "out/rows.jsonl").open("a") as file:
        file.write('{"seed":7')  # as of a campaign that still writes
    before = {path: path.read_bytes() for path in (folder / "out").rglob("*") if path.is_file()}
    assert say("swarm", "--show", "out")[0] == 1
    after = {path: path.read_bytes() for path in (folder / "out").rglob("*") if path.is_file()}
    page = folder / "out/index.html"
    assert {path for path in after if after[path] != before.get(path)} <= {page}
    assert 'http-equiv="refresh"' not in page.read_text()


def test_show_works_without_rig_and_program(folder, say):
    shutil.rmtree(folder / "wheels")
    (folder / "errand.py").unlink()
    status, out, _ = say("swarm", "--show", "out")
    assert status == 1
    assert out.startswith(f"{SEEDS} worlds: ")
    assert out.endswith("page: out/index.html\n")


def test_show_of_folders_copied_together_is_of_all(tmp_path, monkeypatch, say):
    monkeypatch.chdir(tmp_path)
    written(tmp_path / "one").append([FOUND, failure(0)], part=(1, 2))
    written(tmp_path / "two").append([failure(1), Row(3, Result.PASSED)], part=(2, 2))
    shutil.copytree("one", "all")
    shutil.copytree("two", "all", dirs_exist_ok=True)
    status, out, _ = say("swarm", "--show", "all")
    assert status == 1
    assert out.startswith("3 worlds: 2 fail, 1 pass; 1 cause; ")


@pytest.mark.parametrize(
    ("rows", "status", "told"),
    [
        ([FOUND, Row(0, Result.PASSED)], 0, ""),
        ([FOUND, failure(0)], 1, ""),
        ([Row(-1, Result.PASSED), Row(0, Result.PASSED)], 3, "the canary was not found"),
        ([FOUND], 3, "no world has run"),
    ],
)
def test_status_tells_failures_and_doubts(tmp_path, say, rows, status, told):
    written(tmp_path / "out", rows, PLAN)
    found, _, err = say("swarm", "--show", str(tmp_path / "out"))
    assert found == status
    assert told in err
