"""Command lines run by tests, in this process or in another one."""

import os
import select
import subprocess
import sys
from contextlib import contextmanager
from pathlib import Path

from tests.support.checkout import CHECKOUT, CORES


def environment():
    """Return an environment in which another process finds bench.py and its plugins."""
    folders = (Path.cwd().parent / "site", CORES, CHECKOUT)
    return {**os.environ, "PYTHONPATH": os.pathsep.join(map(str, folders))}


def in_another_process(*words, **options):
    pipe = subprocess.PIPE
    usual = {"env": environment(), "stdout": pipe, "stderr": pipe, "text": True, "timeout": 120}
    return subprocess.run([sys.executable, "-m", "motorhil", *words], **{**usual, **options})


def has_ended(pid):
    """Wait for the end of a process that is not a child of this one."""
    try:
        descriptor = os.pidfd_open(pid)
    except ProcessLookupError:
        return True
    try:
        return bool(select.select([descriptor], [], [], 10.0)[0])
    finally:
        os.close(descriptor)


INTERRUPTIBLE = (
    "import signal, sys\n"
    "signal.signal(signal.SIGINT, signal.default_int_handler)  # ignored in the background\n"
    "from motorhil.__main__ import start\n"
    "sys.exit(start())\n"
)


@contextmanager
def beside(*words):
    """Run the command in the background; kill it at the end of the context."""
    pipe = subprocess.PIPE
    command = [sys.executable, "-c", INTERRUPTIBLE, *words]
    with subprocess.Popen(
        command, env=environment(), stdout=pipe, stderr=pipe, text=True
    ) as process:
        try:
            yield process
        finally:
            process.kill()
