"""Rigs of two of our drives for the host's side, and strangers on their bus."""

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from tempfile import TemporaryDirectory

from emulators.media.faults import FaultRule
from harness.rig import Rig
from motorapi import ControlMode, Motor, TrapezoidalTrajectory
from tests.crosscheck.wire import frame
from tests.motorapi.adaptations.conftest import HEAD, drive

INC_PER_RAD = 21_008.45
"""Of these wheels: 2000 increments a turn, 66 turns of the motor a turn of the wheel."""


@contextmanager
def two_drives(*rules: FaultRule, seed: int = 1) -> Iterator[Rig]:
    """Drives "left" (node 1) and "right" (node 2), enabled before anything goes wrong."""
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
    """Somebody else on the bus: says frames, one after another, and lets them pass."""
    port = rig.world.add_host("can0", "stranger", lambda *_: None)

    def say(*texts: str) -> None:
        for text in texts:
            port.send(frame(text))
            rig.runtime.run_for(0.003)

    return say


def moving(motor: Motor, distance: float = 1.0) -> Motor:
    """The motor is 0.2 s into a trajectory over `distance` [rad]."""
    motor.set_control_mode(ControlMode.TRAJECTORY)
    motor.set_trajectory(TrapezoidalTrajectory(distance))
    motor.start()
    motor.runtime.run_for(0.2)
    return motor


def demand(rig: Rig, name: str = "left") -> float:
    """What the drive aims at now [increments]."""
    return rig.controllers[name].snapshot()["demand_inc"]


def is_at_rest(rig: Rig, *names: str) -> bool:
    """Whether nothing moves in 0.2 s."""
    before = [demand(rig, name) for name in names]
    rig.runtime.run_for(0.2)
    return before == [demand(rig, name) for name in names]
