"""The conformance kit on a real SocketCAN interface."""

from motorhil.harness.conformance.clause import Result
from motorhil.harness.conformance.job import Job
from motorhil.harness.conformance.kit import all_clauses
from motorhil.harness.conformance.run import run_clause
from motorhil.harness.conformance.target import Target
from motorhil.motorapi.locking.directory import VARIABLE
from motorhil.traces.mcap.reader import read_trace
from tests.system.vcan.inside.on_fencing import serving_on


def test_clause_is_checked_and_its_bus_traffic_recorded(tmp_path, monkeypatch):
    monkeypatch.setenv(VARIABLE, str(tmp_path))
    tmp_path.chmod(0o700)
    target = Target(Job("cia402", on=("can0=vcan0",)))
    with serving_on("vcan0"):
        verdict = run_clause(all_clauses()["STATE-01"], target.opener(tmp_path / "run.mcap"))
    assert verdict.result is Result.PASSED, verdict
    with read_trace(tmp_path / "run.mcap") as trace:
        assert {channel.topic for channel, _, _ in trace.messages()} == {"/can/can0"}
