"""Entry point of `python -m motorhil`, the same as `motorhil`."""

import gc
import os
import sys
import threading
from pathlib import Path

ALLOCATIONS = 10_000
"""Objects between two garbage collections; at 700, imports take a seventh longer."""


def start() -> int:
    """Run the command line and return its exit status; handle Ctrl-C even during imports.

    The command `motorhil` of a clone takes its compiled cores; `python -m motorhil` does not.
    """
    gc.set_threshold(ALLOCATIONS)
    try:
        clone = Path(__file__).absolute().parents[1]
        if (clone / ".venv-compiled").exists() and Path(sys.argv[0]).name == "motorhil":
            from motorhil.compiled import run_compiled

            run_compiled(clone)
        from motorhil.harness.cli.main import main
    except KeyboardInterrupt:
        sys.stderr.write("motorhil: interrupted\n")
        return 130
    status = main()
    others = [thread for thread in threading.enumerate() if thread is not threading.main_thread()]
    if status == 130 and not all(thread.daemon for thread in others):
        sys.stdout.flush()
        sys.stderr.flush()
        os._exit(status)  # Python would wait for a thread that cannot be ended
    return status


if __name__ == "__main__":
    sys.exit(start())
