"""The motor behind the servo against its data sheet, with expected values by hand in SI units."""

import math
from dataclasses import replace

import pytest

from motorhil.emulators.firmware import servo
from motorhil.emulators.firmware.axis import Axis
from motorhil.emulators.firmware.servo_tables import ServoGains, ServoTables
from motorhil.emulators.plant.dc_motor import MotorPlant
from motorhil.emulators.plant.presets import WHEEL_60W

MS = 1_000_000
UNLIMITED_A = 1e6  # a current demand that saturates the power stage's voltage

# The bare motor of the wheel: no gear, no load, no viscous friction.
BARE = replace(WHEEL_60W, gear_ratio=1.0, load_inertia_kg_m2=0.0, viscous_friction_n_m_s_rad=0.0)


def at_full_voltage(plant: MotorPlant, duration_s: float, load_n_m: float = 0.0):
    """Return current, speed and position of the motor after a time at supply voltage."""
    tables = ServoTables(plant, ServoGains.tuned(plant, MS, 10), MS, 10)
    i, u, w, x = 0.0, 0.0, 0.0, 0.0
    steps = round(duration_s / 1e-4)
    i, u, w, x = servo.steps(tables.step, steps, load_n_m, UNLIMITED_A, i, u, w, x)
    return i, w, x


def test_no_load_speed_matches_data_sheet_formula():
    i, w, _ = at_full_voltage(BARE, 1.0)
    no_load_a = 0.004 / 0.0259
    assert i == pytest.approx(no_load_a, rel=1e-9)  # settled to e^-300
    assert w == pytest.approx((24.0 - 0.611 * no_load_a) / 0.0259, rel=1e-9)
    assert BARE.no_load_speed_rad_s() == pytest.approx(w, rel=1e-9)


def test_blocked_motor_has_stall_current_and_torque():
    held = replace(BARE, coulomb_friction_n_m=2.0)  # more than the motor can overcome
    i, w, x = at_full_voltage(held, 0.1)
    assert (w, x) == (0.0, 0.0)
    assert i == pytest.approx(24.0 / 0.611, rel=1e-9)
    assert held.stall_torque_n_m() == pytest.approx(i * 0.0259, rel=1e-9)


def test_voltage_step_has_both_time_constants():
    free = replace(BARE, coulomb_friction_n_m=0.0)
    j, k, r, henry = 3.37e-6, 0.0259, 0.611, 0.119e-3
    root = math.sqrt((j * r) ** 2 - 4 * j * henry * k * k)
    p, q = (-j * r + root) / (2 * j * henry), (-j * r - root) / (2 * j * henry)
    for time_s in (0.0002, 0.001, 0.003, 0.01):
        _, w, x = at_full_voltage(free, time_s)
        slow, fast = math.expm1(p * time_s), math.expm1(q * time_s)
        expected = 24.0 / k * (q * slow - p * fast) / (p - q)
        assert w == pytest.approx(expected, rel=1e-10)  # rounding only
        angle = 24.0 / k * (time_s + (q / p * slow - p / q * fast) / (p - q))
        assert x * 2 * math.pi / 2000 == pytest.approx(angle, rel=1e-9)
    assert free.mechanical_time_constant_s() == pytest.approx(j * r / k**2, rel=1e-12)
    assert free.electrical_time_constant_s() == pytest.approx(henry / r, rel=1e-12)


def test_gear_and_load_are_referred_to_motor_side():
    geared = replace(BARE, gear_ratio=50.0, load_inertia_kg_m2=0.05)
    assert geared.inertia_kg_m2() == pytest.approx(3.37e-6 + 0.05 / 2500, rel=1e-15)
    _, free, _ = at_full_voltage(geared, 2.0)
    _, loaded, _ = at_full_voltage(geared, 2.0, load_n_m=0.02)
    # speed-torque line: slope R / K^2
    assert free - loaded == pytest.approx(0.02 * 0.611 / 0.0259**2, rel=1e-9)


