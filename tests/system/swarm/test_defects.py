"""A swarm finds planted defects, and nothing in the programs without them."""

import pytest

from motorhil.harness.rig.reading import describe
from motorhil.harness.swarm.lanes import Lane
from motorhil.harness.swarm.trial import tried_in
from motorhil.harness.swarm.worlds.disturbance import Disturbance
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


def test_reactions_are_what_a_program_sends_after_a_fault():
    fault = Disturbance("fault", "left", (("code", 0x5441), ("at_s", 0.8)))
    row = run_forked(plan_without_profile(CORRECT["carriage"]), 1, (fault,))
    marks = {(one.sender, one.identifier): one.marks for one in row.reactions}
    assert marks["host", 0x202][0][1] == pytest.approx(0.8, abs=1e-3)  # the other wheel is halted
    reset_s = marks["left", 0x81][1][1]  # an EMCY without an error, after the one with the fault
    assert next(at_s for _, at_s in marks["host", 0x601]) < reset_s
    times = [at_s for one in row.reactions for _, at_s in one.marks]
    assert 0.8 <= min(times) <= max(times) <= 2.8
    assert "stimulus fault at come_to_rest | command 200h" in row.new
    assert "stimulus fault at clear | command 600h" in row.new


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
