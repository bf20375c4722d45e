"""Summary and coverage of a campaign, and their lines for a terminal."""

from dataclasses import replace
from pathlib import Path

import pytest

from motorhil.harness.rig.config.worlds import UNDECLARED, SwarmTable
from motorhil.harness.swarm.kept import keep
from motorhil.harness.swarm.report.coverage import coverage_of
from motorhil.harness.swarm.report.progress import Progress
from motorhil.harness.swarm.report.texts import as_table, lines_of, progress_line, span
from motorhil.harness.swarm.row import CANARY, Result, Row, row_from
from motorhil.harness.swarm.summary import Strikes, summary_of
from motorhil.harness.swarm.worlds.drawing import possible
from tests.support.swarm.campaigns import FOUND, PLAN, PROFILE, failure


def passed(seed, **more):
    return Row(seed, Result.PASSED, **more)


def lines(rows, kept=(), progress=None):
    summary = summary_of(rows)
    return list(lines_of(summary, kept, PLAN, coverage_of(PLAN, summary), progress or Progress()))


def test_causes_are_ranked_by_number_of_worlds():
    few = [failure(seed, "limit-position", "rule") for seed in (1, 2)]
    many = [failure(seed) for seed in (9, 5, 7)]
    summary = summary_of([*few, *many])
    assert [(one.name.split(" ")[0], len(one.rows), one.lowest) for one in summary.causes] == [
        ("always", 3, 5),
        ("limit-position", 2, 1),
    ]


def test_representative_is_earliest_then_smallest_then_lowest():
    rows = [failure(seed) for seed in (4, 3)]
    rows += [replace(failure(2), world=()), replace(failure(9), at_ns=5)]
    (cause,) = summary_of(rows).causes
    assert [row.seed for row in cause.rows] == [9, 2, 3, 4]


def test_strikes_are_counted_by_world_and_event():
    rows = [
        passed(0, acts=(("drop", 3), ("cut", 0))),
        passed(1, acts=(("drop", 0),)),
        passed(2, acts=(("drop", 2),)),
        replace(FOUND, acts=(("drop", 100),)),
    ]
    assert summary_of(rows).strikes == {"drop": Strikes(3, 2, 5), "cut": Strikes(1, 0, 0)}


def test_acts_of_a_row_survive_its_line():
    row = passed(0, acts=(("drop", 3), ("cut", 0)))
    assert row_from(row.as_line()) == row


def test_growth_counts_worlds_and_pairs_in_order_of_seeds():
    rows = [
        FOUND,
        passed(5, new=("4 after x | a", "1 after x | b")),
        passed(2),
        passed(7, new=("4 after x | a",)),
        passed(9, new=("1m/6 after x | c",)),
    ]
    summary = summary_of(rows)
    assert (summary.growth, summary.pairs) == (((2, 2), (4, 3)), 3)
    assert summary.states == ("1", "1m", "4", "6")


def test_canary_counts_as_found_only_by_its_own_property():
    assert summary_of([]).found_canary
    assert summary_of([FOUND]).found_canary
    for canary in (replace(FOUND, text="limit-velocity"), passed(CANARY)):
        assert not summary_of([canary]).found_canary
    assert summary_of([FOUND]).worlds == summary_of([FOUND]).failures == 0


def test_coverage_tells_what_no_world_reached():
    rows = [
        passed(
            0, met=(("a", 2), ("b", 0)), acts=(("drop", 0), ("cut", 1)), new=("4m/7 after x | y",)
        ),
        passed(1, met=(("a", 1),)),
    ]
    found = coverage_of(PLAN, summary_of(rows))
    assert (found.met, found.unmet) == ({"a": 2}, ("b",))
    assert found.unstruck == ("drop",)
    assert {"delay", "noise", "clock"} <= set(found.undrawn)
    assert {"supply", "lose", "truncate", "quirk", "interleaving"} <= set(found.impossible)
    assert not set(found.undrawn) & {"drop", "cut", *found.impossible}
    assert found.states == ("operation enabled", "fault")
    assert len(found.unmet_states) == 6


def test_coverage_without_numbered_states_has_no_unmet_ones():
    found = coverage_of(PLAN, summary_of([passed(0, new=("- after x | y",))]))
    assert (found.states, found.unmet_states) == ((), ())


