"""Correct motors that differ from the kit's motors do not fail."""

import sys

import pytest

from motorhil.harness.conformance.bench import Ability
from motorhil.harness.conformance.benches import variations
from motorhil.harness.conformance.benches.rig_bench import RigBench, bench_description
from motorhil.harness.conformance.benches.variations import APART, OWN, READ
from motorhil.harness.conformance.claims import Claims
from motorhil.harness.conformance.clause import Result
from motorhil.harness.conformance.job import Job
from motorhil.harness.conformance.kit import all_clauses
from motorhil.harness.conformance.run import run_clause
from motorhil.harness.conformance.target import Target
from motorhil.harness.rig.config.rig_file import parse_rig, read_rig
from motorhil.harness.rig.config.toml import Source
from motorhil.harness.rig.reading import installed_plugins
from tests.conformance.mutants.by_rule import benches
from tests.conformance.variants import (
    BENCHES,
    LIMITED_JERK,
    OF_ONE_PROGRAM,
    OTHERS,
    VARIANTS,
    VENDORS,
    of_vendor,
    text_of,
)
from tests.support.kit_benches import RIGS

CLAUSES = all_clauses()
_ACCELERATION = "acceleration_max_rad_s2 = 4.0"
_TORQUE = "torque_max_n_m = 5.0"
_LONG = "long_move_rad = 1.0"


_STRIDE = len(VARIANTS)


def opener_of(folder, *changes, seed=1):
    """Return an opener of the kit's CiA 402 bench with these changes of its text."""
    (folder / "rig.toml").write_text(text_of(changes))
    described = bench_description(read_rig(folder / "rig.toml", installed_plugins()), "cia402")
    return lambda: RigBench(described, seed)


def accusations(opener, names):
    """Return what the clauses of these names say against the motor of this bench."""
    claims = Claims(opener)
    verdicts = [run_clause(CLAUSES[name], opener, claims) for name in names]
    return [f"{one.clause}: {one.seen}" for one in verdicts if not one.result.is_good]


def slice_of(number):
    """Return clauses for variant `number`; the variants together meet each clause once."""
    return list(CLAUSES)[number::_STRIDE]


def test_variants_cover_every_clause():
    assert {name for number in range(len(VARIANTS)) for name in slice_of(number)} == set(CLAUSES)


@pytest.mark.parametrize("name", VARIANTS)
def test_variant_is_not_accused(tmp_path, name):
    names = slice_of(list(VARIANTS).index(name))
    assert accusations(opener_of(tmp_path, *VARIANTS[name]), names) == []


@pytest.mark.parametrize("name", OF_ONE_PROGRAM)
def test_variant_of_one_program_is_not_accused(tmp_path, name):
    alone = [one for one in slice_of(5) if Ability.SECOND_PROGRAM not in CLAUSES[one].bench]
    assert accusations(opener_of(tmp_path, *OF_ONE_PROGRAM[name]), alone) == []


@pytest.mark.parametrize(("kind", "name"), OTHERS)
def test_varied_motor_of_another_kind_is_not_accused(kind, name):
    names = slice_of(OTHERS.index((kind, name)))
    assert accusations(Target(Job(kind)).opener(None, name), names) == []


@pytest.mark.data
@pytest.mark.parametrize("file", VENDORS)
def test_vendor_drive_is_not_accused(tmp_path, shared, file):
    names = slice_of(VENDORS.index(file))
    assert accusations(opener_of(tmp_path, *of_vendor(shared / "data" / "eds" / file)), names) == []


