"""The group of failures on top names the cause."""

import re

import pytest

from motorhil.emulators.cia402.drive import Cia402Drive
from motorhil.harness.conformance.claims import Claims
from motorhil.harness.conformance.clause import Diagnosis, Result, Verdict
from motorhil.harness.conformance.examination import Finding
from motorhil.harness.conformance.job import Job, Promise
from motorhil.harness.conformance.kit import all_clauses
from motorhil.harness.conformance.run import run_clause
from motorhil.harness.conformance.target import Target
from motorhil.harness.conformance.verdicts.causes import groups_of, summary_of
from motorhil.harness.conformance.verdicts.diagnosis import diagnose, name_of
from motorhil.motorapi import MotionInterrupted
from tests.conformance.mutants import MUTANTS, replaced
from tests.conformance.mutants.everyone import MODULES
from tests.conformance.verdicts.named_causes import NAMED_CAUSES
from tests.support.kit_benches import opener

assert MODULES
CLAUSES = all_clauses()
QUICK = (
    "degrees_for_radians",
    "encoder_of_2048_lines",
    "set_point_taken_as_distance",
    "sign_of_the_gear_forgotten",
    "velocity_in_rpm",
    "torque_of_the_motors_shaft",
    "following_error_turned_round",
    "duration_ignored",
)


def findings(kind, names):
    """Return the findings of these clauses, observed."""
    seen = opener(kind, is_observed=True)
    claims, home = Claims(opener(kind)), Target(Job(kind)).home
    return [
        finding(name, int(CLAUSES[name].level), run_clause(CLAUSES[name], seen, claims, home))
        for name in names
    ]


def finding(name, level, verdict):
    return Finding(Promise(name, level, f"It keeps {name}.", "a test"), verdict, 0.0)


def top_of(name, clauses):
    """Return the text of the top group of a mutant, without its promise."""
    with MUTANTS[name].plant():
        groups = groups_of(findings(MUTANTS[name].kind, clauses))
    return "\n".join(line for line in summary_of(groups[:1]) if "promise:" not in line)


BY_KILLER = (
    *("half_the_torque", "slows_down_as_it_speeds_up", "stale_done", "late_from_above"),
    *("times_in_microseconds", "heartbeat_not_watched", "low_level_access_closes"),
    *("dead_man_does_nothing", "last_state_for_ever", "set_points_wait_for_one_another"),
)
"""Mutants whose first killer names the cause; their other failures were not examined."""
OTHERS = {
    "distances_count_from_the_last_target": "in motion, ended at",
    "angles_within_a_turn": "reduced to a turn",
    "a_halt_of_another_is_told_to_nobody": "reported done",
    "told_to_be_held_by_oneself": "is held by",
    "a_velocity_of_0_is_taken_for_no_answer": "at rest",
    "who_has_lost_it_goes_on": "taken over",
    "once_off_always_off": "bus-off",
}
"""Mutants whose cause was told as a factor of values, or as an answer that every drive may give."""


@pytest.mark.parametrize("name", [*QUICK, *BY_KILLER])
def test_failure_of_mutant_names_its_cause(name):
    top = top_of(name, MUTANTS[name].killers[:1])
    assert re.search(NAMED_CAUSES[name], top), top


@pytest.mark.parametrize("name", OTHERS)
def test_cause_is_not_a_factor_of_unlike_values(name):
    cause, _, _ = top_of(name, MUTANTS[name].killers[:1]).partition("\n")
    assert OTHERS[name] in cause


@pytest.mark.nightly
@pytest.mark.parametrize("name", [one for one in NAMED_CAUSES if one not in BY_KILLER])
def test_top_group_of_mutant_names_its_cause(name):
    top = top_of(name, CLAUSES)
    assert re.search(NAMED_CAUSES[name], top), top


def test_bug_of_an_emulator_is_one_group():
    def broken(receive):
        def received(self, data, now_ns):
            receive(self, None, now_ns)  # so that the error arises in the emulator

        return received

    with replaced(Cia402Drive, "receive", broken):
        groups = groups_of(findings("cia402", ["UNIT-01", "STATE-01", "SET-01", "STOP-01"]))
    (group,) = groups
    assert group.cause.startswith("the emulator raises TypeError: ")
    assert len(group.findings) == 4


def failure(name, level, cause):
    return finding(name, level, Verdict(name, Result.FAILED, "seen", "", 0, "", cause))


def test_groups_are_ranked_by_level_then_by_size():
    many, few = Diagnosis("many", "m"), Diagnosis("few", "f")
    basic = Diagnosis("basic", "b")
    groups = groups_of(
        [
            failure("A-01", 0, basic),
            failure("B-01", 1, few),
            failure("C-01", 1, many),
            failure("C-02", 2, many),
        ]
    )
    assert [(one.cause, one.first.promise.id, one.others) for one in groups] == [
        ("basic", "A-01", ()),
        ("many", "C-01", ("C-02",)),
        ("few", "B-01", ()),
    ]


def test_summary_tells_first_clause_in_full_and_others_by_id():
    cause = Diagnosis("cause", "key", ("position of left at 1.000 s: told 2 rad",))
    text = "\n".join(
        summary_of(groups_of([failure(name, 0, cause) for name in ("A-01", "A-02", "A-03")]))
    )
    assert text.startswith("1. cause (3 clauses)\n   A-01 failed\n     promise: It keeps A-01.")
    assert "position of left at 1.000 s: told 2 rad" in text
    assert text.endswith("also: A-02, A-03")


@pytest.mark.parametrize(
    ("factor", "words"),
    [
        (57.29578, "degrees for radians"),
        (-1.0, "sign reversed"),
        (-57.29578, "sign reversed, degrees for radians"),
        (9.5493, "revolutions per minute for rad/s"),
        (66.0, "the gear ratio: motor side for output side"),
        (1.0, ""),
        (1.3, ""),
    ],
)
def test_factor_has_the_name_of_its_mistake(factor, words):
    assert name_of(factor, 66.0) == words


@pytest.mark.parametrize(("clause", "is_doubted"), [("HOME-01", True), ("OTHER-01", False)])
def test_interruption_by_nothing_is_doubted(clause, is_doubted):
    error = MotionInterrupted(motor="left", by="another program", at_ns=0)
    cause = diagnose(CLAUSES[clause], error, f"raised {error}", "", None).cause
    assert ("nothing on this bench ended the motion" in cause) is is_doubted
