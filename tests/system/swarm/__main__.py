"""Runs the correct programs in worlds with new seeds, and keeps what fails.

    python -m tests.system.swarm --first SEED --seeds N

Each failure is made small and appended to `kept.toml`, where a test repeats it from then on.
"""

import argparse
import sys
from functools import partial
from pathlib import Path

from motorhil.harness import examples
from motorhil.harness.swarm.campaign import with_profile
from motorhil.harness.swarm.plan import SCRIPT, Program, plan_of
from motorhil.harness.swarm.worlds.disturbance import fragment
from motorhil.harness.swarm.worlds.shrinking import cause_of, shrunk
from tests.system.swarm.defects import CORRECT, Defect
from tests.system.swarm.kept import KeptWorld, keep
from tests.system.swarm.measure import WALL_S, campaign, plan_for, run_forked

EXAMPLES = Path(examples.__file__).parent
SCRIPTS = {"two_wheels": ("two_wheels.toml", "two_wheels.py")}


def plan_named(name):
    """Return the program of this name, and its plan."""
    if name not in SCRIPTS:
        return CORRECT[name], plan_for(CORRECT[name])
    rig, script = (EXAMPLES / file for file in SCRIPTS[name])
    plan = with_profile(plan_of(rig, Program(SCRIPT, str(script)), (), WALL_S))
    return Defect(name, str(script), rig, "", ()), plan


def main():
    """Run all; return 1 if anything failed."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("names", nargs="*")
    parser.add_argument("--first", type=int, required=True)
    parser.add_argument("--seeds", type=int, default=200)
    options = parser.parse_args()
    failed = False
    for name in options.names or [*CORRECT, *SCRIPTS]:
        one, plan = plan_named(name)
        seeds = range(options.first, options.first + options.seeds)
        found = campaign(one, plan, seeds, guided=True, stops=False)
        causes = {cause_of(row): row for row in reversed(found.others)}
        print(f"{name}: {found.worlds} worlds, {len(found.others)} failures", flush=True)
        for cause, row in causes.items():
            failed = True
            small = shrunk(row, partial(run_forked, plan, row.seed))
            print(f"  {cause}: seed {row.seed}: {small.text}", flush=True)
            keep(KeptWorld(name, row.seed, "", small.text, fragment(small.world)))
    return int(failed)


if __name__ == "__main__":
    sys.exit(main())
