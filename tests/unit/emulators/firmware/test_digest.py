"""The same commit has the same motion, to the last bit, in every process."""

import os
import subprocess
import sys

from tests.support.motion.scenario import digest


def test_digest_other_hash_seeds_is_equal():
    here = digest()
    for seed in ("1", "2"):
        result = subprocess.run(
            [sys.executable, "-m", "tests.support.motion.scenario"],
            env={**os.environ, "PYTHONHASHSEED": seed},
            capture_output=True,
            text=True,
            check=True,
        )
        assert result.stdout.strip() == here
