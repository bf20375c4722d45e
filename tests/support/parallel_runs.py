"""Processes that run motorhil in parallel, each with its own hash seed."""

import os
import subprocess
import sys
from pathlib import Path

from tests.support.checkout import CHECKOUT

INSTALLED = "import sys; from motorhil.harness.cli.main import main; sys.exit(main())"
FROM_SOURCES = f"import sys; sys.path.insert(0, {str(CHECKOUT)!r}); " + INSTALLED.split("; ", 1)[1]


def start(folder: Path, hash_seed: int, *words, program=INSTALLED, text=None):
    """Start motorhil in `folder`, which is created; `text` is its standard input."""
    folder.mkdir(parents=True, exist_ok=True)
    process = subprocess.Popen(
        [sys.executable, "-P", "-c", program, *words],
        cwd=folder,
        env={**os.environ, "PYTHONHASHSEED": str(hash_seed)},
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
    )
    process.stdin.write(text or "")
    process.stdin.close()
    process.stdin = None
    return process


def outputs(processes):
    """Wait for all processes, check that they passed, and return their outputs."""
    done = [(*process.communicate(timeout=250), process.returncode) for process in processes]
    for _, err, status in done:
        assert status == 0, err
        assert "Traceback" not in err
    return [out for out, _, _ in done]
