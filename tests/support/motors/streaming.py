"""Helpers for streaming tests: functions, a bus tap, an argument that jumps."""

from collections.abc import Callable
from math import pi

from motorhil.harness.rig.rig import Rig
from motorhil.motorapi.adaptations.cia402.motor import Cia402Motor
from motorhil.motorapi.commands import ControlMode, ControlVariable
from motorhil.motorapi.functions import Function, Polynomial
from motorhil.motorapi.trajectory import ComplexTrajectory, MotorPosition

OpenRig = Callable[..., Rig]
MS = 1_000_000
INC_PER_RAD = 132_000 / (2 * pi)  # 2000 x 66, the emulated drive's default motor and gear
SYNC, LEFT, RIGHT = 0x080, 0x301, 0x302
EVERY_MS = "set_point_period_ms = 1\nservo_period_ms = 1"


def quintic(distance: float, duration_s: float) -> Function:
    """Return a function from rest to rest, without acceleration at either end."""
    shape = Polynomial((0.0, 0.0, 0.0, 10.0 * distance, -15.0 * distance, 6.0 * distance))
    return shape.scaled(duration_s).restricted(0.0, duration_s)


def motor_of(rig: Rig, name: str = "left") -> Cia402Motor:
    motor = rig.motors[name]
    assert isinstance(motor, Cia402Motor)
    return motor


def set_function(
    motor: Cia402Motor,
    function: Function,
    variable: ControlVariable = ControlVariable.POSITION,
    argument: MotorPosition | None = None,
    *,
    relative: bool = True,
) -> Cia402Motor:
    motor.set_control_mode(ControlMode.TRAJECTORY, variable)
    motor.set_trajectory(ComplexTrajectory(function, relative=relative), argument)
    return motor


class Tap:
    """The SYNCs and set-points on the bus: (time, identifier, controlword, target)."""

    def __init__(self, rig: Rig) -> None:
        self.frames: list[tuple[int, int, int, int]] = []
        rig.world.tap_frames(self._on_frame)

    def _on_frame(self, bus: str, time_ns: int, sender: str, frame: bytes) -> None:
        can_id = int.from_bytes(frame[:4], "little")
        if can_id in (SYNC, LEFT, RIGHT):
            target = int.from_bytes(frame[10:14], "little", signed=True)
            word = int.from_bytes(frame[8:10], "little")
            self.frames.append((time_ns, can_id, word, target))

    def latched(self, can_id: int) -> list[tuple[int, int]]:
        """Return (time of SYNC, target) of each latched set-point; two between SYNCs fail."""
        result, waiting = [], []
        for time_ns, found, _, target in self.frames:
            if found == can_id:
                waiting.append(target)
            elif found == SYNC and waiting:
                assert len(waiting) == 1, f"{len(waiting)} set-points before one SYNC"
                result.append((time_ns, waiting.pop()))
        assert not waiting
        return result


def demands(rig: Rig, name: str, for_s: float) -> list[float]:
    """Record the demand at every millisecond from now on [increments]."""
    result = []
    for _ in range(round(for_s * 1e3)):
        rig.runtime.run_for(1e-3)
        result.append(rig.controllers[name].snapshot()["demand_inc"])
    return result


class Jumps:
    """An argument that steps, unlike any motor."""

    name = "position of something"
    rate_max = 1.0

    def __init__(self) -> None:
        self.now = 0.0
        self.rate = 0.0

    def value(self) -> float:
        return self.now
