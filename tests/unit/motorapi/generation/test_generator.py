import subprocess
import sys
from math import inf

import pytest

from motorhil.motorapi.commands import ControlVariable, DerivativeLimits
from motorhil.motorapi.errors import LimitError, UnsupportedError, UsageError
from motorhil.motorapi.generation import ProfileLimits, generate, shortest, trapezoid
from motorhil.motorapi.model import MotionKind, MotorModel
from motorhil.motorapi.trajectory import TrapezoidalTrajectory

MODEL = MotorModel(
    name="wheel",
    velocity_max=2.0,
    acceleration_max=4.0,
    deceleration_max=1.0,
    jerk_max=9.0,
    torque_max=5.0,
    position_min=-3.0,
    position_max=3.0,
)


def test_generate_without_own_limits_uses_the_model():
    profile = generate(TrapezoidalTrajectory(2.0), MODEL)
    assert profile == trapezoid(2.0, ProfileLimits(2.0, 4.0, 1.0, value=(-3.0, 3.0)))
    assert profile.duration_s == pytest.approx(shortest(2.0, 2.0, 4.0, 1.0).duration_s, rel=1e-15)


def test_generate_uses_tighter_own_limits():
    limits = DerivativeLimits(first=(-9.0, 0.5), second=(-0.5, 8.0))
    profile = generate(TrapezoidalTrajectory(2.0, limits=limits), MODEL)
    assert profile.velocity_range == (0.0, 0.5)
    assert {piece[6] for piece in profile.pieces} == {4.0, 0.0, -0.5}
    back = generate(TrapezoidalTrajectory(-2.0, limits=limits), MODEL)
    # Backward: acceleration 0.5, deceleration 1: u² (1/0.5 + 1) / 2 = 2.
    assert back.velocity_range[0] == pytest.approx(-((4.0 / 3.0) ** 0.5), rel=1e-15)
    assert {piece[6] for piece in back.pieces} == {-0.5, 1.0}


def test_generate_begins_at_the_given_value_and_time():
    relative = generate(TrapezoidalTrajectory(1.0, initial_argument=2.0), MODEL, start=-0.5)
    assert (relative.initial, relative.final, relative.initial_argument) == (-0.5, 0.5, 2.0)
    absolute = generate(TrapezoidalTrajectory(1.0, 0.25), MODEL, start=9.0)
    assert (absolute.initial, absolute.final) == (0.25, 1.0)


def test_generate_meets_duration_and_boundary_velocities():
    asked = TrapezoidalTrajectory(
        1.0, duration_s=1.5, initial_derivatives=(1.0,), final_derivatives=(0.5, 0.0)
    )
    profile = generate(asked, MODEL)
    assert profile.duration_s == 1.5
    assert (profile.first(0.0), profile.first(1.5)) == (1.0, 0.5)
    # A boundary velocity may exceed its limit by rounding, as everywhere.
    most = TrapezoidalTrajectory(2.0, initial_derivatives=(2.0 * (1 + 1e-10),))
    assert generate(most, MODEL).initial_velocity == 2.0 * (1 + 1e-10)


def test_generate_ramps_velocity_at_its_limit():
    ramp = generate(TrapezoidalTrajectory(2.0), MODEL, variable=ControlVariable.VELOCITY)
    assert (ramp.duration_s, ramp.velocity_range) == (0.5, (0.0, 4.0))
    down = generate(TrapezoidalTrajectory(0.5, 1.5), MODEL, variable=ControlVariable.VELOCITY)
    assert down.duration_s == 1.0
    through = generate(TrapezoidalTrajectory(-1.0, 1.0), MODEL, variable=ControlVariable.VELOCITY)
    assert through.duration_s == 2.0


def test_generate_limits_jerk_by_the_trajectory_only():
    """Generate a velocity, whose second derivative is jerk: 0 to 2 rad/s, 8 rad/s³, 4 rad/s²."""
    limits = DerivativeLimits(second=8.0)
    asked = TrapezoidalTrajectory(2.0, limits=limits)
    ramp = generate(asked, MODEL, variable=ControlVariable.VELOCITY)
    assert ramp.duration_s == 0.5 + 4.0 / 8.0


def test_generate_torque_requires_a_limit_or_a_duration():
    torque = ControlVariable.TORQUE
    slow = TrapezoidalTrajectory(4.0, limits=DerivativeLimits(first=2.0))
    assert generate(slow, MODEL, variable=torque).duration_s == 2.0
    line = generate(TrapezoidalTrajectory(4.0, duration_s=8.0), MODEL, variable=torque)
    assert line.velocity_range == (0.0, 0.5)
    with pytest.raises(UsageError, match="neither velocity nor acceleration is limited"):
        generate(TrapezoidalTrajectory(4.0), MODEL, variable=torque)


