"""The verb `new`: creates a rig, its script and CI jobs, programs, or packages for new drives."""

import argparse
import json
import shlex
import sys
from pathlib import Path

from motorhil.harness.cli.main import PASSED
from motorhil.harness.plugins import ADAPTATIONS, CONTROLLERS, installed
from motorhil.harness.rig.config.ros2_canopen import rig_of_bus
from motorhil.harness.rig.config.scaffold import (
    CI_FILES,
    requirement,
    write_new_drive,
    write_new_rig,
    write_program,
    write_rig,
)
from motorhil.harness.rig.config.toml import RigError


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the arguments of `new`."""
    parser.add_argument(
        "folder", type=_folder, nargs="?", metavar="DIR", help="the folder; created if missing"
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
    kinds.add_argument(
        "--drive",
        metavar="NAME",
        help="write a package for a kind of drive that motorhil does not know, into DIR or "
        "motorhil-NAME: an adaptation and an emulated drive, which work at once",
    )
    kinds.add_argument(
        "--excite",
        metavar="MOTOR",
        help="write the application that moves this motor of DIR/rig.toml so that `identify` sees "
        "inertia and friction, within the limits of its model",
    )
    parser.add_argument("--json", action="store_true", help="print JSON")


def _folder(text: str) -> Path:
    if not text:
        raise argparse.ArgumentTypeError("an empty name; name a folder, or . for this one")
    return Path(text)


def run(options: argparse.Namespace) -> int:
    """Write the files.

    Raises:
        RigError: the files exist already, or cannot be written.
    """
    if options.source is not None:
        return _from_bus(options.source, options.folder or Path(), as_json=options.json)
    if options.drive is not None:
        return _drive(options.folder, options.drive, as_json=options.json)
    if options.excite is not None:
        return _excite(options.folder or Path(), options.excite, as_json=options.json)
    if options.folder is None:
        raise RigError(Path(), "no folder is named", "name a new one: motorhil new DIR")
    has_requirements = Path("requirements.txt").exists()
    files = [str(path) for path in write_new_rig(options.folder, options.ci)]
    rig, script = options.folder / "rig.toml", options.folder / "drive.py"
    command = ["motorhil", "run", str(rig), str(script)] if script.exists() else None
    if options.json:
        print(json.dumps({"files": files, "next": command}))
    else:
        print("\n".join(files))
    if command is not None:
        print(f"next: {shlex.join(command)}", file=sys.stderr)
    line, wheel = requirement()
    if options.ci is not None and has_requirements:
        print(f"requirements.txt: was there; it must install {line} and pytest", file=sys.stderr)
    if options.ci is not None and wheel:
        print(f"before you push, commit what this makes: {wheel}", file=sys.stderr)
    return PASSED


def _drive(folder: Path | None, name: str, *, as_json: bool) -> int:
    folder = Path(f"motorhil-{name}") if folder is None else folder
    _refuse_installed(folder, name)
    files = [str(path) for path in write_new_drive(folder, name)]
    command = ["pip", "install", "-e", str(folder)]
    print(json.dumps({"files": files, "next": command}) if as_json else "\n".join(files))
    print(f"next: {shlex.join(command)}, then read {folder / 'README.md'}", file=sys.stderr)
    return PASSED


def _refuse_installed(folder: Path, name: str) -> None:
    """Raise RigError if the name is one of a plugin, which would hide the new one."""
    for group in (ADAPTATIONS, CONTROLLERS):
        known = installed(group).get(name)
        if known is not None:
            what = f"{name!r} is a kind of {known.package or known.target}, which is installed"
            raise RigError(folder, what, "use another name; the new package would not be found")


def _from_bus(source: Path, folder: Path, *, as_json: bool) -> int:
    text, notes = rig_of_bus(source, folder)
    files = [str(path) for path in write_rig(folder, text)]
    rig = folder / "rig.toml"
    if as_json:
        print(json.dumps({"files": files, "next": ["motorhil", "check", str(rig)]}))
    else:
        print("\n".join(files))
    for note in notes:
        print(f"{source}: {note}", file=sys.stderr)
    print(f"next: motorhil check {rig}, then motorhil serve {rig}", file=sys.stderr)
    return PASSED


def _excite(folder: Path, motor: str, *, as_json: bool) -> int:
    from motorhil.harness.identification.excitation import application_for, script_of
    from motorhil.harness.rig.reading import describe, read_models

    rig = folder / "rig.toml"
    description = describe(rig)
    text = application_for(description, motor, read_models(description))
    script = folder / script_of(motor)
    files = [str(path) for path in write_program(script, text)]
    recording = folder / f"{motor}.mcap"
    command = ["motorhil", "run", str(rig), str(script), "-o", str(recording)]
    print(json.dumps({"files": files, "next": command}) if as_json else "\n".join(files))
    print(f"next: {shlex.join(command)}", file=sys.stderr)
    return PASSED
