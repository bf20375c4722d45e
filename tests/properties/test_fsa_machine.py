"""Random actions on a drive: it never does what the standard forbids.

`standard` has the reading of the standard, `watched` the rules of motion, `stranger` the possible
actions. The runs' coverage is counted: state by state, transition by transition.
"""

from collections import Counter

import pytest
from hypothesis import HealthCheck, event, settings
from hypothesis import strategies as st
from hypothesis.stateful import RuleBasedStateMachine, initialize, rule, run_state_machine_as_test

from tests.support.cia402.mutants import MUTANTS
from tests.support.cia402.standard import TABLE, State
from tests.support.cia402.stranger import DEEDS, MODES, STARTS, Stranger, walks
from tests.support.cia402.watched import Watched

WALKS = 120
ANY_DEED = st.one_of(
    [
        st.tuples(st.just(what), st.tuples(*(st.sampled_from(kind) for kind in kinds)))
        for what, kinds in DEEDS
    ]
)


class Machine(RuleBasedStateMachine):
    """Hypothesis chooses the actions, and shortens each failure as far as possible."""

    @initialize(start=st.sampled_from(STARTS), limited=st.booleans(), mode=st.sampled_from(MODES))
    def switch_on(self, start, limited, mode):
        self.stranger = Stranger(start, limited, mode)

    @rule(deed=ANY_DEED)
    def does(self, deed):
        self.stranger.does(deed)

    def teardown(self):
        if hasattr(self, "stranger"):
            for state in self.stranger.drive.visited:
                event(state.name)
            machine_seen.append(self.stranger.drive)


machine_seen: list[Watched] = []


def coverage_table(runs: list[Watched]) -> tuple[str, list[str]]:
    """Return a table of transitions and states with counts, and the names never reached."""
    taken: Counter[int] = sum((run.taken for run in runs), Counter())
    visits = Counter(state for run in runs for state in run.visited)
    rows = [f"{len(runs)} runs; transition, how often"]
    for number, (starts, end, _) in TABLE.items():
        start = starts[0].name if len(starts) == 1 else "any"
        rows.append(f"{number:>4}  {start + ' -> ' + end.name:<46}{taken[number]:>6}")
    rows.append("state, share of the runs")
    rows.extend(f"      {state.name:<46}{visits[state] / len(runs):>6.0%}" for state in State)
    missing = [str(number) for number in TABLE if not taken[number]]
    return "\n".join(rows), missing + [state.name for state in State if not visits[state]]


def test_random_actions_never_cause_what_is_forbidden():
    machine_seen.clear()
    run_state_machine_as_test(
        Machine,
        settings=settings(
            derandomize=True,
            deadline=None,
            max_examples=25,
            stateful_step_count=30,
            suppress_health_check=list(HealthCheck),
        ),
    )
    assert sum(len(run.visited) > 4 for run in machine_seen) > len(machine_seen) / 3


def test_seeded_walks_reach_every_state_and_transition(capsys):
    table, missing = coverage_table(walks(WALKS))
    with capsys.disabled():
        print("\n" + table)
    assert missing == [], table


@pytest.mark.pure("compiled cores cannot be broken on purpose")
@pytest.mark.parametrize("name", MUTANTS)
def test_drive_with_a_deliberate_defect_is_detected(name, monkeypatch):
    MUTANTS[name](monkeypatch)
    with pytest.raises(AssertionError):
        walks(4 * WALKS)  # the first walk that finds the defect ends it
