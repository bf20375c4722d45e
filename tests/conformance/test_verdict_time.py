"""When a check was over is told by the bench that was on then: a repetition tells the same."""

from harness.conformance.kit import all_clauses
from harness.conformance.run import run_clause
from tests.conformance.benches import claims, opener


def test_a_check_that_begins_afresh_ends_at_one_time_recorded_or_not(tmp_path):
    """To close a record takes until the line is quiet: time of a bench that is no more."""
    one = all_clauses()["HEAR-01"]
    recorded = opener("leadshine", record=tmp_path / "one.mcap")
    assert run_clause(one, opener("leadshine"), claims("leadshine")) == run_clause(
        one, recorded, claims("leadshine")
    )
