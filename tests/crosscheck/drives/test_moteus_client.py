"""moteus 1.1.1, the library of mjbots, unmodified, with its own transport on a served rig."""

import asyncio
import signal
import subprocess

import can
import moteus
import pytest

from tests.support.line_programs import LONG_S
from tests.support.served_hub import SERVE

pytestmark = pytest.mark.wall
RIG = """
[rig]
name = "a wheel behind a moteus"
[bus.can0]
bitrate_bit_s = 1_000_000
data_bitrate_bit_s = 5_000_000
node.wheel.frames = "fd"
[controller.wheel]
kind = "moteus"
bus = "can0"
node_id = 1
serial_number = 7
default_timeout_s = 30.0
position_min_rev = "none"
position_max_rev = "none"
"""


@pytest.fixture
def hub(tmp_path, monkeypatch):
    monkeypatch.setattr(can, "rc", {})  # the library makes every bus of the process one of CAN FD
    (tmp_path / "rig.toml").write_text(RIG)
    path = tmp_path / "hub.sock"
    command = [*SERVE, "serve", str(tmp_path / "rig.toml"), "--socket", str(path)]
    with subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.DEVNULL) as server:
        assert server.stdout.readline().startswith(b"can0: ")
        try:
            yield path
        finally:
            server.send_signal(signal.SIGINT)
            server.wait(LONG_S)


async def talk(path):
    """Find the drive, move it, read the state, and stop it by text."""
    device = moteus.PythonCanDevice(interface="emulated", channel=str(path), fd=True)
    transport = moteus.Transport([device])
    try:
        found = await transport.discover()
        drive = moteus.Controller(id=1, transport=transport)
        await drive.set_stop()
        target = {"position": 2.0, "velocity_limit": 8.0, "accel_limit": 40.0}
        state = await drive.set_position(**target, query=True)
        complete = drive.make_custom_query({moteus.Register.TRAJECTORY_COMPLETE: moteus.INT8})
        async with asyncio.timeout(LONG_S):  # a fast machine asks often
            while abs(state.values[moteus.Register.POSITION] - 2.0) >= 0.01:
                (heard,) = await transport.cycle([complete])
                if heard.values[moteus.Register.TRAJECTORY_COMPLETE]:
                    state = await drive.query()
        await moteus.Stream(drive).command(b"d stop")
        return found, state.values, (await drive.query()).values
    finally:
        device.close()


def test_library_of_mjbots_moves_the_drive(hub):
    found, moved, stopped = asyncio.run(talk(hub))
    assert [(one.can_id, one.uuid[:4]) for one in found] == [(1, b"\x07\0\0\0")]
    register = moteus.Register
    assert moved[register.MODE] == moteus.Mode.POSITION
    assert moved[register.POSITION] == pytest.approx(2.0, abs=0.01)
    assert moved[register.FAULT] == 0
    assert stopped[register.MODE] == moteus.Mode.STOPPED
