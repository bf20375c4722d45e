"""The kit in gentle worlds: `motorhil conform --swarm`."""

import json

import pytest

from motorhil.harness.cli.main import main
from motorhil.harness.conformance.benches.worlds import fragment_of, is_world, world_name
from motorhil.harness.conformance.job import Job
from motorhil.harness.conformance.kit import all_clauses
from motorhil.harness.conformance.target import Target
from motorhil.harness.rig.reading import describe
from tests.conformance.test_correct_variants import accusations
from tests.support.kit_benches import KINDS, RIGS

CLAUSES = list(all_clauses())
MISBEHAVING = "tests.support.motors.misbehaving:build"
_STRIDE = 40


def drawn(kind, seed):
    """Return the fragment of a world of a kind's own rig."""
    return fragment_of(world_name(seed), describe(RIGS / f"{kind}.toml"))


def test_a_name_stands_for_one_world():
    assert drawn("cia402", 3) == drawn("cia402", 3)
    assert len({drawn("cia402", seed) for seed in range(20)}) > 15
    assert is_world("world 3")
    assert not is_world("fast clock")


def test_worlds_differ_in_plants_clocks_errors_and_turns():
    worlds = [drawn("cia402", seed) for seed in range(20)]
    for sign in ("plant.", "oscillator.ppm", 'kind = "error"', "interleaving = "):
        assert 3 < sum(sign in one for one in worlds) < 20, sign


@pytest.mark.parametrize("kind", KINDS)
def test_no_kind_is_accused_in_a_gentle_world(kind):
    number = list(KINDS).index(kind)
    target = Target(Job(kind))
    names = CLAUSES[number::_STRIDE]
    assert accusations(target.opener(None, world_name(number)), names) == []


def test_each_clause_meets_every_world(capsys, tmp_path):
    words = ["--clause", "ID-01", "--clause", "STATE-01", "--swarm", "2", "--seed", "7"]
    out = tmp_path / "found.json"
    assert main(["conform", "--adaptation", "ideal", *words, "--json", str(out)]) == 0
    shown = json.loads(out.read_text())
    assert [(one["id"], one["bench"]) for one in shown["clauses"]] == [
        (clause, f"two ideal motors, on no bus, {world}")
        for world in ("world 7", "world 8")
        for clause in ("ID-01", "STATE-01")
    ]


def test_a_failure_tells_its_world_and_the_command_that_repeats_it(capsys):
    rig = ["--adaptation", MISBEHAVING, "--rig", str(RIGS / "ideal.toml")]
    assert main(["conform", *rig, "--clause", "STATE-01", "--swarm", "1", "--seed", "7"]) == 1
    shown = capsys.readouterr().out
    assert "world 7" in shown
    assert "--benches 'world 7'" in shown


@pytest.mark.parametrize("words", [["--on", "can0"], ["--controller", "drive"]])
def test_only_emulated_drives_of_an_adaptation_are_disturbed(capsys, words):
    rig = ["--rig", str(RIGS / "cia402.toml")]
    assert main(["conform", *rig, *words, "--swarm", "1"]) == 2
    assert "--swarm disturbs emulated drives" in capsys.readouterr().err
