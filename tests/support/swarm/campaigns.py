"""Campaigns of `motorhil swarm` in the tests: a hasty program, and folders written by hand."""

from dataclasses import replace
from pathlib import Path

from motorhil.harness.swarm.plan import FUNCTION, Plan, Program
from motorhil.harness.swarm.results import Results, create
from motorhil.harness.swarm.row import CANARY, Result, Row
from motorhil.harness.swarm.worlds.disturbance import Disturbance
from motorhil.harness.swarm.worlds.marks import Traffic
from motorhil.harness.swarm.worlds.profile import Profile, Subject

HASTY = """\
from math import pi

from motorhil import always, sometimes
from motorhil.motorapi import ControlMode, MotorError


def run(rig):
    left = rig.motors["left"]
    try:
        left.enable()
        left.set_control_mode(ControlMode.SETPOINT)
        left.set_setpoint(0.2)
        left.start()
        left.wait_until_done(timeout_s=1.0)
    except MotorError as error:
        sometimes(True, "a command has failed")
        print(error)
    sometimes(left.position() < -100.0, "left is behind")
    always(abs(left.position() - 0.2) < 0.01, "left arrives")
"""
DROP = Disturbance(
    "drop", "can0", (("sender", "left"), ("identifier", 0x581), ("skip", 1), ("limit", 1))
)
CUT = Disturbance("cut", "can0", (("node", "left"), ("at_s", 0.5), ("for_s", 0.02)))
PROFILE = Profile(
    2_000_000_000,
    (),
    (Traffic("can0", "left", 0x581, 40),),
    (Subject("left", "can0", ("load_torque_n_m",), (), True, (), 10.0, 0.0),),
    False,
)
PLAN = Plan("rig.toml", Program(FUNCTION, "errand:run"), build="1.0 abc", profile=PROFILE)
FOUND = Row(CANARY, Result.FAILED, "always", "always | x | - | - | -", "always, limit-velocity")


def failure(seed=17, oracle="always", text="PropertyViolated: left arrives (errand.py:9)", **more):
    """Return the row of a failure."""
    signature = f"{oracle} | {text} | - | 4m | drop 580h"
    row = Row(seed, Result.FAILED, oracle, signature, text, 1_052_100_000, 2_000_000_000)
    return replace(row, **{"acts": (("drop", 1),), "world": (DROP,), **more})


def written(folder: Path, rows=(), plan: Plan = PLAN) -> Results:
    """Return the results of a campaign with these rows, in a new folder."""
    results = create(folder, plan)
    results.append(rows)
    return results
