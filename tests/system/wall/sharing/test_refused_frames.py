"""A frame that the hub refuses because of a newer token: the sender names the new owner.

The two programs have different lock directories, as containers without a common one.
"""

import os

import pytest

from motorhil.emulators.cia402.drive import build
from motorhil.emulators.controller import ControllerContext
from motorhil.motorapi import MotorBusyError, WallRuntime
from motorhil.motorapi.adaptations.cia402.bringup import HwOptions
from motorhil.motorapi.adaptations.cia402.hardware import Cia402HwMotor
from motorhil.motorapi.adaptations.cia402.motor import Cia402Motor
from motorhil.motorapi.locking.directory import VARIABLE
from tests.support.line_programs import Program
from tests.support.programs.fenced_owner import MODEL, open_bus
from tests.system.wall.hub.test_hub import serving
from tests.system.wall.sharing.test_shared_drive import MODEL as MODEL_FILE

pytestmark = pytest.mark.wall

OPTIONS = HwOptions(heartbeat_timeout_ms=30_000, sdo_timeout_s=3.0, connect_timeout_s=30.0)


@pytest.fixture
def motor(tmp_path):
    """Return a motor on the hub of the test."""
    runtime, path = WallRuntime(), str(tmp_path / "hub")
    drive = build({"node_id": 1}, ControllerContext(name="wheel", folder=tmp_path, seed=1))
    with serving(path, drive):
        bus = open_bus(path)
        hardware = Cia402HwMotor(bus, 1, runtime=runtime, options=OPTIONS)
        yield Cia402Motor(hardware, MODEL, name="first")
        hardware.close()
        bus.shutdown()
        runtime.close()


def test_refused_frame_names_the_owner_of_the_newer_token(motor, tmp_path):
    elsewhere = tmp_path / "elsewhere"
    elsewhere.mkdir(mode=0o700)
    with motor.reserve("survey"):
        motor.enable()
        env = {**os.environ, VARIABLE: str(elsewhere)}
        other = Program("shared_drive", tmp_path / "hub", MODEL_FILE, "second", env=env)
        try:
            assert other.hear() == "ready"
            assert other.ask("reserve rescue") == "reserved"
            assert other.ask("move 0.1") == "started"
            assert other.ask("wait") == "done"
            for _ in range(2):  # of the refused frame itself, and of the next one
                with pytest.raises(
                    MotorBusyError, match=r"node 1 is held by shared_drive.py\[\d+\] for rescue"
                ):
                    motor.home()
        finally:
            other.end()
