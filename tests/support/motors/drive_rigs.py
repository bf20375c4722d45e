"""Rigs for the adaptation tests: emulated drives on one bus."""

from collections.abc import Callable, Iterator
from contextlib import ExitStack
from pathlib import Path

import pytest

from motorhil.harness.rig.rig import Rig

HEAD = """
[rig]
name = "adaptations"
seed = 1
[bus.can0]
bitrate_bit_s = 1_000_000
"""
DRIVE = """
[controller.{name}]
kind = "cia402"
bus = "can0"
node_id = {node_id}
{controller}
[motor.{name}]
adaptation = "cia402"
controller = "{name}"
{motor}
[motor.{name}.model]
name = "wheel"
velocity_max_rad_s = 3.0
acceleration_max_rad_s2 = 10.0
{model}
"""


def drive(name: str, node_id: int, controller: str = "", motor: str = "", model: str = "") -> str:
    """Return the rig text of one drive and its motor."""
    return DRIVE.format(name=name, node_id=node_id, controller=controller, motor=motor, model=model)


@pytest.fixture
def open_rig(tmp_path: Path) -> Iterator[Callable[..., Rig]]:
    """Open rigs from the text of their files; close all at the end."""
    with ExitStack() as stack:

        def opened(*parts: str) -> Rig:
            path = tmp_path / "rig.toml"
            path.write_text(HEAD + "".join(parts))
            return stack.enter_context(Rig.open(path))

        yield opened
