"""Checks of clauses in this process: times, and the causes of errors."""

import gc
import os
from pathlib import Path

import pytest

from motorhil.harness.conformance.clause import Result
from motorhil.harness.conformance.kit import all_clauses
from motorhil.harness.conformance.run import run_clause
from motorhil.harness.rig.config.toml import BrokenPluginError, RigError
from motorhil.motorapi import ControlMode
from tests.conformance.mutants import MUTANTS
from tests.conformance.mutants.everyone import MODULES
from tests.support.kit_benches import claims, opener

assert MODULES


def test_check_with_afresh_ends_at_same_time_if_recorded(tmp_path):
    """Closing a record waits for a quiet line, in the time of a closed bench."""
    one = all_clauses()["HEAR-01"]
    recorded = opener("leadshine", record=tmp_path / "one.mcap")
    assert run_clause(one, opener("leadshine"), claims("leadshine")) == run_clause(
        one, recorded, claims("leadshine")
    )


def test_rig_error_ends_run_but_plugin_error_fails_clause():
    def raising(error):
        def open_bench():
            raise error("rig.toml", "is wrong", "mend it")

        return open_bench

    one = all_clauses()["STATE-01"]
    with pytest.raises(RigError, match="is wrong"):
        run_clause(one, raising(RigError))
    verdict = run_clause(one, raising(BrokenPluginError))
    assert (verdict.result, "is wrong" in verdict.seen) == (Result.CRASHED, True)


def test_violation_raised_by_a_helper_is_placed_in_its_clause():
    mutant = MUTANTS["absolute_taken_as_distance"]
    with mutant.plant():
        verdict = run_clause(all_clauses()["TRAJ-01"], opener(mutant.kind))
    assert verdict.result is Result.FAILED
    assert Path(verdict.place.rpartition(":")[0]).name == "trajectories.py"


def test_bench_is_only_opened_again_if_used():
    with opener("ideal")() as bench:
        new = bench.rig
        bench.afresh()
        assert bench.rig is new
        bench.motor.set_control_mode(ControlMode.SETPOINT)
        bench.afresh()
        assert bench.motor.control_mode is None
        used = bench.rig
        bench.afresh()
        assert bench.rig is not used
    with opener("ideal")() as bench:
        bench.runtime.run_for(0.1)
        bench.afresh()
        assert bench.runtime.now_ns() == 0


@pytest.fixture
def without_collections():
    gc.collect()
    gc.disable()
    yield
    gc.enable()


@pytest.mark.parametrize("name", [f"PROC-{number:02}" for number in range(1, 8)])
@pytest.mark.usefixtures("without_collections")
def test_clause_of_locks_closes_their_files(name):
    """A file that only garbage keeps open is waited for, 0.25 s for each clause."""
    open_files = set(os.listdir("/proc/self/fd"))
    with opener("ideal")() as bench:
        all_clauses()[name].check(bench)
    assert set(os.listdir("/proc/self/fd")) <= open_files
