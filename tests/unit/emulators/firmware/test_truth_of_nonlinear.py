"""The true state of a drive has its plant's extras only."""

from pathlib import Path

import pytest

from motorhil.emulators.controller import ControllerContext
from tests.support.cia402.bench import MS, Bench, new_drive
from tests.support.cia402.homing_bench import Track

EXTRAS = {
    "preset": "wheel_60w",
    "source_resistance_ohm": 0.5,
    "i2t_continuous_a": 1.0,
    "i2t_peak_a": 3.0,
    "thermal_resistance_winding_housing_k_w": 1.0,
    "thermal_resistance_housing_ambient_k_w": 5.0,
    "thermal_time_constant_winding_s": 10.0,
    "thermal_time_constant_motor_s": 500.0,
    "ambient_c": 31.0,
}
NAMES = ["dc_link_v", "winding_temperature_c", "i2t_level"]


def built(kind, plant):
    if kind == "cia402":
        return new_drive(plant=plant)
    module = __import__(f"motorhil.emulators.{kind}.drive", fromlist=["build"])
    table = {"unit": 1, "plant": plant}
    return module.build(table, ControllerContext(name="drive", folder=Path(), seed=1))


@pytest.mark.parametrize("kind", ["cia402", "leadshine_pr", "oriental_az"])
def test_truth_has_values_of_plant_extras_only(kind):
    drive = built(kind, EXTRAS)
    drive.start(0)
    truth = drive.snapshot(10 * MS)
    assert [truth[name] for name in NAMES] == [drive.axis.dc_link_v(), 31.0, 0.0]
    drive = built(kind, {"preset": "wheel_60w"})
    drive.start(0)
    assert not {*NAMES, "inputs"} & set(drive.snapshot(10 * MS))


def test_inputs_of_switches_are_in_truth_at_rest():
    bench = Bench(switches=Track().table())
    bench.run(1_000 * MS)
    assert bench.truth("inputs") == 4  # it stands on the home switch
    bench.drive.stimulate("positive_limit", 1, bench.now)
    assert bench.truth("inputs") == 6
