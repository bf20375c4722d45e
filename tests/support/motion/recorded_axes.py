"""Recordings of emulated axes with random plants, as a drive would tell them.

The drive's servo follows trapezoids. Its torque has noise, and is told in thousandths of the rated
torque; its position is told in increments of the encoder. A drive tells the torque of the instant,
or the mean of the period, as 2027h "current actual value averaged" of an EPOS2 (maxon's EDS).
"""

import numpy as np

from motorhil.emulators.firmware.axis import Axis
from motorhil.emulators.firmware.servo_tables import ServoGains
from motorhil.emulators.plant.dc_motor import MotorPlant
from motorhil.harness.identification.samples import Samples

TORQUE_CONSTANT = 0.05


def random_plant(draws):
    """Return a plant with its highest speed and acceleration, both at the motor."""
    gear = float(draws.choice([1, 5, 20, 66, 100]))
    rotor = 10 ** draws.uniform(-6, -4)
    load = rotor * gear**2 * draws.uniform(0.2, 3)
    speed = draws.uniform(20, 60)
    acceleration = speed / draws.uniform(0.15, 0.4)
    torque = (rotor + load / gear**2) * acceleration
    coulomb = torque * draws.uniform(0.1, 0.5)
    viscous = torque / speed * draws.uniform(0.1, 0.5)
    size = draws.uniform(0.05, 0.3) * draws.choice([-1, 1])
    current = 6 * torque / TORQUE_CONSTANT
    plant = MotorPlant(
        resistance_ohm=4.8 / current,
        inductance_h=4.8 / current * 3e-4,
        torque_constant_n_m_a=TORQUE_CONSTANT,
        rotor_inertia_kg_m2=rotor,
        encoder_increments_rev=int(draws.choice([2000, 4096, 16384])) * (1 if gear > 10 else 8),
        supply_v=24.0,
        current_max_a=current,
        coulomb_friction_n_m=coulomb,
        viscous_friction_n_m_s_rad=viscous,
        gear_ratio=gear,
        load_inertia_kg_m2=load,
        load_torque_n_m=size * torque * gear,
    )
    return plant, speed, acceleration


def random_recording(seed, rate_hz=1000, duration_s=12.0, noise=0.01, *, averaged=False):
    """Return samples of a random axis, and its true parameters at the output.

    `noise` is the standard deviation of the torque, as a share of the rated torque. Torques are
    means of their period if `averaged`.
    """
    draws = np.random.default_rng(seed)
    plant, speed, acceleration = random_plant(draws)
    axis = Axis(plant, ServoGains.tuned(plant, 1_000_000, 10))
    axis.power(True)
    per_rad, gear = plant.increments_per_rad(), plant.gear_ratio
    count, every = int(duration_s * rate_hz), 1000 // rate_hz
    position, torque = np.empty(count), np.empty(count)
    target, following_ms, total = 0.0, 0, 0.0
    for now_ms in range(count * every):
        axis.at(now_ms * 1_000_000)
        if now_ms >= following_ms:
            fast = speed * draws.uniform(0.2, 1)
            hard = acceleration * draws.uniform(0.5, 1)
            target += draws.choice([-1, 1]) * fast * draws.uniform(0.4, 1.2)
            axis.move_to(int(target * per_rad), fast * per_rad, hard * per_rad, hard * per_rad)
            following_ms = now_ms + int(1000 * draws.uniform(0.7, 1.5))
        total += axis.torque_n_m()
        if now_ms % every == 0:
            position[now_ms // every] = axis.position_inc() / per_rad / gear
            torque[now_ms // every] = total / every if averaged else axis.torque_n_m()
            total = 0.0
    rated = 3 * plant.inertia_kg_m2() * acceleration * gear
    torque += noise * rated * draws.standard_normal(count)
    true = {
        "inertia": plant.inertia_kg_m2() * gear**2,
        "viscous": plant.viscous_friction_n_m_s_rad * gear**2,
        "coulomb": plant.coulomb_friction_n_m * gear,
        "offset": plant.load_torque_n_m,
    }
    told = np.round(torque / rated * 1000) / 1000 * rated
    return Samples("axis", "rad", 1.0 / rate_hz, position, told, "emulated"), true
