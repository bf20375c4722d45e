"""Ownership of a drive by several users, some of which are killed.

The state machines are motorhil's own.
"""

import pytest
from conftest import RIG
from hypothesis import Phase, settings
from motorhil.harness.sharing_tests.state_machine import (
    group_machine,
    ownership_machine,
    shared_rig,
)


@pytest.mark.parametrize(
    ("machine", "examples", "reached"),
    [
        (ownership_machine, 10, ("reserve: done", "motion: as far as asked for")),
        (group_machine, 10, ("2 motors: moved", "2 motors: one refused to be armed")),
    ],
)
def test_drive_has_one_owner_at_a_time(machine, examples, reached):
    machine = machine(shared_rig(str(RIG), ("ann", "ben", "cem")))
    machine.TestCase.settings = settings(
        machine.TestCase.settings,
        max_examples=examples,
        phases=[Phase.generate],
        report_multiple_bugs=False,
        derandomize=True,
        deadline=None,
    )
    machine.TestCase().runTest()
    for what in reached:
        assert machine.reach[what], f"never: {what}"