ONCE_ACCUSED = [
    ("slow SDO server", "LEAD-02", 1),  # its argument ran away while the drive started
    ("quirk heartbeat_jitter", "HOME-03", 4),  # the first heartbeat came after the first reading
    ("no heartbeat consumer", "PROC-11", 1),  # a reader tried to write the object that it lacks
    ("no TPDOs", "PROC-14", 1),  # it ignored the stop of a program that had not seen it enabled
    ("busy bus", "LEAD-01", 3),  # it said that its leader is heard too seldom for such a velocity
    ("quirk slow_sdo", "LEAD-01", 7),  # velocities in steps, of which twelve scatter
    ("quirk slow_sdo", "LEAD-01", 24),
    ("quirk slow_sdo", "TRAJ-02", 6),  # start() had heard of it 1 ms late
    ("quirk slow_sdo", "TRAJ-05", 42),  # its ramp began before start() had the drive's answer
    ("quirk slow_sdo", "MEAS-03", 36),  # readings of up to 0.19 s met the peak by chance
    ("quirk heartbeat_jitter", "LOST-13", 51),  # a short silence lost two heartbeats
    ("quirk slow_sdo", "LOST-11", 159),  # it asked for four objects before done was told
    ("quirk slow_sdo", "FIT-02", 3),  # the steps before the one that is too slow took 0.1 s
    ("position limits in the drive", "MEAS-06", 1),  # they keep it from the end of its counter
    ("brakes gently", "TIME-01", 6),  # of a load whose least urgent message waits very long
]


@pytest.mark.parametrize(("name", "clause", "seed"), ONCE_ACCUSED)
def test_variant_once_accused_passes(tmp_path, name, clause, seed):
    assert accusations(opener_of(tmp_path, *VARIANTS[name], seed=seed), [clause]) == []


OTHERS_ONCE_ACCUSED = [
    *(("cia402", APART, one) for one in ("OPT-03", "OPT-04", "FIT-01")),  # left open
    ("moteus", "starts at 5 rad", "LIM-01"),  # its limit is rounded up: it was refused the way back
    ("oriental_az", "AZ drive keeps its trigger", "PROC-14"),  # it ignored the stop of a program
    ("leadshine", "Leadshine drive options", "MEAS-06"),  # held by a limit switch
    ("leadshine", "Leadshine drive options", "SYNC-09"),  # told late, it stopped where it arrives
    ("cia402", APART, "LEAD-05"),  # its leader was the same drive, in another program
    ("cia402", READ, "LOST-03"),  # the set-up by a reader hid the loss from the owner,
    ("software", "reversing gear", "PROC-16"),  # its program commands it at rest, but not at first
    ("software", READ, "LOST-12"),  # and made a motion done that it had ended
]


@pytest.mark.parametrize(("kind", "name", "clause"), OTHERS_ONCE_ACCUSED)
def test_motor_of_another_kind_once_accused_passes(kind, name, clause):
    assert accusations(Target(Job(kind, seed=2)).opener(None, name), [clause]) == []


@pytest.mark.nightly
@pytest.mark.parametrize("seed", range(1, 51))
@pytest.mark.parametrize("name", VARIANTS)
def test_variant_is_never_accused(tmp_path, name, seed):
    assert accusations(opener_of(tmp_path, *VARIANTS[name], seed=seed), CLAUSES) == []


@pytest.mark.nightly
@pytest.mark.parametrize("seed", range(1, 51))
@pytest.mark.parametrize("kind", BENCHES)
def test_motor_of_another_kind_is_never_accused(kind, seed):
    name = BENCHES[kind][seed % len(BENCHES[kind])]
    assert accusations(Target(Job(kind, seed=seed)).opener(None, name), CLAUSES) == []


def test_class_whose_module_is_no_text_is_not_taken_for_ours():
    class Odd:
        __module__ = property(lambda self: "of an object")

    odd = Odd()  # CLOSE-04 looks at all objects of the process
    assert accusations(Target(Job("mit")).opener(None, OWN), ["CLOSE-04"]) == []
    assert odd


def verdict_of(clause, opener):
    return run_clause(CLAUSES[clause], opener, Claims(opener))


