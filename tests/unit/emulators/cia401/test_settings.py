"""Settings of an I/O node in a rig."""

from pathlib import Path

import pytest

from motorhil.emulators.cia401.node import build
from motorhil.emulators.cia401.settings import OWN_EDS, read_settings
from motorhil.emulators.cia402.settings import OWN_EDS as DRIVE_EDS
from motorhil.emulators.controller import ControllerContext, SettingError
from motorhil.emulators.plant.presets import PRESETS
from tests.support.cia402.io_bench import IoBench


def test_all_keys_except_node_id_have_defaults():
    settings = read_settings({"node_id": 5}, Path())
    (channel,) = settings.channels
    assert settings.eds == OWN_EDS
    assert channel.plant == PRESETS["wheel_60w"]
    assert channel.current_per_volt_a_v == 0.8  # 10 V: the amplifier's maximum of 8 A
    assert (channel.tick_ns, channel.current_steps, channel.enable_ns) == (250_000, 5, 5_000_000)


def test_channels_share_common_settings_and_override_them():
    table = {
        "node_id": 5,
        "channels": 3,
        "plant": {"preset": "wheel_60w", "gear_ratio": 50.0},
        "amplifier": {"current_per_volt_a_v": 0.5, "enable_s": 0.1},
        "initial_position_rad": 0.25,
        "channel": {
            "2": {"plant": {"gear_ratio": 10.0}, "initial_position_rad": -1.0},
            "3": {"plant": {"preset": "mast_20w"}, "amplifier": {"current_per_volt_a_v": 0.3}},
        },
    }
    first, second, third = read_settings(table, Path()).channels
    assert [one.plant.gear_ratio for one in (first, second, third)] == [50.0, 10.0, 100.0]
    assert [one.current_per_volt_a_v for one in (first, second, third)] == [0.5, 0.5, 0.3]
    assert [one.initial_position_rad for one in (first, second, third)] == [0.25, -1.0, 0.25]
    assert third.enable_ns == 100_000_000


@pytest.mark.parametrize(
    ("table", "text"),
    [
        ({"node_id": 0}, "node_id: 0 is out of range; allowed: 1 to 127"),
        (
            {"node_id": None},
            "node_id: must be an integer, but is a date or time (None); write node_id = 1",
        ),
        ({"chanels": 2}, "chanels: unknown key"),
        ({"channels": 5}, "channels: 5 is out of range; allowed: 1 to 4"),
        ({"channel": {"2": {}}}, "channel.2: unknown key"),
        (
            {"channel": {"1": 3}},
            "channel.1: must be a table, but is an integer (3); write [channel.1]",
        ),
        ({"channel": {"1": {"servo": {}}}}, "channel.1.servo: unknown key"),
        (
            {"channel": {"1": {"plant": {"preset": "tank"}}}},
            'channel.1.plant.preset: unknown preset "tank"',
        ),
        ({"plant": {"gear_ratio": 3}}, "plant: resistance_ohm, inductance_h"),
        (
            {"amplifier": {"current_per_volt_a_v": 0}},
            "amplifier.current_per_volt_a_v: 0 A/V is out of range; allowed: 1e-06 to 1e+06 A/V",
        ),
        ({"amplifier": {"gain": 1}}, "amplifier.gain: unknown key"),
        ({"amplifier": {"current_steps": 3}}, "3 steps do not divide 250000 ns"),
        (
            {"channel": {"1": {"amplifier": {"enable_s": -1}}}},
            "channel.1.amplifier.enable_s: -1 s is out of range; allowed: 0 to 3600 s",
        ),
        (
            {"channel": {"1": {"initial_position_rad": 1e9}}},
            "channel.1.initial_position_rad: 21",
        ),
        (
            {"plant": {"preset": "wheel_60w", "coupling_stiffness_n_m_rad": 1e10}},
            "plant.coupling_stiffness_n_m_rad: 1e+10 N m/rad: oscillates at 938729 rad/s",
        ),
        (
            {
                "channel": {
                    "1": {"plant": {"preset": "mast_20w", "coupling_stiffness_n_m_rad": 1e10}}
                }
            },
            "channel.1.plant.coupling_stiffness_n_m_rad: 1e+10 N m/rad: oscillates",
        ),
        ({"timing": {"boot_s": 3}}, "timing.boot_s: unknown key"),
        ({"eds": "none.eds"}, "eds: file "),
        (
            {"eds": str(DRIVE_EDS)},
            "has none of 6000h:1, 6200h:1, 6411h:1, 6820h:1: it is not the EDS",
        ),
        (
            {"objects": {"6443h:2": 0}},
            "objects.'6443h:2': motorhil_cia401.eds has no such object; leave it out",
        ),
        ({"objects": {"6443h:1": 2}}, "objects.'6443h:1': 2 is outside 0..1"),
        ({"objects": {"6443h:1": 0.5}}, "objects.'6443h:1': 0.5 is not a whole number"),
        ({"objects": {"6443h:1": "x"}}, "objects.'6443h:1': 'x' is not a number"),
    ],
)
def test_wrong_setting_is_refused_by_name(table, text):
    with pytest.raises(SettingError) as caught:
        build({"node_id": 5, **table}, ControllerContext("io", Path(), 1))
    assert text in str(caught.value)


