"""A stranger does what he likes; the drive never does what the standard forbids.

The reading of the standard is `standard`'s, the rules of motion are `watched`'s, what may be done
is `stranger`'s. That the runs get everywhere is counted: state by state, transition by transition.
"""

from collections import Counter

import pytest
from hypothesis import HealthCheck, event, settings
from hypothesis import strategies as st
from hypothesis.stateful import RuleBasedStateMachine, initialize, rule, run_state_machine_as_test

from harness.build_info import cores_are_compiled
from tests.emulators.cia402.power_drive_mutants import MUTANTS
from tests.emulators.cia402.standard import TABLE, State
from tests.emulators.cia402.stranger import DEEDS, MODES, STARTS, Stranger, walks
from tests.emulators.cia402.watched import Watched

WALKS = 120
ANY_DEED = st.one_of(
    [
        st.tuples(st.just(what), st.tuples(*(st.sampled_from(kind) for kind in kinds)))
        for what, kinds in DEEDS
    ]
)


class Machine(RuleBasedStateMachine):
    """Hypothesis as the stranger: what it finds it makes as short as it can be."""

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
    """Transitions and states, how often; and the names of what nobody has come to."""
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


def test_whatever_is_done_to_a_drive_it_does_nothing_that_the_standard_forbids():
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


def test_strangers_of_many_seeds_get_everywhere_and_see_nothing_forbidden(capsys):
    table, missing = coverage_table(walks(WALKS))
    with capsys.disabled():
        print("\n" + table)
    assert missing == [], table


@pytest.mark.skipif(cores_are_compiled(), reason="compiled cores cannot be broken on purpose")
@pytest.mark.parametrize("name", MUTANTS)
def test_a_drive_broken_on_purpose_is_found_out(name, monkeypatch):
    MUTANTS[name](monkeypatch)
    with pytest.raises(AssertionError):
        walks(4 * WALKS)  # it ends with the first that finds it
