"""Gravity of turning axes: an arm, emulated as a pendulum."""

from math import atan2, hypot

import numpy as np
import pytest

from motorhil.emulators.firmware.axis import Axis
from motorhil.emulators.firmware.servo_tables import ServoGains
from motorhil.emulators.plant.dc_motor import MotorPlant
from motorhil.emulators.plant.nonlinear import PlantExtras
from motorhil.harness.identification.inverse_model import GRAVITY, fitted
from motorhil.harness.identification.output_error import refined
from motorhil.harness.identification.plant_table import plant_keys
from motorhil.harness.identification.samples import Samples

GEAR = 50.0
PLANT = MotorPlant(
    resistance_ohm=0.6,
    inductance_h=1e-4,
    torque_constant_n_m_a=0.05,
    rotor_inertia_kg_m2=1e-5,
    load_inertia_kg_m2=0.05,
    gear_ratio=GEAR,
    encoder_increments_rev=4096,
    supply_v=48.0,
    current_max_a=10.0,
    coulomb_friction_n_m=4e-3,
    viscous_friction_n_m_s_rad=2e-5,
    extras=PlantExtras(gravity_torque_n_m=1.5, gravity_zero_rad=0.7),
)
INERTIA = 0.05 + GEAR**2 * 1e-5


def recording(travel_rad=2.5, duration_s=10.0):
    """Return samples of an arm that swings there and back, at 250 Hz, with noise of the torque."""
    axis = Axis(PLANT, ServoGains.tuned(PLANT, 1_000_000, 10))
    axis.power(True)
    draws = np.random.default_rng(2)
    per_rad, following = PLANT.increments_per_rad() * GEAR, 0
    position, torque = [], []
    for now_ms in range(0, int(duration_s * 1000), 4):
        axis.at(now_ms * 1_000_000)
        if now_ms >= following:
            target = int(draws.uniform(0.0, travel_rad) * per_rad)
            hard = draws.uniform(5.0, 15.0) * per_rad
            axis.move_to(target, draws.uniform(0.5, 3.0) * per_rad, hard, hard)
            following = now_ms + int(draws.uniform(900, 1600))
        position.append(axis.position_inc() / per_rad)
        torque.append(axis.torque_n_m() + 0.01 * draws.standard_normal())
    return Samples("arm", "rad", 0.004, np.array(position), np.array(torque), "emulated")


def test_a_pendulums_torque_is_found_beside_inertia_and_friction():
    samples = recording()
    fit = refined(samples, fitted(samples))
    sine, cosine = (fit.parameters[name].value for name in GRAVITY)
    assert hypot(sine, cosine) == pytest.approx(1.5, rel=0.02)
    assert atan2(-cosine, sine) == pytest.approx(0.7, abs=0.02)
    assert fit.parameters["inertia"].value == pytest.approx(INERTIA, rel=0.02)
    coulomb = fit.parameters["coulomb"]
    assert coulomb.relative < 0.05
    assert abs(coulomb.value - GEAR * 4e-3) < 3.0 * coulomb.deviation
    keys = plant_keys(fit, "rad", GEAR)
    assert keys["gravity_torque_n_m"] == pytest.approx(1.5, rel=0.02)
    assert keys["gravity_zero_rad"] == pytest.approx(0.7, abs=0.02)


def test_a_short_travel_shows_gravity_as_a_constant_load():
    samples = recording(travel_rad=0.3)
    fit = fitted(samples)
    assert fit.names == ("inertia", "viscous", "coulomb", "offset")
    assert fit.parameters["offset"].value == pytest.approx(1.5 * np.sin(0.15 - 0.7), rel=0.1)
