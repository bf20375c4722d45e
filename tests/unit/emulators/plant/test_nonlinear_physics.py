"""A nonlinear plant against other solvers, closed forms, and conservation of energy."""

import math
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import event, example, given, settings
from hypothesis import strategies as st
from scipy.integrate import solve_ivp
from scipy.linalg import expm

from motorhil.emulators.controller import SettingError
from motorhil.emulators.firmware import nonlinear_servo as extras_step
from motorhil.emulators.firmware.axis import Axis
from motorhil.emulators.firmware.flags import AT_STOP, OVER_VOLTAGE
from motorhil.emulators.firmware.nonlinear_tables import ExtrasTables, StepNumbers
from motorhil.emulators.firmware.servo import steps
from motorhil.emulators.firmware.servo_tables import ServoGains, ServoTables
from motorhil.emulators.plant.nonlinear import PlantExtras
from motorhil.emulators.plant.presets import WHEEL_60W
from motorhil.emulators.settings.motor import ServoTable
from tests.support.repetition import examples

MS = 1_000_000
STEP_S = 1e-4
GEAR = WHEEL_60W.gear_ratio
INC_RAD = WHEEL_60W.increments_per_rad()  # at the motor
ROTOR = WHEEL_60W.rotor_inertia_kg_m2
LOAD = WHEEL_60W.load_inertia_kg_m2 / GEAR**2  # referred to the motor


def with_extras(plant=WHEEL_60W, **numbers):
    return replace(plant, extras=PlantExtras(**numbers))


def numbers_of(plant):
    return StepNumbers(plant, STEP_S, STEP_S, plant.resistance_ohm)


def axis_of(plant):
    axis = Axis(plant, ServoGains.tuned(plant, MS, 10), MS, 10)
    axis.power(True)
    axis.at(10 * MS)
    return axis


def test_all_effects_off_equals_linear_motor():
    """A tick in constant motion, with all effects 0 but computed by the nonlinear step."""
    plant = with_extras(ambient_c=20.0)
    gains = ServoGains.tuned(plant, MS, 10)
    plain = ServoTables(WHEEL_60W, gains, MS, 10)
    tables = ExtrasTables(plant, gains, plain.tick, MS, 10)
    begin = (0.7, 11.0, 400.0, 1234.5)
    for wanted in (0.0, 0.7, 2.5, 8.0):
        expected = steps(plain.step, 10, 0.01, wanted, *begin)
        found = extras_step.plant_tick(tables, 0, True, 0.01, 24.0, wanted, *begin, 0.0, 0.0, 24.0)
        assert found[:4] == pytest.approx(expected, rel=1e-12)
        assert found[4:6] == found[2:4]  # one body


def test_two_bodies_oscillate_as_their_equations():
    k, c, b = 800.0, 3.0, 2.0  # at the output
    plant = with_extras(
        replace(WHEEL_60W, coulomb_friction_n_m=0.0, current_max_a=1e-3),
        coupling_stiffness_n_m_rad=k,
        coupling_damping_n_m_s_rad=c,
        output_viscous_friction_n_m_s_rad=b,
    )
    t = numbers_of(plant)
    viscous = plant.viscous_friction_n_m_s_rad

    def slope(_, y):
        w, wl, a, al = y
        torque = (k * (a - al) + c * (w - wl)) / GEAR**2
        return (-torque - viscous * w) / ROTOR, (torque - b / GEAR**2 * wl) / LOAD, w, wl

    exact = solve_ivp(slope, (0, 0.05), (300.0, 0.0, 0.0, 0.0), rtol=1e-10, atol=1e-10)
    w, x, wl, xl = 300.0, 0.0, 0.0, 0.0
    for _ in range(500):
        _, w, x, wl, xl, _ = extras_step.two_bodies(t, False, 0.0, 0.0, 0.0, w, x, wl, xl)
    w_end, wl_end, a_end, al_end = exact.y[:, -1]
    assert (w, wl) == pytest.approx((w_end, wl_end), rel=0.01, abs=0.5)
    assert (x / INC_RAD, xl / INC_RAD) == pytest.approx((a_end, al_end), rel=2e-3)


