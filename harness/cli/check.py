"""The verb `check`: validates a rig file."""

import argparse
import json
import sys
from collections.abc import Mapping
from itertools import groupby
from pathlib import Path
from typing import TYPE_CHECKING

from motorhil.harness.cli.main import PASSED, WRONG_USAGE
from motorhil.harness.rig.config.toml import RigError

if TYPE_CHECKING:
    from motorhil.harness.rig.config.units import Comparison


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the arguments of `check`."""
    parser.add_argument("rig", type=Path, metavar="RIG", help="a rig file (TOML)")
    parser.add_argument("--json", action="store_true", help="print JSON")


def run(options: argparse.Namespace) -> int:
    """Build the rig with all controllers, and close it again; no time passes.

    Raises:
        RigError: the first error in the rig.
    """
    from motorhil.harness.rig.rig import Rig

    try:
        with Rig.open(options.rig) as rig:
            rig.build_motors()
            notes = rig.notes
            units = {motor: rig.compared_units(motor) for motor in rig.description.motors}
            counts = {
                "buses": len(rig.description.buses),
                "controllers": len(rig.description.controllers),
                "motors": len(rig.description.motors),
                "groups": len(rig.description.groups),
                "faults": len(rig.description.faults),
                "stimuli": len(rig.description.stimuli),
            }
            name = rig.description.name
    except RigError as error:
        if not options.json:
            raise
        print(json.dumps({"right": False, **_facts(error)}))
        return WRONG_USAGE
    if options.json:
        print(json.dumps({"right": True, "name": name, **counts, **_told(units), "notes": notes}))
        return PASSED
    for note in notes:
        print(note, file=sys.stderr)
    for text, motors in groupby(units, lambda motor: str(units[motor][0]) if units[motor] else ""):
        if text:
            print(f"{', '.join(motors)}: {text}")
    parts = [f"{count} {_form(word, count)}" for word, count in counts.items() if count]
    print(f"{options.rig}: {name}: {', '.join(parts)}")
    return PASSED


def _told(units: "Mapping[str, tuple[Comparison, ...]]") -> dict[str, object]:
    return {
        "units": {
            motor: [
                {"quantity": one.quantity, "unit": one.unit, "motor": one.motor, "drive": one.drive}
                for one in found
            ]
            for motor, found in units.items()
        }
    }


def _facts(error: RigError) -> dict[str, object]:
    return {
        "file": str(error.file),
        "line": error.line,
        "key": error.key,
        "message": error.message,
        "remedy": error.remedy,
    }


def _form(plural: str, count: int) -> str:
    if count != 1:
        return plural
    return {"buses": "bus", "stimuli": "stimulus"}.get(plural, plural.removesuffix("s"))
