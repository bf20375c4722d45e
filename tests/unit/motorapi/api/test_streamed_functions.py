"""Functions of time on drives that the host streams to: VESC, RMD, MIT frames."""

import pytest

from motorhil import Rig
from motorhil.harness.conformance.clauses.helpers import failing_function
from motorhil.harness.rig.config.rig_file import parse_rig
from motorhil.harness.rig.config.toml import Source
from motorhil.harness.rig.reading import installed_plugins
from motorhil.motorapi import (
    ComplexTrajectory,
    ControlMode,
    ControlVariable,
    DerivativeLimits,
    LimitError,
    MotorPosition,
    PluginError,
    TrapezoidalTrajectory,
    UnsupportedError,
)
from motorhil.motorapi.functions import Piecewise, Polynomial
from tests.support.kit_benches import RIGS

KINDS = ("mit", "rmd", "vesc")
FOLLOWING = 0.06  # the widest `following_rad` of their conformance rigs
# Half a radian in 1 s and back in 1 s, with a rest of 0.2 s: pieces of cubics.
UP, DOWN = (0.0, 0.0, 1.5, -1.0), (0.5, 0.0, -1.5, 1.0)
COURSE = Piecewise.of_polynomials((0.0, 1.0, 1.2, 2.2), [UP, (0.5,), DOWN])


@pytest.fixture(params=KINDS)
def rig(request):
    path = RIGS / f"{request.param}.toml"
    with Rig(parse_rig(Source(path, path.read_text()), installed_plugins())) as opened:
        opened.motors["left"].enable()
        yield opened


def where(rig):
    return rig.controllers["left"].snapshot()["position_rad"]


def test_piecewise_function_is_followed_by_the_plant(rig):
    motor = rig.motors["left"]
    motor.set_control_mode(ControlMode.TRAJECTORY)
    motor.set_trajectory(ComplexTrajectory(COURSE, relative=True))
    before = where(rig)
    motor.start()
    began_s = motor.runtime.now_ns() / 1e9
    for _ in range(22):
        rig.runtime.run_for(0.1)
        at_s = min(motor.runtime.now_ns() / 1e9 - began_s, 2.2)
        assert where(rig) - before == pytest.approx(COURSE.value(at_s), abs=FOLLOWING)
    motor.wait_until_done(timeout_s=2)
    assert where(rig) == pytest.approx(before, abs=0.01)


def test_function_that_fails_ends_the_motion_only(rig):
    motor = rig.motors["left"]
    function, fail = failing_function(COURSE, "a gear without teeth")
    motor.set_control_mode(ControlMode.TRAJECTORY)
    motor.set_trajectory(ComplexTrajectory(function, relative=True))
    motor.start()
    rig.runtime.run_for(0.5)
    fail()  # the runtime must not fail with it, nor a handler of the drive's answers
    with pytest.raises(PluginError, match="ValueError: sampling a trajectory: a gear without"):
        motor.wait_until_done(timeout_s=3)
    rig.runtime.run_for(1.0)
    assert abs(where(rig) - 0.25) < 0.1  # half of the way


def test_trajectory_with_limited_jerk_takes_longer(rig):
    motor, durations = rig.motors["left"], []
    motor.set_control_mode(ControlMode.TRAJECTORY)
    for way, jerk in ((0.5, None), (-0.5, 10.0)):
        limits = None if jerk is None else DerivativeLimits(third=jerk)
        motor.set_trajectory(TrapezoidalTrajectory(way, limits=limits))
        began_ns = motor.runtime.now_ns()
        motor.start()
        motor.wait_until_done(timeout_s=5)
        durations.append(motor.runtime.now_ns() - began_ns)
    assert durations[1] > 1.1 * durations[0]


def test_function_of_another_motor_is_refused_before_it_moves(rig):
    motor, leader = rig.motors["left"], rig.motors["right"]
    motor.set_control_mode(ControlMode.TRAJECTORY)
    gear = Polynomial((0.0, 0.5)).restricted(leader.position(), leader.position() + 1.0)
    motor.set_trajectory(ComplexTrajectory(gear, relative=True), MotorPosition(leader))
    before = where(rig)
    with pytest.raises(UnsupportedError, match="a motion over the position of right"):
        motor.start()
    rig.runtime.run_for(0.1)
    assert where(rig) == pytest.approx(before, abs=1e-3)


@pytest.mark.parametrize(
    ("variable", "command"),
    [
        (ControlVariable.VELOCITY, ComplexTrajectory(Polynomial((0.0, 0.5)).restricted(0, 1))),
        (ControlVariable.POSITION, TrapezoidalTrajectory(0.5, final_derivatives=(0.1,))),
    ],
)
def test_other_functions_are_refused_when_set(rig, variable, command):
    motor = rig.motors["left"]
    motor.set_control_mode(ControlMode.TRAJECTORY, variable)
    with pytest.raises(UnsupportedError):
        motor.set_trajectory(command)


def test_function_beyond_the_range_of_mit_frames_is_refused():
    path = RIGS / "mit.toml"
    with Rig(parse_rig(Source(path, path.read_text()), installed_plugins())) as rig:
        motor = rig.motors["left"]
        motor.set_control_mode(ControlMode.TRAJECTORY)
        far = Polynomial((0.0, 0.0, 3.0, -2.0)).scaled(20.0) * 13.0
        course = ComplexTrajectory(far.restricted(0.0, 20.0), relative=True)
        motor.set_trajectory(course)
        with pytest.raises(LimitError, match="range of the drive's frames"):
            motor.start()
