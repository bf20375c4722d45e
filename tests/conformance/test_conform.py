"""The verb `conform`: its output, its files, and its errors."""

import json
import os
import re
import signal
import subprocess
import sys
from pathlib import Path
from xml.etree import ElementTree

import pytest

from motorhil.harness.cli.main import main
from motorhil.harness.conformance.benches.rig_bench import RigBench, bench_description
from motorhil.harness.conformance.clause import Clause, Level, NotApplicable, Result, Verdict
from motorhil.harness.conformance.examination import Finding
from motorhil.harness.conformance.job import Job, Loaded, Promise
from motorhil.harness.conformance.kit import all_clauses
from motorhil.harness.conformance.run import run_clause
from motorhil.harness.conformance.target import Target
from motorhil.harness.conformance.verdicts.results import Outcome, as_json, as_junit, as_page
from motorhil.harness.rig.config.toml import RigError
from motorhil.harness.rig.reading import describe
from motorhil.motorapi import ControlMode, ControlVariable
from motorhil.traces.digest import digest
from tests.support.command_line import beside
from tests.support.kit_benches import RIGS

ROOT = Path(__file__).parents[2]
WITHOUT = '[conformance.without]\nposition_trajectory = "it has none"\n'
MISBEHAVING = "tests.support.motors.misbehaving:build"
THREE = ("--clause", "STATE-01", "--clause", "STOP-07", "--clause", "LOW-01")


def conform(*words, seed):
    """Run the command in another process with this hash seed."""
    return subprocess.run(
        [sys.executable, "-m", "motorhil", "conform", *words],
        env={**os.environ, "PYTHONHASHSEED": str(seed)},
        capture_output=True,
        text=True,
        timeout=200,
    )


TIGHT = "window_rad = 0.001", "window_rad = 1e-9"
"""A position window that no motor can keep, for a clause that fails."""


@pytest.fixture(scope="module")
def runs(tmp_path_factory):
    """Two runs of two clauses, one of which fails, in folders of their own: (process, folder)."""
    done = []
    for seed in (1, 2):
        folder = tmp_path_factory.mktemp("conform")
        rig = folder / "rig.toml"
        rig.write_text((RIGS / "cia402.toml").read_text().replace(*TIGHT))
        words = ["--rig", str(rig), "--clause", "UNIT-01", "--clause", "STATE-01"]
        for kind in ("json", "junit", "html"):
            words += [f"--{kind}", str(folder / f"found.{kind}")]
        done.append((conform(*words, "-o", str(folder / "records"), seed=seed), folder))
    return done


def found_in(folder):
    """Return the JSON without wall times and folder names."""
    document = json.loads((folder / "found.json").read_text().replace(str(folder), "."))
    del document["first_verdict_s"], document["took_s"]
    for clause in document["clauses"]:
        del clause["wall_s"]
    return document


@pytest.mark.wall
def test_failed_clause_is_reported_with_record_and_command(runs):
    done, folder = runs[0]
    assert done.returncode == 1, done.stderr
    found = found_in(folder)
    failed, passed = sorted(found["clauses"], key=lambda one: one["result"])
    assert (failed["id"], failed["result"], passed["id"]) == ("UNIT-01", "failed", "STATE-01")
    assert found["counts"]["failed"] == 1
    assert found["passed"] is False
    assert failed["second"] is None  # repeatable
    assert failed["place"].rpartition(":")[0].endswith("clauses/identity.py")
    record = folder / "records" / "UNIT-01.mcap"
    assert failed["record"] == "./records/UNIT-01.mcap"
    assert failed["digest"] == digest(record)
    again = f"motorhil conform --rig {folder}/rig.toml --clause UNIT-01 --seed 1"
    for told in (failed["seen"], again, str(record)):
        assert told.replace("./", f"{folder}/") in done.stdout
    assert found["claims"]["current_set_point"].startswith("the adaptation does not claim")
    assert found["claims"]["position_trajectory"] == ""


@pytest.mark.wall
def test_runs_with_one_seed_have_equal_verdicts_and_records(runs):
    first, second = (found_in(folder) for _, folder in runs)
    assert first == second


