"""Correct motors that differ from the kit's motors do not fail."""

import sys

import pytest

from motorhil.harness.conformance.clause import Result
from motorhil.harness.conformance.kit import all_clauses
from motorhil.harness.conformance.rig_bench import RigBench, bench_description
from motorhil.harness.conformance.run import Claims, run_clause
from motorhil.harness.rig.config.rig_file import read_rig
from motorhil.harness.rig.rig import installed_plugins
from tests.support.kit_benches import RIGS

CLAUSES = all_clauses()
_ACCELERATION = "acceleration_max_rad_s2 = 4.0"
_TORQUE = "torque_max_n_m = 5.0"
_LONG = "long_move_rad = 1.0"


def opener_of(folder, *changes):
    """Return an opener of the kit's CiA 402 bench with these changes of its text."""
    text = (RIGS / "cia402.toml").read_text()
    for before, after in changes:
        assert before in text
        text = text.replace(before, after)
    (folder / "rig.toml").write_text(text)
    described = bench_description(read_rig(folder / "rig.toml", installed_plugins()), "cia402")
    return lambda: RigBench(described, 1)


def verdict_of(clause, opener):
    return run_clause(CLAUSES[clause], opener, Claims(opener))


@pytest.mark.parametrize(
    "clause", ["TRAJ-04", "TRAJ-07", "STOP-06", "SHARE-03", "SYNC-04", "SYNC-09"]
)
def test_gently_braking_motor_passes(tmp_path, clause):
    gently = (_ACCELERATION, f"{_ACCELERATION}\ndeceleration_max_rad_s2 = 1.0")
    verdict = verdict_of(clause, opener_of(tmp_path, gently))
    assert verdict.result is Result.PASSED, verdict.seen


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
