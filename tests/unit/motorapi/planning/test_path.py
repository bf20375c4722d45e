"""Deviations of motors from their line: by hand, and measured against the truth."""

from pathlib import Path
from types import SimpleNamespace

import pytest
from hypothesis import given
from hypothesis import strategies as st

from motorhil.harness.rig.config.rig_file import parse_rig
from motorhil.harness.rig.config.toml import Source
from motorhil.harness.rig.reading import installed_plugins
from motorhil.harness.rig.rig import Rig
from motorhil.motorapi import (
    ControlMode,
    FaultReaction,
    Motor,
    Synchronization,
    TrapezoidalTrajectory,
)
from motorhil.motorapi.execution import Started
from motorhil.motorapi.planning.path import Line, predicted
from tests.support.motors.plain import PlainBus, PlainHwMotor, PlainMotor, fault_now
from tests.unit.motorapi.test_fault_reactions import KINDS, NAMES, WAYS, Truth
from tests.unit.motorapi.test_group import group_of

SIZE = st.floats(0.1, 10.0)
WAY = st.floats(-100.0, 100.0).filter(lambda way: abs(way) > 1e-6)


def test_nearest_point_equals_the_hand_result():
    # (4, 3) beside the line from 0 to (3, 4): at 24/25 of it, (2.88, 3.84).
    line = Line(starts=(0.0, 0.0), ways=(3.0, 4.0), speeds=(2.0, 2.0))
    assert line.deviations([4.0, 3.0]) == pytest.approx([1.12, -0.84], rel=1e-14)
    # A motor a thousand times as fast is so much nearer: the other one determines the point.
    line = Line(starts=(1.0, 0.0), ways=(1.0, 1.0), speeds=(1.0, 1000.0))
    assert line.deviations([1.5, 0.6]) == pytest.approx([0.0, 0.1], abs=1e-6)


@given(st.lists(st.tuples(WAY, SIZE, st.floats(-10.0, 10.0)), min_size=2, max_size=6), WAY)
def test_point_on_the_line_has_no_deviation(parts, along):
    line = Line(
        starts=tuple(start for _, _, start in parts),
        ways=tuple(way for way, _, _ in parts),
        speeds=tuple(speed for _, speed, _ in parts),
    )
    on = [start + along * way for way, _, start in parts]
    rounding = 1e-9 * max(1.0, *(abs(one) for one in on))  # squares of speeds differ up to 1e4
    assert line.deviations(on) == pytest.approx([0.0] * len(parts), abs=rounding)
    off = [one + 0.25 * place for place, one in enumerate(on)]
    found = line.deviations(off)
    # Nearest: the remainder is at right angles to the line, in the measure of speeds.
    right = sum(
        dev * way / speed / speed for dev, (way, speed, _) in zip(found, parts, strict=True)
    )
    assert abs(right) <= rounding * max(abs(way) / speed / speed for way, speed, _ in parts)


def started_by(acceleration):
    """Return a motor that moves by 2 at the velocity 1 with these ramps."""
    motion = SimpleNamespace(
        start=0.0, distance=2.0, velocity=1.0, acceleration=acceleration, deceleration=acceleration
    )
    return Started(SimpleNamespace(model=SimpleNamespace(velocity_max=1.0)), motion, motion)


def test_predicted_deviation_equals_the_hand_result():
    # Ramps of 1 s and of 0.5 s: from 1 s to 2 s, on both plateaus, the first is 0.25 behind. The
    # nearest point of the line is in the middle of both.
    assert predicted([started_by(1.0), started_by(2.0)]) == pytest.approx([0.125, 0.125])


def test_only_motors_in_phase_have_a_path(pair):
    group = group_of(pair, 1.0, 2.0)
    group.start()
    group.wait_until_done()
    assert group.sync_quality().path == ()
    assert group.sync_capability().path == ()


def test_resting_motor_and_line_of_one_are_not_measured(pair):
    group = group_of(pair, 0.0, 2.0)
    group.synchronization = Synchronization.PHASE
    assert [one.motor for one in group.sync_capability().path] == ["m2"]
    group.start()
    group.wait_until_done()
    stays, goes = group.sync_quality().path
    assert (stays.motor, stays.deviation, stays.source) == ("m1", None, "it has no way to go")
    assert (goes.motor, goes.deviation, goes.predicted) == ("m2", None, 0.0)


def test_group_without_any_way_is_done(pair):
    group = group_of(pair, 0.0, 0.0)
    group.synchronization = Synchronization.PHASE
    group.start()
    group.wait_until_done(1.0)
    assert [one.deviation for one in group.sync_quality().path] == [None, None]


