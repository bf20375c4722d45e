"""Variations of the kit's benches: which clause meets which."""

from collections import Counter

import pytest

from motorhil.emulators.can.frame import can_id_of
from motorhil.harness.cli.main import main
from motorhil.harness.conformance.bench import Ability
from motorhil.harness.conformance.benches.variations import (
    APART,
    OWN,
    READ,
    VARIATIONS,
    assigned,
    not_met,
    pairs_of,
    text_of,
)
from motorhil.harness.conformance.job import Job
from motorhil.harness.conformance.kit import all_clauses
from motorhil.harness.conformance.target import Target
from motorhil.motorapi import MotorBusyError
from tests.support.kit_benches import KINDS, RIGS

CLAUSES = list(all_clauses())


@pytest.mark.parametrize("seed", [1, 2, 3])
def test_every_variation_is_met_by_a_clause(seed):
    met = assigned(CLAUSES, list(VARIATIONS), seed)
    assert set(met.values()) == {OWN, *VARIATIONS}
    assert met[CLAUSES[0]] == OWN  # the first verdict waits for no other bench
    assert met == assigned(CLAUSES, list(VARIATIONS), seed)


def test_seeds_vary_the_bench_of_a_clause():
    benches = {assigned(CLAUSES, list(VARIATIONS), seed)[CLAUSES[1]] for seed in range(1, 9)}
    assert len(benches) > 3


def test_conditions_without_clause_are_reported():
    assert not_met(["backlash", "slow bus"], {OWN, "slow bus"}) == ["backlash"]


def test_pairs_leave_out_those_that_contradict_each_other():
    pairs = pairs_of((RIGS / "cia402.toml").read_text(), ["no csp", "only pp", "friction"])
    assert pairs == ["no csp + friction", "only pp + friction"]


def test_pair_of_a_bench_has_both_changes():
    with Target(Job("cia402")).opener(None, "home offset + slow bus")() as bench:
        assert bench.name.endswith(", home offset + slow bus")
        assert bench.rig.description.buses["can0"].bitrate_bit_s == 125_000
        assert bench.rig.controllers["left"].core.od.integer(0x607C, 0, 0) == 1000


def test_other_users_in_a_second_program_have_locks_between():
    with Target(Job("cia402")).opener(None, APART)() as bench:
        motor = bench.motor
        other = bench.another_user_of(motor)
        assert other.hardware is not motor.hardware
        with motor.reserve("survey"), pytest.raises(MotorBusyError, match=r"pid \d+ .* for survey"):
            other.enable()
        assert Ability.ONE_PROGRAM not in bench.abilities


@pytest.mark.parametrize(
    "names",
    [
        ["limited jerk", "linear axis"],
        ["priority queues", "two buses with equal node-IDs"],
    ],
)
def test_pairs_leave_out_those_that_make_no_rig(names):
    text = (RIGS / "cia402.toml").read_text()
    assert len(pairs_of(text, [names[0], "friction"])) == 1
    assert pairs_of(text, names) == []


@pytest.mark.nightly
def test_every_pair_makes_a_rig():
    """A run on pairs ended with wrong usage where one did not."""
    target = Target(Job("cia402"))
    text = (RIGS / "cia402.toml").read_text()
    for pair in pairs_of(text, target.variations):
        with target.opener(None, pair)():
            pass


def test_pairs_not_met_are_counted():
    missing = not_met(["a", "b", "c", "a + b", "a + c"], {OWN, "a + b"})
    assert missing == ["c", "1 of 2 pairs"]


def test_text_without_the_place_of_a_change_is_refused():
    with pytest.raises(ValueError, match=r"gear_ratio = 66\.0"):
        text_of("[rig]", VARIATIONS["reversing gear"])


OTHER_MOTORS = ("dynamixel", "mit", "robstride")  # than the wheel: with variations of their own


@pytest.mark.parametrize("kind", KINDS)
def test_every_variation_of_a_kind_opens(kind):
    target = Target(Job(kind))
    assert ("reversing gear" in target.variations) is (kind not in OTHER_MOTORS)
    assert target.variations
    for name in target.variations:
        with target.opener(None, name)() as bench:
            assert bench.name == f"{target.rig.name}, {name}"


def sent_by(variation, duration_s=0.104):
    """Return the (sender, identifier) of all frames on the kit's CAN bus, and their numbers."""
    seen = Counter()
    with Target(Job("cia402")).opener(None, variation)() as bench:
        bench.rig.world.tap_frames(
            lambda bus, now_ns, sender, frame: seen.update([(sender, can_id_of(frame))])
        )
        bench.runtime.run_for(duration_s)
    return seen


def test_busy_bus_carries_its_declared_messages():
    seen = sent_by("busy bus")
    assert [seen["others", identifier] for identifier in (0x90, 0x98, 0x6A0, 0x6A8)] == [20] * 4


def test_second_program_asks_the_drives_by_itself():
    asked = {identifier for _, identifier in sent_by(READ)}
    assert {0x601, 0x602} <= asked  # CiA 301: SDO requests to nodes 1 and 2
    assert 0x601 not in {identifier for _, identifier in sent_by(OWN)}


def test_rig_of_a_user_is_not_varied():
    assert Target(Job("cia402", str(RIGS / "cia402.toml"))).variations == ()


def test_unknown_variation_is_wrong_usage(capfd):
    words = ["conform", "--adaptation", "ideal", "--clause", "UNIT-01", "--benches", "reversing"]
    assert main(words) == 2
    assert "did you mean reversing gear?" in capfd.readouterr().err


def test_variation_that_claims_less_is_not_accused(capfd):
    words = ["conform", "--adaptation", "dynamixel", "--clause", "STATE-02", "--clause", "UNIT-01"]
    assert main([*words, "--benches", "servo in velocity mode"]) == 0
    out = capfd.readouterr().out
    assert "UNIT-01   not applicable" in out
    assert "STATE-02  passed" in out


def test_failure_repeats_on_its_bench(capfd, tmp_path, monkeypatch):
    monkeypatch.setenv("MISBEHAVE", str(tmp_path / "harm"))
    (tmp_path / "harm").write_text("has_a_bug")
    adaptation = "tests.support.motors.misbehaving:build"
    words = ["conform", "--adaptation", adaptation, "-o", str(tmp_path), "--clause", "STATE-01"]
    assert main([*words, "--benches", "reversing gear"]) == 1
    out = capfd.readouterr().out
    assert "on two ideal motors, on no bus, reversing gear" in out
    assert "--clause STATE-01 --seed 1 --benches 'reversing gear'" in out
