"""How far apart the motions of a motor are in two recordings."""

import numpy as np
import pytest

from motorhil.harness.identification.distance import distances
from motorhil.harness.report.motors import Line, Motor, Plot

MS = 1_000_000
PERIOD_MS = 10


def motor(late_s=0.0, higher=0.0, more=0.0, begin_s=0.0, unit="rad"):
    """Return a motor with two sines of speed, whose torque has another sine more."""
    t = np.arange(begin_s, begin_s + 12.0, PERIOD_MS / 1e3)
    at = t - late_s
    position = higher + np.where(at > 0.0, np.sin(at) + 0.3 * np.sin(3.7 * at), 0.0)
    torque = np.cos(at) + more * np.cos(2.0 * at)
    times = np.round(t * 1000).astype(np.int64) * MS
    plots = [
        Plot(quantity, of, [Line(quantity, "actual", "the bus", False, times, values)])
        for quantity, of, values in (("position", unit, position), ("torque", "N·m", torque))
    ]
    return Motor("axis", "", None, None, plots, "")


def test_equal_motions_are_not_apart():
    shift, found = distances(motor(), motor())
    assert (shift.time_s, shift.position) == (0.0, 0.0)
    assert [(one.quantity, one.unit, one.typical) for one in found] == [
        ("position", "rad", 0.0),
        ("torque", "N·m", 0.0),
    ]


def test_a_later_begin_and_another_zero_are_shifted_away():
    shift, found = distances(motor(late_s=1.0), motor(late_s=2.5, higher=7.0))
    assert shift.time_s == pytest.approx(1.5, abs=0.011)
    assert shift.position == pytest.approx(7.0, abs=0.02)
    assert max(one.share for one in found) < 0.05


def test_a_recording_that_begins_later_is_compared_where_both_are():
    shift, found = distances(motor(late_s=1.0), motor(late_s=1.0, begin_s=0.5))
    assert shift.time_s == pytest.approx(0.0, abs=0.011)
    assert max(one.share for one in found) < 0.02


def test_another_torque_is_told_as_a_share_of_the_first():
    _, found = distances(motor(), motor(more=0.2))
    torque = found[1]
    assert torque.typical == pytest.approx(0.2 / np.sqrt(2.0), rel=0.03)  # a sine's rms
    assert torque.share == pytest.approx(0.2, rel=0.05)
    assert torque.largest == pytest.approx(0.2, rel=0.02)


def test_positions_in_different_units_are_not_compared():
    assert distances(motor(), motor(unit="inc")) is None
