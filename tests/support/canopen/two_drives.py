"""Rigs of two drives for tests of the host, and foreign nodes."""

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from tempfile import TemporaryDirectory

from motorhil.emulators.can.fault_rules import FaultRule
from motorhil.harness.rig.rig import Rig
from motorhil.motorapi import ControlMode, Motor, TrapezoidalTrajectory
from tests.support.canopen.drive_wire import frame
from tests.support.motors.drive_rigs import HEAD, drive

INC_PER_RAD = 21_008.45
"""The increments per radian of these wheels: 2000 per motor turn, 66 motor turns per wheel turn."""


@contextmanager
def two_drives(*rules: FaultRule, seed: int = 1) -> Iterator[Rig]:
    """Yield drives "left" (node 1) and "right" (node 2), enabled without faults."""
    with TemporaryDirectory() as folder:
        path = Path(folder) / "rig.toml"
        head = HEAD.replace("seed = 1", f"seed = {seed}")
        path.write_text(head + drive("left", 1) + drive("right", 2))
        rig = Rig.open(path)
    with rig:
        for name in ("left", "right"):
            rig.motors[name].enable()
        for rule in rules:
            rig.faults.inject("can0", rule)
        yield rig


def stranger(rig: Rig) -> Callable[..., None]:
    """Send frames of a foreign node, one after another, and let them pass."""
    port = rig.world.add_host("can0", "stranger", lambda *_: None)

    def say(*texts: str) -> None:
        for text in texts:
            port.send(frame(text))
            rig.runtime.run_for(0.003)

    return say


def moving(motor: Motor, distance: float = 1.0) -> Motor:
    """Start a trajectory over `distance` [rad] and run 0.2 s of it."""
    motor.set_control_mode(ControlMode.TRAJECTORY)
    motor.set_trajectory(TrapezoidalTrajectory(distance))
    motor.start()
    motor.runtime.run_for(0.2)
    return motor


def demand(rig: Rig, name: str = "left") -> float:
    """Return the present demand of the drive [increments]."""
    return rig.controllers[name].snapshot()["demand_inc"]


def is_at_rest(rig: Rig, *names: str) -> bool:
    """Return whether the motors stay at rest for 0.2 s."""
    before = [demand(rig, name) for name in names]
    rig.runtime.run_for(0.2)
    return before == [demand(rig, name) for name in names]
