"""A swarm finds planted defects, and nothing in the programs without them."""

import pytest

from motorhil.harness.rig.rig import describe
from motorhil.harness.swarm.lanes import Lane
from motorhil.harness.swarm.trial import tried_in
from motorhil.harness.swarm.worlds.shrinking import cause_of
from tests.system.swarm.defects import CORRECT, DEFECTS
from tests.system.swarm.kept import kept_worlds
from tests.system.swarm.measure import campaign, plan_for, plan_without_profile, run_forked

FOUND_WITHIN = {"SwallowsAnError": 16, "MovesTwice": 32, "RepeatsTheWholeWay": 64}
"""Seeds, at most, until the defect is found."""


@pytest.mark.parametrize("name", FOUND_WITHIN)
def test_swarm_finds_defect_and_correct_form_passes(name):
    defect = DEFECTS[name]
    plan = plan_for(defect)
    found = campaign(defect, plan, range(FOUND_WITHIN[name]), guided=True)
    assert found.row is not None, f"not found in {found.worlds} worlds"
    assert not found.others
    correct = plan_without_profile(CORRECT[defect.base])
    row = run_forked(correct, found.row.seed, found.row.world)
    assert not row.is_bad, row.text


@pytest.mark.parametrize("kept", kept_worlds(), ids=lambda kept: f"{kept.program}-{kept.seed}")
def test_kept_world_fails_for_its_defect_only(kept, tmp_path):
    path = tmp_path / "world.toml"
    path.write_text(kept.fragment)
    base = kept.program
    if kept.cause:
        row = tried_in(plan_without_profile(DEFECTS[kept.program]), kept.seed, path)
        assert cause_of(row).startswith(kept.cause), row.text
        base = DEFECTS[kept.program].base
    row = tried_in(plan_without_profile(CORRECT[base]), kept.seed, path)
    assert not row.is_bad, row.text


def test_worlds_of_a_lane_depend_on_its_rows_alone():
    defect = DEFECTS["SwallowsAnError"]
    plan = plan_for(defect)
    rows = campaign(defect, plan, range(0, 48, 16), guided=True, stops=False).rows
    lanes = Lane(), Lane()
    for row in rows:
        for lane in lanes:
            lane.learn(row)
    again = Lane(lanes[0].seen, lanes[0].corpus)
    table = describe(defect.rig).world.swarm
    assert lanes[1].world(48, plan.profile, table) == again.world(48, plan.profile, table)
