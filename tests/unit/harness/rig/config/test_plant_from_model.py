"""Plants with parameters from motor models, also for channels."""

import pytest

from motorhil.harness.rig.config.derived import plant_numbers
from motorhil.harness.rig.config.toml import RigError
from motorhil.harness.rig.rig import Rig
from motorhil.motorapi import MotionKind, MotorModel

NODE = """\
[bus.can0]
bitrate_bit_s = 1_000_000
[controller.node]
kind = "cia401"
bus = "can0"
node_id = 1
channels = 2
[controller.node.plant]
preset = "wheel_60w"
from_motor_model = true
[motor.a]
adaptation = "bare"
controller = "node"
channel = 1
[motor.a.model]
velocity_max_rad_s = 6.0
acceleration_max_rad_s2 = 20.0
gear_ratio = -50.0
encoder_increments_rev = 1000
current_max_a = 3.0
[motor.b]
adaptation = "bare"
controller = "node"
channel = 2
[motor.b.model]
velocity_max_rad_s = 6.0
acceleration_max_rad_s2 = 20.0
gear_ratio = 50.0
encoder_increments_rev = 1000
current_max_a = 3.0
"""
OF_CHANNEL_2 = """\
[controller.node.channel.2.plant]
from_motor_model = true
load_inertia_kg_m2 = 0.125
"""


def model(kind=MotionKind.ROTARY, **numbers):
    return MotorModel(name="m", kind=kind, velocity_max=1.0, acceleration_max=1.0, **numbers)


def opened(bench, text):
    (bench / "rig.toml").write_text(text)
    with Rig.open("rig.toml") as rig:
        channels = rig.controllers["node"].core.settings.channels
        return [channel.plant for channel in channels], rig.notes


def refusal(bench, text):
    with pytest.raises(RigError) as caught:
        opened(bench, text)
    return str(caught.value)


def test_plant_takes_gear_and_encoder_from_the_model():
    numbers = plant_numbers(model(gear_ratio=-66.0, encoder_increments_rev=2000.0), {})
    assert numbers == {"gear_ratio": 66.0, "encoder_increments_rev": 2000}
    increments = model(gear_ratio=50.0, increments_per_unit=50.0 * 1000 / 6.283185307179586)
    assert plant_numbers(increments, {}) == {"gear_ratio": 50.0, "encoder_increments_rev": 1000}


def test_plant_of_a_linear_motor_takes_only_the_encoder():
    slide = model(MotionKind.LINEAR, gear_ratio=200.0, encoder_increments_rev=500.0)
    assert plant_numbers(slide, {}) == {"encoder_increments_rev": 500}


def test_values_of_the_rig_take_precedence():
    known = model(gear_ratio=66.0, encoder_increments_rev=2000.0, current_max=4.0)
    said = {"gear_ratio": 33.0, "encoder_increments_rev": 500, "current_max_a": 2.0}
    assert plant_numbers(known, said) == {}


def test_fractional_encoder_increments_are_refused():
    with pytest.raises(ValueError, match=r"increments, 1000\.5, are 1000\.5 per motor turn: no"):
        plant_numbers(model(encoder_increments_rev=1000.5), {})


def test_channels_with_equal_models_may_ask_together(bench):
    plants, notes = opened(bench, NODE)
    for plant in plants:
        facts = (plant.gear_ratio, plant.encoder_increments_rev, plant.current_max_a)
        assert facts == (50.0, 1000, 3.0)
    assert notes[0] == (
        "rig.toml:10: controller.node.plant: current_max_a = 3, gear_ratio = 50, "
        'encoder_increments_rev = 1000 taken from motor model "a": a mistake in it is on both sides'
    )


def test_channels_with_different_models_must_ask_separately(bench):
    text = NODE.replace("gear_ratio = 50.0", "gear_ratio = 60.0")
    assert refusal(bench, text) == (
        'rig.toml:10: controller.node.plant.from_motor_model: the models of motors "a" '
        'and "b" differ; write it in [controller.node.channel.1.plant] and so on'
    )
    text = text.replace("from_motor_model = true\n", "", 1) + OF_CHANNEL_2
    plants, notes = opened(bench, text)
    assert [plant.gear_ratio for plant in plants] == [66.0, 60.0]  # the preset's, the model's
    assert [plant.load_inertia_kg_m2 == 0.125 for plant in plants] == [False, True]
    assert plants[1].resistance_ohm == plants[0].resistance_ohm
    assert notes[0].startswith("rig.toml:31: controller.node.channel.2.plant: current_max_a = 3, g")


@pytest.mark.parametrize(
    ("old", "new", "told"),
    [
        ("channel = 2\n", "channel = 1\n", "no motor of this rig uses this controller; "),
        ("true\nload", "1\nload", "must be true or false, but is an integer (1)"),
        ("1000\ncurrent_max_a = 3.0\n[con", "0.2\n[con", "the motor model's increments, 0.2, are"),
    ],
)
def test_unusable_channel_setting_is_reported_at_its_line(bench, old, new, told):
    text = NODE.replace("from_motor_model = true\n", "") + OF_CHANNEL_2
    assert old in text
    text = text.replace(old, new, 1)
    line = text.splitlines().index("[controller.node.channel.2.plant]") + 2
    where = f"rig.toml:{line}: controller.node.channel.2.plant.from_motor_model: "
    assert refusal(bench, text).startswith(where + told)


def test_channel_with_own_preset_ignores_the_common_plant(bench):
    text = NODE.replace("current_max_a = 3.0", "current_max_a = 2.25")
    text = text.replace("from_motor_model = true\n", "current_max_a = 9.0\n")
    for preset, current_max_a in (("", 9.0), ('preset = "mast_20w"\n', 2.25)):
        asking = f"[controller.node.channel.2.plant]\nfrom_motor_model = true\n{preset}"
        plants, _ = opened(bench, text + asking)
        assert plants[1].current_max_a == current_max_a