def test_objects_of_rig_are_power_on_values():
    table = {"node_id": 5, "objects": {"6444h:1": -3277, "1008h": "mine"}}
    node = build(table, ControllerContext("io", Path(), 1))
    assert node.od.integer(0x6444, 1, 0) == -3277
    assert node.od.get(0x1008).default == b"mine"


def test_own_file_has_only_used_objects_and_no_warning():
    node = build({"node_id": 5, "channels": 4}, ControllerContext("io", Path(), 1))
    assert list(node.take_events()) == []
    readers = [index for index in (0x6000, 0x6820) if node.od.get(index, 1).reader is None]
    writers = [index for index in (0x6200, 0x6411, 0x6810) if node.od.get(index, 1).writer is None]
    assert (readers, writers) == ([], [])


def eds_with(*objects: tuple[int, int]) -> str:
    """Return an EDS with arrays of that many elements (CiA 306)."""
    text = "[DeviceInfo]\n[1000]\nParameterName=t\nDataType=7\nAccessType=ro\nDefaultValue=0x191\n"
    for index, elements in objects:
        data_type = 3 if index == 0x6411 else 5
        text += f"[{index:x}]\nParameterName=a\nObjectType=8\nSubNumber={elements + 1}\n"
        text += f"[{index:x}sub0]\nParameterName=n\nDataType=5\nAccessType=ro\n"
        text += f"DefaultValue={elements}\n"
        for sub in range(1, elements + 1):
            text += f"[{index:x}sub{sub:x}]\nParameterName=e\nDataType={data_type}\n"
            text += "AccessType=rw\nDefaultValue=0\n"
    return text


def test_node_takes_an_eds_of_digital_io_alone(tmp_path: Path):
    (tmp_path / "io.eds").write_text(eds_with((0x6000, 2), (0x6200, 2)))
    io = IoBench(folder=tmp_path, eds="io.eds")
    io.operational()
    assert io.read(0x6200, 0) == 2
    io.set(0x6200, 2, 0xA5, 1)
    assert io.read(0x6200, 2, signed=False) == 0xA5
    assert io.write(0x6411, 1, 0, 2) == 0x0602_0000
    notes = [text for level, text in io.events if level == "info"]
    assert notes[0] == (
        "channel 1: io.eds has no 6411h:1, 6820h:1: no host reaches this part;"
        " expected only of digital I/O"
    )


def test_node_serves_all_outputs_of_a_vendor_eds(tmp_path: Path):
    (tmp_path / "io.eds").write_text(eds_with((0x6200, 1), (0x6411, 6)))
    io = IoBench(folder=tmp_path, eds="io.eds", channels=2)
    io.boot()
    assert io.read(0x6411, 0) == 6
    io.set(0x6411, 6, -5, 2)
    assert io.read(0x6411, 6) == -5
    assert (
        "info",
        "6411h:3, 6411h:4, 6411h:5, 6411h:6 of io.eds drive no motor: the node has 2 channels",
    ) in io.events
