"""Every clause has a verdict, whatever an adaptation does."""

import os
from pathlib import Path

import pytest

from motorhil.harness.conformance import supervisor as supervision
from motorhil.harness.conformance.claims import Claims
from motorhil.harness.conformance.clause import Result
from motorhil.harness.conformance.job import Job
from motorhil.harness.conformance.kit import all_clauses
from motorhil.harness.conformance.run import run_clause
from motorhil.harness.conformance.supervisor import CannotTestError, Supervisor, WrongJobError
from motorhil.harness.conformance.target import Target
from motorhil.harness.conformance.worker import _Worker
from motorhil.harness.rig.config.conformance import Capability
from motorhil.harness.rig.config.toml import RigError
from motorhil.motorapi.locking.directory import VARIABLE
from tests.support.motors import misbehaving

pytestmark = pytest.mark.wall
ROOT = Path(__file__).parents[2]
MISBEHAVING = "tests.support.motors.misbehaving:build"
CLAUSE = "STATE-01"  # this clause disables the motor
DEADLINE_S = 2.0  # enough on a busy machine
PLACELESS = (  # without a known start
    "leaves_a_process",
    "leaves_a_descriptor",
    "keeps_a_lock",
    "moves_elsewhere",
    "answers_for_the_kit",
)


def line_of(name):
    """Return the place of the harm: the file, and the lines of the function."""
    code = getattr(misbehaving, name).__code__
    return code.co_filename, range(code.co_firstlineno, code.co_firstlineno + 8)


@pytest.fixture(scope="module")
def supervisor(tmp_path_factory):
    """A supervisor for the module, with a function that selects the next misbehaviour."""
    told = tmp_path_factory.mktemp("harm") / "harm"
    before = Path.cwd()
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("MISBEHAVE", str(told))
        patch.setattr(supervision, "_GRACE_S", 4.0)  # also for a busy machine
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
        ("answers_for_the_kit", Result.CRASHED, """wrote '{"verdict": {"result""", None),
        ("keeps_a_lock", Result.LEFT_BEHIND, "not released (pan, for moving)", None),
        ("waits_in_its_runtime", Result.HUNG, "still waiting after 120 s of the rig's time", None),
        ("exits", Result.CRASHED, "worker process ended with exit status 3", None),
        ("segfaults", Result.CRASHED, "worker process ended by SIGSEGV", None),
        ("waits_for_ever", Result.HUNG, "not finished after 2 s of wall time", DEADLINE_S),
        ("works_for_ever", Result.HUNG, "not finished after 2 s of wall time", DEADLINE_S),
        ("works_whatever_comes", Result.HUNG, "nor when interrupted", DEADLINE_S),
    ],
)
def test_misbehaviour_has_verdict_and_run_continues(supervisor, harm, result, seen, deadline_s):
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
        assert supervisor.output == ("the adaptation's last words",)


def test_garbage_of_checks_is_bounded(supervisor):
    supervisor.misbehave("leaves_garbage")
    for _ in range(5):  # each leaves 100 MB
        assert supervisor.check(CLAUSE).result is Result.PASSED
    status = Path(f"/proc/{supervisor._child._process.pid}/status").read_text()
    peak_kb = int(status.partition("VmHWM:")[2].split()[0])
    assert peak_kb < 450_000


@pytest.mark.parametrize(
    ("build", "told"),
    [("nothing", "None"), ("kind", "the class IdealMotor"), ("promised", "a 'coroutine'")],
)
@pytest.mark.filterwarnings("ignore:coroutine 'promised':RuntimeWarning")
def test_builder_without_motor_is_reported_with_rig_line(build, told):
    target = Target(Job(f"tests.support.motors.misbehaving:{build}", str(misbehaving.RIG)))
    verdict = run_clause(all_clauses()[CLAUSE], target.opener())
    assert (verdict.result, verdict.place) == (Result.CRASHED, "")
    line = 1 + misbehaving.RIG.read_text().splitlines().index('adaptation = "ideal"')
    assert verdict.seen.startswith(f"{misbehaving.RIG}:{line}: motor.left.adaptation: plugin ")
    assert f" built {told}, which is not a motorapi.Motor; " in verdict.seen


def test_target_that_is_not_a_function_is_wrong_usage():
    with pytest.raises(RigError, match="none_at_all: is a 'int'; name a function"):
        Target(Job("tests.support.motors.misbehaving:none_at_all"))


def test_error_while_reading_claims_is_reported_with_line():
    job = Job("tests.support.motors.misbehaving:shy", str(misbehaving.RIG))
    with pytest.raises(RigError, match=r"misbehaving.py:\d+: PluginError: .*KeyError"):
        _Worker(job.packed()).claims()


def test_claim_that_raises_fails_only_clauses_that_need_it():
    """The error was once counted against the first clause only."""
    target = Target(Job("tests.support.motors.misbehaving:alone", str(misbehaving.RIG)))
    claims = Claims(target.opener())
    for _ in range(2):
        with pytest.raises(AttributeError, match="'level'"):
            claims.why_not(Capability.COMMON_TRIGGER)
        assert claims.why_not(Capability.POSITION_SET_POINT) == ""


def test_worker_processes_are_gone(supervisor):
    """This is the last test of the module: nothing is left of the processes above."""
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


def test_adaptation_that_exits_when_loaded_is_reported(tmp_path, monkeypatch):
    (tmp_path / "ends_it.py").write_text(
        "import os, sys\nprint('so long', file=sys.stderr, flush=True)\nos._exit(7)\n"
    )
    monkeypatch.syspath_prepend(str(tmp_path))
    with (
        Supervisor(Job("ends_it:build", "rig.toml")) as supervisor,
        pytest.raises(CannotTestError, match="exit status 7\n  so long"),
    ):
        supervisor.check(CLAUSE)


def test_unusable_rig_raises_wrong_job_error():
    with (
        Supervisor(Job("ideal", os.devnull)) as supervisor,
        pytest.raises(WrongJobError, match=r"/dev/null:1: the rig has no bus; add \[bus\.can0\]"),
    ):
        supervisor.check(CLAUSE)
