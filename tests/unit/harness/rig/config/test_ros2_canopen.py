"""Rigs from bus.yml; its keys are those of ros2_canopen's user guide and of Lely's dcfgen."""

import sys
from pathlib import Path

import pytest

from motorhil.emulators.cia401.settings import OWN_EDS as IO_EDS
from motorhil.emulators.cia402.settings import OWN_EDS
from motorhil.harness.cli.main import main
from motorhil.harness.rig.config.ros2_canopen import rig_of_bus
from motorhil.harness.rig.config.toml import RigError
from motorhil.harness.rig.rig import Rig

MASTER = "master: {node_id: 1, driver: d, package: p, sync_period: 20000, baudrate: 500}\n"
BUS = f"""\
options:
  dcf_path: "@BUS_CONFIG_PATH@"
.pdos: &pdos
  1: {{enabled: true, cob_id: auto, transmission: 0x01, mapping: [{{index: 0x6041}}]}}
{MASTER}
defaults:
  dcf: "@BUS_CONFIG_PATH@/drive.eds"
  driver: "ros2_canopen::Cia402Driver"
  sdo: [{{index: 0x60C2, sub_index: 2, value: -3}}]
  tpdo: *pdos
nodes:
  joint_1: {{node_id: 2}}
  joint_2: {{node_id: 0x3, dcf: io.eds}}
"""


@pytest.fixture
def config(tmp_path: Path) -> Path:
    folder = tmp_path / "config"
    folder.mkdir()
    (folder / "drive.eds").write_bytes(OWN_EDS.read_bytes())
    (folder / "io.eds").write_bytes(IO_EDS.read_bytes())
    return folder


def made(config: Path, text: str) -> tuple[str, list[str]]:
    (config / "bus.yml").write_text(text)
    return rig_of_bus(config / "bus.yml", config.parent)


def test_rig_has_the_nodes_the_bit_rate_and_sync(config, tmp_path, capsys):
    (config / "bus.yml").write_text(BUS)
    folder = tmp_path / "rig"
    assert main(["new", str(folder), "--from", str(config / "bus.yml")]) == 0
    assert main(["check", str(folder / "rig.toml")]) == 0
    assert "1 bus, 2 controllers" in capsys.readouterr().out
    with Rig.open(folder / "rig.toml") as rig:
        bus = rig.description.buses["can0"]
        assert bus.bitrate_bit_s == 500_000
        assert [(one.can_id, one.period_s) for one in bus.messages] == [(0x080, 0.02)]
        kinds = {name: one.kind for name, one in rig.description.controllers.items()}
        assert kinds == {"joint_1": "cia402", "joint_2": "cia401"}
        host = rig.bus("can0")
        rig.runtime.run_for(0.4)
        booted = [host.recv(0), host.recv(0)]
        assert {one and one.arbitration_id for one in booted} == {0x702, 0x703}


def test_sections_of_dcfgen_are_nodes(config):
    text, _ = made(config, MASTER + "wheel: {node_id: 7, dcf: drive.eds}\n.hidden: {a: 1}\n")
    assert '[controller.wheel]\nkind = "cia402"\nbus = "can0"\nnode_id = 7' in text
    assert 'eds = "config/drive.eds"' in text


def test_nodes_may_be_a_list(config):
    text, _ = made(config, f"{MASTER}nodes:\n  - a: {{node_id: 2, dcf: drive.eds}}\n")
    assert "[controller.a]" in text


def test_node_id_may_come_from_the_dcf(config):
    with (config / "drive.eds").open("a") as file:
        file.write("\n[DeviceComissioning]\nNodeID=0x05\n")
    text, _ = made(config, f"{MASTER}nodes:\n  a: {{dcf: drive.eds}}\n")
    assert "node_id = 5" in text


