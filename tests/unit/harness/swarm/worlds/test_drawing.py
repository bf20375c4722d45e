from dataclasses import replace
from random import Random

import pytest

from motorhil.harness.rig.config.worlds import SwarmTable
from motorhil.harness.swarm.lanes import LANES, Lane
from motorhil.harness.swarm.row import Result, Row
from motorhil.harness.swarm.worlds.disturbance import Disturbance, fragment, kinds_in
from motorhil.harness.swarm.worlds.drawing import Parent, drawn, mutated
from motorhil.harness.swarm.worlds.marks import Traffic
from motorhil.harness.swarm.worlds.profile import Profile, Subject

MARK_S = 2.0
PROFILE = Profile(
    end_ns=10_000_000_000,
    lines=(),
    traffic=(
        Traffic("can0", "host", 0x201, 1, ((0, MARK_S),)),
        Traffic("can0", "left", 0x181, 1000, answers=True),
    ),
    subjects=tuple(
        Subject(
            name, "can0", ("fault", "load_torque_n_m"), ("stray",), True, (("k", 1.0),), 5.0, 24.0
        )
        for name in ("left", "right")
    ),
    parties=True,
)
FAULT = Disturbance("fault", "left", (("code", 0x2310), ("at_s", 5.0)))


@pytest.mark.parametrize("seed", range(50))
def test_kinds_of_a_fragment_are_those_of_its_world(seed):
    world = drawn(Random(seed), PROFILE, SwarmTable())
    kinds = {one.kind for one in world} - {"interleaving"}
    found = kinds_in(fragment(world))
    assert kinds <= found
    assert found - kinds <= {"load", "stall"}  # they change the same input


def test_half_of_all_times_lie_around_a_mark():
    worlds = [drawn(Random(seed), PROFILE, SwarmTable(disturbances=1)) for seed in range(400)]
    times = [one.number("at_s") for world in worlds for one in world if one.get("at_s") is not None]
    near = sum(abs(at_s - MARK_S) <= 0.5 for at_s in times)
    assert 0.4 < near / len(times) < 0.75  # 0.5 + 0.5 * 1 s / 10 s, if drawn evenly


def test_mutation_adds_a_second_fault_soon_after_the_first():
    found = 0
    for seed in range(400):
        world = mutated(Parent((FAULT,)), Random(seed), PROFILE, SwarmTable())
        faults = [one for one in world if one.kind == "fault" and one.on == "left"]
        found += any(0.0 < one.number("at_s") - 5.0 <= 0.5 for one in faults[1:])
    assert found > 40


def test_mutation_strikes_reactions_of_its_parent():
    """Frames that no undisturbed run has: their numbers are unknown, so their time counts."""
    halt, error = (Traffic("can0", sender, 0x80, 3, ((2, 6.5),)) for sender in ("host", "left"))
    found = {"host": 0, "left": 0}
    for seed in range(400):
        world = mutated(Parent((FAULT,), (halt, error)), Random(seed), PROFILE, SwarmTable())
        for one in world:
            if one.get("identifier") == 0x80:
                assert one.get("skip") is None
                found[one.get("sender")] += one.number("from_s") == 6.4998
    assert min(found.values()) > 20


def test_reactions_count_after_the_disturbance_only():
    early = Traffic("can0", "host", 0x80, 3, ((2, 4.9),))
    worlds = [
        mutated(Parent((FAULT,), (early,)), Random(seed), PROFILE, SwarmTable())
        for seed in range(200)
    ]
    pairs = [world for world in worlds if len(world) == 2]
    assert len(pairs) > 40
    assert not [one for world in pairs for one in world if one.get("identifier") == 0x80]


def test_answer_may_come_later_than_a_command_or_a_status():
    table = SwarmTable(disturbances=1, delay_s=0.2, answer_delay_s=1.0)
    asked_for = Traffic("can0", "right", 0x582, 2, ((0, MARK_S), (1, MARK_S)), answers=True)
    profile = replace(PROFILE, traffic=(*PROFILE.traffic, asked_for))
    late = {"host": [], "left": [], "right": []}
    for seed in range(3000):
        for one in drawn(Random(seed), profile, table):
            if one.kind == "delay":
                late[one.get("sender")].append(one.number("delay_s"))
    assert max(late["host"] + late["left"]) <= 0.2
    assert sum(0.2 < delay_s <= 1.0 for delay_s in late["right"]) > len(late["right"]) / 3


def test_time_moves_by_steps_that_do_not_grow_with_it():
    late = replace(FAULT, values=(("code", 0x2310), ("at_s", 5000.0)))
    table = SwarmTable(weights={"fault": 0.0})
    moved = [
        one.number("at_s")
        for seed in range(400)
        for one in mutated(Parent((late,)), Random(seed), PROFILE, table)
        if one.get("code") == 0x2310 and one.number("at_s") != 5000.0
    ]
    assert len(moved) > 40
    assert max(abs(at_s - 5000.0) for at_s in moved) <= 1.0 + 1e-9  # twice 0.5 s
    assert min(abs(at_s - 5000.0) for at_s in moved) < 0.01


def test_lane_draws_anew_in_every_fourth_round_only():
    lane = Lane()
    lane.learn(Row(0, Result.PASSED, new=("a pair",), world=(FAULT,)))
    table = SwarmTable()
    assert lane.world(4 * LANES, PROFILE, table) == drawn(Random("world 64"), PROFILE, table)
    fresh = drawn(Random("world 16"), PROFILE, table)
    assert lane.world(LANES, PROFILE, table, guided=False) == fresh
    assert lane.world(LANES, PROFILE, table) != fresh
