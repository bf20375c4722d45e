"""canopen's LSS master, an independent implementation, on a virtual rig's bus."""

from pathlib import Path

import can
import canopen
import canopen.lss
import pytest
from canopen.lss import LssError

from motorhil.harness.rig.rig import Rig

RIG = """\
[bus.can0]
bitrate_bit_s = 500_000
[controller.left]
kind = "cia402"
bus = "can0"
node_id = 5
node_id_by_lss = true
objects = { "1018h:4" = 0x1234_5678 }
[controller.io]
kind = "cia401"
bus = "can0"
node_id = 6
node_id_by_lss = true
objects = { "1018h:4" = 7 }
"""


class RigNetwork(canopen.Network):
    """canopen's network on a rig's bus; an answer arrives within 5 ms of its frame."""

    def __init__(self, rig: Rig) -> None:
        super().__init__()
        self._bus = rig.bus("can0")
        self.heard: list[tuple[int, bytes]] = []

    def send_message(self, can_id: int, data: bytes, remote: bool = False) -> None:
        self._bus.send(can.Message(arbitration_id=can_id, data=bytes(data), is_extended_id=False))
        self.pump(0.005)

    def pump(self, timeout_s: float) -> None:
        while (message := self._bus.recv(timeout_s)) is not None:
            self.heard.append((message.arbitration_id, bytes(message.data)))
            self.notify(message.arbitration_id, bytearray(message.data), message.timestamp)


@pytest.fixture
def rig(tmp_path: Path, monkeypatch):
    monkeypatch.setattr(canopen.lss.time, "sleep", lambda seconds: None)
    monkeypatch.setattr(canopen.lss.LssMaster, "RESPONSE_TIMEOUT", 0.000_1)
    path = tmp_path / "rig.toml"
    path.write_text(RIG)
    with Rig.open(path) as rig:
        yield rig


def test_fastscan_finds_each_slave_and_assigns_node_ids(rig):
    network = RigNetwork(rig)
    network.pump(1.0)
    assert network.heard == []  # no node-ID, no messages
    found = []
    for node_id in (6, 5):
        is_there, address = network.lss.fast_scan()
        assert is_there
        found.append(address)
        assert network.lss.inquire_node_id() == 255
        network.lss.configure_node_id(node_id)
        network.lss.store_configuration()
        network.lss.send_switch_state_global(network.lss.WAITING_STATE)
        network.pump(0.5)
        assert network.heard[-1] == (0x700 + node_id, b"\0")
    # the lowest address first: product code 191h before 402h
    assert [address[3] for address in found] == [7, 0x1234_5678]
    assert network.lss.fast_scan() == (False, None)
    remote = network.add_node(canopen.RemoteNode(5, canopen.ObjectDictionary()))
    remote.sdo.RESPONSE_TIMEOUT = 0.001
    assert remote.sdo.upload(0x1018, 4) == bytes.fromhex("78563412")
    assert remote.sdo.upload(0x1014, 0) == bytes.fromhex("85000000")


def test_slave_is_selected_by_address_and_queried(rig):
    network = RigNetwork(rig)
    lss = network.lss
    product = 0x402
    with pytest.raises(LssError):
        lss.send_switch_state_selective(0, product, 0x0001_0000, 0x1234_5679)
    assert lss.send_switch_state_selective(0, product, 0x0001_0000, 0x1234_5678)
    asked = (0x5A, 0x5B, 0x5C, 0x5D)
    told = [lss.inquire_lss_address(command) for command in asked]
    assert told == [0, product, 0x0001_0000, 0x1234_5678]
    lss.configure_bit_timing(4)
    lss.activate_bit_timing(100)
    with pytest.raises(LssError, match="1"):
        lss.configure_bit_timing(5)
    with pytest.raises(LssError, match="1"):
        lss.configure_node_id(0)
    lss.send_identify_remote_slave(0, product, 0, 0xFFFF_FFFF, 0, 0xFFFF_FFFF)
    assert network.heard[-1] == (0x7E4, bytes.fromhex("4F 00 00 00 00 00 00 00"))
