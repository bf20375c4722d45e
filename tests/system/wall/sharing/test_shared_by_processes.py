"""Drives on a hub, shared by several programs."""

import os

import pytest

from motorhil.harness.rig.config.scaffold import EXAMPLES
from motorhil.harness.sharing_tests.bus_evidence import read_evidence
from motorhil.harness.sharing_tests.processes import Plan, run
from tests.support.served_hub import served

pytestmark = pytest.mark.wall

LONGER = int(os.environ.get("MOTORHIL_SHARING", "1"))
NODES = {"left": ("can0", 1), "right": ("can0", 2)}


@pytest.fixture
def shared(tmp_path):
    """Run a plan on a hub of two wheels; return its result and the evidence of the bus."""

    def on_hub(portion=1, **plan):
        path, record = tmp_path / f"hub{portion}", tmp_path / f"run{portion}.mcap"
        plan["seconds"] *= portion
        facts = {
            "channel": str(path),
            "model": str(EXAMPLES / "wheel_model.toml"),
            "node_ids": [1, 2],
        }
        facts |= plan["facts"]
        with served(EXAMPLES / "two_wheels.toml", path, "-o", record):
            outcome = run(Plan(**{**plan, "facts": facts}))
        print(outcome.table())
        outcome.require_sound()
        moved = {name: at for name, at in NODES.items() if at[1] in facts["node_ids"]}
        evidence = read_evidence(record, moved)
        print(evidence.table())
        evidence.require_sound()
        return outcome, evidence

    return on_hub


def test_groups_in_opposite_orders_never_deadlock(shared):
    rounds = 500 * LONGER
    outcome, evidence = shared(
        work="motorhil.harness.sharing_tests.workers:work_groups",
        workers=2,
        seconds=60.0 * LONGER,
        facts={"rounds": rounds, "move_every": 250},
    )
    assert outcome.reached()["read: done"] == 2 * rounds  # every round has ended
    assert outcome.counts["ended by itself"] == 2
    assert evidence.counts["left: own"] >= 4


def test_only_the_owner_commands_under_kills_and_takeovers(shared):
    for portion in (1, 3, 6):  # a busy machine gets more time
        outcome, evidence = shared(
            portion,
            work="motorhil.harness.sharing_tests.workers:work_motor",
            workers=4,
            seconds=8.0 * LONGER,
            kill_period_s=2.3,
            pause_period_s=1.1,
            pause_s=0.5,
            pause_inside=True,
            facts={"node_ids": [1], "lease_s": 0.2, "take_over": 0.1, "commands": 3},
        )
        reached = outcome.reached()
        enough = {
            "killed": reached["killed"] >= 1,
            "paused inside": reached["paused inside"] >= 1,
            "taken": reached["take: done from a living owner"] >= 1,
            "own": evidence.counts["left: own"] >= 20,
        }
        if all(enough.values()):
            return
    pytest.fail(f"too little of something: {enough}")
