"""Programs that name hardware get the rig's buses, and never the hardware."""

import can
import pytest
from can.interfaces import BACKENDS

from motorhil.harness.python_can.hardware_names import bus_settings
from motorhil.harness.rig.rig import Rig

RIG = """
[rig]
name = "names"
seed = 1
[bus.can0]
bitrate_bit_s = 500_000
[bus.ttyUSB0]
bitrate_bit_s = 500_000
"""


@pytest.fixture
def rig(tmp_path):
    (tmp_path / "rig.toml").write_text(RIG)
    with Rig.open(tmp_path / "rig.toml") as rig, bus_settings(rig.description.buses):
        yield rig


@pytest.mark.parametrize(
    ("interface", "channel", "bus"),
    [
        ("socketcan", "can0", "can0"),
        ("kvaser", 0, "can0"),
        ("slcan", "/dev/ttyUSB0", "ttyUSB0"),
        ("pcan", None, "can0"),
    ],
)
def test_named_hardware_opens_bus_of_that_name(rig, interface, channel, bus):
    with (
        can.Bus(interface=interface, channel=channel, bitrate=500_000) as one,
        can.Bus(channel=bus) as other,
    ):
        one.send(can.Message(arbitration_id=0x123, is_extended_id=False))
        assert other.recv(0.1).arbitration_id == 0x123


def test_hardware_without_rig_bus_is_refused(rig):
    with pytest.raises(
        can.CanInitializationError, match=r"'socketcan', channel 'can7'.*its buses: can0, ttyUSB0"
    ):
        can.Bus(interface="socketcan", channel="can7")


def test_interfaces_are_restored(tmp_path):
    (tmp_path / "rig.toml").write_text(RIG)
    before = dict(BACKENDS)
    with Rig.open(tmp_path / "rig.toml") as rig:
        with bus_settings(rig.description.buses):
            changed = {name for name in before if BACKENDS[name] != before[name]}
        assert changed == {*before} - {"emulated", "virtual"}
    assert before == BACKENDS
