"""The verb `new`: creates a rig, its script, and CI jobs."""

import argparse
import sys
from pathlib import Path

from motorhil.harness.cli.main import PASSED
from motorhil.harness.rig.config.ros2_canopen import rig_of_bus
from motorhil.harness.rig.config.scaffold import CI_FILES, requirement, write_new_rig, write_rig
from motorhil.harness.rig.config.toml import RigError


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the arguments of `new`."""
    parser.add_argument(
        "folder", type=Path, nargs="?", metavar="DIR", help="the folder; created if missing"
    )
    kinds = parser.add_mutually_exclusive_group()
    kinds.add_argument(
        "--from",
        dest="source",
        type=Path,
        metavar="FILE",
        help="make the rig of ros2_canopen's bus.yml, in DIR or the current folder",
    )
    kinds.add_argument(
        "--ci",
        choices=list(CI_FILES),
        help=f"also write a CI job into the current folder: {' or '.join(CI_FILES.values())}; "
        "an existing rig in DIR is kept",
    )


def run(options: argparse.Namespace) -> int:
    """Write the files.

    Raises:
        RigError: the files exist already, or cannot be written.
    """
    if options.source is not None:
        return _from_bus(options.source, options.folder or Path())
    if options.folder is None:
        raise RigError(Path(), "no folder is named", "name a new one: motorhil new DIR")
    has_requirements = Path("requirements.txt").exists()
    for path in write_new_rig(options.folder, options.ci):
        print(path)
    rig, script = options.folder / "rig.toml", options.folder / "drive.py"
    if script.exists():
        print(f"next: motorhil run {rig} {script}", file=sys.stderr)
    line, command = requirement()
    if options.ci is not None and has_requirements:
        print(f"requirements.txt: was there; it must install {line} and pytest", file=sys.stderr)
    if options.ci is not None and command:
        print(f"before you push, commit what this makes: {command}", file=sys.stderr)
    return PASSED


def _from_bus(source: Path, folder: Path) -> int:
    text, notes = rig_of_bus(source, folder)
    for path in write_rig(folder, text):
        print(path)
    for note in notes:
        print(f"{source}: {note}", file=sys.stderr)
    rig = folder / "rig.toml"
    print(f"next: motorhil check {rig}, then motorhil serve {rig}", file=sys.stderr)
    return PASSED
