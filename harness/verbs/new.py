"""`motorhil new DIR`: a working rig, and a script that drives it."""

import argparse
import sys
from pathlib import Path

from harness.exit_status import PASSED
from harness.scaffold import write_new_rig


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """What `new` can be told."""
    parser.add_argument("folder", type=Path, metavar="DIR", help="where; it is made if missing")


def run(options: argparse.Namespace) -> int:
    """The files are written.

    Raises:
        RigError: they are there already, or cannot be written.
    """
    files = write_new_rig(options.folder)
    for path in files:
        print(path)
    rig = next(path for path in files if path.name == "rig.toml")
    script = next(path for path in files if path.suffix == ".py")
    print(f"next: motorhil run {rig} {script}", file=sys.stderr)
    return PASSED
