"""Disturbances as values and as TOML."""

import tomllib
from dataclasses import replace
from random import Random

import pytest

from motorhil.harness.rig.config.rig_file import parse_rig
from motorhil.harness.rig.config.scaffold import EXAMPLES
from motorhil.harness.rig.config.toml import Source
from motorhil.harness.rig.config.worlds import UNDECLARED, WEIGHTS
from motorhil.harness.rig.reading import installed_plugins
from motorhil.harness.rig.rig import Rig
from motorhil.harness.swarm.worlds.disturbance import Disturbance, fragment, from_table
from motorhil.harness.swarm.worlds.drawing import Parent, drawn, mutated
from motorhil.harness.swarm.worlds.profile import Profile, Traffic, subjects_of

RIG = EXAMPLES / "two_wheels.toml"
OWN = parse_rig(Source(RIG, RIG.read_text()), installed_plugins())
PROFILE = Profile(
    3_000_000_000,
    (),
    (
        Traffic("can0", "host", 0x601, 90),
        Traffic("can0", "left", 0x581, 90),
        Traffic("can0", "right", 0x182, 150),
    ),
    subjects_of(OWN),
    True,
)
_ON_LINES = {"lose", "truncate"}
_WITH_SOURCE_RESISTANCE = {"supply"}
_WITH_PROGRAMS = {"kill"}


def worlds(count):
    """Return worlds of the rig with two wheels, and one mutation of each."""
    for seed in range(count):
        world = drawn(Random(seed), PROFILE, UNDECLARED)
        yield world
        yield mutated(Parent(world), Random(-seed), PROFILE, UNDECLARED)


def test_a_lost_answer_is_a_fault_of_the_rig():
    values = (("sender", "left"), ("identifier", 0x581), ("skip", 4), ("limit", 1))
    assert tomllib.loads(fragment((Disturbance("drop", "can0", values),))) == {
        "fault": [
            {
                "bus": "can0",
                "kind": "drop",
                "name": "drop 1",
                "sender": "left",
                "identifier": 0x581,
                "skip": 4,
                "limit": 1,
            }
        ]
    }


def test_a_load_begins_and_ends():
    values = (("value", 2.5), ("at_s", 1.0), ("for_s", 0.25))
    stimuli = tomllib.loads(fragment((Disturbance("load", "left", values),)))["stimulus"]
    assert [(one["at_s"], one["value"]) for one in stimuli] == [(1.0, 2.5), (1.25, 0.0)]
    assert {one["name"] for one in stimuli} == {"load_torque_n_m"}


def test_a_killed_program_is_a_table_of_the_world():
    kill = Disturbance("kill", "driver", (("at_s", 1.5),))
    assert tomllib.loads(fragment((kill,))) == {
        "world": {"kill": [{"program": "driver", "at_s": 1.5}]}
    }


def test_programs_that_share_the_time_are_killed():
    with_programs = replace(PROFILE, programs=("driver", "watcher"))
    worlds = [drawn(Random(seed), with_programs, UNDECLARED) for seed in range(200)]
    assert {one.on for world in worlds for one in world if one.kind == "kill"} == {
        "driver",
        "watcher",
    }


def test_an_identifier_of_29_bits_is_marked_as_one():
    one = Disturbance("drop", "can0", (("sender", "host"), ("identifier", 0x901)))
    assert tomllib.loads(fragment((one,)))["fault"][0]["extended"] is True


def test_a_world_survives_json():
    for world in worlds(30):
        assert tuple(from_table(one.as_table()) for one in world) == world


def test_every_drawn_world_is_a_rig_that_opens():
    for world in worlds(40):
        text = RIG.read_text() + "\n" + fragment(world)
        rig = parse_rig(Source(RIG, text), installed_plugins())
        with Rig(rig, seed=1, doubts=False) as opened:
            opened.runtime.run_for(0.001)


def test_worlds_meet_every_kind_that_the_rig_can_have():
    met = {one.kind for world in worlds(400) for one in world}
    assert set(WEIGHTS) - met == _ON_LINES | _WITH_SOURCE_RESISTANCE | _WITH_PROGRAMS | {"corrupt"}


def test_one_seed_draws_one_world():
    assert list(worlds(20)) == list(worlds(20))


@pytest.mark.parametrize("kind", ["quirk", "clock", "interleaving"])
def test_a_place_has_one_disturbance_of_some_kinds(kind):
    for world in worlds(300):
        places = [one.on for one in world if one.kind == kind]
        assert len(places) == len(set(places))


def test_worlds_stay_within_the_number_of_disturbances():
    sizes = {len(world) for world in worlds(300)}
    assert sizes == {1, 2, 3, 4}
