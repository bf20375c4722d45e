"""Whatever an adaptation does, a clause ends in a verdict of its own, and the next is checked."""

import os
from pathlib import Path

import pytest

from harness.conformance import supervision
from harness.conformance.capability import Capability
from harness.conformance.claims import Claims
from harness.conformance.job import Job
from harness.conformance.kit import all_clauses
from harness.conformance.run import run_clause
from harness.conformance.supervision import CannotTestError, Supervisor, WrongJobError
from harness.conformance.target import Target
from harness.conformance.verdict import Result
from harness.conformance.worker import _Worker
from harness.settings import RigError
from motorapi.lock_directory import VARIABLE
from tests.conformance import misbehaving

pytestmark = pytest.mark.wall
ROOT = Path(__file__).parents[2]
MISBEHAVING = "tests.conformance.misbehaving:build"
CLAUSE = "STATE-01"  # it disables the motor
DEADLINE_S = 2.0  # enough to get there on a busy machine
PLACELESS = (  # begun nobody knows where
    "leaves_a_process",
    "leaves_a_descriptor",
    "keeps_a_lock",
    "moves_elsewhere",
    "answers_for_the_kit",
)


def line_of(name):
    """Where the harm is done: the first line of the function that does something."""
    code = getattr(misbehaving, name).__code__
    return code.co_filename, range(code.co_firstlineno, code.co_firstlineno + 8)


@pytest.fixture(scope="module")
def supervisor(tmp_path_factory):
    """One for all tests of the module, and how to say what goes wrong next."""
    told = tmp_path_factory.mktemp("harm") / "harm"
    before = Path.cwd()
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("MISBEHAVE", str(told))
        patch.setattr(supervision, "_GRACE_S", 4.0)  # for a busy machine, too
        patch.setenv(VARIABLE, str(tmp_path_factory.mktemp("locks")))
        patch.syspath_prepend(str(ROOT))
        with Supervisor(Job(MISBEHAVING)) as supervisor:
            supervisor.misbehave = told.write_text
            yield supervisor
    assert Path.cwd() == before


@pytest.mark.parametrize(
    ("harm", "result", "seen", "deadline_s"),
    [
        ("raises", Result.CRASHED, "ZeroDivisionError('division by zero')", None),
        ("leaves", Result.CRASHED, "SystemExit: no more", None),
        ("leaves_a_thread", Result.LEFT_BEHIND, "thread 'poller', started at ", None),
        ("leaves_a_bus", Result.LEFT_BEHIND, "a bus not shut down (Virtual bus channel pri", None),
        ("leaves_a_process", Result.LEFT_BEHIND, "import signal; signal.pause()", None),
        ("leaves_a_descriptor", Result.LEFT_BEHIND, "a descriptor not closed (/dev/null)", None),
        ("moves_elsewhere", Result.LEFT_BEHIND, "another current folder (/)", None),
        ("interrupts", Result.CRASHED, "KeyboardInterrupt", None),
        ("answers_for_the_kit", Result.CRASHED, """it wrote '{"verdict": {"result""", None),
        ("keeps_a_lock", Result.LEFT_BEHIND, "not let go of (pan, for moving)", None),
        ("waits_in_its_runtime", Result.HUNG, "still waits after 120 s of the rig's time", None),
        ("exits", Result.CRASHED, "its process ended, with exit status 3", None),
        ("segfaults", Result.CRASHED, "its process was ended by SIGSEGV", None),
        ("waits_for_ever", Result.HUNG, "has not ended after 2 s of the wall's time", DEADLINE_S),
        ("works_for_ever", Result.HUNG, "has not ended after 2 s of the wall's time", DEADLINE_S),
        ("works_whatever_comes", Result.HUNG, "nor when it was interrupted", DEADLINE_S),
    ],
)
def test_a_harm_has_a_verdict_of_its_own_and_the_rest_still_runs(
    supervisor, harm, result, seen, deadline_s
):
    supervisor.misbehave("")
    assert supervisor.check(CLAUSE).result is Result.PASSED
    supervisor.misbehave(harm)
    verdict = supervisor.check(CLAUSE, deadline_s=deadline_s)
    assert (verdict.clause, verdict.result) == (CLAUSE, result), verdict
    assert verdict.seen.endswith(seen) if deadline_s else seen in verdict.seen
    where = verdict.place or verdict.seen.rpartition(" ")[2]
    if harm not in PLACELESS:
        file, _, line = where.rpartition(":")
        expected, lines = line_of(harm)
        assert (file, int(line) in lines) == (expected, True), where
    if harm == "exits":
        assert supervisor.said == ("the adaptation's last words",)