@pytest.mark.wall
def test_result_files_contain_the_results(runs):
    _, folder = runs[0]
    suite = ElementTree.parse(folder / "found.junit").getroot()
    assert (suite.get("tests"), suite.get("failures"), suite.get("errors")) == ("2", "1", "0")
    cases = {case.get("name").split()[0]: case for case in suite}
    assert "commanded" in cases["UNIT-01"].find("failure").get("message")
    assert list(cases["STATE-01"]) == []
    page = (folder / "found.html").read_text()
    assert '<a href="records/UNIT-01.mcap">' in page
    assert "<td>position_set_point</td><td>claimed</td>" in page
    assert "://" not in page
    assert "default-src 'none'" in page


def test_refused_claim_of_rig_fails_with_line_of_claim(tmp_path):
    rig = tmp_path / "rig.toml"
    text = (RIGS / "cia402.toml").read_text()
    before, head, after = text.partition("[conformance]\n")
    claims = 'claims = [\n  "homing",\n  "current_set_point",\n]\n'
    rig.write_text(f"{before}{head}{claims}{after}")

    def check(bench):
        bench.motor.set_control_mode(ControlMode.SETPOINT, ControlVariable.CURRENT)

    described = bench_description(describe(rig), None)
    (claimed,) = (one for one in described.conformance.claims if "current" in one.value)
    clause = Clause("X-01", Level.L0, "It is so.", "nowhere", (claimed,), (), check)
    verdict = run_clause(clause, lambda: RigBench(described, 1))
    assert verdict.result is Result.FAILED
    assert "current set-points: claimed by the rig, refused by the motor" in verdict.seen
    assert verdict.place == f"{rig}:{before.count(chr(10)) + 4}"


@pytest.mark.parametrize(
    ("words", "told"),
    [
        ((), "no adaptation named; use --adaptation NAME, --rig RIG, or both"),
        (("--rig", "no_motor.toml"), "no_motor.toml: has no motors to test; add a [motor.NAME]"),
        (("--adaptation", "ideal", "--clause", "STAT-01"), "no such clause; did you mean STATE-01"),
        (
            ("--list", "--level", "L0", "--clause", "STOP-01"),
            "STOP-01: is of level L2, above --lev",
        ),
        (("--list", "--level", "L7"), "invalid level 'L7'; use L0 to L5"),
        (("--adaptation", "ideal", "--json", "no/x"), "no/x: folder no does not exist; create it"),
        (("--adaptation", "ideal", "--html", "."), ".: is a folder; name a file in it"),
        (
            ("--rig", "x", "--on", "y", "--workers", "2"),
            "one clause after another; leave --workers",
        ),
        (("--rig", "x", "--fail-fast", "--workers", "2"), "leave --workers out"),
    ],
)
def test_wrong_usage_is_reported_in_one_line(words, told, tmp_path, monkeypatch, capfd):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "no_motor.toml").write_text("[bus.can0]\nbitrate_bit_s = 1_000_000\n")
    assert main(["conform", *words]) == 2
    out, err = capfd.readouterr()
    assert out == ""
    assert told in err
    assert "Traceback" not in err


@pytest.mark.parametrize(
    ("job", "told"),
    [
        (Job("cia40"), "adaptation cia40: is not installed (known: cia402"),
        (Job("no.such:build", "x.toml"), "cannot be loaded: ModuleNotFoundError: No module name"),
        (Job("os:no_such", "x.toml"), "AttributeError: module 'os' has no attribute 'no_such'"),
        (Job("os:getpid"), "adaptation os:getpid: has no rig of its own; add --rig RIG"),
        (Job("ideal", "none.toml"), "none.toml: no such file"),
    ],
)
def test_unusable_target_is_reported_with_reason(job, told):
    with pytest.raises(RigError, match=re.escape(told)):
        Target(job)


def test_refused_setting_raises_rig_error(tmp_path):
    rig = tmp_path / "rig.toml"
    rig.write_text((RIGS / "ideal.toml").read_text().replace('axis = "left"', "axis = 3"))
    opener = Target(Job("", str(rig))).opener()
    with pytest.raises(RigError, match=r"rig.toml:\d+: motor.left.axis: must be a string"):
        run_clause(all_clauses()["STATE-01"], opener)