def test_gravity_load_swings_as_pendulum():
    """The wave approximates a sine to 0.1 %."""
    plant = with_extras(
        replace(WHEEL_60W, coulomb_friction_n_m=0.0, viscous_friction_n_m_s_rad=0.0),
        gravity_torque_n_m=3.0,
        gravity_zero_rad=0.4,
    )
    t = numbers_of(plant)
    inertia = (ROTOR + LOAD) * GEAR**2

    def slope(_, y):
        return y[1], -3.0 / inertia * math.sin(y[0] - 0.4)

    exact = solve_ivp(slope, (0, 0.5), (1.9, 0.0), rtol=1e-10, atol=1e-10)
    w, x = 0.0, 1.9 * GEAR * INC_RAD + 0.5
    for _ in range(5_000):
        _, w, x, _ = extras_step.one_body(t, False, 0.0, 0.0, 0.0, w, x)
    assert (x - 0.5) / (GEAR * INC_RAD) == pytest.approx(exact.y[0, -1], abs=0.01)


def test_load_stands_until_backlash_is_used_up():
    play = {"backlash_rad": 0.02, "output_coulomb_friction_n_m": 0.3}
    t = numbers_of(with_extras(replace(WHEEL_60W, coulomb_friction_n_m=0.0), **play))
    half_inc = 0.01 * GEAR * INC_RAD
    w, x, wl, xl = 20.0, 0.5, 0.0, 0.5
    ticks = 0
    while wl == 0.0:
        before = x - xl
        _, w, x, wl, xl, _ = extras_step.two_bodies(t, False, 0.0, 0.0, 0.0, w, x, wl, xl)
        ticks += 1
        assert ticks < 1_000
        assert (wl == 0.0) is (xl == 0.5)
    assert before <= half_inc
    assert before + 20.0 * STEP_S * INC_RAD > half_inc

    axis = axis_of(with_extras(**play))
    axis.move_to(3_000, 30_000.0, 200_000.0, 200_000.0)
    axis.at(1_000 * MS)
    assert axis.output_velocity_rad_s() == 0.0
    gap_rad = axis.position_inc() / (GEAR * INC_RAD) - axis.output_position_rad()
    assert -0.0101 <= gap_rad <= -0.005  # it continued to the other flank
    axis.move_to(3_100, 3_000.0, 200_000.0, 200_000.0)  # less than the backlash: the load stays
    there = axis.output_position_rad()
    axis.at(1_500 * MS)
    assert axis.position_inc() == 3_100
    assert axis.output_position_rad() == there


# --- energy ---------------------------------------------------------------------------------------


def height(p):
    """Return the wave's integral from 0 to p."""
    p -= math.floor(p)
    if p >= 0.5:
        return height(0.49999999999999994) - height(p - 0.5)
    line = 4.0 * p**2 - 16.0 / 3.0 * p**3
    square = 256.0 * (p**3 / 12.0 - p**4 / 4.0 + p**5 / 5.0)
    return 0.775 * line + 0.225 * square


def energy(t, plant, i, w, x, wl, xl):
    """Return the energy [J] at the motor; torques of waves and springs are per increment."""
    twist = max(0.0, abs(x - xl) - t.gap) if t.two_bodies else 0.0
    stored = 0.5 * t.spring * twist * twist
    if t.cogging:
        stored -= t.cogging / t.cogging_inc * height((x - 0.5) * t.cogging_inc)
    if t.gravity:
        stored += t.gravity / t.gravity_inc * height((xl - 0.5) * t.gravity_inc - t.gravity_zero)
    moving = 0.5 * ROTOR * w * w + 0.5 * LOAD * wl * wl
    return moving + stored / INC_RAD + 0.5 * plant.inductance_h * i * i


EXTRAS = st.fixed_dictionaries(
    {
        "backlash_rad": st.sampled_from([0.0, 1e-4, 0.003, 0.05]),
        "coupling_stiffness_n_m_rad": st.sampled_from([0.0, 30.0, 700.0, 4_000.0]),
        "coupling_damping_n_m_s_rad": st.sampled_from([0.0, 0.5, 40.0]),
        "output_coulomb_friction_n_m": st.sampled_from([0.0, 0.1]),
        "stop_low_rad": st.sampled_from([-1e9, -0.02]),
        "stop_high_rad": st.sampled_from([1e9, 0.02]),
        "stop_restitution": st.sampled_from([0.0, 0.5, 1.0]),
        "static_friction_n_m": st.sampled_from([0.0, 8e-3]),
        "cogging_torque_n_m": st.sampled_from([0.0, 4e-3]),
        "cogging_periods_rev": st.sampled_from([1, 14]),
        "gravity_torque_n_m": st.sampled_from([0.0, 3.0, -3.0]),
        "gravity_zero_rad": st.sampled_from([0.0, 0.7]),
    }
)
SPEED = st.floats(-600.0, 600.0)


