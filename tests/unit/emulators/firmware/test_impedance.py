"""Impedance control: a spring, a damper and a constant torque in place of the cascade."""

import math
from dataclasses import replace
from itertools import pairwise

import pytest
from hypothesis import given
from hypothesis import strategies as st

from motorhil.emulators.firmware.axis import NEVER_NS, Axis
from motorhil.emulators.firmware.flags import CURRENT_REACHED, CURRENT_SATURATED, POWERED
from motorhil.emulators.firmware.servo_tables import ServoGains
from motorhil.emulators.plant.nonlinear import PlantExtras
from motorhil.emulators.plant.presets import WHEEL_60W
from tests.support.motion.axes import MS, new_axis, powered_axis

# At the output: 1 inc, 1 A.
INC_RAD = WHEEL_60W.encoder_increments_rev * WHEEL_60W.gear_ratio / (2.0 * math.pi)
N_M_A = WHEEL_60W.torque_constant_n_m_a * WHEEL_60W.gear_ratio
INERTIA = WHEEL_60W.inertia_kg_m2() * WHEEL_60W.gear_ratio**2
FRICTIONLESS = replace(WHEEL_60W, coulomb_friction_n_m=0.0, viscous_friction_n_m_s_rad=0.0)


def pull(axis: Axis, rad: float, kp: float, kd: float, rad_s: float = 0.0, n_m: float = 0.0):
    stiffness, damping = kp / INC_RAD / N_M_A, kd / INC_RAD / N_M_A
    axis.follow_impedance(rad * INC_RAD, rad_s * INC_RAD, stiffness, damping, n_m / N_M_A)


def test_impedance_deflection_is_torque_by_stiffness():
    axis = Axis(FRICTIONLESS, ServoGains.tuned(FRICTIONLESS, MS, 10))
    axis.power(True)
    axis.set_load(2.0)
    pull(axis, 0.5, kp=40.0, kd=3.0)
    axis.at(3000 * MS)
    # Steady state: kp * deflection carries the load; one increment is 0.05 mrad.
    assert axis.output_position_rad() == pytest.approx(0.5 - 2.0 / 40.0, abs=2 / INC_RAD)


def test_impedance_without_damping_swings_at_its_frequency():
    axis = Axis(FRICTIONLESS, ServoGains.tuned(FRICTIONLESS, MS, 10))
    axis.power(True)
    pull(axis, 0.1, kp=20.0, kd=0.0)
    turns = []
    before = 0.0
    for k in range(1, 2000):
        axis.at(k * MS)
        velocity = axis.output_velocity_rad_s()
        if before > 0.0 >= velocity:
            turns.append(k)
        before = velocity
    periods = [b - a for a, b in pairwise(turns)]
    expected_ms = 2e3 * math.pi * math.sqrt(INERTIA / 20.0)
    # The plant's back-EMF is compensated by the current loop; its lag is below a tick.
    assert sum(periods) / len(periods) == pytest.approx(expected_ms, rel=0.03)


def test_impedance_with_damping_only_follows_the_velocity():
    axis = Axis(FRICTIONLESS, ServoGains.tuned(FRICTIONLESS, MS, 10))
    axis.power(True)
    pull(axis, 123.0, kp=0.0, kd=5.0, rad_s=1.5)
    axis.at(2000 * MS)
    assert axis.output_velocity_rad_s() == pytest.approx(1.5, rel=0.01)
    assert axis.demand_inc() == axis.position_inc()  # no position is controlled


@given(st.floats(-10.0, 10.0))
def test_impedance_torque_alone_is_the_current(n_m):
    axis = powered_axis()
    pull(axis, 0.0, kp=0.0, kd=0.0, n_m=n_m)
    axis.at(51 * MS)
    assert axis.current_demand_a() == n_m / N_M_A
    assert axis.flags & (POWERED | CURRENT_REACHED) == POWERED


def test_impedance_beyond_the_current_limit_saturates():
    axis = powered_axis()
    axis.set_current_limit(2.0, 1.0)
    pull(axis, 1.0, kp=500.0, kd=0.0)
    axis.at(51 * MS)
    assert axis.current_demand_a() == 2.0
    assert axis.flags & CURRENT_SATURATED
    pull(axis, -1.0, kp=500.0, kd=0.0)
    axis.at(52 * MS)
    assert axis.current_demand_a() == -1.0


def test_impedance_at_rest_costs_nothing():
    axis = powered_axis()
    pull(axis, 0.001, kp=10.0, kd=1.0)  # within the friction
    axis.at(500 * MS)
    assert axis.event_ns(NEVER_NS) == NEVER_NS
    assert axis.rest() >= 0
    pull(axis, 1.0, kp=10.0, kd=1.0)
    assert axis.rest() == -1


def test_impedance_position_counts_from_set_position():
    axis = powered_axis()
    axis.set_position(1000)
    axis.follow_impedance(1100.0, 0.0, 0.01, 0.0, 0.0)
    axis.at(51 * MS)
    assert axis.current_demand_a() == pytest.approx(1.0, rel=1e-12)
    assert axis.demand_inc() == 1100


def test_impedance_then_move_starts_where_the_motor_is():
    axis = powered_axis()
    pull(axis, 1.0, kp=20.0, kd=2.0)
    axis.at(300 * MS)
    was = axis.position_inc()
    axis.ramp_to_rest(1e6)
    axis.at(301 * MS)
    assert abs(axis.demand_inc() - was) < 0.1 * INC_RAD
    axis.at(2000 * MS)
    assert axis.velocity_inc_s() == 0.0


def test_impedance_acts_on_a_nonlinear_plant():
    plant = replace(FRICTIONLESS, extras=PlantExtras(backlash_rad=0.01, stop_high_rad=0.3))
    axis = Axis(plant, ServoGains.tuned(plant, MS, 10))
    axis.power(True)
    pull(axis, 1.0, kp=20.0, kd=2.0)
    axis.at(2000 * MS)
    assert axis.output_position_rad() == pytest.approx(0.3, abs=1e-6)
    assert axis.torque_n_m() > 5.0


def test_impedance_without_power_is_refused():
    with pytest.raises(RuntimeError, match="power"):
        pull(new_axis(), 1.0, 1.0, 1.0)


def test_impedance_readings_do_not_depend_on_who_reads():
    once, often = powered_axis(), powered_axis()
    for axis in (once, often):
        pull(axis, 0.7, kp=15.0, kd=1.0, n_m=0.5)
    for k in range(51, 800):
        often.at(k * MS)
        often.event_ns(NEVER_NS)
    once.at(799 * MS)
    assert once.output_position_rad() == often.output_position_rad()
    assert once.current_a() == often.current_a()
