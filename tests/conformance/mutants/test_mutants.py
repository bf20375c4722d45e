"""Every mutant in `tests.conformance.mutants` is killed by its clauses."""

import pytest

from motorhil.harness.conformance.kit import all_clauses
from motorhil.harness.conformance.run import run_clause
from tests.conformance.mutants import MUTANTS
from tests.conformance.mutants.by_rule.benches import is_of_drive
from tests.conformance.mutants.by_rule.classified import known
from tests.conformance.mutants.everyone import MODULES
from tests.conformance.mutants.stays import WHY_IT_STAYS
from tests.support.kit_benches import opener

assert MODULES


@pytest.mark.parametrize(
    ("name", "clause"),
    [(one.name, clause) for one in MUTANTS.values() for clause in one.killers],
)
def test_mutant_is_killed_by_its_clause(name, clause):
    mutant = MUTANTS[name]
    with mutant.plant():
        verdict = run_clause(all_clauses()[clause], opener(mutant.kind))
    assert not verdict.result.is_good, f"{clause} let through: {mutant.mistake}"


def test_every_clause_has_a_mutant_or_a_reason():
    by_hand = {clause for one in MUTANTS.values() for clause in one.killers}
    by_rule = {one.clause for one in known() if not is_of_drive(one.bench)}
    assert set(all_clauses()) == by_hand | by_rule | set(WHY_IT_STAYS)
