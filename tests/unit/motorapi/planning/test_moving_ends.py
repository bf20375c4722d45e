"""Trajectories that begin or end with a velocity, judged by the true motion of every kind."""

from pathlib import Path

import pytest
from hypothesis import Phase, event, example, given, settings
from hypothesis import strategies as st

from motorhil.harness.rig.rig import Rig
from motorhil.motorapi import (
    ControlMode,
    ControlVariable,
    DerivativeLimits,
    LimitError,
    Motor,
    MotorError,
    MotorGroup,
    StateError,
    TrapezoidalTrajectory,
    UnsupportedError,
)
from motorhil.motorapi.motion import Motion
from motorhil.motorapi.planning import sampling
from tests.support.motors.kinds import (
    ACCELERATION_MAX,
    ASKED,
    KINDS,
    VELOCITY_MAX,
    Kind,
    opened,
    true_position,
)

MS = 1_000_000
STEP_S = 0.001
WINDOW = 20  # milliseconds for which velocities are averaged
VELOCITY = st.floats(-1.5, 1.5).map(lambda one: round(one, 3)).filter(lambda one: abs(one) > 0.05)
WAY = st.floats(-3.0, 3.0).map(lambda one: round(one, 3)).filter(lambda one: one != 0.0)
LEG = st.tuples(WAY, VELOCITY)
CHAIN = [(1.0, 1.5), (0.3, -1.5), (-0.3, 0.1)]
OVERSHOOT = {"cia402": 1.4}  # of the acceleration, by the drive's servo after a step of it
EVERY_KIND = pytest.mark.parametrize("kind", KINDS.values(), ids=KINDS)


class Seen:
    """The true positions of a motor, every millisecond."""

    def __init__(self, rig: Rig, name: str = "left") -> None:
        self._rig, self._name = rig, name
        self.positions: list[float] = []
        rig.runtime.every(STEP_S, self._look)

    def _look(self) -> None:
        self.positions.append(true_position(self._rig, self._name))

    def velocities(self) -> list[float]:
        """Return the mean velocities of all windows."""
        ends = zip(self.positions, self.positions[WINDOW:], strict=False)
        return [(after - before) / (WINDOW * STEP_S) for before, after in ends]

    def accelerations(self) -> list[float]:
        """Return the mean changes of velocity from window to window."""
        speeds = self.velocities()
        ends = zip(speeds, speeds[WINDOW:], strict=False)
        return [(after - before) / (WINDOW * STEP_S) for before, after in ends]


def velocity_now(rig: Rig, for_s: float = 0.02) -> float:
    """Return the true mean velocity from now on."""
    before = true_position(rig, "left")
    rig.runtime.run_for(for_s)
    return (true_position(rig, "left") - before) / for_s


def moved(motor: Motor, *arguments: float, **keywords: object) -> None:
    """Start a trajectory and wait for its end."""
    motor.set_control_mode(ControlMode.TRAJECTORY)
    motor.set_trajectory(TrapezoidalTrajectory(*arguments, **keywords))
    motor.start()
    motor.wait_until_done(timeout_s=20)


@EVERY_KIND
def test_motion_continues_at_its_final_velocity(kind):
    with opened(kind, Path("ends.toml")) as rig:
        motor = rig.motors["left"]
        moved(motor, 1.0, final_derivatives=(0.8,))
        # reported in a message of the drive, or after the settling time of the servo
        assert 1.0 - kind.window <= true_position(rig, "left") <= 1.0 + 0.8 * 0.045
        for _ in range(5):
            assert velocity_now(rig, 0.1) == pytest.approx(0.8, abs=0.01)
        assert motor.is_done()
        with pytest.raises(StateError, match=r"stop\(\) first"):
            moved(motor, 1.0)
        at = true_position(rig, "left")
        motor.stop()
        motor.wait_until_done(timeout_s=2)
        way = true_position(rig, "left") - at
        assert way == pytest.approx(0.8**2 / 2 / ACCELERATION_MAX, abs=0.8 * 0.01)
        moved(motor, 0.1)  # from rest again