@settings(max_examples=examples(30))
@example({"static_friction_n_m": 8e-3}, False, True, 0.0078125, 0.0, 0.0)
@example(
    {"static_friction_n_m": 8e-3, "coupling_stiffness_n_m_rad": 30.0}, False, True, 0.0078, 0.0, 0.0
)
@given(EXTRAS, st.booleans(), st.booleans(), SPEED, SPEED, st.floats(-0.02, 0.02))
def test_free_plant_never_gains_energy(numbers, is_dry, shorted, w, wl, at_rad):
    """Coasting, or with a shorted winding; any effects, in every single substep."""
    plant = with_extras(
        WHEEL_60W if is_dry else replace(WHEEL_60W, coulomb_friction_n_m=0.0), **numbers
    )
    t = numbers_of(plant)
    x = xl = at_rad * GEAR * INC_RAD + 0.5
    if not t.two_bodies:
        wl = w
    i = 0.0
    start = energy(t, plant, i, w, x, wl, xl)
    scale = abs(start) + 1e-3
    before = start
    for _ in range(60):
        if t.two_bodies:
            i, w, x, wl, xl, stands = extras_step.two_bodies(t, shorted, 0.0, 0.0, i, w, x, wl, xl)
        else:
            i, w, x, stands = extras_step.one_body(t, shorted, 0.0, 0.0, i, w, x)
            wl, xl = w, x
        if stands:
            i *= t.decay
        after = energy(t, plant, i, w, x, wl, xl)
        assert after <= before + 1e-9 * abs(before) + 1e-13 * scale
        assert t.low <= xl <= t.high
        before = after
    event("two bodies" if t.two_bodies else "one body")
    event("lost half" if before - start < -0.5 * abs(start) else "kept most")


@given(
    st.floats(0.01, 5.0),
    st.floats(0.0, 50.0),
    st.floats(0.0, 50.0),
    st.floats(1e-3, 100.0),
    st.floats(0.0, 5_000.0),
)
def test_flanks_push_and_never_pull(gap, twist, free, give, damping):
    """With any damper; the flanks separate where the backlash begins, without penetration."""
    t = numbers_of(with_extras(backlash_rad=0.01, coupling_damping_n_m_s_rad=damping))
    t.gap = gap
    torque = extras_step.coupling(t, twist, free, give)
    assert extras_step.coupling(t, -twist, -free, give) == -torque
    if free <= gap:
        assert torque == 0.0
    else:
        assert torque >= 0.0
        assert free - give * torque >= gap * (1.0 - 1e-9)


def test_end_stop_holds_and_rebounds():
    plant = with_extras(
        replace(WHEEL_60W, coulomb_friction_n_m=0.0, viscous_friction_n_m_s_rad=0.0),
        stop_high_rad=0.05,
        stop_restitution=0.6,
    )
    t = numbers_of(plant)
    w, x = 100.0, 0.5
    while w > 0.0:
        _, w, x, _ = extras_step.one_body(t, False, 0.0, 0.0, 0.0, w, x)
    assert w == pytest.approx(-60.0, rel=1e-12)
    assert x == t.high

    axis = axis_of(with_extras(stop_high_rad=0.05, stop_restitution=0.6))
    axis.apply_current(1.0, 1e3)
    worst = 0.0
    for k in range(11, 1_500):
        axis.at(k * MS)
        worst = max(worst, axis.output_position_rad())
    assert worst == pytest.approx(0.05, abs=1e-12)
    assert axis.flags & AT_STOP
    assert axis.next_event_ns() is None  # pushing against it is rest
    assert axis.current_a() == 1.0


# --- supply and heat ------------------------------------------------------------------------------


