"""The sampled motor against mathematics without matrix exponentials."""

import math

import pytest
from hypothesis import given
from hypothesis import strategies as st

from motorhil.emulators.plant.dc_motor import exponential, product, sample
from motorhil.emulators.plant.presets import PLAUSIBLE, WHEEL_60W

# The series is cut below 1e-21 and squared at most about ten times: a few units in the last place.
ROUNDING = 1e-13


@given(st.floats(-30.0, 5.0))
def test_exponential_of_number_matches_math(x):
    assert exponential([[x]])[0][0] == pytest.approx(math.exp(x), rel=ROUNDING)


@given(st.floats(-20.0, 20.0))
def test_exponential_of_rotation_is_sine_and_cosine(angle):
    (c, minus_s), (s, c2) = exponential([[0.0, -angle], [angle, 0.0]])
    assert (c, s) == pytest.approx((math.cos(angle), math.sin(angle)), abs=1e-12)
    assert (c2, minus_s) == (c, -s)


def test_exponential_of_nilpotent_matrix_is_finite_series():
    assert exponential([[0.0, 1.0, 0.0], [0.0, 0.0, 1.0], [0.0, 0.0, 0.0]]) == [
        [1.0, 1.0, 0.5],
        [0.0, 1.0, 1.0],
        [0.0, 0.0, 1.0],
    ]


@pytest.mark.parametrize("plant", PLAUSIBLE.values(), ids=PLAUSIBLE)
def test_two_half_steps_equal_one_step(plant):
    half, whole = sample(plant, 0.5e-4), sample(plant, 1e-4)
    inputs = [[0.0, 0.0, 0.0, 1.0, 0.0], [0.0, 0.0, 0.0, 0.0, 1.0]]
    twice = product(half.driven + inputs, half.driven + inputs)
    for got, expected in zip(twice[:3], whole.driven, strict=True):
        assert got == pytest.approx(expected, rel=1e-12)  # rounding of the two products


def runge_kutta(plant, state, voltage, torque, duration_s, steps):
    """Integrate the three differential equations by the classical fourth-order rule."""
    k, j = plant.torque_constant_n_m_a, plant.inertia_kg_m2()
    inc_rad = plant.encoder_increments_rev / (2 * math.pi)

    def slope(s):
        current, speed, _ = s
        return (
            (voltage - plant.resistance_ohm * current - k * speed) / plant.inductance_h,
            (k * current - plant.viscous_friction_n_m_s_rad * speed + torque) / j,
            speed * inc_rad,
        )

    h = duration_s / steps
    for _ in range(steps):
        a = slope(state)
        b = slope([s + h / 2 * d for s, d in zip(state, a, strict=True)])
        c = slope([s + h / 2 * d for s, d in zip(state, b, strict=True)])
        d = slope([s + h * x for s, x in zip(state, c, strict=True)])
        state = [
            s + h / 6 * (p + 2 * q + 2 * r + t)
            for s, p, q, r, t in zip(state, a, b, c, d, strict=True)
        ]
    return state


@pytest.mark.parametrize("plant", PLAUSIBLE.values(), ids=PLAUSIBLE)
@pytest.mark.parametrize(
    ("start", "voltage", "torque"),
    [
        ((0.0, 0.0, 0.0), 24.0, 0.0),
        ((3.0, -200.0, 500.0), -7.0, 0.01),
        ((0.0, 50.0, 0.0), 0.0, -0.02),
    ],
)
def test_step_solves_differential_equations(plant, start, voltage, torque):
    motor = sample(plant, 1e-4)
    vector = [*start, voltage, torque]
    got = [sum(m * v for m, v in zip(row, vector, strict=True)) for row in motor.driven]
    fine = runge_kutta(plant, list(start), voltage, torque, 1e-4, 200)
    # 200 steps of 0.5 us: the rule's own error is below 1e-10 of each quantity
    assert got == pytest.approx(fine, rel=1e-9, abs=1e-9)


def test_coasting_motor_decelerates_by_friction():
    plant = WHEEL_60W
    motor = sample(plant, 1e-3)
    b, j, torque, start = plant.viscous_friction_n_m_s_rad, plant.inertia_kg_m2(), -0.004, 300.0
    speed, position = start, 0.0
    for _ in range(100):
        vector = (speed, position, torque)
        speed, position = (
            sum(m * v for m, v in zip(row, vector, strict=True)) for row in motor.coasting
        )
    decay = math.exp(-b / j * 0.1)
    expected = start * decay + torque / b * (1 - decay)
    assert speed == pytest.approx(expected, rel=1e-12)  # rounding of 100 steps
    travelled = (j * (start - speed) + torque * 0.1) / b * plant.encoder_increments_rev
    assert position == pytest.approx(travelled / (2 * math.pi), rel=1e-9)  # cancellation


def test_blocked_current_rises_with_time_constant():
    plant = WHEEL_60W
    motor = sample(plant, 1e-4)
    current = 0.0
    for _ in range(10):
        current = motor.blocked_decay * current + motor.blocked_gain_a_v * 12.0
    tau = plant.inductance_h / plant.resistance_ohm
    expected = 12.0 / plant.resistance_ohm * (1 - math.exp(-1e-3 / tau))
    assert current == pytest.approx(expected, rel=1e-13)  # rounding of 10 steps