def test_every_key_without_effect_is_told(config):
    node = "1st joint: {node_id: 2, dcf: drive.eds, colour: red, num_channels: 2}"
    more = "defaults: {perio: 10}\nextra: {a: 1}\noptions: {path: x}\n"
    _, notes = made(config, f"{MASTER[:-2]}, speed: 1}}\n{more}nodes:\n  {node}\n")
    assert notes == [
        "options: unknown keys, left out: path",
        "unknown sections, left out: extra",
        "master: unknown keys, left out: speed",
        "1st joint: unknown keys, left out: perio, colour",
        "1st joint: num_channels: only the first axis moves",
        "1st joint: named node_1st_joint in the rig",
        "sdo, rpdo, tpdo, heartbeats: the master writes them when a node boots",
    ]


def test_node_that_is_no_drive_is_left_out_and_told(config):
    (config / "sensor.eds").write_text(
        "[DeviceInfo]\n[1000]\nParameterName=t\nDataType=7\nAccessType=ro\nDefaultValue=0x194\n"
    )
    nodes = "a: {node_id: 2, dcf: drive.eds}\n  s: {node_id: 3, dcf: sensor.eds}"
    text, notes = made(config, f"{MASTER}nodes:\n  {nodes}\n")
    assert "[controller.s]" not in text
    assert "s: left out: sensor.eds describes neither a drive nor an I/O node" in notes


@pytest.mark.parametrize(
    ("text", "message"),
    [
        (MASTER, "no node to emulate"),
        ("[1]", "the file is not a section of keys"),
        ("master: {", "is not YAML: expected the node content, but found '<stream end>'"),
        (MASTER + "nodes: {a: {node_id: 2}}", "no dcf: the file of its objects is missing"),
        (MASTER + "nodes: {a: {node_id: 2, dcf: none.eds}}", "cannot be read: No such file"),
        (MASTER + "nodes: {a: {node_id: two, dcf: drive.eds}}", "node_id is 'two'; expected a"),
        (MASTER + "nodes: {a: {node_id: 128, dcf: drive.eds}}", "node_id 128 is not 1 to 127"),
        (MASTER + "nodes: {a: {dcf: drive.eds}}", "node_id 0 is not 1 to 127"),
        (MASTER + "nodes: {a: {node_id: 1, dcf: drive.eds}}", "node-ID 1 is also that of the mas"),
    ],
)
def test_wrong_file_is_refused_with_the_reason(config, text, message):
    with pytest.raises(RigError) as refused:
        made(config, text)
    assert message in str(refused.value)


@pytest.mark.parametrize("is_list", [False, True])
def test_every_mistake_is_told_with_its_line(config, capsys, is_list):
    dash = "- " if is_list else "  "
    text = f"""master:
  node_id: 1
  sync_period: often
defaults:
  dcf: drive.eds
nodes:
{dash}left:
    node_id: two
{dash}right:
    dcf: none.eds
    node_id: 3
{dash}front:
    node_id: 1
{dash}rear:
    node_id: 4
"""
    (config / "bus.yml").write_text(text)
    assert main(["new", str(config / "rig"), "--from", str(config / "bus.yml")]) == 2
    told = capsys.readouterr().err.replace(f"{config}/", "")
    assert told.splitlines() == [
        "bus.yml:3: master: sync_period is 'often'; expected a whole number; correct it",
        "bus.yml:8: left: node_id is 'two'; expected a whole number; correct it",
        "bus.yml:10: right: none.eds: cannot be read: No such file or directory; check dcf",
        "bus.yml:13: front: node-ID 1 is also that of the master; give each a node-ID of its own",
    ]
    assert not (config / "rig").exists()


def test_missing_pyyaml_is_named_with_its_extra(config, monkeypatch, capsys):
    monkeypatch.setitem(sys.modules, "yaml", None)
    (config / "bus.yml").write_text(BUS)
    assert main(["new", str(config / "rig"), "--from", str(config / "bus.yml")]) == 2
    said = capsys.readouterr().err
    assert "needs the package PyYAML; install it: pip install 'motorhil[yaml]'" in said


def test_new_without_a_folder_is_refused(capsys):
    assert main(["new"]) == 2
    assert "no folder is named; name a new one: motorhil new DIR" in capsys.readouterr().err
