"""Measures how many worlds find each planted defect, with guidance and without, in one run.

    python -m tests.system.swarm.measure [NAME ...] --seeds 2000 --first 0 --correct

A campaign stops at the first failure with a right cause. Failures with others are counted.
"""

import argparse
import json
import sys
from dataclasses import dataclass, field, replace
from functools import partial
from importlib import import_module
from pathlib import Path
from tempfile import TemporaryDirectory

from motorhil.harness.rig.reading import describe
from motorhil.harness.swarm import trial
from motorhil.harness.swarm.campaign import with_profile
from motorhil.harness.swarm.child import call_forked
from motorhil.harness.swarm.lanes import Lane, lane_of
from motorhil.harness.swarm.plan import FUNCTION, Program, plan_of
from motorhil.harness.swarm.row import Result, Row, row_from
from motorhil.harness.swarm.worlds.disturbance import fragment
from motorhil.harness.swarm.worlds.shrinking import cause_of, shrunk
from tests.system.swarm.defects import CORRECT, DEFECTS

for _module in ("carriage", "gate", "line", "joint", "adaptations", "kinds"):
    if (Path(__file__).parent / "defects" / f"{_module}.py").exists():
        import_module(f"tests.system.swarm.defects.{_module}")
WALL_S = 60.0
SHOWN = 10


@dataclass
class Found:
    """The result of a campaign.

    worlds: how many ran, the last one included.
    row: the first failure with a right cause, or None.
    others: failures with other causes.
    rows: all rows, with what is new in each lane.
    """

    worlds: int = 0
    row: Row | None = None
    others: list[Row] = field(default_factory=list)
    rows: list[Row] = field(default_factory=list)


def plan_for(one):
    """Return the plan of a defect, with the profile of its undisturbed run, which must pass."""
    return with_profile(plan_without_profile(one))


def plan_without_profile(one):
    """Return the plan of a defect, enough to run given worlds."""
    return plan_of(one.rig, Program(FUNCTION, one.target), (), WALL_S)


def run_forked(plan, seed, world):
    """Return the row of a world that runs in a child of this process."""
    with TemporaryDirectory() as folder:
        run = partial(trial.tried, plan, seed, world, Path(folder))
        ended = call_forked(lambda: run().as_line(), plan.wall_s)
    if ended.text is None:
        return Row(seed, Result.TIMEOUT if ended.is_late else Result.KILLED, world=world)
    return row_from(ended.text)


def campaign(one, plan, seeds, *, guided, stops=True):
    """Run the seeds as a campaign does, one after another; by default up to the first find."""
    table = describe(one.rig).world.swarm
    lanes: dict[int, Lane] = {}
    found = Found()
    for seed in seeds:
        lane = lanes.setdefault(lane_of(seed), Lane())
        world = lane.world(seed, plan.profile, table, guided)
        row = run_forked(plan, seed, world)
        new = tuple(pair for pair in row.new if pair not in lane.seen)
        found.rows.append(replace(row, new=new))
        lane.learn(found.rows[-1])
        found.worlds += 1
        if not row.is_bad:
            continue
        row = replace(row, world=world)
        if one.causes and cause_of(row).startswith(one.causes) and _is_its_own(one, row):
            found.row = found.row or row
            if stops:
                break
        else:
            found.others.append(row)
            if len(found.others) <= SHOWN:
                print(f"OTHER {shown(row)}", file=sys.stderr, flush=True)
    return found


def _is_its_own(one, row):
    """Return True if the correct application passes the same world."""
    plan = plan_without_profile(CORRECT[one.base])
    return not run_forked(plan, row.seed, row.world).is_bad


def shown(row):
    """Return a row in two lines."""
    world = fragment(row.world).replace("\n\n", "\n")
    return f"seed {row.seed}: {row.signature}\n    {row.text}\n{world}"


def main():
    """Measure, and print a line for each defect."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("names", nargs="*")
    parser.add_argument("--seeds", type=int, default=2000)
    parser.add_argument("--first", type=int, default=0)
    parser.add_argument("--repeat", type=int, default=1)
    parser.add_argument("--correct", action="store_true")
    parser.add_argument("--guided-only", action="store_true")
    parser.add_argument("--shrink", action="store_true")
    parser.add_argument("--fast", action="store_true", help="no oracles of recordings")
    options = parser.parse_args()
    if options.fast:
        trial.judge = lambda *_, **__: ()
        trial.digest = lambda _: ""
    known = CORRECT if options.correct else DEFECTS
    for name in options.names or known:
        one = known[name]
        plan = plan_for(one)
        table = {"name": name}
        for guided in (True,) if options.guided_only or options.correct else (True, False):
            key = "guided" if guided else "random"
            for number in range(options.repeat):
                first = options.first + number * 100_000
                seeds = range(first, first + options.seeds)
                found = campaign(one, plan, seeds, guided=guided, stops=not options.correct)
                table.setdefault(key, []).append(found.worlds if found.row else None)
                if guided and found.row and "cause" not in table:
                    table["cause"] = found.row.signature
                    if options.shrink:
                        again = partial(run_forked, plan, found.row.seed)
                        small = shrunk(found.row, again)
                        table["drawn"] = len(found.row.world)
                        table["small"] = len(small.world)
                        table["world"] = [one.as_table() for one in small.world]
                table[f"{key}_others"] = table.get(f"{key}_others", 0) + len(found.others)
        print(json.dumps(table), flush=True)


if __name__ == "__main__":
    main()
