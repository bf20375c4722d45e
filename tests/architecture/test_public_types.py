"""Types of the public names, as pyright sees them in an application: all must be known."""

import json
import os
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

from tests.support.checkout import CHECKOUT

PATH = f"{Path(sys.executable).parent}{os.pathsep}{os.environ['PATH']}"
PYRIGHT = shutil.which("pyright", path=PATH)
JUDGE = ("--verifytypes", "motorhil", "--ignoreexternal", "--outputjson")


@pytest.mark.skipif(PYRIGHT is None, reason="pyright is not installed: pip install pyright[nodejs]")
def test_every_public_name_has_a_known_type(tmp_path):
    # a copy: pyright takes a linked folder for another package
    shutil.copytree(CHECKOUT / "motorhil", tmp_path / "motorhil")
    found = subprocess.run(
        [PYRIGHT, *JUDGE],
        cwd=tmp_path,
        env=os.environ | {"PATH": PATH, "PYTHONPATH": str(tmp_path)},
        capture_output=True,
        text=True,
    )
    judged = json.loads(found.stdout)["typeCompleteness"]
    assert judged["exportedSymbolCounts"]["withKnownType"] > 1000
    assert unknown(judged["symbols"]) == []
    assert found.returncode == 0


def unknown(symbols):
    return [
        f"{symbol['name']}: {error['message']}"
        for symbol in symbols
        for error in symbol["diagnostics"]
        if error["severity"] == "error"
    ]
