from random import Random

import pytest

from motorhil.harness.rig.config.worlds import SwarmTable
from motorhil.harness.swarm.lanes import LANES, Lane
from motorhil.harness.swarm.row import Result, Row
from motorhil.harness.swarm.worlds.disturbance import Disturbance, fragment, kinds_in
from motorhil.harness.swarm.worlds.drawing import drawn, mutated
from motorhil.harness.swarm.worlds.profile import Profile, Subject, Traffic

MARK_S = 2.0
PROFILE = Profile(
    end_ns=10_000_000_000,
    lines=(),
    traffic=(
        Traffic("can0", "host", 0x201, 1, ((0, MARK_S),)),
        Traffic("can0", "left", 0x181, 1000),
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
        world = mutated((FAULT,), Random(seed), PROFILE, SwarmTable())
        faults = [one for one in world if one.kind == "fault" and one.on == "left"]
        found += any(0.0 < one.number("at_s") - 5.0 <= 0.5 for one in faults[1:])
    assert found > 40


def test_lane_mutates_in_every_second_round_only():
    lane = Lane()
    lane.learn(Row(0, Result.PASSED, new=("a pair",), world=(FAULT,)))
    table = SwarmTable()
    assert lane.world(2 * LANES, PROFILE, table) == drawn(Random("world 32"), PROFILE, table)
    fresh = drawn(Random("world 16"), PROFILE, table)
    assert lane.world(LANES, PROFILE, table, guided=False) == fresh
    assert lane.world(LANES, PROFILE, table) != fresh
