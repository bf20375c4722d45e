"""Five processes compete for one lock while some are killed or paused.

MOTORHIL_SHARING=5 extends the 2 s of kills to the required 10 s. Planted defects test the
judgement.
"""

import os

import pytest

from motorhil.harness.sharing_tests.history import SharingViolated
from motorhil.harness.sharing_tests.processes import Plan, run

pytestmark = pytest.mark.wall

LONGER = int(os.environ.get("MOTORHIL_SHARING", "1"))
PATIENT_S = 5.0
"""A turn delayed by a busy machine [s]; far shorter than a lock that is never released."""
MUTANTS = "tests.support.sharing.mutants"
LEASES = {"lease_s": 0.02, "take_over": 0.02, "inside_s": 0.002, "commands": 5}


PORTIONS = (1, 3, 9)
"""Factors of the duration for repetitions on a busy machine that reached too few cases."""


def judged(enough=lambda outcome: True, *, seconds, **plan):
    for portion in PORTIONS:
        outcome = run(Plan(seconds=portion * seconds, **plan))
        print(outcome.table())
        outcome.require_sound()
        if enough(outcome):
            break
    return outcome


def until_found_out(**plan):
    """Run until SharingViolated is raised, or the repetitions are used up."""
    judged(lambda outcome: False, **plan)


def test_lock_with_kills_every_50_ms_stays_sound():
    outcome = judged(
        lambda outcome: outcome.reached()["killed"] >= 5 and outcome.reached()["take: done"] >= 100,
        seconds=2.0 * LONGER,
        kill_period_s=0.05,
    )
    assert outcome.counts["killed"] >= 5
    assert outcome.reached()["take: done"] >= 100
    assert outcome.worst_gap_s < PATIENT_S


def test_lock_survives_kills_of_its_holders():
    outcome = judged(
        lambda outcome: outcome.reached()["killed inside"] and outcome.taken_after_last_kill,
        seconds=1.0 * LONGER,
        workers=3,
        kill_period_s=0.1,
        kill_inside=True,
        facts={"inside_s": 0.02},
    )
    assert outcome.counts["killed inside"] == outcome.counts["killed"] >= 1
    assert outcome.taken_after_last_kill > 0
    assert outcome.worst_gap_s < PATIENT_S


def test_lock_survives_paused_workers():
    outcome = judged(
        lambda outcome: outcome.reached()["paused"] >= 5,
        seconds=1.0,
        pause_period_s=0.03,
        pause_s=0.01,
        kill_period_s=0.11,
    )
    assert outcome.counts["paused"] >= 5


def test_paused_owner_loses_its_lease_and_writes_nothing():
    def enough(outcome):
        reached = outcome.reached()
        return reached["take: done from a living owner"] >= 3 and reached["command: lost"] >= 1

    outcome = judged(
        enough,
        seconds=2.0 * LONGER,
        workers=4,
        pause_period_s=0.1,
        pause_s=0.05,
        pause_inside=True,
        kill_period_s=0.31,
        facts=LEASES,
    )
    reached = outcome.reached()
    assert reached["take: done from a living owner"] >= 3
    assert reached["command: lost"] >= 1, "no worker that lost the lock tried to write"
    assert outcome.counts["paused inside"] >= 1


# ---- planted defects


def test_judgement_detects_lock_without_fifo():
    with pytest.raises(SharingViolated, match="overtaken"):
        until_found_out(seconds=0.5, plant=f"{MUTANTS}:whoever_is_quickest")


def test_judgement_detects_lock_without_fencing():
    with pytest.raises(SharingViolated, match="no order of its"):
        until_found_out(
            seconds=2.0,
            workers=4,
            pause_period_s=0.1,
            pause_s=0.05,
            pause_inside=True,
            facts=LEASES,
            plant=f"{MUTANTS}:no_fence",
        )


def test_judgement_detects_lock_without_exclusion():
    with pytest.raises(SharingViolated):
        until_found_out(seconds=0.5, plant=f"{MUTANTS}:no_exclusion")


def test_judgement_detects_constant_token():
    with pytest.raises(SharingViolated, match="token did not grow"):
        until_found_out(seconds=0.5, plant=f"{MUTANTS}:no_token")


def test_judgement_detects_lock_held_by_the_dead():
    for portion in PORTIONS:  # on a busy machine, the time may be over before the first kill
        plan = {"seconds": 1.0 * portion, "kill_period_s": 0.6 * portion, "kill_inside": True}
        plan["facts"] = {"inside_s": 0.02}
        outcome = run(Plan(**plan, plant=f"{MUTANTS}:stays_after_death"))
        if outcome.counts.get("killed inside"):
            break
    assert outcome.counts["killed inside"] == 1
    assert outcome.taken_after_last_kill == 0
    assert judged(lambda outcome: outcome.taken_after_last_kill, **plan).taken_after_last_kill > 0


def test_failed_worker_is_reported():
    with pytest.raises(SharingViolated, match=r"worker 0: AttributeError: .*no_such_mutant"):
        judged(
            seconds=0.1, workers=1, plant="tests.unit.harness.sharing_tests.test_processes:fails"
        )


def fails(folder):
    raise AttributeError("no_such_mutant")
