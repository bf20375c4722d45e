"""robstride 0.1.0, unmodified, commands an emulated drive in virtual time.

The client reads mode "run" (2) as "reset" (0): it looks at one bit of two.
"""

import can
import pytest
from robstride.client import Client, MotorError, MotorMode, RunMode

from motorhil.harness.rig.rig import Rig

RIG = """
[rig]
name = "a RobStride drive"
[bus.can0]
bitrate_bit_s = 1_000_000
[controller.joint]
kind = "robstride"
bus = "can0"
node_id = 1
model = "rs01"
plant = { preset = "wheel_60w", gear_ratio = 10.0 }
"""


@pytest.fixture
def rig(tmp_path):
    (tmp_path / "rig.toml").write_text(RIG)
    with Rig.open(tmp_path / "rig.toml") as rig:
        rig.runtime.run_for(0.2)
        yield rig


@pytest.fixture
def client(rig):
    with can.Bus(interface="emulated", channel="can0") as bus:
        yield Client(bus)


def truth(rig):
    return rig.controllers["joint"].snapshot()


def test_client_enables_and_disables_the_drive(rig, client):
    told = client.enable(1)
    assert (told.servo_id, told.errors, told.mode) == (1, [], MotorMode.Reset)
    assert (told.angle, told.velocity, told.torque) == pytest.approx((0, 0, 0), abs=1e-3)
    assert told.temp == 25.0
    assert truth(rig)["is_on"] == 1.0
    client.disable(1)
    assert truth(rig)["is_on"] == 0.0


def test_client_runs_the_motor_at_a_speed(rig, client):
    client.write_param(1, "run_mode", RunMode.Speed)
    assert client.read_param(1, "run_mode") is RunMode.Speed
    client.enable(1)
    client.write_param(1, "spd_ref", 3.0)
    rig.runtime.run_for(1.0)
    assert client.read_param(1, "mechvel") == pytest.approx(3.0, rel=0.01)
    told = client.disable(1)
    assert told.velocity == pytest.approx(3.0, rel=0.01)


def test_client_moves_the_motor_to_a_position(rig, client):
    client.write_param(1, "run_mode", RunMode.Position)
    client.write_param(1, "limit_spd", 5.0)
    client.enable(1)
    client.write_param(1, "loc_ref", -1.5)
    rig.runtime.run_for(1.5)
    assert client.read_param(1, "mechpos") == pytest.approx(-1.5, abs=0.005)
    assert client.enable(1).angle == pytest.approx(-1.5, abs=0.005)


def test_client_applies_a_current(rig, client):
    client.write_param(1, "run_mode", RunMode.Current)
    client.enable(1)
    client.write_param(1, "iq_ref", 2.0)
    rig.runtime.run_for(0.02)
    assert client.read_param(1, "iqf") == pytest.approx(2.0, rel=0.05)
    torque = client.enable(1).torque
    assert torque == pytest.approx(2.0 * 0.0259 * 10.0, abs=0.03)


def test_client_reads_limits_and_supply(client):
    assert client.read_param(1, "limit_torque") == 17.0
    assert client.read_param(1, "vbus") == 24.0


def test_client_sees_faults(rig, client):
    client.enable(1)
    rig.controllers["joint"].stimulate("fault", 4)
    assert client.disable(1).errors == [MotorError.Overtemp]


def test_client_changes_the_identifier(rig, client):
    client.update_id(1, 9)
    assert client.enable(9).servo_id == 9
