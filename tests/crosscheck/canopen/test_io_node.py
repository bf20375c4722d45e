"""The I/O node with canopen's client and the node's EDS.

Expected: CiA 401 and CiA 406 as in tests/unit/emulators/cia401/test_node.py. Here canopen encodes
and decodes: names, signs and places are its reading of the EDS and of the frames.
"""

import types

import canopen
import pytest
from canopen.profiles import p402

from motorhil.emulators.cia401.settings import OWN_EDS
from tests.crosscheck.conftest import aborted
from tests.support.canopen.drive_wire import MS, Wire
from tests.support.canopen.pumped_client import PumpedSdoClient
from tests.support.canopen.wire_client import WireNetwork

HALF = 16384  # 5 V of 6411h


class WireNode(canopen.RemoteNode):
    def add_sdo(self, rx_cobid, tx_cobid):
        client = PumpedSdoClient(rx_cobid, tx_cobid, self.object_dictionary)
        self.sdo_channels.append(client)
        return client


@pytest.fixture
def connected(monkeypatch) -> tuple[Wire, WireNetwork, canopen.RemoteNode]:
    wire = Wire({"node_id": 5, "kind": "cia401", "channels": 4})
    network = WireNetwork(wire)
    node = WireNode(5, str(OWN_EDS))
    network.add_node(node)
    clock = types.SimpleNamespace(monotonic=lambda: wire.now / 1e9, sleep=None)
    monkeypatch.setattr(p402, "time", clock)
    assert network.pump_until(lambda: node.nmt.state == "PRE-OPERATIONAL", 1.0)
    return wire, network, node


def test_eds_objects_exist_with_stated_values(connected):
    _wire, _network, node = connected
    checked = 0
    for entry in node.object_dictionary.values():
        is_one = isinstance(entry, canopen.objectdictionary.ODVariable)
        for variable in [entry] if is_one else entry.values():
            if variable.index < 0x1000 or (variable.index == 0x1003 and variable.subindex):
                continue  # a data type; or an error that has not happened
            data = node.sdo.upload(variable.index, variable.subindex)
            value = variable.decode_raw(data)
            if variable.default is not None:
                assert value == variable.default, f"{variable.index:04X}h:{variable.subindex}"
                checked += 1
    assert checked > 100


def test_outputs_and_counters_work_with_canopen_pdo_maps(connected):
    wire, network, node = connected
    node.rpdo.read()
    node.tpdo.read()
    node.nmt.state = "OPERATIONAL"
    node.rpdo[1]["Write output 8-bit.Write output 8-bit 1"].raw = 0b1111
    node.rpdo[1].transmit()
    network.pump(20 * MS)
    assert node.tpdo[1]["Read input 8-bit.Read input 8-bit 1"].raw == 0b01010101
    for channel, value in enumerate((HALF, -HALF, 3000, -3000), 1):
        node.rpdo[2][channel - 1].raw = value
    node.rpdo[2].transmit()
    network.pump(100 * MS)
    network.sync.transmit()
    network.pump(1 * MS)
    counts = [
        node.tpdo[2]["Position value.Position value 1"].raw,
        node.tpdo[2]["Position value.Position value 2"].raw,
        node.tpdo[3]["Position value.Position value 3"].raw,
        node.tpdo[3]["Position value.Position value 4"].raw,
    ]
    assert [count > 100 for count in counts] == [True, False, True, False]
    assert counts[1] < -100
    assert counts[3] < -100
    assert abs(counts[0]) > abs(counts[2])
    # an SDO upload is some frames later than the SYNC, and the motors keep turning
    assert 0 <= node.sdo["Position value"][1].raw - counts[0] < 5000
    assert wire.truth("channel_2_output_v") == -5.0


def test_canopen_maps_channel_pair_synchronously(connected):
    wire, network, node = connected
    node.rpdo.read()
    pdo = node.rpdo[3]
    pdo.clear()
    pdo.add_variable(0x6411, 3)
    pdo.add_variable(0x6411, 4)
    pdo.trans_type = 1
    pdo.cob_id = 0x405
    pdo.enabled = True
    pdo.save()
    node.nmt.state = "OPERATIONAL"
    network.pump(1 * MS)
    wire.tell("205#0F")
    wire.run(10 * MS)
    wire.tell("405#0010FFEF")  # 4096, -4097
    assert wire.truth("channel_3_output_v") == 0.0
    wire.tell("080#")
    assert wire.truth("channel_3_output_v") == 4096 * 10 / 32768
    assert wire.truth("channel_4_output_v") == -4097 * 10 / 32768


def test_refusals_have_standard_codes(connected):
    _wire, _network, node = connected
    assert aborted(lambda: node.sdo.download(0x6820, 1, b"\0\0\0\0")) == 0x0601_0002
    assert aborted(lambda: node.sdo.download(0x6411, 1, b"\0\0\0\0")) == 0x0607_0012
    assert aborted(lambda: node.sdo.download(0x6443, 1, b"\x02")) == 0x0609_0031
    assert aborted(lambda: node.sdo.upload(0x6411, 5)) == 0x0609_0011
    assert aborted(lambda: node.sdo.upload(0x6401, 1)) == 0x0602_0000


def test_missing_host_heartbeat_is_detected_in_time(connected):
    wire, network, node = connected
    node.sdo[0x1016][1].raw = 127 << 16 | 100
    node.nmt.state = "OPERATIONAL"
    wire.tell("205#0F", "305#0040004000000000")
    wire.tell("77F#05")
    heard = wire.times(0x77F)[-1]
    network.pump(heard + 100 * MS - 1 - wire.now)
    assert wire.truth("output_v") == 5.0
    network.pump(1)
    assert wire.truth("output_v") == 0.0
    network.pump(1 * MS)
    assert node.emcy.active[0].code == 0x8130
    assert wire.read(0x6200, 1) == 0