@EVERY_KIND
def test_motion_begins_at_the_velocity_of_the_last(kind):
    overshoot = OVERSHOOT.get(kind.name, 1.15)
    with opened(kind, Path("begins.toml")) as rig:
        motor, seen = rig.motors["left"], Seen(rig)
        moved(motor, 1.0, final_derivatives=(0.8,))
        moved(motor, 2.5, 1.0, initial_derivatives=(0.8,), final_derivatives=(-0.5,))
        assert true_position(rig, "left") == pytest.approx(2.5, abs=kind.window + 0.5 * 0.045)
        assert velocity_now(rig) == pytest.approx(-0.5, abs=0.02)
        moved(motor, -1.5, initial_derivatives=(-0.5,))
        assert abs(velocity_now(rig)) < 0.01
        assert max(map(abs, seen.velocities())) <= VELOCITY_MAX * 1.02
        assert max(map(abs, seen.accelerations())) <= ACCELERATION_MAX * overshoot


@EVERY_KIND
def test_absolute_target_is_reached_from_a_moving_start(kind):
    with opened(kind, Path("target.toml")) as rig:
        motor = rig.motors["left"]
        moved(motor, 1.0, final_derivatives=(1.0,))
        moved(motor, 2.0, 1.0, initial_derivatives=(1.0,))
        rig.runtime.run_for(0.3)
        assert true_position(rig, "left") == pytest.approx(2.0, abs=kind.window)
        assert motor.position() == pytest.approx(2.0, abs=kind.window)
        moved(motor, 0.5)
        assert motor.position() == pytest.approx(2.5, abs=kind.window)


@EVERY_KIND
def test_motion_is_replaced_on_its_plateau(kind):
    with opened(kind, Path("plateau.toml")) as rig:
        motor, seen = rig.motors["left"], Seen(rig)
        motor.set_control_mode(ControlMode.TRAJECTORY)
        motor.set_trajectory(
            TrapezoidalTrajectory(9.0, final_derivatives=(0.1,), limits=DerivativeLimits(first=1.0))
        )
        motor.start()
        rig.runtime.run_for(1.0)
        at = true_position(rig, "left")
        moved(motor, 1.0, initial_derivatives=(1.0,))
        rig.runtime.run_for(0.1)
        assert true_position(rig, "left") == pytest.approx(at + 1.0, abs=0.03)
        overshoot = OVERSHOOT.get(kind.name, 1.15)
        assert max(map(abs, seen.accelerations())) <= ACCELERATION_MAX * overshoot


@EVERY_KIND
def test_initial_velocity_from_rest_raises_with_the_actual_one(kind):
    with opened(kind, Path("rest.toml")) as rig:
        motor = rig.motors["left"]
        motor.enable()
        with pytest.raises(StateError, match=r"begins at 0\.5 rad/s, the motor moves at -?0 rad/s"):
            moved(motor, 1.0, initial_derivatives=(0.5,))
        assert velocity_now(rig, 0.2) == pytest.approx(0.0, abs=0.001)
        moved(motor, 1.0, final_derivatives=(0.5,))
        with pytest.raises(StateError, match=r"begins at 1 rad/s, the motor moves at 0\.\d+ rad/s"):
            moved(motor, 1.0, initial_derivatives=(1.0,))
        with pytest.raises(StateError, match="begins at 9 rad, the motor passes"):
            moved(motor, 8.0, 9.0, initial_derivatives=(0.5,))
        assert velocity_now(rig, 0.2) == pytest.approx(0.5, abs=0.01)  # nothing has changed


@EVERY_KIND
def test_final_velocity_towards_a_limit_ends_at_rest_there(kind):
    with opened(kind, Path("limit.toml")) as rig:
        motor = rig.motors["left"]
        limits = DerivativeLimits(value=(-1.0, 2.0))
        moved(motor, 1.5, final_derivatives=(1.0,), limits=limits)
        rig.runtime.run_for(1.5)
        assert true_position(rig, "left") == pytest.approx(2.0, abs=kind.window)
        motor.stop()
        motor.wait_until_done(timeout_s=2)
        motor.set_trajectory(TrapezoidalTrajectory(-2.9, final_derivatives=(-1.0,), limits=limits))
        with pytest.raises(LimitError, match="final velocity of the trajectory -1 rad/s"):
            motor.start()


@EVERY_KIND
def test_second_derivative_needs_a_limit_of_jerk(kind):
    with opened(kind, Path("second.toml")) as rig:
        motor = rig.motors["left"]
        motor.set_control_mode(ControlMode.TRAJECTORY)
        with pytest.raises(UnsupportedError, match="second derivative at an end"):
            motor.set_trajectory(TrapezoidalTrajectory(1.0, final_derivatives=(0.5, 1.0)))
        pytest.importorskip("ruckig")
        smooth = DerivativeLimits(third=40.0)
        moved(motor, 1.0, final_derivatives=(0.5, 1.0), limits=smooth)
        assert velocity_now(rig, 0.1) == pytest.approx(0.5, abs=0.01)
        moved(motor, 1.0, initial_derivatives=(0.5,), limits=smooth)
        assert abs(velocity_now(rig)) < 0.01


