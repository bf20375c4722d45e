"""Clauses for drives: no accusation of correct drives, and a killer for each mistake."""

import json
from xml.etree import ElementTree

import pytest

from motorhil.harness.cli.main import main
from motorhil.harness.conformance.clause import Result
from motorhil.harness.conformance.drives.kit import drive_clauses
from motorhil.harness.conformance.drives.target import DriveTarget
from motorhil.harness.conformance.job import Job
from motorhil.harness.conformance.run import run_clause
from motorhil.harness.rig.config.toml import RigError
from tests.conformance.drives.mutants import MUTANTS
from tests.conformance.drives.rigs import (
    CLAUSES,
    DEVIATIONS,
    DRIVES,
    LEGAL,
    TRULY_ACCUSED,
    target,
    text_of,
)

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


def verdict(target, name):
    return run_clause(drive_clauses()[name], target.opener())


def accusations(target, names=None):
    verdicts = [verdict(target, name) for name in names or drive_clauses()]
    return [one for one in verdicts if one.result not in (Result.PASSED, Result.NOT_APPLICABLE)]


NEEDS_STATEMENTS = {
    "HOME-03",
    "HOME-04",
    "HOME-05",
    "TP-04",
    "CYC-01",
    "OD-10",
    "VAL-02",
    "VAL-04",
    "PLANT-11",
    "DIN-02",
} | {f"PLANT-0{number}" for number in range(1, 10)}
"""Clauses about switches, monitoring and objects that the kit's own drive does not have."""


def test_built_in_drive_keeps_every_clause():
    target = DriveTarget(Job(controller="drive"))
    verdicts = [verdict(target, name) for name in drive_clauses()]
    assert [
        one
        for one in verdicts
        if (one.result is not Result.PASSED) != (one.clause in NEEDS_STATEMENTS)
        or one.result not in (Result.PASSED, Result.NOT_APPLICABLE)
    ] == []


@pytest.mark.parametrize(("drive", "names"), [("switches", ("HOME-03", "HOME-04", "TP-04"))])
def test_stated_switches_make_their_clauses_apply(drive, names):
    found = target(DRIVES[drive])
    assert [verdict(found, name).result for name in names] == [Result.PASSED] * len(names)


@pytest.mark.parametrize("name", ["HOME-06", "TP-02"])
def test_drive_without_index_pulse_is_not_accused(name):
    assert verdict(target(DRIVES["lean"]), name).result is Result.NOT_APPLICABLE


@pytest.mark.parametrize("name", ["PV-01", "PP-01", "TQ-01", "PLANT-04"])
def test_drive_between_end_stops_is_not_accused(name):
    seen = verdict(target(DRIVES["end stops"]), name)
    assert seen.result is Result.PASSED, seen


@pytest.mark.nightly
@pytest.mark.parametrize("drive", [name for name in DRIVES if not name.startswith("quirk ")])
def test_correct_drive_is_not_accused(drive):
    names = CLAUSES[drive] if drive in TRULY_ACCUSED else drive_clauses()
    assert accusations(target(DRIVES[drive]), names) == []


@pytest.mark.parametrize("quirk", DEVIATIONS)
def test_deviating_drive_has_its_finding(quirk):
    seen = verdict(target(DRIVES[f"quirk {quirk}"]), DEVIATIONS[quirk])
    assert seen.result is Result.FAILED, seen


@pytest.mark.pure("compiled cores cannot be broken on purpose")
@pytest.mark.parametrize(("keys", "wanted"), [("true", Result.PASSED), ("false", Result.FAILED)])
def test_home_offset_has_the_declared_sign(monkeypatch, keys, wanted):
    MUTANTS["home_offset_has_the_other_sign"].plant(monkeypatch)
    found = target(f"[conformance]\nhome_offset_is_opposite = {keys}")
    seen = verdict(found, "HOME-01")
    assert seen.result is wanted, seen
    assert wanted is Result.PASSED or "as KEB's F6 has; home_offset_is_opposite" in seen.seen


def test_home_offset_of_the_standard_contradicts_a_declaration():
    found = target("[conformance]\nhome_offset_is_opposite = true")
    seen = verdict(found, "HOME-01")
    assert seen.result is Result.FAILED
    assert "that of CiA 402-2; home_offset_is_opposite = false" in seen.seen


def test_drive_with_all_legal_quirks_is_not_accused():
    assert accusations(target(f"quirks = {LEGAL}")) == []


@pytest.mark.nightly
@pytest.mark.parametrize("quirk", LEGAL)
def test_drive_with_a_legal_quirk_is_not_accused(quirk):
    assert accusations(target(f'quirks = ["{quirk}"]')) == []


@pytest.mark.pure("compiled cores cannot be broken on purpose")
@pytest.mark.parametrize("name", MUTANTS)
def test_clause_finds_its_mistake(monkeypatch, name):
    mutant = MUTANTS[name]
    mutant.plant(monkeypatch)
    found = target(mutant.keys)
    seen = verdict(found, mutant.killer)
    assert seen.result is Result.FAILED, seen
    assert "expected" in seen.seen


def test_every_clause_has_a_mistake_that_it_finds():
    killers = {mutant.killer for mutant in MUTANTS.values()}
    assert set(drive_clauses()) - killers == {"PP-07"}  # drives to DSP 402 version 2 ignore bit 9


def of_vendor(shared, file):
    return target(f'eds = "{shared / "data" / "eds" / file}"\n{VENDORS[file]}')


@pytest.mark.data
@pytest.mark.parametrize("file", VENDORS)
def test_drive_with_a_vendors_dictionary_is_not_accused(shared, file):
    names = list(drive_clauses())[list(VENDORS).index(file) % 3 :: 3]  # each meets two drives
    assert accusations(of_vendor(shared, file), names) == []


@pytest.mark.data
@pytest.mark.nightly
@pytest.mark.parametrize("file", VENDORS)
def test_drive_with_a_vendors_dictionary_is_never_accused(shared, file):
    assert accusations(of_vendor(shared, file)) == []


# --- the verb


def test_finding_about_a_drive_is_in_all_results(tmp_path, capsys):
    rig = tmp_path / "rig.toml"
    rig.write_text(text_of('quirks = ["inverted_set_point_acknowledge"]'))
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
    with pytest.raises(RigError, match=r"no such controller; it has drive .*; did you mean drive"):
        DriveTarget(Job(controller="drvie"))


def test_kind_in_place_of_controller_is_answered_with_a_name():
    with pytest.raises(RigError, match=r"own rig .* kind cia402\); use --controller drive, or"):
        DriveTarget(Job(controller="cia402"))


def test_drive_and_adaptation_together_are_refused(capsys):
    assert main(["conform", "--controller", "drive", "--adaptation", "cia402"]) == 2
    assert "leave one of them out" in capsys.readouterr().err


@pytest.mark.parametrize("clause", ["LSS-01", "LSS-02"])
def test_drive_beside_another_one_is_not_accused_of_its_lss(clause):
    plant = 'plant = { preset = "wheel_60w" }\n'
    second = f'{plant}[controller.second]\nkind = "cia402"\nbus = "can0"\nnode_id = 6\n{plant}'
    verdict = run_clause(drive_clauses()[clause], target(second).opener())
    assert verdict.result is Result.NOT_APPLICABLE, verdict.seen
    assert "another device on the bus answers LSS" in verdict.seen
