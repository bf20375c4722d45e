"""The judge's oracles on recordings of drives with one mistake each, and of correct ones."""

import pytest

from motorhil.harness.conformance.drives.kit import drive_clauses
from motorhil.harness.conformance.run import run_clause
from motorhil.harness.oracles.base import Verdict
from motorhil.harness.oracles.judge import judge
from tests.conformance.drives.mutants import MUTANTS
from tests.conformance.drives.rigs import DRIVES, target

SEEN = {  # a mistake, and the oracle that sees it on the bus, in a recording of its clause
    "csp_is_claimed_falsely": "mode-signs",
    "halt_holds_the_mode": "mode-signs",
    "acknowledge_is_never_cleared": "mode-signs",
    "acknowledge_is_inverted": "mode-signs",
    "reserved_method_homes": "mode-signs",
    "store_needs_no_signature": "sdo-refusals",
    "heartbeat_is_twice_as_slow": "heartbeat-kept",
    "heartbeat_always_says_operational": "nmt-obeyed",
    "switch_on_disabled_takes_enable": "pds-legal",
    "shutdown_is_ignored_when_switched_on": "commands-obeyed",
    "quick_stop_never_stays": "commands-obeyed",
    "relative_is_absolute": "arrival-true",
    "position_window_time_is_ignored": "arrival-true",
    "velocity_window_time_is_ignored": "arrival-true",
    "velocity_limit_is_ignored": "limit-velocity",
    "software_limits_are_ignored": "limit-position",
    "software_limits_are_ignored_in_csp": "limit-position",
    "error_register_is_misplaced": "errors-listed",
    "history_is_empty": "errors-listed",
    "synchronous_tpdo_is_sent_at_once": "tpdo-times",
    "every_sync_sends_the_tpdo": "tpdo-times",
    "inhibit_time_is_ignored": "tpdo-times",
}
TRUE_OF = {"legal quirks": ["sdo-answered"]}  # it is deaf after its boot-up


def broken(keys, clause, path):
    """Return the oracles that this drive breaks in a recording of this clause.

    The kit sends SYNCs between its requests: their period is not the drive's.
    """
    run_clause(drive_clauses()[clause], target(keys).opener(path))
    found = [one.oracle for one in judge(path) if one.verdict is Verdict.BROKEN]
    return [name for name in found if name != "sync-period"]


@pytest.mark.pure("compiled cores cannot be broken on purpose")
@pytest.mark.parametrize("name", SEEN)
def test_mistake_is_seen_on_the_bus(monkeypatch, tmp_path, name):
    mutant = MUTANTS[name]
    assert broken("", mutant.killer, tmp_path / "correct.mcap") == []
    mutant.plant(monkeypatch)
    assert broken(mutant.keys, mutant.killer, tmp_path / "mutant.mcap") == [SEEN[name]]


def test_refused_mapping_denies_the_mapped_object_alone(tmp_path):
    assert broken("", "PDO-09", tmp_path / "mapping.mcap") == []


@pytest.mark.nightly
@pytest.mark.parametrize("drive", [name for name in DRIVES if not name.startswith("quirk ")])
def test_correct_drive_is_not_accused_by_a_recording(tmp_path, drive):
    accused = {name: broken(DRIVES[drive], name, tmp_path / name) for name in drive_clauses()}
    known = TRUE_OF.get(drive, [])
    assert {name: oracles for name, oracles in accused.items() if oracles not in ([], known)} == {}