@pytest.mark.parametrize(
    ("build", "told"),
    [("nothing", "None"), ("kind", "the class IdealMotor"), ("promised", "a 'coroutine'")],
)
@pytest.mark.filterwarnings("ignore:coroutine 'promised':RuntimeWarning")
def test_what_builds_no_motor_is_told_by_the_line_of_the_rig(build, told):
    target = Target(Job(f"tests.conformance.misbehaving:{build}", str(misbehaving.RIG)))
    verdict = run_clause(all_clauses()[CLAUSE], target.opener())
    assert (verdict.result, verdict.place) == (Result.CRASHED, "")
    line = 1 + misbehaving.RIG.read_text().splitlines().index('adaptation = "ideal"')
    assert verdict.seen.startswith(f"{misbehaving.RIG}:{line}: motor.left.adaptation: plugin ")
    assert f" built {told}, which is not a motorapi.Motor; " in verdict.seen


def test_what_is_no_function_is_wrong_usage():
    with pytest.raises(RigError, match="none_at_all: is a 'int'; name a function"):
        Target(Job("tests.conformance.misbehaving:none_at_all"))


def test_a_motor_that_cannot_be_asked_what_it_claims_is_told_with_the_line():
    job = Job("tests.conformance.misbehaving:shy", str(misbehaving.RIG))
    with pytest.raises(RigError, match=r"misbehaving.py:\d+: PluginError: .*KeyError"):
        _Worker(job.packed()).claims()


def test_a_question_that_raises_is_held_against_the_clauses_that_ask_it_alone():
    """It was held against whichever came first, and against nobody the second time."""
    target = Target(Job("tests.conformance.misbehaving:alone", str(misbehaving.RIG)))
    claims = Claims(target.opener())
    for _ in range(2):
        with pytest.raises(AttributeError, match="'level'"):
            claims.why_not(Capability.COMMON_TRIGGER)
        assert claims.why_not(Capability.POSITION_SET_POINT) == ""


def test_nothing_is_left_of_it(supervisor):
    """It is the last test of the module: what was started above is gone."""
    supervisor.misbehave("leaves_a_process")
    supervisor.check(CLAUSE)
    child = supervisor._child._process.pid
    supervisor.__exit__()
    assert not Path(f"/proc/{child}").exists()
    ours = [path.read_text() for path in Path("/proc/self/task").glob("*/children")]
    sleepers = [
        pid
        for pid in " ".join(ours).split()
        if b"signal.pause()" in Path(f"/proc/{pid}/cmdline").read_bytes()
    ]
    assert sleepers == []


def test_what_ends_the_process_when_it_is_loaded_is_told(tmp_path, monkeypatch):
    (tmp_path / "ends_it.py").write_text(
        "import os, sys\nprint('so long', file=sys.stderr, flush=True)\nos._exit(7)\n"
    )
    monkeypatch.syspath_prepend(str(tmp_path))
    with (
        Supervisor(Job("ends_it:build", "rig.toml")) as supervisor,
        pytest.raises(CannotTestError, match="exit status 7\n  so long"),
    ):
        supervisor.check(CLAUSE)


def test_a_rig_that_cannot_be_used_is_no_verdict():
    with (
        Supervisor(Job("ideal", os.devnull)) as supervisor,
        pytest.raises(WrongJobError, match=r"/dev/null:1: the rig has no bus; add \[bus\.can0\]"),
    ):
        supervisor.check(CLAUSE)