def test_dc_link_falls_under_load_rises_in_braking():
    base = {"source_resistance_ohm": 0.3, "dc_link_capacitance_f": 470e-6}
    axis = axis_of(with_extras(**base, stop_high_rad=0.0))
    axis.apply_current(8.0, 1e4)
    axis.at(200 * MS)
    power = 0.611 * 8.0 * 8.0
    v = 12.0 + math.sqrt(12.0**2 - 0.3 * power)  # v = 24 - 0.3 power / v
    assert axis.dc_link_v() == pytest.approx(v, rel=1e-9)

    tops = []
    for chopper in ({}, {"chopper_threshold_v": 26.0, "chopper_resistance_ohm": 3.0}):
        axis = axis_of(with_extras(**base, **chopper))
        axis.set_thresholds(over_voltage_v=25.0)
        axis.run_at(200_000.0, 1e6, 1e6)
        axis.at(600 * MS)
        assert axis.dc_link_v() < 24.0
        kinetic = 0.5 * (ROTOR + LOAD) * (axis.output_velocity_rad_s() * GEAR) ** 2
        axis.ramp_to_rest(4e6)
        top = 0.0
        rose = 0
        for k in range(601, 900):
            axis.at(k * MS)
            top = max(top, axis.dc_link_v())
            rose |= axis.flags & OVER_VOLTAGE
        assert rose
        assert 0.5 * 470e-6 * (top**2 - 24.0**2) < kinetic
        tops.append(top)
    assert tops[1] < tops[0]


def test_blocked_motor_warms_as_two_nodes():
    """Compare with scipy's matrix exponential at 100 s and 2,000 s."""
    heat = {
        "thermal_resistance_winding_housing_k_w": 1.7,
        "thermal_resistance_housing_ambient_k_w": 6.0,
        "thermal_time_constant_winding_s": 16.2,
        "thermal_time_constant_motor_s": 714.0,
    }
    axis = axis_of(with_extras(**heat, stop_high_rad=0.0))
    axis.apply_current(2.0, 1e6)
    winding, housing = 16.2 / 1.7, 714.0 / 6.0
    rates = np.array(
        [
            [-1 / 1.7 / winding, 1 / 1.7 / winding, 1 / winding],
            [1 / 1.7 / housing, -(1 / 1.7 + 1 / 6.0) / housing, 0],
            [0, 0, 0],
        ]
    )
    for time_s in (100.0, 2_000.0):
        axis.at(round(time_s * 1e9))
        rise = expm(rates * (time_s - 0.011)) @ np.array([0.0, 0.0, 0.611 * 4.0])
        assert axis.winding_temperature_c() - 25.0 == pytest.approx(rise[0], rel=1e-3)
        assert axis.housing_temperature_c() - 25.0 == pytest.approx(rise[1], rel=2e-3)


def test_winding_has_time_constant_of_data_sheet():
    """With copper's coefficient the voltage that holds the current rises with the temperature."""
    heat = {
        "thermal_resistance_winding_housing_k_w": 2.0,
        "thermal_resistance_housing_ambient_k_w": 1e-3,
        "thermal_time_constant_winding_s": 5.0,
        "thermal_time_constant_motor_s": 10.0,
    }
    axis = axis_of(with_extras(**heat, stop_high_rad=0.0))
    axis.apply_current(4.0, 1e6)
    axis.at(11 * MS + 5_000 * MS)
    full = 2.0 * 0.611 * 16.0
    assert axis.winding_temperature_c() - 25.0 == pytest.approx(0.632 * full, rel=0.01)

    warm = axis_of(with_extras(**heat, stop_high_rad=0.0, copper_coefficient_1_k=0.0039))
    warm.apply_current(4.0, 1e6)
    warm.at(100_000 * MS)
    rise = full / (1.0 - 0.0039 * full)  # the losses rise with the resistance
    assert warm.winding_temperature_c() - 25.0 == pytest.approx(rise, rel=5e-3)


def test_too_stiff_coupling_is_refused_with_limit():
    plant = with_extras(coupling_stiffness_n_m_rad=1e9)
    with pytest.raises(SettingError) as caught:
        ServoTable().gains(plant)
    assert caught.value.path == ("plant", "coupling_stiffness_n_m_rad")
    text = str(caught.value)
    limit = float(text.partition("at most ")[2].split(" ", 1)[0])
    assert "tick_s" in text
    ServoTable().gains(with_extras(coupling_stiffness_n_m_rad=limit * 0.99))
    with pytest.raises(SettingError):
        ServoTable().gains(with_extras(coupling_stiffness_n_m_rad=limit * 1.01))
