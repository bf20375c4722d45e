"""Five processes fight for one lock while some are killed or paused; and the judge is judged."""

import json
import subprocess
import sys
from dataclasses import asdict

import pytest

from tests.wall.lock_stress import Plan, Verdict

pytestmark = pytest.mark.wall

PATIENT_S = 5.0
"""A turn of somebody that a busy machine delays; far below what a lock that is not let go takes."""


def stress(**plan):
    done = subprocess.run(
        [sys.executable, "-m", "tests.wall.lock_stress", json.dumps(asdict(Plan(**plan)))],
        capture_output=True,
        text=True,
        timeout=60,
        check=False,
    )
    assert done.stderr == "", done.stderr
    return Verdict(**json.loads(done.stdout))


def is_sound(verdict):
    return not (verdict.intruders or verdict.overtaken or verdict.tokens_repeated)


def test_with_a_kill_every_50_ms_nobody_intrudes_or_is_overtaken_and_it_goes_on():
    verdict = stress(seconds=2.0, kill_period_s=0.05)
    assert is_sound(verdict), verdict
    assert verdict.killed >= 5
    assert verdict.turns >= 100
    assert verdict.longest_gap_s < PATIENT_S, verdict


def test_holders_are_killed_too():
    verdict = stress(seconds=1.0, workers=3, kill_period_s=0.1, kill_inside=True, inside_us=20_000)
    assert is_sound(verdict), verdict
    assert verdict.killed_inside == verdict.killed >= 1
    assert verdict.longest_gap_s < PATIENT_S, verdict


def test_those_who_are_paused_and_go_on_find_it_as_it_should_be():
    verdict = stress(seconds=1.0, pause_period_s=0.03, pause_s=0.01, kill_period_s=0.11)
    assert is_sound(verdict), verdict
    assert verdict.paused >= 5


def test_a_lock_that_lets_the_quickest_in_is_found_out():
    verdict = stress(seconds=0.5, plant="no order")
    assert verdict.overtaken > 0
    assert verdict.intruders == 0


def test_a_lock_that_is_none_is_found_out():
    assert stress(seconds=0.5, plant="no exclusion").intruders > 0


def test_a_token_that_does_not_grow_is_found_out():
    assert stress(seconds=0.5, plant="no token").tokens_repeated > 0


def test_a_lock_that_survives_its_holder_is_found_out():
    plan = {"seconds": 1.0, "kill_period_s": 0.6, "kill_inside": True, "inside_us": 20_000}
    verdict = stress(**plan, plant="stays after death")
    assert verdict.killed_inside == 1
    assert verdict.turns_after_last_kill == 0, verdict
    assert stress(**plan).turns_after_last_kill > 0
