"""Shrinking of failing worlds."""

import pytest

from motorhil.harness.swarm.row import Result, Row
from motorhil.harness.swarm.worlds.disturbance import Disturbance
from motorhil.harness.swarm.worlds.shrinking import is_alike, shrunk

LOST = Disturbance("drop", "can0", (("sender", "left"), ("skip", 37), ("limit", 5)))
CUT = Disturbance("cut", "can0", (("node", "left"), ("at_s", 1.2345), ("for_s", 0.8)))
HEAT = Disturbance("heat", "right", (("value", 61.25), ("at_s", 0.5), ("for_s", 0.1)))
SIGNATURE = "assert | assert at app.py:3 | - | 4m | drop 580h"


def failure(world, signature=SIGNATURE):
    return Row(1, Result.FAILED, "assert", signature, "it is wrong", 5, world=world)


def program(fails):
    """Return a runner of worlds that fail if `fails(world)`, and its list of worlds."""
    ran = []

    def run(world):
        ran.append(world)
        return failure(world) if fails(world) else Row(1, Result.PASSED)

    return run, ran


def kinds(world):
    return {one.kind for one in world}


def test_what_does_not_matter_is_removed():
    run, _ = program(lambda world: "cut" in kinds(world))
    assert kinds(shrunk(failure((LOST, CUT, HEAT)), run).world) == {"cut"}


def test_a_pair_that_is_needed_stays():
    run, _ = program(lambda world: {"cut", "drop"} <= kinds(world))
    assert kinds(shrunk(failure((LOST, CUT, HEAT)), run).world) == {"cut", "drop"}


def test_numbers_become_as_small_as_the_failure_allows():
    def fails(world):
        (one,) = world
        return one.number("skip") >= 9 and one.number("limit") >= 2

    found = shrunk(failure((LOST,)), program(fails)[0]).world
    assert found == (Disturbance("drop", "can0", (("sender", "left"), ("skip", 9), ("limit", 2))),)


def test_times_become_round_and_short():
    def fails(world):
        (one,) = world
        return 1.0 <= one.number("at_s") <= 1.3 and one.number("for_s") > 0.05

    (found,) = shrunk(failure((CUT,)), program(fails)[0]).world
    assert found.number("at_s") == 1.0
    assert found.number("for_s") == 0.1


def test_another_failure_is_not_taken_for_this_one():
    other = "exception | KeyError at app.py:9 | - | 4 | drop 580h"

    def run(world):
        return failure(world, SIGNATURE if "drop" in kinds(world) else other)

    assert "drop" in kinds(shrunk(failure((LOST, CUT)), run).world)
    assert not is_alike(failure(()), failure((), other))


def test_state_and_last_fault_may_differ():
    assert is_alike(failure(()), failure((), "assert | assert at app.py:3 | - | 7 | cut: begins"))


@pytest.mark.parametrize("fails", [True, False])
def test_the_number_of_runs_is_bounded(fails):
    run, ran = program(lambda world: fails)
    shrunk(failure((LOST, CUT, HEAT)), run, tries_max=2)
    assert len(ran) == 2


def test_a_world_that_never_fails_again_stays_as_it_was():
    run, ran = program(lambda world: False)
    assert shrunk(failure((LOST, CUT)), run).world == (LOST, CUT)
    assert len(ran) == len(set(ran))
