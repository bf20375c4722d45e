"""Samples of a motor from the plots of a recording."""

import numpy as np
import pytest

from motorhil.harness.identification import samples
from motorhil.harness.report.motors import Line, Motor, Plot
from motorhil.harness.rig.config.toml import RigError
from motorhil.harness.rig.rig import Rig
from tests.support.plugin_rigs import GOOD, WHEEL

MS = 1_000_000
COUNT = 300


def plot(quantity, unit, period_ms, value):
    """Return a plot of a quantity that grows evenly from 0 to a value."""
    times = np.arange(0, COUNT * 10 // period_ms) * period_ms * MS
    values = np.linspace(0.0, value, len(times))
    return Plot(quantity, unit, [Line(quantity, "actual", "the bus", False, times, values)])


@pytest.fixture
def recording(bench, monkeypatch):
    """Return a function that makes a recording whose only motor has these plots."""
    (bench / "rig.toml").write_text(GOOD)
    (bench / "wheel.toml").write_text(WHEEL)

    def made(*plots):
        with Rig.open(bench / "rig.toml", record=bench / "run.mcap"):
            pass
        motor = Motor("axis", "", None, None, list(plots), "")
        monkeypatch.setattr(samples, "motors_of", lambda found: [motor])
        return bench / "run.mcap"

    return made


def test_both_quantities_are_on_the_grid_of_the_positions(recording):
    file = recording(plot("position", "rad", 10, 3.0), plot("torque", "N·m", 30, 6.0))
    found = samples.samples_in(file)
    assert (found.name, found.unit, found.period_s) == ("axis", "rad", 0.01)
    assert found.position[100] == pytest.approx(3.0 * 100 / (COUNT - 1))
    assert found.effort[99] == pytest.approx(6.0 * 33 / 99)
    assert len(found.position) == len(found.effort) == len(found)


def test_parts_of_the_rated_torque_are_scaled(recording):
    file = recording(plot("position", "rad", 10, 3.0), plot("torque", "‰ of rated", 10, 500.0))
    with pytest.raises(RigError, match="holds no torque or force of axis in SI units"):
        samples.samples_in(file)
    assert samples.samples_in(file, how=samples.Reading(rated=2.4)).effort[-1] == pytest.approx(1.2)


def test_values_that_a_line_does_not_repeat_are_held():
    times = np.array([0, 10, 20, 100, 110]) * MS
    line = Line("position", "actual", "the bus", True, times, np.array([0.0, 1.0, 2.0, 3.0, 4.0]))
    grid = np.arange(0, 120, 10) * float(MS)
    found = samples.on_grid(grid, line, 10.0 * MS)
    assert found.tolist() == [0.0, 1.0, 2.0, 2.0, 2.0, 2.0, 2.0, 2.0, 2.0, 2.0, 3.0, 4.0]
