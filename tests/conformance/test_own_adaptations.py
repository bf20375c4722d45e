"""Our own adaptations keep every promise that they claim to keep."""

import pytest

from harness.conformance.kit import all_clauses
from harness.conformance.run import Result, run_clause
from tests.conformance.benches import KINDS, claims, opener

CLAUSES = all_clauses()


@pytest.mark.parametrize("clause", CLAUSES)
@pytest.mark.parametrize("kind", KINDS)
def test_an_adaptation_of_ours_keeps_its_promise(kind, clause):
    verdict = run_clause(CLAUSES[clause], opener(kind), claims(kind))
    if verdict.result is Result.NOT_APPLICABLE:
        return  # which of them are, is held by the test below
    assert verdict.result is Result.PASSED, f"{verdict.seen} ({verdict.place})"
