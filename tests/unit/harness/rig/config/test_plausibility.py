"""Values that are permitted but hardly meant: each is a note with file, line and likely slip."""

from pathlib import Path

import pytest

from motorhil.emulators.plant.presets import PRESETS
from motorhil.harness.cli.main import main
from motorhil.harness.plugins import ADAPTATIONS, CONTROLLERS, SETTINGS, installed
from motorhil.harness.rig.config.buses import BusTable
from motorhil.harness.rig.config.conformance import ConformanceTable
from motorhil.harness.rig.config.faults import FaultTable
from motorhil.harness.rig.config.rig_file import parse_rig
from motorhil.harness.rig.config.stimuli import StimulusTable
from motorhil.harness.rig.config.toml import Source
from motorhil.harness.rig.reading import installed_plugins
from motorhil.harness.rig.rig import Rig
from motorhil.motorapi.model import MotorModel
from motorhil.settings import Items, Number, TableOf, TablesByKey, declaration

ROOT = Path(__file__).parents[5]
RIGS = [
    *sorted(ROOT.glob("harness/conformance/rigs/*.toml")),
    *(ROOT / f"harness/examples/{name}.toml" for name in ("rover", "fido", "rocky8", "two_wheels")),
    ROOT / "harness/examples/ideal_wheels.toml",
]
TEXT = """\
[bus.can0]
bitrate_bit_s = 1_000_000
[controller.wheel]
kind = "cia402"
bus = "can0"
node_id = 1
plant.preset = "wheel_60w"
[motor.wheel]
adaptation = "cia402"
controller = "wheel"
[motor.wheel.model]
velocity_max_rad_s = 6.0
acceleration_max_rad_s2 = 20.0
"""
# A limit belongs to the drive's own units, or is as narrow as any plausible range.
WITHOUT_RANGE = ("bytes", "quanta", "characters", "ppm", "1/s", "V/A", "V/(A·s)")


def notes(text):
    with Rig(parse_rig(Source(Path("rig.toml"), text), installed_plugins())) as rig:
        return rig.notes


@pytest.mark.parametrize(
    ("line", "instead", "key", "told"),
    [
        (2, "bitrate_bit_s = 1000", "bus.can0.bitrate_bit_s",
         "1000 bit/s is implausible; usual: 10000 to 1000000 bit/s;"
         " if it is in kbit/s, write 1000000"),
        (7, "plant = { preset = 'wheel_60w', inductance_h = 0.119 }",
         "controller.wheel.plant.inductance_h",
         "0.119 H is implausible; usual: 1e-06 to 0.1 H; if it is in mH, write 0.000119"),
        (7, "plant = { preset = 'wheel_60w', inductance_h = 0.040 }",
         "controller.wheel.plant.inductance_h",
         "0.04 H and 0.611 ohm are an electrical time constant of 65.47 ms, which is implausible"
         " for a motor with a stall torque of 1.02 N·m; usual: 0.001 to 50 ms; data sheets give"
         " mH"),
        (7, "plant = { preset = 'wheel_60w', torque_constant_n_m_a = 25.9 }",
         "controller.wheel.plant.torque_constant_n_m_a",
         "25.9 N·m/A is implausible; usual: 0.0001 to 10 N·m/A;"
         " if it is in mN·m/A, write 0.0259"),
        (7, "plant = { preset = 'wheel_60w', rotor_inertia_kg_m2 = 33.7 }",
         "controller.wheel.plant.rotor_inertia_kg_m2",
         "33.7 kg·m² is implausible; usual: 1e-10 to 1 kg·m²;"
         " if it is in g·cm², write 3.37e-06"),
        (7, "plant = { preset = 'wheel_60w', coulomb_friction_n_m = 4.0 }",
         "controller.wheel.plant.coulomb_friction_n_m",
         "4 N·m is not below the motor's greatest torque, 0.2072 N·m: it cannot turn;"
         " data sheets give mN·m"),
        (7, "plant.preset = 'wheel_60w'\ntiming.boot_up_s = 300", "controller.wheel.timing"
         ".boot_up_s",
         "300 s is implausible; usual: 0.001 to 60 s; if it is in ms, write 0.3"),
        (7, "plant.preset = 'wheel_60w'\nservo.tick_s = 0.02", "controller.wheel.servo.tick_s",
         "0.02 s is longer than the mechanical time constant of motor and load, 13.51 ms: the"
         " servo cannot control it; if it is in ms, write 2e-05"),
        (9, "adaptation = 'cia402'\nservo_period_ms = 0.001", "motor.wheel.servo_period_ms",
         "0.001 ms is implausible; usual: 0.01 to 20 ms; if it is in s, write 1"),
        (12, "velocity_max_rad_s = 60.0", "motor.wheel.model.velocity_max_rad_s",
         "60 rad/s is above the no-load speed of the plant with gear_ratio = 66, 13.97 rad/s;"
         " if it is in rpm, write 6.28319"),
        (13, "acceleration_max_rad_s2 = 1146.0", "motor.wheel.model.acceleration_max_rad_s2",
         "1146 rad/s² is above the greatest acceleration of the plant with gear_ratio = 66,"
         " 211.4 rad/s²; if it is in rpm/s, write 120.009"),
        (13, "acceleration_max_rad_s2 = 20.0\ntorque_max_n_m = 1200.0",
         "motor.wheel.model.torque_max_n_m",
         "1200 N·m is above the greatest torque of the plant with gear_ratio = 66, 13.68 N·m;"
         " if it is in mN·m, write 1.2"),
    ],
)  # fmt: skip
def test_implausible_value_is_one_note_with_its_slip(line, instead, key, told):
    lines = TEXT.splitlines()
    lines[line - 1] = instead
    at = line + instead.count("\n")
    assert notes("\n".join(lines)) == [f"rig.toml:{at}: warning: {key}: {told}"]


