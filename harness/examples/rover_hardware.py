"""The rover's drives for a robot's program: bus, node-ID, model.

Environment variables name the buses, as `motorhil serve RIG -- PROGRAM` sets them: CAN_INTERFACE
for python-can's interface, MOTORHIL_CHANNEL_CAN0 and so on for the channels.
"""

import os
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path

import can

from motorhil.harness.examples.rover_kinematics import WHEELS
from motorhil.motorapi import Motor, MotorModel
from motorhil.motorapi.adaptations.cia402.bringup import HwOptions
from motorhil.motorapi.adaptations.cia402.hardware import Cia402HwMotor
from motorhil.motorapi.adaptations.cia402.motor import Cia402Motor

PLACES = {
    **{f"drive_{name}": ("can0", node_id, "wheel") for node_id, name in enumerate(WHEELS, 1)},
    **{f"steer_{name}": ("can1", node_id, "steering") for node_id, name in enumerate(WHEELS, 1)},
    "pan": ("can0", 11, "mast"),
    "tilt": ("can0", 12, "mast"),
}
# Drives in a laboratory: their hosts may be busy for a second. All programs that share a drive use
# the same options.
OPTIONS = HwOptions(heartbeat_timeout_ms=10_000, sdo_timeout_s=10.0, connect_timeout_s=30.0)


@contextmanager
def rover_motors(*names: str) -> Iterator[list[Motor]]:
    """Open the motors with these names for the block."""
    with ExitStack() as opened:
        buses: dict[str, can.BusABC] = {}
        motors: list[Motor] = []
        for name in names:
            bus, node_id, kind = PLACES[name]
            if bus not in buses:
                channel = os.environ[f"MOTORHIL_CHANNEL_{bus.upper()}"]
                interface = os.environ["CAN_INTERFACE"]
                buses[bus] = opened.enter_context(can.Bus(interface=interface, channel=channel))
            drive = Cia402HwMotor(buses[bus], node_id=node_id, options=OPTIONS)
            opened.callback(drive.close)
            model = MotorModel.load(Path(__file__).parent / f"rover_{kind}.toml")
            motors.append(Cia402Motor(drive, model=model, name=name))
        yield motors