@pytest.mark.parametrize(
    "clause", ["TRAJ-04", "TRAJ-07", "STOP-06", "SHARE-03", "SYNC-04", "SYNC-09"]
)
def test_gently_braking_motor_passes(tmp_path, clause):
    gently = (_ACCELERATION, f"{_ACCELERATION}\ndeceleration_max_rad_s2 = 1.0")
    verdict = verdict_of(clause, opener_of(tmp_path, gently))
    assert verdict.result is Result.PASSED, verdict.seen


OF_JERK = {
    "cia402": (
        *("TRAJ-02", "TRAJ-03", "TRAJ-04", "TRAJ-09", "START-02", "START-05", "DONE-01"),
        *("DONE-04", "STOP-04", "SHARE-12", "SYNC-02", "SYNC-03", "SYNC-08", "SYNC-09"),
        *("SYNC-10", "SYNC-13", "SYNC-14"),
    ),
    "ideal": ("TRAJ-05", "TRAJ-11", "TRAJ-13", "TRAJ-14"),  # its velocities are limited, too
}
"""Clauses that knew of no limit of jerk."""


@pytest.mark.parametrize("kind", OF_JERK)
def test_motor_with_limited_jerk_is_not_accused(kind):
    path = RIGS / f"{kind}.toml"
    text = variations.text_of(path.read_text(), LIMITED_JERK)
    described = bench_description(parse_rig(Source(path, text), installed_plugins()), kind)
    assert accusations(lambda: RigBench(described, 1), OF_JERK[kind]) == []


NARROW = (_TORQUE, f"{_TORQUE}\nposition_min_rad = -0.1\nposition_max_rad = 0.1")


@pytest.mark.parametrize("clause", ["UNIT-01", "MEAS-01", "LOST-01"])
def test_clause_without_room_is_not_applicable(tmp_path, clause):
    verdict = verdict_of(clause, opener_of(tmp_path, NARROW))
    assert verdict.result is Result.NOT_APPLICABLE, verdict.seen
    assert "-0.1 to 0.1 rad" in verdict.seen


def test_clause_whose_package_is_not_installed_is_not_applicable(tmp_path, monkeypatch):
    for name in ("hypothesis", "hypothesis.errors"):
        monkeypatch.setitem(sys.modules, name, None)
    monkeypatch.delitem(sys.modules, "motorhil.harness.sharing_tests.state_machine", raising=False)
    verdict = verdict_of("SHARE-11", opener_of(tmp_path, (_ACCELERATION, _ACCELERATION)))
    assert verdict.result is Result.NOT_APPLICABLE, verdict.seen
    assert verdict.seen == "hypothesis is not installed; pip install hypothesis"


def test_shared_motor_moves_in_a_course_of_any_seed(tmp_path):
    seed = 2  # its first courses end no motion
    verdict = verdict_of("SHARE-11", opener_of(tmp_path, (_LONG, _LONG), seed=seed))
    assert verdict.result is Result.PASSED, verdict.seen


@pytest.mark.parametrize(
    ("clause", "result"),
    [
        ("SET-05", Result.PASSED),
        ("SET-08", Result.NOT_APPLICABLE),  # never reaches its top speed
        ("LOST-01", Result.PASSED),  # in long modes
        ("LOST-08", Result.NOT_APPLICABLE),
    ],
)
def test_motor_with_short_moves_passes(tmp_path, clause, result):
    short = (_LONG, "long_move_rad = 0.04")
    verdict = verdict_of(clause, opener_of(tmp_path, NARROW, short))
    assert verdict.result is result, verdict.seen


OF_DEFAULTS = ("SET-02", "MOVE-02", "DONE-01", "STOP-01", "FAULT-01", "FAULT-04", "LOW-01")
"""Clauses that meet defaults of hooks: references, ends, stops, faults, missing capabilities."""


@pytest.mark.parametrize("clauses", [OF_DEFAULTS, pytest.param(CLAUSES, marks=pytest.mark.nightly)])
def test_motor_with_few_hooks_is_not_accused(clauses):
    assert accusations(benches.opener("few hooks"), clauses) == []
