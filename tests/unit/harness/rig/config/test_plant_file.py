"""Plants of rigs from files that `motorhil identify` writes."""

import pytest

from motorhil.harness.rig.config.toml import RigError
from motorhil.harness.rig.reading import describe
from motorhil.harness.rig.recording import named_files
from motorhil.harness.rig.rig import Rig
from motorhil.settings import parse_toml

RIG = """
[bus.can0]
bitrate_bit_s = 1_000_000

[controller.node]
kind = "cia402"
bus = "can0"
node_id = 1
plant = { preset = "wheel_60w", file = "plant.toml", gear_ratio = 50.0 }
"""
PLANT = """
[plant]
gear_ratio = 66.0
rotor_inertia_kg_m2 = 2e-5
load_inertia_kg_m2 = 0.0
"""


@pytest.fixture
def rig(tmp_path):
    (tmp_path / "rig.toml").write_text(RIG)
    (tmp_path / "plant.toml").write_text(PLANT)
    return tmp_path / "rig.toml"


def test_values_of_the_file_replace_a_preset_but_not_the_rigs_own(rig):
    plant = describe(rig).controllers["node"].settings["plant"]
    assert plant == {
        "preset": "wheel_60w",
        "rotor_inertia_kg_m2": 2e-5,
        "load_inertia_kg_m2": 0.0,
        "gear_ratio": 50.0,
    }


def test_a_recording_has_the_plants_file_and_its_rig_opens(rig, tmp_path):
    assert named_files(parse_toml(RIG)) == [("plant.toml", "application/toml")]
    with Rig.open(rig, record=tmp_path / "run.mcap"):
        pass
    (tmp_path / "plant.toml").unlink()
    recorded = describe(tmp_path / "run.mcap")
    assert ("plant.toml", "application/toml", PLANT.encode()) in recorded.attached


@pytest.mark.parametrize(
    ("contents", "expected"),
    [
        (None, "no such file"),
        ("[plant", "is not TOML"),
        ("gear_ratio = 1.0\n", "has no table [plant]"),
        ("[plant]\nmass = 1.0\n", "mass"),
        ("[plant]\nrotor_inertia_kg_m2 = -1.0\n", "rotor_inertia_kg_m2"),
    ],
)
def test_a_file_that_is_no_plant_is_refused_in_a_line(rig, tmp_path, contents, expected):
    (tmp_path / "plant.toml").unlink()
    if contents is not None:
        (tmp_path / "plant.toml").write_text(contents)
    with pytest.raises(RigError) as caught, Rig.open(rig):
        pass
    assert expected in str(caught.value)
    assert "\n" not in str(caught.value)
    assert "rig.toml:9" in str(caught.value)
