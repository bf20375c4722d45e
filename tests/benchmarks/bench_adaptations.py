"""Host-side costs: status frames, and SDO uploads over the emulated bus."""

import time
from pathlib import Path
from tempfile import TemporaryDirectory

from motorhil.harness.rig.rig import Rig
from motorhil.motorapi.adaptations.cia402.hardware import Cia402HwMotor
from motorhil.motorapi.adaptations.cia402.motion_status import SetpointWatch
from motorhil.motorapi.adaptations.cia402.motor import Cia402Motor
from motorhil.motorapi.commands import ControlMode
from motorhil.motorapi.model import MotorModel

FRAMES = 100_000
UPLOADS = 3_000
ROUNDS = 3
RIG = """
[rig]
name = "bench"
[bus.can0]
bitrate_bit_s = 1_000_000
[controller.drive]
kind = "cia402"
bus = "can0"
node_id = 3
"""


def run() -> list[tuple[str, float, str]]:
    """Return the figures as (name, figure, unit)."""
    with TemporaryDirectory() as folder:
        path = Path(folder) / "rig.toml"
        path.write_text(RIG)
        with Rig.open(path) as rig:
            hw = Cia402HwMotor(rig.bus("can0"), 3)
            rig.runtime.run_for(0.35)
            begun = time.process_time()
            hw.connect()
            figures = [("bringing a drive up, CPU", (time.process_time() - begun) * 1e3, "ms")]
            figures += _status_frames(hw)
            uploads = max(_uploads(hw) for _ in range(ROUNDS))
            figures.append(("SDO uploads, exact frames on the bus, full drive", uploads, "1/s"))
            figures.append(("start() of a move, CPU", _starts(hw), "ms"))
            hw.close()
    return figures


def _status_frames(hw: Cia402HwMotor) -> list[tuple[str, float, str]]:
    """Measure status frames through the link's dispatch, as the runtime delivers them."""
    on_frame = hw.link._on_frame
    still = b"\x83\x01\0\0\x06\0\0\0\x37\x06\x10\x27\0\0\0\0"
    other = b"\x83\x01\0\0\x06\0\0\0\x37\x02\x11\x27\0\0\0\0"
    figures = []
    for name, frames in (("unchanged", (still, still)), ("changing", (still, other))):
        for watched in (False, True):
            watch = SetpointWatch(
                commanded_ns=0,
                expected_ns=0,
                acknowledged=True,
                target_inc=0,
                tolerance_inc=0,
            )
            hw.follow(watch if watched else None)
            best = min(_time(on_frame, frames) for _ in range(ROUNDS))
            what = "in motion" if watched else "at rest"
            figures.append((f"status TPDO received, {name}, {what}", best * 1e6, "us"))
    hw.follow(None)
    return figures


def _time(on_frame, frames) -> float:  # type: ignore[no-untyped-def]
    begun = time.process_time()
    for number in range(FRAMES):
        on_frame(frames[number & 1], number, False)
    return (time.process_time() - begun) / FRAMES


def _uploads(hw: Cia402HwMotor) -> float:
    begun = time.process_time()
    for _ in range(UPLOADS):
        hw.upload(0x6064)
    return UPLOADS / (time.process_time() - begun)


def _starts(hw: Cia402HwMotor) -> float:
    motor = Cia402Motor(hw, MotorModel(name="wheel", velocity_max=3.0, acceleration_max=10.0))
    motor.set_control_mode(ControlMode.SETPOINT)
    motor.set_setpoint(0.01)
    motor.start()
    motor.wait_until_done()
    spent = 0.0
    for number in range(50):
        motor.set_setpoint(0.01 * (number & 1))
        begun = time.process_time()
        motor.start()
        spent += time.process_time() - begun
        motor.wait_until_done()
    return spent / 50 * 1e3
