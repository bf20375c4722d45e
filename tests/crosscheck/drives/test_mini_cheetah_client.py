"""mini-cheetah-motor-driver-socketcan 0.4.3, unmodified, drives emulated motors in virtual time.

The library opens a raw CAN socket by itself. The stand-in passes the frames of that socket to the
rig's bus; 14 bytes of a frame are all that the library receives. It waits in a loop on the clock.
"""

import struct
from types import SimpleNamespace

import can
import pytest
from motor_driver import canmotorlib

from motorhil.emulators.mit.settings import MODELS
from motorhil.harness.rig.rig import Rig
from motorhil.harness.virtual_time.stdlib.install import in_virtual_time

RIG = """
[rig]
name = "a motor with MIT frames"
[bus.can0]
bitrate_bit_s = 1_000_000
[controller.joint]
kind = "mit"
bus = "can0"
node_id = 1
model = "{model}"
"""
# of the library, and ours
TYPES = {
    "AK80_6_V1": "ak80_6_v1",
    "AK80_6_V1p1": "ak80_6_v1_1",
    "AK80_6_V2": "ak80_6_v2",
    "AK80_9_V1p1": "ak80_9_v1_1",
    "AK80_9_V2": "ak80_9_v2",
    "AK70_10_V1p1": "ak70_10",
    "AK10_9_V1p1": "ak10_9",
}


class BusSocket:
    """A raw CAN socket on the emulated bus."""

    def __init__(self, *_):
        self._timeout_s = None

    def setsockopt(self, *_):
        pass

    def bind(self, address):
        self._bus = can.Bus(interface="emulated", channel=address[0])

    def settimeout(self, timeout_s):
        self._timeout_s = timeout_s

    def send(self, frame):
        can_id, length, data = struct.unpack("=IB3x8s", frame)
        self._bus.send(can.Message(arbitration_id=can_id, data=data[:length], is_extended_id=False))

    def recvfrom(self, size):
        heard = self._bus.recv(self._timeout_s)
        if heard is None:
            raise TimeoutError("timed out")
        data = bytes(heard.data).ljust(8, b"\0")
        return struct.pack("=IB3x8s", heard.arbitration_id, heard.dlc, data)[:size], None

    def close(self):
        self._bus.shutdown()


@pytest.fixture
def motor(tmp_path, monkeypatch, capsys):
    names = SimpleNamespace(
        **dict.fromkeys(("AF_CAN", "SOCK_RAW", "CAN_RAW", "SOL_CAN_RAW", "CAN_RAW_LOOPBACK"), 0),
        socket=BusSocket,
    )
    monkeypatch.setattr(canmotorlib, "socket", names)
    opened = []

    def make(kind="AK80_6_V2", model=None, more=""):
        file = tmp_path / "rig.toml"
        file.write_text(RIG.format(model=model or TYPES[kind]) + more)
        rig = Rig.open(file)
        opened.append(rig.__enter__())
        time = in_virtual_time(rig)
        time.__enter__()
        rig.runtime.run_for(0.2)  # booted
        opened.append(time)
        canmotorlib.CanMotorController.can_socket_declared = False
        client = canmotorlib.CanMotorController("can0", 1, kind)
        opened.append(client.motor_socket)
        return rig, client

    yield make
    for one in reversed(opened):
        one.close() if isinstance(one, BusSocket) else one.__exit__(None, None, None)
    canmotorlib.CanMotorController.can_socket_declared = False
    assert "rror" not in capsys.readouterr().out


def stream(rig, client, seconds, *command):
    """Repeat a command every 5 ms; return the last answer."""
    for _ in range(round(seconds / 0.005)):
        rig.runtime.run_for(0.005)
        told = client.send_rad_command(*command)
    return told


def test_client_tables_and_emulated_models_agree():
    tables = {
        "AK80_6_V1": canmotorlib.AK80_6_V1_PARAMS,
        "AK80_6_V1p1": canmotorlib.AK80_6_V1p1_PARAMS,
        "AK80_6_V2": canmotorlib.AK80_6_V2_PARAMS,
        "AK80_9_V1p1": canmotorlib.AK80_9_V1p1_PARAMS,
        "AK80_9_V2": canmotorlib.AK80_9_V2_PARAMS,
        "AK70_10_V1p1": canmotorlib.AK70_10_V1p1_params,
        "AK10_9_V1p1": canmotorlib.AK10_9_V1p1_PARAMS,
    }
    for kind, table in tables.items():
        names = ("P_MAX", "V_MAX", "T_MAX", "KP_MAX", "KD_MAX")
        assert tuple(MODELS[TYPES[kind]][1]) == tuple(table[name] for name in names)


@pytest.mark.parametrize("kind", ["AK80_6_V1p1", "AK80_6_V2", "AK80_9_V2", "AK70_10_V1p1"])
def test_client_moves_an_emulated_motor_to_its_target(motor, kind):
    rig, client = motor(kind)
    client.enable_motor()
    stream(rig, client, 2.0, 0.8, 0.0, 20.0, 2.0, 0.0)
    p, v, _ = client.send_rad_command(0.8, 0.0, 20.0, 2.0, 0.0)
    sign = client.motorParams["AXIS_DIRECTION"]
    step = 2 * client.motorParams["P_MAX"] / 65535
    truth = rig.controllers["joint"].snapshot()["position_rad"]
    assert p * sign == pytest.approx(truth, abs=1.2 * step)
    assert truth * sign == pytest.approx(0.8, abs=0.27 / 20.0 + 2 * step)  # friction / kp
    assert v == pytest.approx(0.0, abs=2 * client.motorParams["V_MAX"] / 4095)


def test_client_reads_the_torque_that_a_load_needs(motor):
    rig, client = motor()
    client.enable_motor()
    rig.controllers["joint"].stimulate("load_torque_n_m", 3.0)
    _, _, torque = stream(rig, client, 2.0, 0.0, 0.0, 50.0, 3.0, 0.0)
    assert torque == pytest.approx(3.0, abs=0.264 + 24 / 4095)  # friction holds a part


def test_client_turns_at_a_velocity_without_stiffness(motor):
    rig, client = motor("AK80_9_V2")
    client.enable_motor()
    _, v, _ = stream(rig, client, 2.0, 0.0, 2.0, 0.0, 5.0, 0.0)
    assert v == pytest.approx(2.0, abs=0.264 / 5.0 + 0.02)


def test_client_disables_and_sets_zero(motor):
    rig, client = motor()
    client.enable_motor()
    stream(rig, client, 1.0, 0.5, 0.0, 30.0, 2.0, 0.0)
    client.disable_motor()
    assert rig.controllers["joint"].snapshot()["is_on"] == 0.0
    assert client.set_zero_position()[0] == pytest.approx(0.5, abs=0.02)  # before it acted
    p, _, _ = client.send_rad_command(0.0, 0.0, 0.0, 0.0, 0.0)
    assert p == pytest.approx(0.0, abs=25 / 65535)


def test_client_with_a_wrong_table_scales_velocity(motor):
    """Both tables are those of an AK80-9 in different libraries: 25.64 and 50 rad/s."""
    rig, client = motor("AK80_9_V2", more="v_max_rad_s = 50.0\n")
    client.enable_motor()
    _, v, _ = stream(rig, client, 2.0, 0.0, 1.0, 0.0, 5.0, 0.0)
    truth = rig.controllers["joint"].snapshot()["velocity_rad_s"]
    assert truth / v == pytest.approx(50.0 / 25.64, rel=0.03)