@pytest.mark.parametrize("path", RIGS, ids=lambda path: path.stem)
def test_rig_of_the_project_has_no_doubts(path):
    with Rig.open(path) as rig:
        assert [note for note in rig.notes if "warning" in note] == []


@pytest.mark.parametrize("preset", PRESETS)
def test_motor_of_a_data_sheet_has_no_doubts(preset):
    slow = TEXT.replace("= 6.0", "= 0.1").replace("= 20.0", "= 0.1")
    assert notes(slow.replace("wheel_60w", preset)) == []


def test_model_file_is_named_with_its_own_line(tmp_path, capsys):
    assert main(["new", str(tmp_path / "wheels")]) == 0
    rig, model = tmp_path / "wheels/rig.toml", tmp_path / "wheels/wheel_model.toml"
    assert main(["check", str(rig)]) == 0
    assert "warning" not in capsys.readouterr().err
    text = model.read_text()
    model.write_text(text.replace("velocity_max_rad_s = 6.0", "velocity_max_rad_s = 57.3"))
    line = text[: text.index("velocity_max")].count("\n") + 1
    script = tmp_path / "nothing.py"
    script.write_text("")
    told = f"{model}:{line}: warning: velocity_max_rad_s: 57.3 rad/s is above the no-load speed of"
    for words in (["check", str(rig)], ["run", str(rig), str(script)]):
        assert main(words) == 0
        assert capsys.readouterr().err.count(told) == 1  # not once for each motor


def test_recording_keeps_the_doubts_about_its_controllers(tmp_path, capsys):
    rig, record = tmp_path / "rig.toml", tmp_path / "out.mcap"
    rig.write_text(TEXT.replace('"wheel_60w"', '"wheel_60w"\nplant.inductance_h = 0.119'))
    with Rig.open(rig, record=record):
        pass
    assert main(["show", str(record)]) == 0
    assert "warning: controller.wheel.plant.inductance_h: 0.119 H" in capsys.readouterr().out


def quantities(of, path):
    """Yield (path, kind) of each number in a declaration that has a unit."""
    for name, key in declaration(of).keys.items():
        yield from numbers(key.kind, f"{path}.{name}")


def numbers(kind, path):
    if isinstance(kind, Number) and kind.unit:
        yield path, kind
    elif isinstance(kind, TableOf):
        yield from quantities(kind.of, path)
    elif isinstance(kind, Items | TablesByKey):
        yield from numbers(kind.item, path)


def test_every_quantity_has_a_plausible_range():
    tables = [BusTable, MotorModel, FaultTable, StimulusTable, ConformanceTable]
    for group in (CONTROLLERS, ADAPTATIONS):
        tables += [
            one.load() for one in installed(SETTINGS[group]).values() if "motorhil." in one.target
        ]
    found = [pair for of in tables for pair in quantities(of, declaration(of).name)]
    assert len(found) > 150
    lacking = [
        f"{path} [{kind.unit}]"
        for path, kind in found
        if kind.plausible is None
        and kind.unit not in WITHOUT_RANGE
        and "/inc" not in kind.unit
        and "{u}" not in kind.unit.partition("/")[2]
        and abs(kind.low) != abs(kind.high)
    ]
    assert lacking == []
