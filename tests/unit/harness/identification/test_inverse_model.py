"""Identification of an axis by its inverse dynamic model."""

import numpy as np
import pytest

from motorhil.harness.identification.inverse_model import NAMES, Parameter, effort_error, fitted
from motorhil.harness.identification.plant_table import plant_keys, table_of
from motorhil.harness.identification.samples import Samples
from motorhil.harness.rig.config.toml import RigError
from tests.support.motion.measured_axes import PUBLISHED, emps

TRUE = {"inertia": 0.065, "viscous": 0.02, "coulomb": 0.27, "offset": -0.1}


def samples(rate_hz=200.0, duration_s=20.0, noise=0.0, drift=0.0, true=TRUE, speeds=(0.5, 1.3)):
    """Return exact samples of two sines of speed, with noise of the effort from a fixed seed."""
    t = np.arange(0.0, duration_s, 1.0 / rate_hz)
    slow, fast = (2.0 * np.pi * one for one in speeds)
    velocity = drift + np.sin(slow * t) + 0.5 * np.sin(fast * t)
    acceleration = slow * np.cos(slow * t) + 0.5 * fast * np.cos(fast * t)
    position = drift * t - np.cos(slow * t) / slow - 0.5 * np.cos(fast * t) / fast
    effort = (
        true["inertia"] * acceleration
        + true["viscous"] * velocity
        + true["coulomb"] * np.sign(velocity)
        + true["offset"]
        + noise * np.random.default_rng(1).standard_normal(len(t))
    )
    return Samples("axis", "rad", 1.0 / rate_hz, position, effort, "computed")


@pytest.mark.parametrize("rate_hz", [100.0, 200.0, 1000.0])
def test_an_exact_axis_is_found(rate_hz):
    fit = fitted(samples(rate_hz))
    for name in NAMES:
        found = fit.parameters[name]
        assert found.value == pytest.approx(TRUE[name], rel=0.02), name
        assert found.unseen == ""
    assert fit.error < 0.03


def test_noise_widens_the_deviations_and_they_are_honest():
    hits = 0
    for seed in range(20):
        own = samples(noise=0.0)
        noisy = own.effort + 0.05 * np.random.default_rng(seed).standard_normal(len(own))
        fit = fitted(Samples("axis", "rad", own.period_s, own.position, noisy, "computed"))
        one = fit.parameters["coulomb"]
        hits += abs(one.value - TRUE["coulomb"]) < 3.0 * one.deviation
    assert hits >= 18


def test_a_motor_that_never_reverses_shows_no_friction_beside_a_load():
    fit = fitted(samples(drift=3.0))
    for name in ("coulomb", "offset"):
        assert "never reverses" in fit.parameters[name].unseen
        assert fit.parameters[name].remedy == "move there and back"
    assert fit.parameters["inertia"].unseen == ""


def test_what_noise_hides_is_not_seen():
    fit = fitted(samples(noise=3.0, duration_s=5.0, true={**TRUE, "viscous": 0.05}))
    assert fit.parameters["viscous"].unseen == "all speeds are alike"


def test_a_motor_at_rest_is_refused():
    still = Samples("axis", "rad", 0.01, np.zeros(500), np.zeros(500), "computed")
    with pytest.raises(RigError, match="does not move"):
        fitted(still)


def test_another_plant_explains_less_of_the_effort():
    fit = fitted(samples())
    assert effort_error(fit, samples(speeds=(0.4, 1.1))) < 0.05
    heavier = samples(true={**TRUE, "inertia": 0.09}, speeds=(0.4, 1.1))
    assert effort_error(fit, heavier) > 0.15


def test_the_table_has_the_keys_of_a_plant_on_the_motors_side():
    fit = fitted(samples())
    keys = plant_keys(fit, "rad", 10.0)
    assert keys["rotor_inertia_kg_m2"] == pytest.approx(0.065 / 100.0, rel=0.02)
    assert keys["coulomb_friction_n_m"] == pytest.approx(0.27 / 10.0, rel=0.02)
    assert keys["load_torque_n_m"] == pytest.approx(-0.1, rel=0.02)
    assert "[plant]\ngear_ratio = 10.0\n" in table_of(fit, samples(), 10.0)


def test_a_parameter_that_is_not_seen_has_no_key():
    fit = fitted(samples(drift=3.0))
    assert "coulomb_friction_n_m" not in plant_keys(fit, "rad", 1.0)
    assert "not seen: the motor never reverses" in table_of(fit, samples(drift=3.0), 1.0)


@pytest.mark.data
def test_a_measured_axis_agrees_with_what_was_published(shared):
    """EMPS: within 1 % of each parameter, effort error of both records as published or better."""
    pytest.importorskip("scipy.io")
    fit = fitted(emps(shared, "DATA_EMPS.mat"))
    for name, value in PUBLISHED.items():
        assert fit.parameters[name].value == pytest.approx(value, rel=0.01), name
        assert fit.parameters[name].unseen == ""
    assert fit.error <= 0.042
    assert effort_error(fit, emps(shared, "DATA_EMPS_PULSES.mat")) <= 0.061


@pytest.mark.parametrize(
    ("value", "deviation", "told", "share"),
    [
        (0.064582, 0.00019, "0.06458", "0.29%"),
        (0.0038312, 0.00101, "0.0038", "26%"),
        (-0.00039337, 0.00167, "-0.0004", "420%"),
        (1234.5678, 9.8, "1234.6", "0.79%"),
        (9.99, 1.0, "10", "10%"),
        (0.0, 0.1, "0", "-"),
        (2.5, 0.0, "2.5", "-"),
        (2.5, float("inf"), "2.5", "-"),
    ],
)
def test_a_parameter_has_two_digits_of_its_deviation(value, deviation, told, share):
    one = Parameter("inertia", value, deviation)
    assert (one.told, one.share_told) == (told, share)