def test_motor_that_leaves_the_line_is_found(runtime, pair):
    group = group_of(pair, 1.0, 2.0)
    group.synchronization = Synchronization.PHASE
    group.fault_reaction = FaultReaction.NONE
    pair[1].hw.latency_s = 0.1  # begins later than reported: 0.1 s of the line behind
    group.start()
    runtime.run_for(3.0)
    first, second = group.sync_quality().path
    # On the plateau, 1 and 2 rad/s, the second motor is 0.2 rad behind. From the nearest point of
    # the line (1, 2)/sqrt 5 the first one is then 0.08 rad ahead, the second 0.04 behind.
    assert first.deviation == pytest.approx(0.08, abs=1e-9)
    assert second.deviation == pytest.approx(0.04, abs=1e-9)


def test_failed_motor_has_left_the_line(runtime, pair):
    group = group_of(pair, 1.0, 2.0)
    group.synchronization = Synchronization.PHASE
    group.start()
    runtime.run_for(0.7)
    fault_now(pair[0].hw)
    runtime.run_for(3.0)
    assert all(one.deviation < 1e-9 for one in group.sync_quality().path)


class Seldom(PlainMotor):
    """A motor that reports every 20 ms, `after_ns` after each full 20 ms."""

    after_ns = 0
    heard = None

    def _latest(self):
        now_ns = self.runtime.now_ns() - self.after_ns
        if self.heard is None or now_ns // 20_000_000 > (self.heard.time_ns - self.after_ns) // (
            20_000_000
        ):
            self.heard = super()._latest()
        return self.heard


def test_motors_reporting_at_different_times_are_compared(runtime):
    bus = PlainBus()
    motors = [Seldom(PlainHwMotor(runtime, node, bus)) for node in (1, 2)]
    motors[1].after_ns = 10_000_000
    group = group_of(motors, 1.0, 2.0)
    group.synchronization = Synchronization.PHASE
    group.start()
    runtime.run_for(3.0)
    for one in group.sync_quality().path:
        # A chord of 20 ms under 4 rad/s^2 deviates by a h^2 / 8 = 0.2 mrad at most, by its part of
        # the line; 10 ms of 2 rad/s would be 20 mrad.
        assert 0.0 < one.deviation <= 0.0002
        assert 0.0 < one.age_s <= 0.01


def moved(kind, disturb):
    """Return the reported path of the group, the true deviations, and the predicted ones."""
    description = parse_rig(Source(Path("path.toml"), kind.rig), installed_plugins())
    with Rig(description) as rig:
        group = rig.groups["all"]
        group.for_each(Motor.enable)
        group.for_each(Motor.set_control_mode, ControlMode.TRAJECTORY)
        group.set_trajectory(*map(TrapezoidalTrajectory, WAYS))
        group.synchronization = Synchronization.PHASE
        predicted = [one.predicted for one in group.sync_capability().path]
        rig.runtime.run_for(0.0003)  # no tick of a drive between the SYNCs of two buses
        group.start()
        truth = Truth(rig)
        rig.runtime.run_for(0.6)
        if disturb:
            rig.controllers["m1"].stimulate("load_torque_n_m", 8.0)
        group.wait_until_done(timeout_s=5)
        line = Line(tuple(truth.seen[0][1]), WAYS, (1.0, 1.0, 1.0))
        found = [line.deviations(positions) for _, positions in truth.seen]
        worst = [max(abs(row[place]) for row in found) for place in range(len(NAMES))]
        return group.sync_quality().path, worst, predicted


@pytest.mark.parametrize("disturb", [False, True], ids=["free", "disturbed"])
@pytest.mark.parametrize("kind", KINDS.values(), ids=KINDS)
def test_reported_path_equals_that_of_the_plants(kind, disturb):
    """Compare within four increments, for rounding and the time of a frame.

    The maximum may lie between two samples, at most 20 ms apart.
    """
    if disturb and kind.name == "ideal":
        return  # without disturbance
    path, worst, predicted = moved(kind, disturb)
    for one, most in zip(path, worst, strict=True):
        assert 0.85 * most - 0.0002 <= one.deviation <= most + 0.0002
        assert 0.0 <= one.age_s <= 0.02
    assert [one.predicted for one in path] == predicted
    assert max(predicted) <= 0.00003
    if disturb:
        assert path[0].deviation > 0.003
    sources = {"ideal": "the law of its motion", "servos": "counts that came with SYNC"}
    expected = sources.get(kind.name, "6064h in TPDO 181h every 20 ms, when it was heard")
    assert path[0].source == expected
