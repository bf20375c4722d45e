"""Helpers for tests of low-level access: a motion, and the host's frames."""

from collections.abc import Callable

from motorhil.harness.rig.rig import Rig
from motorhil.motorapi.commands import ControlMode
from motorhil.motorapi.motor import Motor

OpenRig = Callable[..., Rig]
SPARED = {0x080: "SYNC", 0x77F: "the host's heartbeat"}


def go_to(motor: Motor, target: float) -> None:
    motor.set_control_mode(ControlMode.SETPOINT)
    motor.set_setpoint(target)
    motor.start()


def sent_on(rig: Rig) -> list[tuple[int, int, bytes]]:
    """Record (time, identifier, data) of the host's frames, except SYNC and its heartbeat."""
    heard: list[tuple[int, int, bytes]] = []

    def on_frame(bus: str, time_ns: int, sender: str, frame: bytes) -> None:
        can_id = int.from_bytes(frame[:4], "little")
        if sender == "host" and can_id not in SPARED:
            heard.append((time_ns, can_id, frame[8 : 8 + frame[4]]))

    rig.world.tap_frames(on_frame)
    return heard
