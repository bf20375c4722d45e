"""Data-sheet values with a slipped unit are told; motors of data sheets are not."""

from dataclasses import replace

import pytest

from motorhil.emulators.plant.presets import PRESETS


@pytest.mark.parametrize("name", PRESETS)
def test_motors_of_data_sheets_are_plausible(name):
    assert PRESETS[name].doubts() == []


@pytest.mark.parametrize(
    ("key", "factor", "told"),
    [
        ("inductance_h", 1000.0, "electrical time constant"),  # mH
        ("torque_constant_n_m_a", 1000.0, "no-load speed"),  # mN m/A
        ("rotor_inertia_kg_m2", 1e7, "mechanical time constant"),  # g cm2
    ],
)
def test_slipped_unit_is_told_with_its_value(key, factor, told):
    plant = PRESETS["wheel_60w"]
    wrong = replace(plant, **{key: getattr(plant, key) * factor})
    (line,) = [line for line in wrong.doubts() if told in line]
    assert f"{key} = {getattr(wrong, key):g}" in line
