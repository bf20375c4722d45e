"""What is wrong with sharing on purpose is found out by the shipped suites."""

import pytest

from harness.sharing.history import SharingViolated
from harness.sharing.machine import group_machine, ownership_machine
from tests.harness.sharing import mutants
from tests.harness.sharing.test_machine import rig_of, run


def killed(mutant, machine, kind):
    """What the machine says of the mutant."""
    with mutant(), pytest.raises(SharingViolated) as caught:
        run(machine(rig_of(kind)), 200)
    return str(caught.value)


@pytest.mark.parametrize("kind", ["ideal", "cia402"])
def test_a_lock_without_fifo_is_killed(kind):
    told = killed(mutants.a_lock_without_fifo, ownership_machine, kind)
    assert "first come, first served" in told


@pytest.mark.parametrize("kind", ["ideal", "cia402"])
def test_the_lack_of_fencing_is_killed(kind):
    told = killed(mutants.no_fencing, ownership_machine, kind)
    assert " command " in told or "start was refused" in told, told


@pytest.mark.parametrize("kind", ["ideal", "cia402", "software"])
def test_a_group_that_starts_before_all_are_armed_is_killed(kind):
    told = killed(mutants.a_group_that_starts_before_all_are_armed, group_machine, kind)
    assert "was armed" in told


def test_a_start_that_pushes_settings_after_starting_is_killed():
    mutant = mutants.a_start_that_pushes_settings_after_starting
    told = killed(mutant, ownership_machine, "cia402")
    assert "another owner's settings" in told