@pytest.mark.parametrize(
    ("old", "new", "told"),
    [
        ('motors = ["left", "right"]\na', 'motors = ["left", "left"]\na', 'left" is there twice'),
        ('claims = ["', 'claims = ["dead_man", "', "is claimed at "),
    ],
)
def test_contradiction_in_conformance_table_raises_rig_error(old, new, told, tmp_path):
    rig = tmp_path / "rig.toml"
    text = (RIGS / "ideal.toml").read_text()
    assert text.count(old) == 1
    rig.write_text(text.replace(old, new))
    with pytest.raises(RigError, match=rf"rig.toml:\d+: conformance.*{told}"):
        Target(Job("", str(rig)))


def test_result_files_escape_special_characters():
    odd = "<&\"'\x00\x1b[31m\ud800 \n]]>"
    promise = Promise("X-01", 2, odd, odd)
    finding = Finding(promise, Verdict("X-01", Result.HUNG, odd, odd), 0.5, (odd,), odd)
    loaded = Loaded(odd, odd, odd, (odd,), 1, 30.0, odd, ())
    outcome = Outcome(loaded, [finding], {"homing": odd}, 0.1, 0.2)
    (case,) = ElementTree.fromstring(as_junit(outcome).encode())
    assert case.find("error").get("message") == "<&\"'\ufffd\ufffd[31m\ufffd \n]]>"
    assert json.loads(as_json(outcome))["clauses"][0]["seen"] == odd
    page = as_page(outcome, Path())
    assert page.encode()
    assert "&lt;&amp;" in page
    assert "<&" not in page


def test_adaptation_with_own_rig_is_tested_on_it():
    assert Target(Job(MISBEHAVING)).rig.source.path.samefile(RIGS / "ideal.toml")


def test_refused_homing_is_not_claimed_and_faults_are_assumed(capfd, tmp_path):
    words = ("--adaptation", "tests.support.motors.misbehaving:homeless", "-o", str(tmp_path))
    assert main(["conform", *words, "--clause", "HOME-01", "--clause", "HOME-02"]) == 0
    told = capfd.readouterr().out
    assert "HOME-01   not applicable" in told
    assert "HOME-02   passed" in told
    (claimed,) = re.findall("(?m)^claimed: (.*)", told)
    assert not {"homing", "faults", "dead_man"}.intersection(claimed.split(", "))
    assert re.search(r"(?m)^assumed, unless \[conformance\.without\] denies it: faults$", told)


def test_record_folder_that_cannot_be_created_is_reported(tmp_path, capfd):
    rig = tmp_path / "rig.toml"
    rig.write_text((RIGS / "cia402.toml").read_text().replace(*TIGHT))
    words = ("--rig", str(rig), "--clause", "UNIT-01", "-o", str(rig / "x"))
    assert main(["conform", *words]) == 2
    assert "rig.toml/x: cannot be created: Not a directory" in capfd.readouterr().err


def test_run_without_applicable_clause_exits_with_3(tmp_path, capfd):
    rig = tmp_path / "rig.toml"
    text = (RIGS / "ideal.toml").read_text()
    rig.write_text(text.partition("[conformance.without]")[0] + WITHOUT)
    assert main(["conform", "--rig", str(rig), "--clause", "UNIT-01"]) == 3
    out, err = capfd.readouterr()
    assert "no clause was applicable" in err
    assert "not applicable: UNIT-01: not claimed by the rig: it has none" in out


@pytest.mark.wall
def test_ctrl_c_ends_run_and_worker(tmp_path, monkeypatch):
    monkeypatch.setenv("MISBEHAVE", str(tmp_path / "harm"))
    monkeypatch.chdir(ROOT)
    (tmp_path / "harm").write_text("says_so_and_works_for_ever")
    with beside("conform", "--adaptation", MISBEHAVING, "--clause", "STATE-01") as process:
        while not (tmp_path / "harm.at").exists():
            assert process.poll() is None
        worker = int((tmp_path / "harm.at").read_text())
        process.send_signal(signal.SIGINT)
        _, err = process.communicate(timeout=100)
    assert process.returncode == 130
    assert err == "motorhil: interrupted\n"
    assert not Path(f"/proc/{worker}").exists()


