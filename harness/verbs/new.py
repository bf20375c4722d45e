"""`motorhil new DIR`: a working rig, and a script that drives it; and a CI job for both."""

import argparse
import sys
from pathlib import Path

from harness.exit_status import PASSED
from harness.scaffold import CI_FILES, write_new_rig


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """What `new` can be told."""
    parser.add_argument("folder", type=Path, metavar="DIR", help="where; it is made if missing")
    parser.add_argument(
        "--ci",
        choices=list(CI_FILES),
        help=f"also write a CI job into the current folder: {' or '.join(CI_FILES.values())}; "
        "a rig that is in DIR already stays as it is",
    )


def run(options: argparse.Namespace) -> int:
    """The files are written.

    Raises:
        RigError: they are there already, or cannot be written.
    """
    for path in write_new_rig(options.folder, options.ci):
        print(path)
    rig, script = options.folder / "rig.toml", options.folder / "drive.py"
    print(f"next: motorhil run {rig} {script}", file=sys.stderr)
    return PASSED
