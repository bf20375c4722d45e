"""Summaries of runs against recorded controllers."""

import pytest

from motorhil.harness.replay.host import DrivenRig
from motorhil.harness.replay.rig import with_recorded
from motorhil.harness.replay.verdict import never_came, players, summary, unanswered
from motorhil.harness.rig.rig import Rig
from motorhil.traces.can_frame import classic
from motorhil.traces.exchange.steps import Role
from tests.support.golden import described, golden

UNKNOWN = bytes.fromhex("4018100700000000")


@pytest.fixture
def rig():
    with golden("cia402") as path, Rig(with_recorded(described("cia402"), path)) as opened:
        opened.runtime.run_for(0.5)
        yield opened


def tell(rig, node, data):
    DrivenRig(rig).send("can0", classic(0x600 + node, data))
    rig.runtime.run_for(0.01)


def commands(rig, name):
    """Return (index, request) of the controller's SDO writes."""
    told = [step for step in players(rig)[name].log.steps if step.role is Role.COMMAND]
    return [(number, step.turns[0].asked[8:16]) for number, step in enumerate(told) if step.turns]


def test_unanswered_commands_are_listed_by_time(rig):
    for node in (1, 2, 1):
        tell(rig, node, UNKNOWN)
    assert [one.controller for one in unanswered(rig)] == ["left", "right", "left"]
    lines = list(summary(rig))
    assert lines[0] == "2 recorded controllers: 3 of 3 commands not in the recording; first:"
    assert lines[1].startswith("left at 0.5")


def test_summary_names_commands_that_never_came(rig):
    missing = never_came(rig)
    first, *told = list(summary(rig))[1:]
    assert first == f"{len(missing)} commands of the recording never came; first:"
    assert told == [
        f"  {name}, at {step.time_ns / 1e9:.6f} s of it: {step.text}" for name, step in missing[:5]
    ]
    (place, request), *_ = [one for one in commands(rig, "left") if one[0] > 3]
    tell(rig, 1, request)
    left = [step for name, step in never_came(rig) if name == "left"]
    assert len(never_came(rig)) == len(missing) - 1
    assert len([step for step in left if step.time_ns <= left[place].time_ns]) == place + 1
    tell(rig, 1, UNKNOWN)
    assert next(summary(rig)).startswith("2 recorded controllers: 1 of 2 commands not in")


@pytest.mark.parametrize(
    ("failure", "is_told"),
    [("", False), ("left: it has a fault", True), ("leftover", False), ("right is away", False)],
)
def test_summary_lists_last_answers_of_failing_controller(rig, failure, is_told):
    tell(rig, 1, commands(rig, "left")[0][1])
    told = [line for line in summary(rig, failure) if "answered last" in line]
    assert [line.split()[0] for line in told] == (["left"] if is_told else [])
