"""Streamed set-points on the wall clock, over a hub."""

from pathlib import Path
from time import monotonic

import can
import pytest

from motorhil.emulators.cia402.drive import build
from motorhil.emulators.controller import ControllerContext
from motorhil.motorapi import MotorModel, WallRuntime
from motorhil.motorapi.adaptations.cia402.bringup import HwOptions
from motorhil.motorapi.adaptations.cia402.hardware import Cia402HwMotor
from motorhil.motorapi.adaptations.cia402.motor import Cia402Motor
from tests.support.motors.streaming import quintic, set_function
from tests.system.wall.hub.test_hub import serving

pytestmark = pytest.mark.wall

MODEL = MotorModel(name="wheel", velocity_max=3.0, acceleration_max=10.0)


def test_late_host_takes_longer_and_reports_it(tmp_path):
    path = str(tmp_path / "hub.sock")
    core = build({"node_id": 1}, ControllerContext(name="drive", folder=Path(), seed=1))
    runtime = WallRuntime()
    with serving(path, core), can.Bus(interface="emulated", channel=path) as bus:
        options = HwOptions(
            set_point_period_ms=10,
            heartbeat_timeout_ms=30_000,
            sdo_timeout_s=10.0,
            connect_timeout_s=30.0,
        )
        hardware = Cia402HwMotor(bus, 1, runtime=runtime, options=options)
        motor = set_function(Cia402Motor(hardware, MODEL, name="wheel"), quintic(0.5, 1.0))
        motor.start()
        busy_until = []

        def be_busy() -> None:
            if not busy_until:
                busy_until.append(monotonic() + 0.1)
                while monotonic() < busy_until[0]:
                    pass

        busy = runtime.every(0.3, be_busy)
        motor.wait_until_done(timeout_s=30)
        busy.cancel()
        stream = hardware.stream
        assert stream is not None
        assert stream.sent == 100
        assert stream.missed >= 8
        times = motor._motion_times()
        assert times is not None
        assert f"the host missed {stream.missed} periods" in times.source
        assert times.ended_ns is not None
        assert times.started_ns is not None
        late = 1  # the first may be late by less than a period, which misses none
        periods = 99 + stream.missed - late
        assert times.ended_ns - times.started_ns >= periods * 0.01 * 1e9
        assert abs(motor.position() - 0.5) < 0.001
        hardware.close()
        runtime.close()
