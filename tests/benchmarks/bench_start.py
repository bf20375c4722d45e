"""Modules and calls of one `Motor.start()` on CiA 402, cold and warm.

A cold start connects and enables the drive. A warm start is the second one of an enabled motor in
the same mode. Only modules of motorhil.motorapi count: the rest belongs to libraries and the rig.
"""

import sys
from collections.abc import Callable, Iterator
from math import pi
from pathlib import Path
from types import FrameType
from typing import Final

from motorhil.harness.rig.rig import Rig
from motorhil.motorapi import ControlMode

_RIG: Final = Path(__file__).parents[2] / "harness/examples/two_wheels.toml"
_PACKAGE: Final = "motorhil.motorapi"


def run() -> Iterator[tuple[str, float, str]]:
    """Yield the modules and the calls of a cold and of a warm start."""
    for kind, visited in zip(("cold", "warm"), starts(), strict=True):
        yield f"{kind} start of a CiA 402 motor: modules", len(visited), ""
        yield f"{kind} start of a CiA 402 motor: calls", sum(visited.values()), ""


def starts() -> tuple[dict[str, int], dict[str, int]]:
    """Return the calls in each module during a cold and a warm start."""
    with Rig.open(_RIG) as rig:
        motor = rig.motors["left"]
        motor.set_control_mode(ControlMode.SETPOINT)
        motor.set_setpoint(2.0 * pi)
        cold = visited_by(motor.start)
        motor.wait_until_done(timeout_s=10.0)
        motor.set_setpoint(pi)
        return cold, visited_by(motor.start)


def visited_by(action: Callable[[], object]) -> dict[str, int]:
    """Run `action`. Return the number of calls in each module of the package."""
    visited: dict[str, int] = {}

    def count(frame: FrameType, event: str, _: object) -> None:
        module = frame.f_globals.get("__name__", "")
        if event == "call" and module.startswith(_PACKAGE):
            visited[module] = visited.get(module, 0) + 1

    sys.setprofile(count)
    try:
        action()
    finally:
        sys.setprofile(None)
    return visited
