"""Resonance of axes with an elastic coupling, from their emulated drives."""

import numpy as np
import pytest

from motorhil.emulators.firmware.axis import Axis
from motorhil.emulators.firmware.servo_tables import ServoGains
from motorhil.emulators.plant.dc_motor import MotorPlant
from motorhil.emulators.plant.nonlinear import NO_EXTRAS, PlantExtras
from motorhil.harness.identification.inverse_model import fitted
from motorhil.harness.identification.plant_table import plant_keys
from motorhil.harness.identification.resonance import Resonance, resonance_in
from motorhil.harness.identification.samples import Samples

ROTOR, LOAD = 1e-5, 2e-5


def recording(stiffness, duration_s=10.0, hardest=400.0):
    """Return 1 kHz samples of an axis that moves there and back, torque in 0.5 mN m."""
    extras = NO_EXTRAS
    if stiffness:
        extras = PlantExtras(
            coupling_stiffness_n_m_rad=stiffness, coupling_damping_n_m_s_rad=2e-4 * stiffness
        )
    plant = MotorPlant(
        resistance_ohm=0.5,
        inductance_h=1e-4,
        torque_constant_n_m_a=0.05,
        rotor_inertia_kg_m2=ROTOR,
        load_inertia_kg_m2=LOAD,
        encoder_increments_rev=65_536,
        supply_v=48.0,
        current_max_a=10.0,
        coulomb_friction_n_m=2e-3,
        viscous_friction_n_m_s_rad=1e-5,
        extras=extras,
    )
    axis = Axis(plant, ServoGains.tuned(plant, 1_000_000, 10))
    axis.power(True)
    per_rad, draws, following = plant.increments_per_rad(), np.random.default_rng(1), 0
    position, torque = [], []
    for number in range(int(duration_s * 1000)):
        axis.at(number * 1_000_000)
        if number >= following:
            target = int(draws.uniform(-20, 20) * per_rad)
            axis.move_to(target, 40 * per_rad, hardest * per_rad, hardest * per_rad)
            following = number + int(draws.uniform(400, 900))
        position.append(axis.position_inc() / per_rad)
        torque.append(round(axis.torque_n_m() * 2e3) / 2e3)
    return Samples("axis", "rad", 1e-3, np.array(position), np.array(torque), "emulated")


@pytest.mark.parametrize("stiffness", [0.3, 0.5])
def test_an_elastic_coupling_is_found(stiffness):
    found = resonance_in(recording(stiffness), ROTOR + LOAD)
    antiresonance_hz = np.sqrt(stiffness / LOAD) / (2.0 * np.pi)
    resonance_hz = antiresonance_hz * np.sqrt(1.0 + LOAD / ROTOR)
    assert found.antiresonance_hz == pytest.approx(antiresonance_hz, rel=0.05)
    assert found.resonance_hz == pytest.approx(resonance_hz, rel=0.05)
    distances = (found.antiresonance_hz - antiresonance_hz, found.resonance_hz - resonance_hz)
    assert all(
        abs(one) < 2.0 * deviation
        for one, deviation in zip(distances, found.deviations_hz, strict=True)
    )
    assert found.load_share() == pytest.approx(LOAD / (ROTOR + LOAD), rel=0.1)
    assert found.stiffness(ROTOR + LOAD) == pytest.approx(stiffness, rel=0.05)


def test_a_rigid_axis_has_none_and_says_how_far_it_was_seen():
    found = resonance_in(recording(0.0), ROTOR + LOAD)
    assert not found.is_seen
    assert found.seen_hz > 50.0
    assert found.told().startswith(f"resonance: not seen: none up to {found.seen_hz:.0f} Hz")
    assert "record a chirp of torque" in found.told()


def test_a_resonance_divides_the_inertia_of_the_plant():
    samples = recording(0.0, duration_s=6.0)
    fit = fitted(samples)
    inertia = float(fit.parameters["inertia"].told)
    found = Resonance(100.0, 20.0, 40.0)
    keys = plant_keys(fit, "rad", 2.0, found)
    assert found.load_share() == pytest.approx(0.75)
    assert keys["load_inertia_kg_m2"] == pytest.approx(0.75 * inertia)
    assert keys["rotor_inertia_kg_m2"] == pytest.approx(0.25 * inertia / 4.0)
    stiffness = (2.0 * np.pi * 20.0) ** 2 * 0.75 * inertia
    assert keys["coupling_stiffness_n_m_rad"] == pytest.approx(stiffness)
