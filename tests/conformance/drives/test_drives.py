"""Clauses for drives: no accusation of correct drives, and a killer for each mistake."""

import json
from xml.etree import ElementTree

import pytest

from motorhil.emulators.cia402.settings import CATALOGUE
from motorhil.harness.cli.main import main
from motorhil.harness.conformance.clause import Result
from motorhil.harness.conformance.drives.kit import drive_clauses
from motorhil.harness.conformance.drives.target import DriveTarget
from motorhil.harness.conformance.job import Job
from motorhil.harness.conformance.run import run_clause
from motorhil.harness.rig.config.toml import RigError
from motorhil.harness.version import cores_are_compiled
from tests.conformance.drives.mutants import MUTANTS

RIG = """\
[rig]
name = "a drive"
seed = 1
[bus.can0]
bitrate_bit_s = 1_000_000
[controller.drive]
kind = "cia402"
bus = "can0"
node_id = 5
plant = {{ preset = "wheel_60w" }}
{keys}
"""
DEVIATIONS = {
    "inverted_set_point_acknowledge",
    "single_set_point_only",
    "edge_only_bits",
    "stale_target_reached",
    "halt_holds_mode",
    "stray_emcy",
    "misplaced_error_register",
}
"""Quirks that break a promise of the standards; all others are legal behaviour."""
LEGAL = [quirk.name for quirk in CATALOGUE if quirk.name not in DEVIATIONS]


SPEED = 'objects = { "6081h" = 40000, "6083h" = 400000 }'
RPM = "units = { velocity_unit_inc_s = 33.3333, acceleration_unit_inc_s2 = 33.3333 }"
VENDORS = {
    "maxon_epos2_50_5.eds": RPM,
    "elmo_gold_cob.dcf": SPEED,
    "nanotec_C5-E-2-09.eds": "",
    "technosoft_ipos.eds": SPEED,
    "roboteq_v80.eds": SPEED,
    "schunk_prl_erb_0_63.dcf": SPEED,
}
"""Vendors' files, with the speeds and units that they do not state."""


def target(tmp_path, keys):
    rig = tmp_path / "rig.toml"
    rig.write_text(RIG.format(keys=keys))
    return DriveTarget(Job(rig=str(rig), controller="drive"))


def verdict(target, name):
    return run_clause(drive_clauses()[name], target.opener())


def accusations(target):
    verdicts = [verdict(target, name) for name in drive_clauses()]
    return [one for one in verdicts if one.result not in (Result.PASSED, Result.NOT_APPLICABLE)]


def test_built_in_drive_keeps_every_clause():
    target = DriveTarget(Job(controller="drive"))
    verdicts = [verdict(target, name) for name in drive_clauses()]
    assert [one for one in verdicts if one.result is not Result.PASSED] == []


def test_drive_with_all_legal_quirks_is_not_accused(tmp_path):
    assert accusations(target(tmp_path, f"quirks = {LEGAL}")) == []


@pytest.mark.nightly
@pytest.mark.parametrize("quirk", LEGAL)
def test_drive_with_a_legal_quirk_is_not_accused(tmp_path, quirk):
    assert accusations(target(tmp_path, f'quirks = ["{quirk}"]')) == []


@pytest.mark.skipif(cores_are_compiled(), reason="compiled cores cannot be broken on purpose")
@pytest.mark.parametrize("name", MUTANTS)
def test_clause_finds_its_mistake(tmp_path, monkeypatch, name):
    mutant = MUTANTS[name]
    mutant.plant(monkeypatch)
    found = target(tmp_path, mutant.keys)
    seen = verdict(found, mutant.killer)
    assert seen.result is Result.FAILED, seen
    assert "expected" in seen.seen


def test_every_clause_has_a_mistake_that_it_finds():
    killers = {mutant.killer for mutant in MUTANTS.values()}
    assert set(drive_clauses()) - killers == {"PP-07"}  # drives to DSP 402 version 2 ignore bit 9


@pytest.mark.data
@pytest.mark.parametrize("file", VENDORS)
def test_drive_with_a_vendors_dictionary_is_not_accused(tmp_path, shared, file):
    keys = f'eds = "{shared / "data" / "eds" / file}"\n{VENDORS[file]}'
    assert accusations(target(tmp_path, keys)) == []


# --- the verb


def test_finding_about_a_drive_is_in_all_results(tmp_path, capsys):
    rig = tmp_path / "rig.toml"
    rig.write_text(RIG.format(keys='quirks = ["inverted_set_point_acknowledge"]'))
    junit, found = tmp_path / "junit.xml", tmp_path / "found.json"
    words = ["--controller", "drive", "--rig", str(rig), "-o", str(tmp_path / "records")]
    files = ["--junit", str(junit), "--json", str(found)]
    assert main(["conform", *words, *files, "--clause", "PP-02"]) == 1
    (clause,) = json.loads(found.read_text())["clauses"]
    assert clause["seen"].startswith(
        "6041h, enabled without a set-point: expected bit 12 = 0; seen"
    )
    assert clause["second"] is None
    assert "drives/clauses/positioning.py" in clause["place"]
    assert (tmp_path / "records" / "PP-02.mcap").exists()
    assert f"--controller drive --rig {rig} --clause PP-02 --seed 1" in capsys.readouterr().out
    (failure,) = ElementTree.parse(junit).getroot().iter("failure")
    assert failure.get("message") == clause["seen"]


def test_clauses_for_drives_are_listed(capsys):
    assert main(["conform", "--controller", "drive", "--list", "--json"]) == 0
    listed = json.loads(capsys.readouterr().out)
    assert [one["clause"] for one in listed] == list(drive_clauses())


def test_unknown_controller_is_refused_with_known_names():
    with pytest.raises(RigError, match="has no such controller; did you mean drive"):
        DriveTarget(Job(controller="drvie"))


def test_drive_and_adaptation_together_are_refused(capsys):
    assert main(["conform", "--controller", "drive", "--adaptation", "cia402"]) == 2
    assert "leave one of them out" in capsys.readouterr().err
