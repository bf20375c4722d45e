"""A clause is checked in this process: when it was over, and whose mistake an error is."""

import pytest

from harness.conformance.kit import all_clauses
from harness.conformance.run import Result, run_clause
from harness.settings import BrokenPluginError, RigError
from tests.conformance.benches import claims, opener


def test_a_check_that_begins_afresh_ends_at_one_time_recorded_or_not(tmp_path):
    """To close a record takes until the line is quiet: time of a bench that is no more."""
    one = all_clauses()["HEAR-01"]
    recorded = opener("leadshine", record=tmp_path / "one.mcap")
    assert run_clause(one, opener("leadshine"), claims("leadshine")) == run_clause(
        one, recorded, claims("leadshine")
    )


def test_a_rig_that_cannot_be_used_ends_the_run_and_a_plugin_that_breaks_its_clause_alone():
    def raising(error):
        def open_bench():
            raise error("rig.toml", "is wrong", "mend it")

        return open_bench

    one = all_clauses()["STATE-01"]
    with pytest.raises(RigError, match="is wrong"):
        run_clause(one, raising(RigError))
    verdict = run_clause(one, raising(BrokenPluginError))
    assert (verdict.result, "is wrong" in verdict.seen) == (Result.CRASHED, True)
