"""Planted defects of sharing are detected by the shipped machines."""

import pytest

from motorhil.harness.sharing_tests.history import SharingViolated
from motorhil.harness.sharing_tests.state_machine import group_machine, ownership_machine
from tests.properties.test_sharing_machine import rig_of, run
from tests.support.sharing import mutants


def killed(mutant, machine, kind):
    """Return the machine's message about the mutant."""
    with mutant(), pytest.raises(SharingViolated) as caught:
        run(machine(rig_of(kind)), 200)
    return str(caught.value)


@pytest.mark.parametrize("kind", ["ideal", "cia402"])
def test_machine_detects_lock_without_fifo(kind):
    told = killed(mutants.a_lock_without_fifo, ownership_machine, kind)
    assert "first come, first served" in told


@pytest.mark.parametrize("kind", ["ideal", "cia402"])
def test_machine_detects_missing_fencing(kind):
    told = killed(mutants.no_fencing, ownership_machine, kind)
    assert " command " in told or "start was refused" in told, told


@pytest.mark.parametrize("kind", ["ideal", "cia402", "software"])
def test_machine_detects_start_before_all_are_armed(kind):
    told = killed(mutants.a_group_that_starts_before_all_are_armed, group_machine, kind)
    assert "was armed" in told


def test_machine_detects_settings_after_start():
    mutant = mutants.a_start_that_pushes_settings_after_starting
    told = killed(mutant, ownership_machine, "cia402")
    assert "another owner's settings" in told
