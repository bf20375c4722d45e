"""The demo's drives with vendors' EDS files, and the units they imply."""

import json
import os
import tomllib
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

from harness.rig_file import Known, parse_rig
from harness.settings import RigError, Source
from harness.toml_text import with_table

if TYPE_CHECKING:
    from harness.rig_file import RigDescription

INCREMENTS_PER_TURN: Final = 2000  # of the motors in the demo's rigs


def with_eds(
    description: "RigDescription", files: Sequence[Path], known: Known
) -> "RigDescription":
    """Return the rig with these files assigned in turn to wheels, steering and mast.

    Drives and motor models get one set of units, whatever a file says: increments, and rpm of the
    motor. Most vendors mean rpm by limits such as 607Fh. The rig's text is changed accordingly,
    because a recording contains the text of the rig that ran.

    Raises:
        RigError: a file does not exist, or the rig has no drives.
    """
    path, text = description.source.path, description.source.text
    for file in files:
        if not file.is_file():
            raise RigError(file, "no such EDS file", "check the path given with --eds")
    if any(controller.kind != "cia402" for controller in description.controllers.values()):
        raise RigError(path, "has no drives", "use --eds with another --rig")
    kinds = list(dict.fromkeys(name.split("_")[0] for name in description.controllers))
    given = {kind: files[place % len(files)] for place, kind in enumerate(kinds)}
    unit_inc_s = INCREMENTS_PER_TURN / 60.0
    units = _inline(
        {
            "position_unit_inc": 1.0,
            "velocity_unit_inc_s": unit_inc_s,
            "acceleration_unit_inc_s2": unit_inc_s,
        }
    )
    for name in description.controllers:
        eds = os.path.relpath(given[name.split("_")[0]].absolute(), description.folder.absolute())
        lines = f"eds = {json.dumps(eds)}\nunits = {units}\n"
        text = with_table(text, f"controller.{name}", lines, ("eds", "units"))
    for name, motor in description.motors.items():
        model = _inline(_in_rpm(motor.model, unit_inc_s))
        text = with_table(text, f"motor.{name}", f"model = {model}\n", ("model",))
    return parse_rig(Source(path, text), known)


def _in_rpm(model: Path | Mapping[str, Any], unit_inc_s: float) -> dict[str, Any]:
    """Return the same motor model (a TOML table, hence Any) for a drive that counts in rpm."""
    table = tomllib.loads(model.read_text("utf-8")) if isinstance(model, Path) else dict(model)
    unit_rad_s = unit_inc_s / table["increments_per_rad"]
    return {**table, "velocity_unit_rad_s": unit_rad_s, "acceleration_unit_rad_s2": unit_rad_s}


def _inline(table: Mapping[str, Any]) -> str:
    """Return an inline TOML table of strings and numbers."""
    return "{ " + ", ".join(f"{key} = {json.dumps(value)}" for key, value in table.items()) + " }"