def test_possible_kinds_follow_the_profile_and_the_weights():
    assert "load" in possible(PROFILE, UNDECLARED)
    assert "load" not in possible(PROFILE, SwarmTable(weights={"load": 0.0}))
    assert "corrupt" not in possible(PROFILE, UNDECLARED)
    assert "corrupt" not in possible(
        replace(PROFILE, traffic=()), SwarmTable(weights={"corrupt": 1})
    )
    assert "corrupt" in possible(PROFILE, SwarmTable(weights={"corrupt": 1.0}))


def test_lines_name_results_causes_commands_and_tests(tmp_path):
    kept = keep(failure(3), PLAN, tmp_path)
    progress = Progress(10, 0.0, 4.0, 4.0, True, (), dict.fromkeys(range(6), 1.0))
    rows = [FOUND, passed(0, ended_by="LinkError"), failure(3), failure(5)]
    head, cause, story, again, test, *rest = lines(rows, [kept], progress)
    assert head == "3 worlds: 1 pass, 2 fail; 1 cause; 0 pairs of state and event; 1.5 worlds/s"
    assert cause.startswith("1. always | PropertyViolated: left arrives")
    assert cause.endswith(": 2 worlds, first seed 3")
    assert story.startswith("   World 3: the second frame 581h of left is lost; at 1.052100 s ")
    assert again.startswith("   again: motorhil swarm rig.toml errand:run --seed 3 --world ")
    assert test == f"   test:  {kept.test}"
    assert rest[-1] == "ended by allowed errors: LinkError 1"


def test_lines_list_at_most_twenty_causes():
    rows = [failure(seed, f"oracle {seed}") for seed in range(23)]
    shown = lines(rows)
    assert sum(" worlds, first" in line or " world, first" in line for line in shown) == 20
    assert "and 3 more causes; see the page, or --json" in shown
    summary = summary_of(rows)
    table = as_table(summary, (), PLAN, coverage_of(PLAN, summary), Progress())
    assert len(table["causes"]) == 23


def test_lines_tell_that_nothing_can_be_disturbed():
    still = replace(PLAN, profile=replace(PROFILE, traffic=(), subjects=()))
    text = "no disturbance is possible on this rig, or its [swarm] switches all off"
    for plan, expected in ((still, 1), (PLAN, 0)):
        summary = summary_of([passed(0)])
        shown = lines_of(summary, (), plan, coverage_of(plan, summary), Progress())
        assert list(shown).count(text) == expected


def test_lines_cannot_control_a_terminal():
    rows = [failure(1, text="a\x1b[2J"), passed(2, met=(("b\x1b[2J", 0),), ended_by="c\x1b[2J")]
    shown = lines(rows)
    assert all(line.isprintable() for line in shown), shown
    assert any("never true: b" in line for line in shown)


@pytest.mark.parametrize(
    ("time_s", "expected"), [(99.4, "99 s"), (100, "2 min"), (5999, "100 min"), (6000, "1.7 h")]
)
def test_span_has_a_fitting_unit(time_s, expected):
    assert span(time_s) == expected


def test_progress_line_tells_rate_failures_and_time_left():
    line = progress_line("2 failures of 1 cause", 50, 100, 12.5)
    assert line == "50 of 100 worlds, 12.5/s, 4 s left; 2 failures of 1 cause"
    assert progress_line("", 0, 100, 0.0) == "0 of 100 worlds, 0.0/s"


def test_json_has_all_that_the_page_has(tmp_path):
    kept = keep(failure(3), PLAN, tmp_path)
    summary = summary_of(
        [FOUND, failure(3), passed(4, met=(("a", 0),), acts=(("cut", 0),), new=("7 after x | y",))]
    )
    table = as_table(summary, [kept], PLAN, coverage_of(PLAN, summary), Progress())
    assert table["results"] == {"pass": 1, "fail": 1, "timeout": 0, "killed": 0, "cancelled": 0}
    assert (table["growth"], table["states"]) == ([[2, 1]], ["fault"])
    assert table["disturbances"]["cut"] == {"worlds": 1, "struck": 0, "times": 0}
    assert (table["never"]["true"], table["never"]["struck"]) == (["a"], ["cut"])
    (one,) = table["kept"]
    assert (one["seed"], one["record"], Path(one["test"])) == (3, None, kept.test)
    assert one["cause"] == table["causes"][0]["cause"]
