"""One file for several drives: the shared result equals separate reads."""

from pathlib import Path

import pytest

from motorhil import emulators
from motorhil.emulators.canopen.files.device_description import DeviceDescription
from motorhil.emulators.canopen.files.eds import EdsError, EdsText, _Reader, read_eds
from tests.support.canopen.eds_texts import GOOD

OWN = Path(emulators.__file__).parent / "eds" / "motorhil_cia402.eds"
VENDORS = ("maxon_epos2_50_5.eds", "nanotec_C5-E-2-09.eds", "elmo_gold_cob.dcf", "roboteq_v80.eds")
NODES = (5, 1, 127, 64, 5)

RPDO = """
[1400]
ParameterName=RPDO
ObjectType=0x9
SubNumber=2
[1400sub0]
ParameterName=n
DataType=0x0005
AccessType=ro
DefaultValue=1
[1400sub1]
ParameterName=COB-ID
DataType=0x0007
AccessType=rw
DefaultValue=$NODEID+0x200
"""


def facts(description: DeviceDescription) -> list[object]:
    device = [getattr(description, name) for name in vars_of(description) if name != "objects"]
    return device + [
        [getattr(one, name) for name in (*vars_of(one), "limits")] for one in description.objects
    ]


def vars_of(one: object) -> list[str]:
    names = (
        "node_id vendor_name product_name order_code vendor_number product_number revision_number "
        "dummies warnings path index subindex name data_type access pdo_mappable default line"
    )
    return [name for name in names.split() if hasattr(one, name)]


def alone(path: Path, node_id: int) -> DeviceDescription:
    return _Reader(EdsText(path, path.read_bytes()), node_id).read()


def check(path: Path) -> None:
    for node_id in NODES:
        assert facts(read_eds(path, node_id)) == facts(alone(path, node_id))


def test_own_file_shared_by_nodes_equals_single_read():
    check(OWN)
    assert facts(alone(OWN, 5)) != facts(alone(OWN, 6))


@pytest.mark.data
@pytest.mark.parametrize("name", VENDORS)
def test_vendor_files_shared_by_nodes_equal_single_reads(name: str, shared: Path):
    check(shared / "data" / "eds" / name)


@pytest.mark.parametrize(
    "more",
    [
        RPDO,
        RPDO + "HighLimit=$NODEID+0x200\nLowLimit=$NODEID+0x200\n",
        RPDO + "HighLimit=0x240\n",  # too low for some nodes: a warning for those only
        RPDO + "PDOMapping=$NODEID\n",
        RPDO.replace("SubNumber=2", "SubNumber=$NODEID"),
        RPDO.replace("DefaultValue=1", "DefaultValue=1 ; one"),
        "[DummyUsage]\nDummy0007=$NODEID\n",
        "[DeviceComissioning]\nNodeID=5\n" + RPDO,
        RPDO.replace("ParameterName=RPDO", "ParameterName=$NODEID"),
    ],
)
def test_fields_with_node_id_are_read_for_each_node(more: str, tmp_path: Path):
    path = tmp_path / "some.eds"
    path.write_text(GOOD + more)
    check(path)


def test_value_too_large_for_one_node_is_refused_for_it_only(tmp_path: Path):
    path = tmp_path / "some.eds"
    path.write_text(GOOD + RPDO.replace("0x0007", "0x0005").replace("0x200", "0xE0"))
    assert read_eds(path, 5).objects[-1].default == 0xE5
    with pytest.raises(EdsError, match="0xE0"):
        read_eds(path, 127)
    assert read_eds(path, 6).objects[-1].default == 0xE6


def test_changed_file_is_read_again(tmp_path: Path):
    path = tmp_path / "some.eds"
    path.write_text(GOOD)
    before = read_eds(path, 5)
    assert read_eds(path, 5) is before
    path.write_text(GOOD.replace("ProductNumber=7", "ProductNumber=8"))
    assert read_eds(path, 5).product_number == 8
    assert before.product_number == 7
