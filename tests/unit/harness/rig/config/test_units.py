"""Units that a motor assumes beside those of its emulated drive: contradictions are refused."""

from pathlib import Path

import pytest

from motorhil.harness.rig.config.rig_file import parse_rig
from motorhil.harness.rig.config.toml import RigError, Source
from motorhil.harness.rig.reading import installed_plugins
from motorhil.harness.rig.rig import Rig

# wheel_60w: 2000 increments a turn of the motor, gear 66: 21008.45 increments per rad.
CIA402 = """\
[bus.can0]
bitrate_bit_s = 1_000_000
[controller.wheel]
kind = "cia402"
bus = "can0"
node_id = 1
plant.preset = "wheel_60w"
{drive}
[motor.wheel]
adaptation = "cia402"
controller = "wheel"
[motor.wheel.model]
velocity_max_rad_s = 6.0
acceleration_max_rad_s2 = 20.0
{model}
"""
MODBUS = """\
[bus.serial]
kind = "modbus_rtu"
[controller.wheel]
kind = "{kind}"
bus = "serial"
unit = 1
plant.preset = "wheel_60w"
[motor.wheel]
adaptation = "{adaptation}"
controller = "wheel"
[motor.wheel.model]
velocity_max_rad_s = 6.0
acceleration_max_rad_s2 = 20.0
gear_ratio = {gear}
"""
MODBUS_KINDS = [("leadshine_pr", "leadshine"), ("oriental_az", "oriental_az")]


def built(text):
    with Rig(parse_rig(Source(Path("rig.toml"), text), installed_plugins())) as rig:
        rig.build_motors()
        return rig.compared_units("wheel")


def test_factors_of_the_drive_agree_with_its_plant():
    found = built(CIA402.format(drive="", model=""))
    assert [one.quantity for one in found] == ["position", "velocity unit", "acceleration unit"]
    assert found[0].motor == pytest.approx(66 * 2000 / 6.283185307, rel=1e-9)


@pytest.mark.parametrize("per_rad", [-21008.45, 21010.0])
def test_direction_and_rounding_of_a_model_are_no_contradiction(per_rad):
    assert built(CIA402.format(drive="", model=f"increments_per_rad = {per_rad}"))[0].agrees


@pytest.mark.parametrize(
    ("drive", "model", "told"),
    [
        ("", "increments_per_rad = 318.31", r"318\.31 increments/rad .*21008\.5 for drive"),
        ("plant.gear_ratio = 100.0", "increments_per_rad = 21008.45", "gear_ratio = 100"),
        # A vendor's file: 2000 position units per turn of the shaft, as if there were no gear.
        ('objects = { "6092h:1" = 2000, "6092h:2" = 1, "6091h:1" = 1, "608Fh:1" = 500 }', "",
         r"318\.31 increments/rad for the motor \(6092h = 2000 position units per turn\)"),
        ("", "velocity_unit_rad_s = 0.001", "velocity unit: 0.001 rad/s for the motor"),
        ("", "acceleration_unit_rad_s2 = 0.01", "acceleration unit: 0.01 rad/s²"),
    ],
)  # fmt: skip
def test_contradiction_is_refused_with_both_figures(drive, model, told):
    with pytest.raises(RigError, match=told) as caught:
        built(CIA402.format(drive=drive, model=model))
    assert caught.value.key == "motor.wheel"


@pytest.mark.parametrize(("kind", "adaptation"), MODBUS_KINDS)
def test_gear_of_a_modbus_drive_is_compared(kind, adaptation):
    found = built(MODBUS.format(kind=kind, adaptation=adaptation, gear=-66.0))
    assert [(one.motor, one.drive) for one in found] == [(-66.0, 66.0)]
    with pytest.raises(RigError, match=r"gear: 1 motor turns/turn for the motor"):
        built(MODBUS.format(kind=kind, adaptation=adaptation, gear=1.0))


def test_unknown_unit_is_told_by_the_key_of_a_model_file():
    hidden = 'objects = { "6097h:1" = 7 }'
    with pytest.raises(RigError, match="acceleration_unit_rad_s2 is not known"):
        built(CIA402.format(drive=hidden, model=""))