@pytest.mark.parametrize(
    ("trajectory", "told"),
    [
        (
            TrapezoidalTrajectory(4.0),
            "wheel: position of the trajectory 4 rad, allowed is -3 to 3 rad",
        ),
        (
            TrapezoidalTrajectory(1.0, duration_s=0.5),
            r"wheel: duration of the trajectory 0\.5 s, allowed is at least 1\.58114 s \(the",
        ),
        (
            TrapezoidalTrajectory(1.0, initial_derivatives=(2.5,)),
            r"velocity of the trajectory 2\.5 rad/s, allowed is -2 to 2 rad/s \(at argument 0",
        ),
        (
            TrapezoidalTrajectory(
                0.1, duration_s=1.0, initial_derivatives=(1.0,), final_derivatives=(1.0,)
            ),
            "allowed is .* to .* s .a longer motion would have to stop",
        ),
    ],
)
def test_generate_beyond_limits_raises_limit_error(trajectory, told):
    with pytest.raises(LimitError, match=told):
        generate(trajectory, MODEL)


def test_generate_with_overshooting_boundary_velocity_raises():
    """Start from 2.5 rad at 2 rad/s and 1 rad/s², which inevitably reaches 4.5 rad."""
    with pytest.raises(LimitError, match=r"position of the trajectory 4\.5 rad, .*at argument 2"):
        generate(TrapezoidalTrajectory(2.0, 2.5, initial_derivatives=(2.0,)), MODEL)


@pytest.mark.parametrize(
    "trajectory",
    [
        TrapezoidalTrajectory(1.0, limits=DerivativeLimits(third=5.0)),
        TrapezoidalTrajectory(1.0, final_derivatives=(0.0, 0.5)),
    ],
)
def test_generate_with_limited_jerk_names_the_alternative(trajectory):
    with pytest.raises(UnsupportedError, match="jerk_limited"):
        generate(trajectory, MODEL)


def test_generate_errors_use_the_units_of_the_motor():
    lift = MotorModel(name="lift", kind=MotionKind.LINEAR, velocity_max=1.0, acceleration_max=1.0)
    with pytest.raises(LimitError) as told:
        generate(TrapezoidalTrajectory(1.0, final_derivatives=(1.5,)), lift)
    error = told.value
    assert (error.unit, error.value, error.low, error.high) == ("m/s", 1.5, -1.0, 1.0)
    assert error.motor == "lift"
    with pytest.raises(LimitError) as told:
        generate(TrapezoidalTrajectory(1.5), lift, variable=ControlVariable.VELOCITY)
    assert (told.value.unit, told.value.quantity) == ("m/s", "velocity of the trajectory")


def test_profile_as_function_has_the_same_values():
    profile = generate(
        TrapezoidalTrajectory(1.0, initial_argument=3.0, initial_derivatives=(-1.0,)), MODEL
    )
    function = profile.as_function()
    assert function.domain == (3.0, profile.final_argument)
    assert function.value(profile.final_argument) == 1.0
    for k in range(1, 50):
        t = 3.0 + profile.duration_s * k / 50
        assert function.value(t) == pytest.approx(profile.value(t), rel=1e-14, abs=1e-15)
        assert function.derivative().value(t) == pytest.approx(profile.first(t), abs=1e-14)
        assert function.derivative(2).value(t) == profile.second(t)
    with pytest.raises(UsageError, match="takes no time"):
        generate(TrapezoidalTrajectory(0.0), MODEL).as_function()


def test_generation_does_not_import_numpy():
    script = (
        "import sys\n"
        "from motorhil.motorapi.generation import ProfileLimits, trapezoid\n"
        "trapezoid(1.0, ProfileLimits(1.0, 1.0), duration_s=3.0).value(0.5)\n"
        "print([name for name in ('numpy', 'ruckig') if name in sys.modules])"
    )
    done = subprocess.run(
        [sys.executable, "-c", script], capture_output=True, text=True, check=True
    )
    assert done.stdout.strip() == "[]"


def test_generate_with_unlimited_positions_accepts_inf():
    free = MotorModel(name="free", velocity_max=1.0, acceleration_max=1.0)
    assert generate(TrapezoidalTrajectory(1e9), free).duration_s == 1e9 + 1.0
    assert generate(TrapezoidalTrajectory(1e9), free).value_range[1] < inf
