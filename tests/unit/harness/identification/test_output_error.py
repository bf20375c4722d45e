"""Identification of an axis by output error, through an emulated drive."""

from dataclasses import replace

import numpy as np
import pytest

from motorhil.harness.identification.inverse_model import (
    DELAY,
    NAMES,
    SIDES,
    effort_error,
    fitted,
    friction_by_direction,
)
from motorhil.harness.identification.output_error import refined
from motorhil.harness.identification.samples import Samples
from motorhil.harness.rig.config.toml import RigError
from tests.support.motion.measured_axes import PUBLISHED, emps
from tests.support.motion.recorded_axes import random_recording

CASES = 1000


def found(samples):
    return refined(samples, fitted(samples))


def distances(fit, true):
    """Return the distance of each parameter from the truth, in standard deviations."""
    return [
        (fit.parameters[name].value - true[name]) / fit.parameters[name].deviation for name in NAMES
    ]


@pytest.mark.parametrize("seed", [4, 5])
def test_random_plants_at_1_khz_are_found_within_2_percent(seed):
    samples, true = random_recording(seed, duration_s=6.0)
    fit = found(samples)
    for name in NAMES:
        assert fit.parameters[name].value == pytest.approx(true[name], rel=0.02), name
        assert fit.parameters[name].unseen == ""
    assert max(map(abs, distances(fit, true))) < 4.0


def slow_recording(seed, *, averaged):
    return random_recording(seed, rate_hz=100, duration_s=30.0, noise=0.003, averaged=averaged)


@pytest.mark.parametrize("seed", [8, 11])
def test_means_of_the_torque_at_100_hz_show_a_plant_within_10_percent(seed):
    samples, true = slow_recording(seed, averaged=True)
    fit = found(samples)
    for name in NAMES:
        assert fit.parameters[name].value == pytest.approx(true[name], rel=0.1), name
    assert max(map(abs, distances(fit, true))) < 4.0


def test_instants_of_the_torque_at_100_hz_have_larger_deviations():
    """A servo's ripple between the samples is noise then, and the deviations say so."""
    means, instants = (found(slow_recording(8, averaged=one)[0]) for one in (True, False))
    for name in NAMES:
        assert instants.parameters[name].deviation > 3.0 * means.parameters[name].deviation, name


@pytest.mark.nightly
@pytest.mark.timeout(3600)
def test_means_of_the_torque_at_100_hz_show_200_plants_within_10_percent():
    near = np.zeros(len(NAMES))
    for seed in range(200):
        samples, true = slow_recording(seed, averaged=True)
        fit = found(samples)
        for name in NAMES:
            assert fit.parameters[name].value == pytest.approx(true[name], rel=0.1), (seed, name)
        near += np.abs(distances(fit, true)) < 2.0
    assert np.all(near / 200 >= 0.93), near


@pytest.mark.nightly
@pytest.mark.timeout(14_400)
def test_deviations_of_1000_random_plants_are_honest():
    """The truth is within two deviations in 93 to 97 % of the cases (95.4 % by a normal law)."""
    near = np.zeros(len(NAMES))
    for seed in range(CASES):
        samples, true = random_recording(seed, duration_s=8.0)
        near += np.abs(distances(found(samples), true)) < 2.0
    shares = near / CASES
    assert np.all(shares >= 0.93), shares
    assert np.all(shares <= 0.97), shares


def test_efforts_that_are_recorded_late_are_shifted_back():
    samples, true = random_recording(4, duration_s=6.0)
    late = replace(samples, effort=np.roll(samples.effort, 4), position=samples.position)
    own, fit = found(samples), found(late)
    shift = fit.parameters[DELAY].value - own.parameters[DELAY].value
    assert shift == pytest.approx(0.004, abs=1e-4)
    assert fit.parameters["inertia"].value == pytest.approx(true["inertia"], rel=0.01)
    assert fitted(late).parameters["inertia"].value != pytest.approx(true["inertia"], rel=0.01)


def test_noise_without_a_motion_is_refused():
    draws = np.random.default_rng(1)
    noise = Samples(
        "axis", "rad", 0.001, 1e-4 * draws.integers(0, 2, 5000), draws.normal(size=5000), "computed"
    )
    with pytest.raises(RigError, match="axis: the recording does not show the inertia"):
        found(noise)


def test_a_constant_speed_is_refused():
    draws = np.random.default_rng(1)
    position = np.arange(5000) * 0.002 + 1e-4 * draws.integers(0, 2, 5000)
    steady = Samples("axis", "rad", 0.001, position, 1.0 + draws.normal(size=5000), "computed")
    with pytest.raises(RigError, match=r"does not show the inertia.*accelerate harder"):
        found(steady)


@pytest.mark.data
def test_a_measured_axis_agrees_with_the_published_values(shared):
    """EMPS by output error: each parameter within 1 %, efforts of both records as published."""
    pytest.importorskip("scipy.io")
    fit = found(emps(shared, "DATA_EMPS.mat"))
    for name, value in PUBLISHED.items():
        assert fit.parameters[name].value == pytest.approx(value, rel=0.01), name
        assert fit.parameters[name].unseen == ""
    assert fit.error <= 0.042
    assert effort_error(fit, emps(shared, "DATA_EMPS_PULSES.mat")) <= 0.061


@pytest.mark.data
def test_frictions_of_each_direction_agree_with_published_ones(shared):
    """EMPS with asymmetric friction: 166.7 and 240.4 N s/m, 20.14 and 20.63 N, 3.11 % left."""
    pytest.importorskip("scipy.io")
    sides, error = friction_by_direction(emps(shared, "DATA_EMPS.mat"))
    published = dict(zip(SIDES, (166.7, 240.4, 20.14, 20.63), strict=True))
    for name, value in published.items():
        assert sides[name].value == pytest.approx(value, rel=0.01), name
    assert error <= 0.0311