@EVERY_KIND
def test_moving_ends_in_a_group_are_refused(kind):
    with opened(kind, Path("group.toml")) as rig:
        group = rig.groups["both"]
        assert isinstance(group, MotorGroup)
        group.for_each(Motor.set_control_mode, ControlMode.TRAJECTORY)
        group.set_trajectory(
            TrapezoidalTrajectory(1.0, final_derivatives=(0.5,)), TrapezoidalTrajectory(1.0)
        )
        with pytest.raises(UnsupportedError, match="in a group"):
            group.start()


@EVERY_KIND
def test_moving_ends_of_other_variables_are_refused(kind):
    with opened(kind, Path("variables.toml")) as rig:
        motor = rig.motors["left"]
        motor.set_control_mode(ControlMode.TRAJECTORY, ControlVariable.VELOCITY)
        with pytest.raises(UnsupportedError, match="trajectory of velocity that ends with a first"):
            motor.set_trajectory(TrapezoidalTrajectory(1.0, final_derivatives=(0.5,)))


@pytest.mark.parametrize("kind", ASKED.values(), ids=ASKED)
def test_drive_profiles_refuse_moving_ends_at_the_setting(kind):
    with opened(kind, Path("profiles.toml")) as rig:
        motor = rig.motors["left"]
        motor.set_control_mode(ControlMode.TRAJECTORY)
        for ends in ({"final_derivatives": (0.5,)}, {"initial_derivatives": (0.5,)}):
            with pytest.raises(UnsupportedError, match="does not begin and end at rest"):
                motor.set_trajectory(TrapezoidalTrajectory(1.0, **ends))


def judge_chain(kind: Kind, legs: list[tuple[float, float]]) -> int:
    """Run motions, each from the velocity of the last; return how many were possible."""
    with opened(kind, Path("chain.toml")) as rig:
        motor, seen = rig.motors["left"], Seen(rig)
        made, before = 0, 0.0
        for way, after in legs:
            ends = {"initial_derivatives": (before,), "final_derivatives": (after,)}
            try:
                moved(motor, way, **ends)
            except LimitError:  # too fast, or it would have to stop on its way
                break
            assert velocity_now(rig) == pytest.approx(after, abs=0.03)
            made, before = made + 1, after
        assert max(map(abs, seen.velocities())) <= VELOCITY_MAX * 1.02
        overshoot = OVERSHOOT.get(kind.name, 1.15)
        assert max(map(abs, seen.accelerations())) <= ACCELERATION_MAX * overshoot
        return made


@EVERY_KIND
@settings(max_examples=8, phases=(Phase.explicit, Phase.reuse, Phase.generate))
@given(legs=st.lists(LEG, min_size=2, max_size=4))
@example(legs=CHAIN)
def test_chained_motions_keep_limits_and_velocities(kind, legs):
    """Each motion begins with the velocity of the last; none comes to rest between them."""
    event(f"{judge_chain(kind, legs)} motions")


@pytest.mark.parametrize(
    ("name", "where"),
    [
        ("cia402", "motorhil.motorapi.adaptations.cia402.motion.from_here"),
        ("software", "motorhil.motorapi.adaptations.host_servo.motor.from_here"),
    ],
)
def test_begin_where_the_motion_was_planned_is_found(name, where, monkeypatch):
    """The motor has moved on since: the set-points would step back by a part of a radian."""
    monkeypatch.setattr(where, lambda motor, model, motion, position: motion)
    with pytest.raises((AssertionError, MotorError)):
        judge_chain(KINDS[name], CHAIN)


@EVERY_KIND
def test_demand_that_ends_at_its_final_velocity_is_found(kind, monkeypatch):
    """A demand that stands still after a final velocity steps in velocity."""
    monkeypatch.setattr(sampling, "_Onward", Standing)
    with pytest.raises((AssertionError, MotorError)):
        judge_chain(kind, CHAIN)


class Standing:
    """A demand that stays where its trajectory has ended."""

    def __init__(self, motion: Motion) -> None:
        self._target = motion.target

    def value(self, since_s: float) -> float:
        return self._target

    def first(self, since_s: float) -> float:
        return 0.0

    second = first
