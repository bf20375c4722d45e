"""Vendors' EDS and DCF files, compared with canopen, on a node.

The files stay in ../shared (third parties' data); the index there lists their defects.
"""

from pathlib import Path

import canopen
import pytest

from motorhil.emulators.canopen.files.device_description import DeviceDescription
from motorhil.emulators.canopen.files.eds import EdsError, read_eds
from motorhil.emulators.canopen.object_dictionary import is_integer, is_signed, length_bits
from tests.support.canopen.client_loop import Loop, raw_of
from tests.support.canopen.node_bench import NODE_ID, Bench

pytestmark = pytest.mark.data

OBJECTS = {  # as counted with canopen in INDEX.md of the data, dummies included
    "maxon_epos2_50_5.eds": 157,
    "nanotec_C5-E-2-09.eds": 233,
    "technosoft_ipos.eds": 189,
    "roboteq_v80.eds": 212,
    "elmo_gold_cob.dcf": 167,
    "schunk_prl_erb_0_63.dcf": 98,
}


@pytest.fixture(params=OBJECTS)
def path(request: pytest.FixtureRequest, shared: Path) -> Path:
    return shared / "data" / "eds" / str(request.param)


@pytest.fixture
def device(path: Path) -> DeviceDescription:
    return read_eds(path, NODE_ID)


def canopens(path: Path) -> dict[tuple[int, int], canopen.objectdictionary.ODVariable]:
    od = canopen.import_od(str(path), node_id=NODE_ID)
    variables = {}
    for entry in od.values():
        if entry.index < 0x1000:
            continue
        members = [entry] if hasattr(entry, "data_type") else entry.values()
        for variable in members:
            variables[variable.index, variable.subindex] = variable
    return variables


def two_s_complement(value: object, data_type: int) -> object:
    if (
        isinstance(value, int)
        and is_signed(data_type)
        and value >= 1 << (length_bits(data_type) - 1)
    ):
        return value - (1 << length_bits(data_type))
    return value


def test_objects_equal_those_of_canopen(path, device):
    od = device.dictionary()
    assert len(od.indices()) + len(device.dummies) == OBJECTS[path.name]
    assert [(v.index, v.subindex) for v in od] == sorted(canopens(path))
    assert device.warnings == ()


def test_types_access_mapping_and_limits_equal_canopen(path, device):
    theirs = canopens(path)
    for ours in device.objects:
        other = theirs[ours.index, ours.subindex]
        place = f"{ours.index:04X}h:{ours.subindex:02X}h"
        assert ours.data_type == other.data_type, place
        assert ours.access == other.access_type, place
        assert ours.pdo_mappable == other.pdo_mappable, place
        assert ours.name == other.name, place
        if is_integer(ours.data_type):
            assert ours.limits == (other.min, other.max), place


def test_values_equal_canopen_except_twos_complement(path, device):
    theirs = canopens(path)
    for ours in device.objects:
        other = theirs[ours.index, ours.subindex]
        expected = other.default if other.value is None else other.value
        if expected in ("", b""):
            expected = None
        place = f"{ours.index:04X}h:{ours.subindex:02X}h"
        shown = raw_of(ours.default, ours.data_type) if ours.default is not None else None
        assert shown == two_s_complement(expected, ours.data_type), place


def test_node_boots_and_canopen_client_reads_all(device):
    bench = Bench(device.dictionary()).boot()
    loop = Loop(bench)
    for variable in bench.od:
        if variable.access == "wo" or variable.index == 0x1003:
            continue
        raw = loop.remote.sdo.upload(variable.index, variable.subindex)
        assert raw == variable.upload()


def test_pdos_work_as_canopen_client_reads_them(device):
    bench = Bench(device.dictionary()).boot()
    assert [text for level, text in bench.node.take_events() if level == "warning"] == []
    loop = Loop(bench)
    loop.remote.pdo.read()
    loop.remote.nmt.state = "OPERATIONAL"
    loop.send_message(0x080, b"")
    for number, pdo in loop.remote.rpdo.items():
        if not pdo.enabled or not pdo.map:
            continue
        for variable in pdo.map:
            variable.raw = 1
        pdo.transmit()
        loop.send_message(0x080, b"")
        for variable in pdo.map:
            ours = bench.od.get(variable.index, variable.subindex)
            in_range = (ours.low is None or ours.low <= 1) and (ours.high is None or ours.high >= 1)
            assert ours.value == 1 or not in_range, f"RPDO {number}, {variable.index:04X}h"


def test_values_that_canopen_reads_differently(shared):
    maxon = read_eds(shared / "data/eds/maxon_epos2_50_5.eds", NODE_ID).dictionary()
    assert maxon.integer(0x60C2, 2, 0) == -3  # 0xFD
    assert maxon.integer(0x60C0, 0, 0) == -1  # 0xFFFF
    schunk = read_eds(shared / "data/eds/schunk_prl_erb_0_63.dcf", NODE_ID).dictionary()
    assert schunk.integer(0x60C2, 1, 0) == 50  # DefaultValue 8, ParameterValue 50
    elmo = read_eds(shared / "data/eds/elmo_gold_cob.dcf", NODE_ID).dictionary()
    assert elmo.integer(0x1017, 0, 0) == 100


def test_identity_of_file_is_the_node_identity(shared):
    device = read_eds(shared / "data/eds/maxon_epos2_50_5.eds", NODE_ID)
    assert (device.vendor_name, device.product_name) == ("maxon motor ag", "EPOS2 50/5")
    assert device.dictionary().integer(0x1018, 1, 0) == 0xFB


def test_windows_1252_file_is_read_with_line_in_warning(shared):
    path = shared / "data/eds/BAD_faulhaber_mcbl_51V.eds"
    device = read_eds(path, NODE_ID)
    assert len(device.objects) == 156
    places = [(file, line) for file, line, _ in device.warnings]
    assert places == [(path, 52), (path, 833)]  # a byte 94h; limits 0..-1


def test_contradictory_merge_is_refused_with_line(shared):
    path = shared / "data/eds/BAD_epos2_master.dcf"
    with pytest.raises(EdsError) as caught:
        read_eds(path, NODE_ID)
    # conflicts before it (lines 32, 67, 87) are about counts and lists; 1006h has two values
    assert (caught.value.path, caught.value.line) == (path, 235)
