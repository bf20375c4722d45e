"""Lanes: worlds that depend on the lower seeds of their lane, and on nothing else."""

from motorhil.harness.rig.config.worlds import UNDECLARED
from motorhil.harness.swarm.lanes import LANES, Lane, lane_of
from motorhil.harness.swarm.row import CANARY, Result, Row
from tests.unit.harness.swarm.test_disturbances import PROFILE

_SEEDS = range(3, 3 + 40 * LANES, LANES)


def run(lane, seeds, guided=True):
    """Return the worlds of a lane whose every third world meets something new."""
    worlds = []
    for seed in seeds:
        world = lane.world(seed, PROFILE, UNDECLARED, guided)
        worlds.append(world)
        new = (f"pair {seed}",) if seed % 3 == 0 else ()
        lane.learn(Row(seed, Result.PASSED, new=new, world=world if new else ()))
    return worlds


def test_a_lane_gives_the_same_worlds_however_it_is_divided():
    whole = run(Lane(), _SEEDS)
    first = Lane()
    parts = run(first, _SEEDS[:17])
    resumed = Lane(first.seen, first.corpus)
    assert parts + run(resumed, _SEEDS[17:]) == whole


def test_guided_worlds_are_like_earlier_ones():
    lane = Lane()
    earlier = run(lane, _SEEDS)
    known = {one for world in earlier for one in world}
    later = range(_SEEDS.stop, _SEEDS.stop + 40 * LANES, LANES)
    guided = [seed for seed in later if (seed // LANES) % 2]
    shares = [sum(one in known for one in lane.world(seed, PROFILE, UNDECLARED)) for seed in guided]
    assert sum(map(bool, shares)) > len(guided) / 2


def test_without_guidance_a_world_depends_on_its_seed_alone():
    assert run(Lane(), _SEEDS, guided=False) == [
        Lane().world(seed, PROFILE, UNDECLARED, False) for seed in _SEEDS
    ]


def test_a_pair_counts_once():
    lane = Lane(["pair 3"])
    lane.learn(Row(3, Result.PASSED, new=("pair 3",), world=run(Lane(), [3])[0]))
    assert lane.corpus == []


def test_the_canary_teaches_nothing():
    lane = Lane()
    lane.learn(Row(CANARY, Result.FAILED, new=("a pair",), world=run(Lane(), [3])[0]))
    assert (dict(lane.seen), lane.corpus) == ({}, [])
    assert lane_of(CANARY) == 0


def test_parents_are_rather_worlds_that_reached_a_condition():
    lane = Lane()
    plain, rare = (run(Lane(), [seed])[0] for seed in (3, 19))
    for number, world in enumerate((*[plain] * 5, rare, *[plain] * 4)):
        met = (("a retry", int(world == rare)), ("a stop", 0))
        row = Row(3 + number * LANES, Result.PASSED, new=(f"pair {number}",), met=met, world=world)
        lane.learn(row)
    shares = {
        world: sum(
            any(one in world for one in lane.world(seed, PROFILE, UNDECLARED))
            for seed in range(3 + LANES, 3 + 400 * LANES, 4 * LANES)
        )
        for world in (plain, rare)
    }
    assert shares[rare] * 9 > 2 * shares[plain] > 0
