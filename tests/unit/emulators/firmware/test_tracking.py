"""Tracking and settling of a typical robot wheel with the tuned gains."""

import math
from dataclasses import replace

import pytest

from motorhil.emulators.firmware.axis import Axis
from motorhil.emulators.firmware.flags import PROFILE_ACTIVE
from motorhil.emulators.firmware.servo_tables import ServoGains
from motorhil.emulators.plant.presets import PLAUSIBLE, WHEEL_60W

MS = 1_000_000


def follow_a_move(plant, distance, v, a, load_n_m=0.0):
    """Return peak following errors in motion and 50 ms after it, and the overshoot [inc]."""
    axis = Axis(plant, ServoGains.tuned(plant, MS, 10), MS, 10)
    axis.power(True)
    axis.set_load(load_n_m)
    axis.at(1_000 * MS)
    axis.move_to(distance, v, a, a)
    moving = overshoot = 0
    k = 1_000
    while axis.flags & PROFILE_ACTIVE:
        k += 1
        axis.at(k * MS)
        moving = max(moving, abs(axis.following_error_inc()))
    settled = 0
    for after in range(1_000):
        axis.at((k + after) * MS)
        overshoot = max(
            overshoot, int(math.copysign(1, distance)) * (axis.position_inc() - distance)
        )
        if after >= 50:
            settled = max(settled, abs(axis.following_error_inc()))
    return moving, settled, overshoot


@pytest.mark.parametrize("name", PLAUSIBLE)
@pytest.mark.parametrize("distance", [200_000, -30_000, 2_000])
@pytest.mark.parametrize("load_share", [0.0, 0.3, -0.3])
def test_trapezoid_is_followed_within_few_increments(name, distance, load_share):
    plant = PLAUSIBLE[name]
    load = load_share * plant.torque_constant_n_m_a * plant.current_max_a * plant.gear_ratio
    moving, settled, overshoot = follow_a_move(plant, distance, 150_000.0, 500_000.0, load)
    assert moving <= 30  # of 2000 per turn of the motor: 0.08 degrees behind the gear
    assert settled <= 1
    assert overshoot <= 2


def test_sudden_load_is_rejected():
    axis = Axis(WHEEL_60W, ServoGains.tuned(WHEEL_60W, MS, 10), MS, 10)
    axis.power(True)
    axis.at(100 * MS)
    axis.set_load(3.0)
    worst = 0
    for k in range(100, 600):
        axis.at(k * MS)
        worst = max(worst, abs(axis.following_error_inc()))
    assert 5 < worst < 100
    assert axis.position_inc() == 0


def test_tuned_current_loop_has_no_overshoot():
    """Zero on the pole, closed-loop pole at 0.6: the error is 0.6^n (a first-order lag)."""
    g = ServoGains.tuned(WHEEL_60W, MS, 10)
    decay = math.exp(-1e-4 * 0.611 / 0.119e-3)
    gain = (1 - decay) / 0.611
    current, integrator = 0.0, 0.0
    for n in range(1, 12):
        error = 1.0 - current
        current = decay * current + gain * (g.current_kp_v_a * error + integrator)
        integrator += g.current_ki_v_a_s * 1e-4 * error
        assert 1.0 - current == pytest.approx(0.6**n, rel=1e-9)  # rounding


def test_coarse_encoder_gets_softer_servo():
    fine = ServoGains.tuned(WHEEL_60W, MS, 10)
    coarse = ServoGains.tuned(replace(WHEEL_60W, encoder_increments_rev=24), MS, 10)
    assert coarse.position_kp_1_s < 0.6 * fine.position_kp_1_s
    increment_a = coarse.velocity_kp_a_s_inc * 0.5 / 1e-3
    assert increment_a == pytest.approx(0.4 * WHEEL_60W.current_max_a, rel=1e-9)
