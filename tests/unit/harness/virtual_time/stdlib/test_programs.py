"""Independent programs on the rig that `motorhil new` writes."""

import os
import subprocess
import sys
from importlib.resources import files
from pathlib import Path

from motorhil import emulators
from motorhil.traces.digest import digest

HERE = Path(__file__).parents[4] / "support" / "programs" / "unmodified"
EDS = str(files(emulators) / "eds" / "motorhil_cia402.eds")
RIG = str(files("motorhil.harness") / "examples" / "two_wheels.toml")

# Two drives with one identity answer the request for the node-ID at once. They destroy each other's
# frames until one is error passive (ISO 11898-1), which takes a millisecond.
MOVED = """\
booted at 0.3 s; LSS finds node 1
OPERATIONAL, EMCY: None
50000 at 2.323 s
0 at 3.083 s
31 places seen, the farthest 49987
"""
HEARD = """\
{'581': 8, '701': 1, '702': 1} 10
21 heard, 0.0 s late; 3.00 s
"""

AWAITED = """\
{'581': 5, '701': 1, '702': 1} 0.0 s late
TimeoutError; 1.70 s
"""


def run_alone(hash_seed, *command):
    done = subprocess.run(
        [sys.executable, "-m", "motorhil", "run", *command],
        env={**os.environ, "PYTHONHASHSEED": hash_seed},
        capture_output=True,
        text=True,
        check=False,
    )
    return done.returncode, done.stdout, done.stderr


def test_canopen_program_gives_equal_records_in_each_process(tmp_path):
    digests = []
    for seed in ("1", "2"):
        record = tmp_path / f"{seed}.mcap"
        command = (RIG, str(HERE / "profile_move.py"), "-o", str(record), "--", EDS)
        assert run_alone(seed, *command) == (0, MOVED, "")
        digests.append(digest(str(record)))
    assert digests[0] == digests[1]


def test_python_can_program_receives_and_sends_cyclically(say):
    assert say("run", RIG, str(HERE / "listening.py")) == (0, HEARD, "")


def test_asyncio_program_gives_equal_records_in_each_process(tmp_path):
    digests = []
    for seed in ("1", "2"):
        record = tmp_path / f"{seed}.mcap"
        command = (RIG, str(HERE / "asyncio_listening.py"), "-o", str(record))
        assert run_alone(seed, *command) == (0, AWAITED, "")
        digests.append(digest(str(record)))
    assert digests[0] == digests[1]


def test_random_numbers_depend_on_rig_seed(tmp_path, say):
    (tmp_path / "dice.py").write_text("import random\nprint(random.randrange(10**9))\n")
    said = [say("run", RIG, str(tmp_path / "dice.py"), "--seed", seed) for seed in "112"]
    assert said[0] == said[1] != said[2]