@pytest.mark.wall
def test_ctrl_c_ends_all_workers(tmp_path, monkeypatch):
    monkeypatch.setenv("MISBEHAVE", str(tmp_path / "harm"))
    monkeypatch.chdir(ROOT)
    (tmp_path / "harm").write_text("works_for_ever_in_a_further_worker")
    words = ("--adaptation", MISBEHAVING, "--workers", "2", "-o", str(tmp_path / "records"))
    with beside("conform", *words, *THREE) as process:
        while not (tmp_path / "harm.at").exists():
            assert process.poll() is None
        workers = [(tmp_path / f"harm.{which}").read_text() for which in ("first", "at")]
        process.send_signal(signal.SIGINT)
        out, err = process.communicate(timeout=20)  # before the deadline of the check
    assert (process.returncode, err) == (130, "motorhil: interrupted\n")
    assert [line.split()[:2] for line in out.splitlines()] == [["STATE-01", "passed"]]
    assert not any(Path(f"/proc/{worker}").exists() for worker in workers)


def test_list_prints_clauses_of_level(capfd):
    assert main(["conform", "--list", "--level", "0"]) == 0
    head, *rows = capfd.readouterr().out.splitlines()
    assert head.split() == ["clause", "level", "promise", "source"]
    assert all(row.split()[1] == "L0" for row in rows)
    assert any(row.startswith("UNIT-01") for row in rows)


def test_not_applicable_clause_has_reason():
    def check(bench):
        raise NotApplicable("there is one motor only")

    clause = Clause("X-02", Level.L0, "It is so.", "nowhere", (), (), check)
    described = bench_description(describe(RIGS / "ideal.toml"), None)
    verdict = run_clause(clause, lambda: RigBench(described, 1))
    assert (verdict.result, verdict.seen) == (Result.NOT_APPLICABLE, "there is one motor only")


@pytest.mark.wall
@pytest.mark.parametrize("harm", ["has_a_bug", "exits"])
def test_several_workers_tell_the_same_in_the_same_order(tmp_path, monkeypatch, harm):
    monkeypatch.setenv("MISBEHAVE", str(tmp_path / "harm"))
    (tmp_path / "harm").write_text(harm)
    found = []
    for count in ("1", "3"):
        folder = tmp_path / count
        folder.mkdir()
        words = ("--adaptation", MISBEHAVING, "--level", "0", "--workers", count, "-o", str(folder))
        done = conform(*words, "--json", str(folder / "found.json"), seed=0)
        assert done.returncode == 1, done.stderr
        told = done.stdout.partition("; first verdict")[0].replace(str(folder), ".")
        found.append((told.splitlines(), found_in(folder)))
    assert found[0] == found[1]
    assert found[0][1]["counts"]["crashed"] == 2


@pytest.fixture
def with_a_bug(tmp_path, monkeypatch):
    monkeypatch.setenv("MISBEHAVE", str(tmp_path / "harm"))
    monkeypatch.chdir(ROOT)
    (tmp_path / "harm").write_text("has_a_bug")
    return ("--adaptation", MISBEHAVING, "-o", str(tmp_path / "records"))


def test_one_bug_is_one_group(with_a_bug, capfd, tmp_path):
    found = tmp_path / "found.json"
    assert main(["conform", *with_a_bug, *THREE, "--json", str(found)]) == 1
    out = capfd.readouterr().out
    crashed = [line for line in out.splitlines() if " crashed " in line and line[:1].isupper()]
    assert len(crashed) > 1
    first = crashed[0].split()[0]
    assert all(line.endswith(f"  the same as {first}") for line in crashed[1:])
    (group,) = json.loads(found.read_text())["groups"]
    assert "LookupError: a bug of the motor, in " in group["cause"]
    assert [group["first"], *group["others"]] == [line.split()[0] for line in crashed]
    assert f"1. {group['cause']} ({len(crashed)} clauses)" in out


def test_fail_fast_ends_after_the_first_bad_clause(with_a_bug, capfd, tmp_path):
    found = tmp_path / "found.json"
    assert main(["conform", *with_a_bug, *THREE, "--fail-fast", "--json", str(found)]) == 1
    results = [one["result"] for one in json.loads(found.read_text())["clauses"]]
    assert results[-1] == "crashed"
    assert set(results[:-1]) <= {"passed", "not applicable"}
    assert len(results) < 3
