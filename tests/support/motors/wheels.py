"""Two wheels on CiA 402 drives: helpers to observe and move them."""

from math import pi

from motorhil.harness.rig.rig import Rig
from motorhil.motorapi.adaptations.cia402.motor import Cia402Motor
from motorhil.motorapi.commands import ControlMode, DerivativeLimits
from motorhil.motorapi.motor import Motor

MS = 1_000_000
INCREMENT_RAD = 2 * pi / 132_000  # 2000 x 66, the emulated drive's default motor and gear
WINDOW_RAD = 10 * INCREMENT_RAD  # its position window: "at the target" is within it


def motor_of(rig: Rig, name: str = "left") -> Cia402Motor:
    motor = rig.motors[name]
    assert isinstance(motor, Cia402Motor)
    return motor


def truth(rig: Rig, name: str = "left") -> float:
    return rig.controllers[name].snapshot()["position_rad"]


def go_to(motor: Motor, target: float, limits: DerivativeLimits | None = None) -> None:
    motor.set_control_mode(ControlMode.SETPOINT)
    motor.set_setpoint(target, limits=limits)
    motor.start()


def frames_on(rig: Rig) -> list[tuple[int, str, int, bytes]]:
    """Record (time, sender, identifier, data) of every frame from now on."""
    heard: list[tuple[int, str, int, bytes]] = []

    def on_frame(bus: str, time_ns: int, sender: str, frame: bytes) -> None:
        can_id = int.from_bytes(frame[:4], "little")
        heard.append((time_ns, sender, can_id, frame[8 : 8 + frame[4]]))

    rig.world.tap_frames(on_frame)
    return heard
