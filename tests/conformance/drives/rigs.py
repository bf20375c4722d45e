"""Rigs of one correct drive each; the clauses for drives must accuse none of them."""

from collections.abc import Callable
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

from motorhil.harness.conformance.drives.target import DriveTarget
from motorhil.harness.conformance.target import Job

_RIG = """\
[rig]
name = "a drive"
seed = 1
[bus.can0]
bitrate_bit_s = 1_000_000
[controller.drive]
kind = "cia402"
bus = "can0"
node_id = 5
{keys}
"""
_PLANT = 'plant = { preset = "wheel_60w" }'

DRIVES: dict[str, str] = {
    "own": "",
    "switches": (
        "switches = { negative_limit_rad = -1.0, positive_limit_rad = 3.0,"
        " home_from_rad = 0.5, home_to_rad = 0.7, touch_probe_1_from_rad = 0.2,"
        " touch_probe_1_to_rad = 0.3, touch_probe_2_from_rad = -0.5, index_rad = 0.7 }"
    ),
    "own clock": "oscillator = { ppm = -8000.0 }",
    "units": (
        'objects = { "6081h" = 2000, "6083h" = 2000 }\n'
        "units = { position_unit_inc = 4.0, velocity_unit_inc_s = 10.0,"
        " acceleration_unit_inc_s2 = 100.0 }"
    ),
    "sync supervision": "cyclic = { sync_lost_periods = 3 }",
    "backlash": (
        'plant = { preset = "wheel_60w", backlash_rad = 0.0003,'
        " coupling_stiffness_n_m_rad = 2000.0, coupling_damping_n_m_s_rad = 5.0 }"
    ),
    "position and homing only": 'supported_modes = ["pp", "hm"]',
}
"""Keys of the controller by name."""


def text_of(keys: str = "") -> str:
    """Return the rig of a drive with these keys of its controller."""
    return _RIG.format(keys=keys if "plant = " in keys else f"{_PLANT}\n{keys}")


def target(keys: str = "") -> DriveTarget:
    """Return a drive as target of the kit, with these keys of its controller."""
    with TemporaryDirectory() as folder:
        rig = Path(folder, "rig.toml")
        rig.write_text(text_of(keys))
        return DriveTarget(Job(rig=str(rig), controller="drive"))


def opener(name: str) -> Callable[[], Any]:
    """Return an opener of benches with the drive of this name."""
    return target(DRIVES[name]).opener()
