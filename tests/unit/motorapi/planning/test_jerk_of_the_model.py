"""The jerk limit of the model is the default of simple trajectories, judged by the true motion."""

from pathlib import Path

import pytest

from motorhil.harness.rig.config.rig_file import parse_rig
from motorhil.harness.rig.config.toml import Source
from motorhil.harness.rig.reading import installed_plugins
from motorhil.harness.rig.rig import Rig
from motorhil.motorapi import (
    ControlMode,
    ControlVariable,
    DerivativeLimits,
    LimitError,
    Motor,
    MotorGroup,
    TrapezoidalTrajectory,
)
from tests.support.motors.kinds import ASKED, KINDS, MODEL, Kind, true_position

JERK = 20.0
ACCELERATION = 4.0
EVERY_KIND = pytest.mark.parametrize("kind", KINDS.values(), ids=KINDS)


def opened(kind: Kind, jerk: float | None = JERK, drive: str = "") -> Rig:
    """Return the rig of the kind, with a jerk limit in its models."""
    text = kind.rig()
    if jerk is not None:
        text = text.replace(MODEL, f"{MODEL}jerk_max_rad_s3 = {jerk}\n")
    text = text.replace('kind = "cia402"', f'kind = "cia402"\n{drive}')
    return Rig(parse_rig(Source(Path("jerk.toml"), text), installed_plugins()))


def course(rig: Rig, motor: Motor, for_s: float = 0.2) -> list[float]:
    """Start the motor; return its true way every 10 ms."""
    motor.start()
    times = motor.logical.hooks.motion_times()
    assert times is not None
    begin_ns = times.started_ns or rig.runtime.now_ns()
    start, made = true_position(rig, "left"), []
    for tick in range(1, round(for_s * 100) + 1):
        rig.runtime.run_for((begin_ns + tick * 10_000_000 - rig.runtime.now_ns()) / 1e9)
        made.append(true_position(rig, "left") - start)
    return made


@EVERY_KIND
@pytest.mark.parametrize("own", [None, 10.0])
def test_position_rises_with_the_jerk_of_the_model(kind, own):
    """x = j t³ / 6 up to 0.2 s, where the acceleration limit is reached."""
    with opened(kind) as rig:
        motor = rig.motors["left"]
        motor.enable()
        motor.set_control_mode(ControlMode.TRAJECTORY)
        limits = None if own is None else DerivativeLimits(third=own)
        motor.set_trajectory(TrapezoidalTrajectory(3.0, limits=limits))
        for tick, way in enumerate(course(rig, motor), 1):
            late_s = 0.007 if kind.name == "cia402" else 0.0015  # the period of set-points, ticks
            highest = (own or JERK) * (tick * 0.01) ** 3 / 6.0
            lowest = (own or JERK) * max(0.0, tick * 0.01 - late_s) ** 3 / 6.0
            assert lowest - kind.following <= way <= highest + kind.following
        motor.wait_until_done(timeout_s=5)
        assert true_position(rig, "left") == pytest.approx(3.0, abs=kind.window)
        with pytest.raises(LimitError, match="jerk limit -21"):
            motor.set_trajectory(TrapezoidalTrajectory(1.0, limits=DerivativeLimits(third=21.0)))


@EVERY_KIND
def test_progress_with_jerk_is_of_the_distance(kind):
    with opened(kind) as rig:
        motor = rig.motors["left"]
        motor.enable()
        motor.set_control_mode(ControlMode.TRAJECTORY)
        motor.set_trajectory(TrapezoidalTrajectory(3.0))
        made = course(rig, motor)[-1]  # 0.7 % of it in a tenth of its time
        progress = motor.progress()
        assert progress is not None
        assert progress.fraction == pytest.approx(made / 3.0, abs=0.01)


@pytest.mark.parametrize("kind", [KINDS["ideal"], KINDS["software"]], ids=["ideal", "software"])
def test_velocity_rises_with_the_jerk_of_the_model(kind):
    """v = j t² / 2, so the way is j t³ / 6."""
    with opened(kind) as rig:
        motor = rig.motors["left"]
        motor.enable()
        motor.set_control_mode(ControlMode.TRAJECTORY, ControlVariable.VELOCITY)
        motor.set_trajectory(TrapezoidalTrajectory(1.5))
        for tick, way in enumerate(course(rig, motor), 1):
            assert way == pytest.approx(JERK * (tick * 0.01) ** 3 / 6.0, abs=0.003)
        motor.wait_until_done(timeout_s=5)
        motor.stop()


def test_drive_without_csp_keeps_its_own_profile():
    """pp cannot limit jerk, so only the acceleration is limited, as the documents say."""
    with opened(KINDS["cia402"], drive='objects = { "6502h" = 0x2D }') as rig:
        motor = rig.motors["left"]
        motor.enable()
        motor.set_control_mode(ControlMode.TRAJECTORY)
        motor.set_trajectory(TrapezoidalTrajectory(3.0))
        way = course(rig, motor)[-1]
        assert way == pytest.approx(ACCELERATION * 0.2**2 / 2.0, rel=0.2)


@pytest.mark.parametrize("kind", ASKED.values(), ids=ASKED)
def test_drive_profiles_move_under_a_model_with_jerk(kind):
    with opened(kind) as rig:
        motor = rig.motors["left"]
        motor.set_control_mode(ControlMode.TRAJECTORY)
        motor.set_trajectory(TrapezoidalTrajectory(0.5))
        motor.start()
        motor.wait_until_done(timeout_s=5)
        assert true_position(rig, "left") == pytest.approx(0.5, abs=0.01)


@EVERY_KIND
def test_group_with_jerk_begins_and_ends_together(kind):
    with opened(kind) as rig:
        group = rig.groups["both"]
        assert isinstance(group, MotorGroup)
        group.for_each(Motor.enable)
        group.for_each(Motor.set_control_mode, ControlMode.TRAJECTORY)
        group.set_trajectory(TrapezoidalTrajectory(1.0), TrapezoidalTrajectory(2.0))
        group.start()
        runs = [motor.logical.run for motor in group]
        durations_s = {run.motion.duration_s for run in runs if run is not None and run.motion}
        assert len(durations_s) == 1
        group.wait_until_done(timeout_s=5)
        ways = [true_position(rig, name) for name in ("left", "right")]
        assert ways == pytest.approx([1.0, 2.0], abs=kind.window)
