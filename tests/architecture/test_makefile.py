import shutil
import subprocess

import pytest

from tests.support.checkout import CHECKOUT


@pytest.mark.skipif(shutil.which("make") is None, reason="make is not installed")
def test_makefile_has_one_recipe_for_each_target():
    done = subprocess.run(
        ["make", "-n", "-o", ".venv/.ready", "check"], cwd=CHECKOUT, capture_output=True, text=True
    )
    assert (done.returncode, done.stderr) == (0, "")
