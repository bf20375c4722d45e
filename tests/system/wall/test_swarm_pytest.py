"""Tests as the program of a campaign."""

import json
import shlex
import subprocess
import sys

import pytest

from motorhil.harness.rig.config.scaffold import write_new_rig
from motorhil.harness.rig.config.toml import RigError
from motorhil.harness.swarm.campaign import Campaign, with_profile
from motorhil.harness.swarm.engine import end_workers, local
from motorhil.harness.swarm.plan import PYTEST, Program, plan_of
from motorhil.harness.swarm.results import create
from motorhil.harness.swarm.row import CANARY, Result
from tests.support.command_line import in_another_process

pytestmark = pytest.mark.wall

TESTS = """\
import random

import pytest
from hypothesis import given, settings, strategies


def run(rig):
    rig.runtime.run_for(0.05)


class TestOwn:
    def test_assert(self, rig):
        run(rig)
        assert rig.seed != 2, "two"

    def test_error(self, rig):
        if rig.seed == 3:
            raise LookupError("three")

    def test_allowed(self, rig):
        if rig.seed == 4:
            from motorhil.motorapi.errors import LinkError

            raise LinkError(link="can0", reason="four")

    def test_teardown(self, rig, request):
        request.addfinalizer(lambda: 1 // (rig.seed - 5))

    def test_endless(self, rig):
        while rig.seed == 6:
            run(rig)

    @pytest.mark.xfail(strict=True)
    def test_strict(self, rig):
        assert rig.seed == 7


def test_skipped(rig):
    pytest.skip("not here")


@settings(deadline=None, max_examples=5)
@given(strategies.integers(0, 1_000_000))
def test_examples(open_rig, number):
    with open_rig() as rig:
        rig.runtime.run_for(0.001 + number / 1e9)


@pytest.fixture(scope="session")
def session_rig(open_rig):
    with open_rig() as rig:
        yield rig


@pytest.mark.parametrize("number", range(2))
def test_session(session_rig, number):
    run(session_rig)


def test_no_rig():
    pass
"""
END = "[swarm]\nend_s = 5.0\n"


@pytest.fixture
def folder(tmp_path, monkeypatch):
    """Return a folder with a rig and its tests, where the tests run."""
    write_new_rig(tmp_path)
    with (tmp_path / "rig.toml").open("a") as file:
        file.write(END)
    (tmp_path / "test_wheels.py").write_text(TESTS)
    (tmp_path / "pytest.ini").write_text("[pytest]\naddopts = -n 2 -W error\n")
    monkeypatch.chdir(tmp_path)
    yield tmp_path
    end_workers()


def rows(folder, node, seeds):
    plan = with_profile(plan_of(folder / "rig.toml", Program(PYTEST, node), (), 60.0))
    results = create(folder / "out", plan)
    with local(1) as engine:
        try:
            Campaign(plan, results, engine, 1).run(seeds, lambda rows: None)
        finally:
            end_workers()
    return results.rows


def test_failures_of_tests_are_failures_of_worlds(folder):
    found = rows(folder, "test_wheels.py::TestOwn", [CANARY, *range(1, 8)])
    told = {seed: row.signature.split(" | ")[:2] for seed, row in found.items() if seed != CANARY}
    assert "always" in found[CANARY].text
    assert found[1].result is Result.PASSED
    assert told[2] == ["assert", "assert at test_wheels.py:14"]
    assert told[3] == ["exception", "LookupError at test_wheels.py:18"]
    assert (found[4].result, found[4].ended_by) == (Result.PASSED, "LinkError"), found[4]
    assert told[5] == ["exception", "ZeroDivisionError at test_wheels.py:27"]
    assert (found[6].result, told[6]) == (Result.TIMEOUT, ["end", "still runs"])
    assert told[7] == ["assert", "assert at ?"]
    assert found[2].at_ns == 50_000_000
    assert not (folder / ".pytest_cache").exists()


@pytest.mark.parametrize("node", ["test_examples", "test_session"])
def test_rigs_of_examples_and_sessions_are_watched(folder, node):
    first = rows(folder, f"test_wheels.py::{node}", range(4))
    assert [row.result for row in first.values()] == [Result.PASSED] * 4
    assert all(row.digest and row.end_ns for row in first.values())
    (folder / "out").rename(folder / "before")
    assert rows(folder, f"test_wheels.py::{node}", range(4)) == first
    assert not (folder / ".hypothesis").exists()


@pytest.mark.parametrize(
    ("node", "problem"),
    [
        ("test_wheels.py::test_nothing", "does not find test_wheels.py::test_nothing"),
        ("test_wheels.py::test_no_rig", "test_wheels.py::test_no_rig opens no rig"),
        ("test_wheels.py::test_skipped", "test_wheels.py::test_skipped"),
        ("test_broken.py", "cannot collect test_broken.py: NameError: name 'broken'"),
    ],
)
def test_node_that_cannot_run_is_wrong_usage(folder, node, problem):
    (folder / "test_broken.py").write_text("broken\n")
    if node.endswith("skipped"):
        (folder / "test_wheels.py").write_text(
            "import pytest\n\ndef test_skipped():\n    pytest.skip('x')\n"
        )
    with pytest.raises(RigError) as raised:
        with_profile(plan_of(folder / "rig.toml", Program(PYTEST, node), (), 60.0))
    assert problem in str(raised.value)


def test_command_of_a_failure_repeats_it(folder):
    (folder / "pytest.ini").write_text("[pytest]\naddopts = -W error\n")
    words = ("swarm", "rig.toml", "--pytest", "test_wheels.py::TestOwn::test_assert")
    done = in_another_process(*words, "--first", "2", "--seeds", "1", "--json", "-o", "out")
    assert done.returncode == 1, done.stderr
    (kept,) = json.loads(done.stdout)["kept"]
    again = [sys.executable, "-m", *shlex.split(kept["again"])]
    repeated = subprocess.run(again, capture_output=True, text=True, check=False)
    assert repeated.returncode == 1
    assert "AssertionError: two" in repeated.stdout
