"""One world in this process: strikes, places of failures, chance."""

import random
from pathlib import Path

import pytest

from motorhil.harness.cli.main import main
from motorhil.harness.swarm.plan import FUNCTION, SCRIPT, Program, plan_of
from motorhil.harness.swarm.trial import tried
from motorhil.harness.swarm.worlds.disturbance import Disturbance

BOOT_UP = (("sender", "left"), ("identifier", 0x701), ("skip", 0), ("limit", 5))
SPAN = ("for_s", 0.01)


def cut(at_s):
    return Disturbance("cut", "can0", (("node", "right"), ("at_s", at_s), SPAN))


def load(at_s):
    return Disturbance("load", "left", (("value", 1.0), ("at_s", at_s), SPAN))


CLOCK = Disturbance("clock", "left", (("ppm", 20.0),))
DROP = Disturbance("drop", "can0", BOOT_UP)
DEAF = Disturbance("drop", "can0", (*BOOT_UP[:2], ("skip", 9), ("limit", 1)))


@pytest.mark.parametrize(
    ("world", "acts"),
    [
        ((), {}),
        ((DROP,), {"drop": 1}),
        ((DEAF,), {"drop": 0}),
        ((DEAF, DROP), {"drop": 1}),
        ((cut(0.2), cut(0.5), cut(5.0)), {"cut": 2}),
        ((load(5.0), CLOCK, load(0.5)), {"load": 1, "clock": 1}),
    ],
)
def test_row_counts_strikes_until_the_end_of_its_run(tmp_path, monkeypatch, world, acts):
    monkeypatch.chdir(tmp_path)
    assert main(["new", "wheels"]) == 0
    Path("calm.py").write_text("import time\n\ntime.sleep(1.0)\n")
    plan = plan_of(Path("wheels/rig.toml"), Program(SCRIPT, "calm.py"), (), 60.0)
    row = tried(plan, 1, world, tmp_path)
    assert dict(row.acts) == acts
    assert row.end_ns == 1_000_000_000


def test_failure_in_a_library_is_at_the_line_of_the_program(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    assert main(["new", "wheels"]) == 0
    Path("parse.py").write_text("import json\n\njson.loads('{')\n")
    plan = plan_of(Path("wheels/rig.toml"), Program(SCRIPT, "parse.py"), (), 60.0)
    row = tried(plan, 1, (), tmp_path)
    assert row.signature.startswith("exception | JSONDecodeError at parse.py:3 | ")


def test_function_has_the_chance_of_its_seed(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    monkeypatch.syspath_prepend(tmp_path)
    assert main(["new", "wheels"]) == 0
    text = "import random\nfrom motorhil import sometimes\n\n\ndef dice(rig):\n"
    Path("chance.py").write_text(f"{text}    sometimes(True, str(random.random()))\n")
    plan = plan_of(Path("wheels/rig.toml"), Program(FUNCTION, "chance:dice"), (), 60.0)
    before = random.getstate()
    one, again, other = (tried(plan, seed, (), tmp_path).met for seed in (1, 1, 2))
    assert one == again != other
    assert random.getstate() == before
