"""Shipped state machines on every kind of hardware, and the cases that they reach."""

import os
from pathlib import Path

import pytest
from hypothesis import Phase, settings

from motorhil.harness.rig.config.rig_file import parse_rig
from motorhil.harness.rig.config.toml import Source
from motorhil.harness.rig.reading import installed_plugins
from motorhil.harness.sharing_tests.history import SharingViolated
from motorhil.harness.sharing_tests.state_machine import (
    group_machine,
    ownership_machine,
    shared_rig,
)
from tests.support.motors.kinds import KINDS

LONGER = int(os.environ.get("MOTORHIL_SHARING", "1"))
"""The factor by which the number of examples is multiplied."""

EXAMPLES = {"ideal": 80, "cia402": 50, "software": 12}
OWNED = (
    "reserve: done",
    "reserve: refused",
    "start: done",
    "start: refused",
    "stop",
    "kill: at work",
    "take over: from a living owner",
    "start: lost before",
    "give: lost before",
    "motion: as far as asked for",
    "motion: as long as asked for",
)
GROUPED = (
    "2 motors: moved",
    "2 motors: moved in a reservation",
    "2 motors: refused",
    "2 motors: one refused to be armed",
    "kill: at work",
    "positions compared",
)


def rig_of(kind, owners=("ann", "ben", "cem")):
    source = Source(Path(f"{kind}.toml"), KINDS[kind].rig())
    return shared_rig(parse_rig(source, installed_plugins()), owners)


def run(machine, examples):
    """Run the machine without shrinking, and return its reach."""
    machine.TestCase.settings = settings(
        machine.TestCase.settings,
        max_examples=examples * LONGER,
        phases=[Phase.generate],
        report_multiple_bugs=False,
    )
    machine.TestCase().runTest()
    return machine.reach


def table(reach):
    return "\n".join(f"{count:6d}  {name}" for name, count in sorted(reach.items()))


@pytest.mark.parametrize("kind", KINDS)
def test_ownership_machine_holds_and_reaches_all_cases(kind):
    reach = run(ownership_machine(rig_of(kind)), EXAMPLES[kind])
    print(table(reach))
    wanted = OWNED if kind != "software" else OWNED[:2] + OWNED[-1:]  # slower, so fewer runs
    assert [name for name in wanted if not reach[name]] == []


@pytest.mark.parametrize("kind", KINDS)
def test_group_machine_holds_and_reaches_all_cases(kind):
    reach = run(group_machine(rig_of(kind)), EXAMPLES[kind])
    print(table(reach))
    assert [name for name in GROUPED if not reach[name]] == []


def test_equal_choices_give_equal_histories():
    def histories():
        told = []
        machine = ownership_machine(rig_of("cia402"))
        teardown = machine.teardown

        def noting(self):
            teardown(self)
            told.append([str(use) for use in self.stage.history])

        machine.teardown = noting
        run(machine, 4)
        return told

    first = histories()
    assert sum(map(len, first)) > 20
    assert histories() == first


def test_rig_without_second_owner_is_refused():
    with pytest.raises(SharingViolated, match="no motor of the rig has two logical motors"):
        run(ownership_machine(rig_of("ideal", ["ann"])), 1)