def test_energy_is_conserved():
    """Supply = heat + friction + load + stored, integrated by trapezoids of 10 us."""
    plant = replace(BARE, viscous_friction_n_m_s_rad=2e-6)
    tables = ServoTables(plant, ServoGains.tuned(plant, 10_000, 1), 10_000, 1)
    i, u, w, x, load = 0.0, 0.0, 0.0, 0.0, 0.01
    supplied = spent = 0.0
    for _ in range(2000):
        i1, u, w1, x1 = servo.steps(tables.step, 1, load, UNLIMITED_A, i, u, w, x)
        supplied += 24.0 * (i + i1) / 2 * 1e-5
        spent += 0.611 * (i * i + i * i1 + i1 * i1) / 3 * 1e-5
        spent += 2e-6 * (w * w + w * w1 + w1 * w1) / 3 * 1e-5
        spent += (0.004 + load) * (x1 - x) * 2 * math.pi / 2000
        i, w, x = i1, w1, x1
    stored = 0.5 * 0.119e-3 * i * i + 0.5 * 3.37e-6 * w * w
    assert spent + stored == pytest.approx(supplied, rel=1e-4)  # trapezoids of a 200 us transient
    assert stored > 0.3 * supplied


def coasting_axis(plant: MotorPlant, speed_rad_s: float) -> Axis:
    axis = Axis(plant, ServoGains.tuned(plant, MS, 10), MS, 10)
    axis.power(True)
    axis.run_at(speed_rad_s * plant.encoder_increments_rev / (2 * math.pi), 1e6, 1e6)
    axis.at(2_000 * MS)
    axis.power(False)
    axis.at(2_001 * MS)
    return axis


def test_coulomb_friction_stops_coasting_motor():
    axis = coasting_axis(BARE, 300.0)
    speed = axis.output_velocity_rad_s()
    position = axis.output_position_rad()
    assert axis.current_a() == 0.0
    deceleration = 0.004 / 3.37e-6
    stop_s = speed / deceleration
    axis.at(2_001 * MS + int(stop_s * 1e9) - MS)
    assert axis.output_velocity_rad_s() > 0.0
    axis.at(2_001 * MS + int(stop_s * 1e9) + 2 * MS)
    assert axis.output_velocity_rad_s() == 0.0
    travelled = axis.output_position_rad() - position
    # it stops within one step of the current loop: at most 0.1 ms at deceleration * 0.1 ms
    assert travelled == pytest.approx(speed * stop_s / 2, abs=deceleration * 1e-8)


def test_load_moves_motor_only_above_friction():
    for sign in (1.0, -1.0):
        for share, moves in ((0.999, False), (1.001, True)):
            axis = Axis(BARE, ServoGains.tuned(BARE, MS, 10), MS, 10)
            axis.set_load(sign * share * 0.004)
            axis.at(1000 * MS)
            assert (axis.output_velocity_rad_s() * sign < 0.0) is moves
            assert (axis.output_position_rad() != 0.0) is moves


def test_falling_load_reaches_viscous_speed():
    plant = replace(BARE, viscous_friction_n_m_s_rad=1e-4)
    axis = Axis(plant, ServoGains.tuned(plant, MS, 10), MS, 10)
    axis.set_load(0.010)
    axis.at(5_000 * MS)
    assert axis.output_velocity_rad_s() == pytest.approx(-0.006 / 1e-4, rel=1e-9)


@pytest.mark.parametrize(
    ("name", "value"),
    [
        ("resistance_ohm", 0.0),
        ("inductance_h", -1.0),
        ("torque_constant_n_m_a", math.nan),
        ("rotor_inertia_kg_m2", math.inf),
        ("encoder_increments_rev", 0),
        ("gear_ratio", 0.0),
        ("coulomb_friction_n_m", -1e-9),
        ("load_inertia_kg_m2", -1e-9),
        ("load_torque_n_m", math.nan),
    ],
)
def test_invalid_plant_number_is_refused_by_name(name, value):
    with pytest.raises(ValueError, match=name):
        replace(WHEEL_60W, **{name: value})
