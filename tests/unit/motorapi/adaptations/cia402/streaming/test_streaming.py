"""Trajectories that no profile of a drive can follow, streamed in csp."""

from itertools import pairwise
from pathlib import Path

import pytest

from motorhil.emulators.can.fault_rules import FaultKind, FaultRule
from motorhil.emulators.firmware.servo_tables import ServoGains
from motorhil.emulators.plant.presets import WHEEL_60W
from motorhil.harness.rig.rig import Rig
from motorhil.motorapi import MotorGroup, TrapezoidalTrajectory
from motorhil.motorapi.adaptations.cia402.motor import Cia402Motor
from motorhil.motorapi.adaptations.cia402.parameters import Cia402Parameters
from motorhil.motorapi.commands import ControlMode, ControlVariable, DerivativeLimits
from motorhil.motorapi.errors import StateError, UnsupportedError, UsageError
from motorhil.motorapi.functions import Constant
from motorhil.motorapi.state import MotorState
from motorhil.motorapi.synchronization.bus_load import CanTraffic, declare_traffic
from motorhil.motorapi.synchronization.quality import SyncLevel
from motorhil.motorapi.trajectory import ComplexTrajectory
from tests.support.motors.drive_rigs import HEAD, drive
from tests.support.motors.streaming import (
    EVERY_MS,
    INC_PER_RAD,
    LEFT,
    MS,
    RIGHT,
    OpenRig,
    Tap,
    motor_of,
    quintic,
    set_function,
)

# --- theory of the drive's following -------------------------------------------------------------

G = WHEEL_60W.torque_constant_n_m_a / WHEEL_60W.inertia_kg_m2() * WHEEL_60W.increments_per_rad()
"""The acceleration per current of the motor with its load [increments/s^2/A], by hand."""


def predicted_error(
    positions: list[float], gains: ServoGains, friction_a: float, substeps: int = 20
) -> list[float]:
    """Return the following error [inc] at each millisecond, by the servo's differential equations.

    P position loop with velocity feed-forward f, PI velocity loop, an inertia, and dry friction:

        i = kp_v e_v + integral of ki_v e_v,  e_v = f x'(t + T/2) + kp (x - y) - y'(t - T),
        y'' = G (i - friction sign y')

    with T = 1 ms. The feed-forward value is the next step, half of it ahead; the measured value is
    the average over 2 T, T old. Error constants, with a = G kp_v, b = G ki_v and no friction:
    E/X = (s^3 + (1 - f) s (a s + b)) / (s^3 + (a s + b)(s + kp)), so velocity leaves (1 - f) v/kp,
    jerk leaves j/(b kp), and the two times leave 3/2 T per kp of acceleration (for f = 1), the
    motor leading.
    """
    h = 1e-3 / substeps
    y = y1 = hold = 0.0
    old = [0.0] * substeps  # y' of the last millisecond
    errors = []
    for x_now, x_next in zip(positions, [*positions[1:], positions[-1]], strict=True):
        errors.append(x_now - y)
        x1 = (x_next - x_now) / 1e-3
        for j in range(substeps):
            x = x_now + x1 * h * j
            old.append(y1)
            error = gains.velocity_feedforward * x1 + gains.position_kp_1_s * (x - y) - old.pop(0)
            hold += gains.velocity_ki_a_inc * error * h
            current = gains.velocity_kp_a_s_inc * error + hold
            if y1 == 0.0 and abs(current) <= friction_a:
                continue
            sign = 1.0 if y1 > 0.0 or (y1 == 0.0 and current > 0.0) else -1.0
            before = y1
            y1 += G * (current - friction_a * sign) * h
            if before * y1 < 0.0:
                y1 = 0.0
            y += y1 * h
    return errors


@pytest.mark.parametrize("feedforward", [1.0, 0.0])
def test_at_1_khz_no_set_point_is_lost_or_doubled_and_the_drive_follows_as_predicted(
    rig: Rig, feedforward: float
):
    motor = motor_of(rig)
    gains = ServoGains.tuned(WHEEL_60W, MS, 10)
    gains = ServoGains(
        position_kp_1_s=50.0,
        velocity_kp_a_s_inc=gains.velocity_kp_a_s_inc,
        velocity_ki_a_inc=gains.velocity_ki_a_inc,
        current_kp_v_a=gains.current_kp_v_a,
        current_ki_v_a_s=gains.current_ki_v_a_s,
        velocity_feedforward=feedforward,
    )
    motor.set_parameters(
        Cia402Parameters(
            position_gains=(50_000, round(1000 * feedforward)), following_error_window=1.0
        )
    )
    function = quintic(2.0, 1.5)
    set_function(motor, function)
    tap = Tap(rig)
    motor.enable()
    rig.runtime.run_for(0.0003)  # so that SYNC never waits for a heartbeat
    motor.start()
    times = motor._motion_times()
    assert times is not None
    assert times.started_ns is not None
    started_ns = times.started_ns

    # 1. On the bus: every millisecond one set-point of the function.
    truth: dict[int, tuple[float, float]] = {}
    tick = rig.runtime.now_ns() // MS
    while rig.runtime.now_ns() < started_ns + 1_600 * MS:
        tick += 1
        rig.runtime.run_for((tick * MS - rig.runtime.now_ns()) / 1e9)
        now = rig.controllers["left"].snapshot()
        truth[tick] = (now["demand_inc"], now["position_inc"])
    motor.wait_until_done(timeout_s=1)
    latched = tap.latched(LEFT)
    expected = [round(function.value(k * 1e-3) * INC_PER_RAD) for k in range(1501)]
    assert [target for _, target in latched] == expected
    stream = motor.hardware.stream
    assert (stream.sent, stream.late, stream.missed) == (1500, 0, 0)
    syncs = [time for time, _ in latched]
    assert all(abs(b - a - MS) <= 1000 for a, b in pairwise(syncs))
    assert syncs[1] == started_ns

    # 2. In the drive: the demand reaches the target of SYNC k at the second tick after it, evenly.
    for time_ns, target in latched:
        at = time_ns // MS + 2
        if at in truth:
            assert truth[at][0] == target

    # 3. The motor: as the equations of the servo predict, within 2.5 increments: integer counts of
    #    the encoder in position and velocity, integer targets.
    first = started_ns // MS + 1  # the tick at which the demand begins to move
    demands = [function.value(min(k * 1e-3, 1.5)) * INC_PER_RAD for k in range(1550)]
    friction_a = WHEEL_60W.coulomb_friction_n_m / WHEEL_60W.torque_constant_n_m_a
    errors = predicted_error(demands, gains, friction_a)
    largest = max(abs(error) for error in errors)
    if feedforward == 1.0:  # a lead by acceleration, of 3/2 T / kp
        assert largest < 1.5e-3 / 50.0 * 5.2 * INC_PER_RAD + 1.0
    else:  # a lag by velocity, of 1 / kp
        assert largest == pytest.approx(2.5 * INC_PER_RAD / 50.0, rel=0.01)
    for k, error in enumerate(errors):
        demand, position = truth[first + k]
        assert demand - position == pytest.approx(error, abs=2.5), k


# --- beginning and ending ------------------------------------------------------------------------


def test_group_begins_and_ends_with_one_sync(rig: Rig):
    left, right = motor_of(rig), motor_of(rig, "right")
    set_function(left, quintic(1.0, 1.0))
    set_function(right, quintic(-0.5, 1.0))
    group = MotorGroup(left, right)
    capability = group.sync_capability()
    assert capability.level is SyncLevel.CYCLIC
    assert capability.start_skew_s == 1e-3  # the servo's tick, the longest delay after one SYNC
    tap = Tap(rig)
    group.start()
    group.wait_until_done(timeout_s=3)
    first, second = tap.latched(LEFT), tap.latched(RIGHT)
    assert [time for time, _ in first] == [time for time, _ in second]
    for latched, distance in ((first, 1.0), (second, -0.5)):
        function = quintic(distance, 1.0)
        assert [target for _, target in latched] == [
            round(function.value(k * 1e-3) * INC_PER_RAD) for k in range(1001)
        ]
    quality = group.sync_quality()
    assert quality.start_skew_s == 0.0
    assert quality.end_skew_s is not None
    assert quality.end_skew_s <= 0.02  # within the resolution of a TPDO every 20 ms


@pytest.mark.parametrize("order", [("left", "right"), ("right", "left")])
def test_profile_and_stream_begin_by_one_sync(rig: Rig, order: tuple[str, str]):
    group = MotorGroup(*(motor_of(rig, name) for name in order))
    group.for_each(Cia402Motor.set_control_mode, ControlMode.TRAJECTORY)
    motor_of(rig).set_trajectory(TrapezoidalTrajectory(0.5))
    set_function(motor_of(rig, "right"), quintic(0.5, 1.0))
    capability = group.sync_capability()
    assert capability.level is SyncLevel.TRIGGERED
    # The first step of a stream is one period later, unless SYNC is delayed.
    assert capability.start_skew_s is None
    declare_traffic(rig.bus("can0"), CanTraffic(1_000_000))
    start_skew_s = group.sync_capability().start_skew_s
    assert start_skew_s is not None
    assert 2e-3 <= start_skew_s <= 4e-3
    group.start()
    group.wait_until_done(timeout_s=3)
    quality = group.sync_quality()
    assert quality.start_skew_s == pytest.approx(1e-3, abs=1e-5)
    for name in order:
        assert rig.controllers[name].snapshot()["demand_inc"] == round(0.5 * INC_PER_RAD)


def test_lead_in_to_the_trajectory_makes_others_wait(rig: Rig):
    left, right = motor_of(rig), motor_of(rig, "right")
    shifted = quintic(1.0, 1.0) + Constant(0.008)  # within the model's tolerance of 0.01 rad
    set_function(left, shifted, relative=False)
    set_function(right, quintic(1.0, 1.0))
    group = MotorGroup(left, right)
    tap = Tap(rig)
    group.start()
    group.wait_until_done(timeout_s=3)
    first = [target for _, target in tap.latched(LEFT)]
    second = [target for _, target in tap.latched(RIGHT)]
    wait = len(second) - 1001
    assert wait == 57  # 0.008 rad at 10 rad/s2: 2 sqrt(0.008 / 10) s
    assert len(first) == len(second)
    assert second[: wait + 1] == [0] * (wait + 1)
    ways = [b - a for a, b in pairwise(first)]
    assert max(abs(way) for way in ways[: len(ways) - 1000]) <= 0.283 * 1e-3 * INC_PER_RAD + 1
    assert first[-1] == round(1.008 * INC_PER_RAD)


def test_profile_after_a_stream_continues_from_its_end(rig: Rig):
    motor = set_function(motor_of(rig), quintic(0.5, 0.7))
    for _ in range(2):
        motor.start()
        motor.wait_until_done(timeout_s=3)
    assert motor.position() == pytest.approx(1.0, abs=10 / INC_PER_RAD)
    motor.set_trajectory(TrapezoidalTrajectory(0.25))
    motor.start()
    motor.wait_until_done(timeout_s=3)
    assert rig.controllers["left"].snapshot()["demand_inc"] == round(1.25 * INC_PER_RAD)
    assert motor.hardware.node.bus.sync.period_ns is None


def test_unstreamable_trajectory_is_refused_before_sending(rig: Rig):
    motor = motor_of(rig)
    motor.set_control_mode(ControlMode.TRAJECTORY, ControlVariable.TORQUE)
    with pytest.raises(UnsupportedError, match="position and velocity"):
        motor.set_trajectory(ComplexTrajectory(quintic(1.0, 1.0)))
    smooth = TrapezoidalTrajectory(1.0, limits=DerivativeLimits(first=1.0, second=10.0))
    with pytest.raises(UnsupportedError, match="other than a ramp at a constant rate"):
        motor.set_trajectory(smooth)
    assert motor.state() is MotorState.OFFLINE  # not even connected


def test_drive_without_csp_refuses_and_stays(open_rig: OpenRig):
    rig = open_rig(drive("left", 1, controller='supported_modes = ["pp", "pv"]'))
    motor = motor_of(rig)
    motor.enable()
    with pytest.raises(UnsupportedError, match="where the drive has csp"):
        set_function(motor, quintic(1.0, 1.0))
    assert motor.hardware.node.bus.sync.period_ns is None


def test_stream_of_another_period_is_refused(open_rig: OpenRig):
    slower = "set_point_period_ms = 4"
    rig = open_rig(drive("left", 1, motor=EVERY_MS), drive("right", 2, motor=slower))
    left, right = motor_of(rig), motor_of(rig, "right")
    set_function(left, quintic(1.0, 1.0)).start()
    with pytest.raises(UsageError, match="every 1 ms already, so not every 4 ms"):
        set_function(right, quintic(1.0, 1.0)).start()
    left.wait_until_done(timeout_s=3)
    assert rig.controllers["right"].snapshot()["demand_inc"] == 0
    right.start()
    right.wait_until_done(timeout_s=3)


def test_start_while_streaming_is_refused_until_rest(rig: Rig):
    motor = set_function(motor_of(rig), quintic(1.0, 1.0))
    motor.start()
    rig.runtime.run_for(0.3)
    with pytest.raises(StateError, match="stop"):
        motor.start()
    motor.wait_until_done(timeout_s=3)


def test_pp_group_begins_in_one_burst_beside_a_cyclic_sync(open_rig: OpenRig):
    rig = open_rig(*(drive(name, n, motor=EVERY_MS) for n, name in enumerate("abc", 1)))
    set_function(motor_of(rig, "a"), quintic(2.0, 2.0)).start()
    group = MotorGroup(motor_of(rig, "b"), motor_of(rig, "c"))
    group.for_each(Cia402Motor.set_control_mode, ControlMode.TRAJECTORY)
    group.set_trajectory(TrapezoidalTrajectory(0.2), TrapezoidalTrajectory(0.2))
    capability = group.sync_capability()
    assert capability.level is SyncLevel.TRIGGERED
    assert "SYNC runs every 1 ms, produced by" in capability.reason
    assert capability.command_skew_s is None
    assert capability.no_command_bound == (
        "b: the other traffic on can0 is not declared (declare_traffic)"
    )
    group.start()
    group.wait_until_done(timeout_s=3)
    for name in "bc":
        assert rig.controllers[name].snapshot()["demand_inc"] == round(0.2 * INC_PER_RAD)
    motor_of(rig, "a").wait_until_done(timeout_s=3)


# --- late, lost ----------------------------------------------------------------------------------


def test_late_set_points_are_counted_and_reported(tmp_path: Path):
    """At 125 kbit/s SYNC and one set-point take 1.2 ms: too long for a period of 1 ms."""
    path = tmp_path / "slow.toml"
    text = HEAD.replace("1_000_000", "125_000") + drive("left", 1, motor=EVERY_MS)
    path.write_text(text)
    with Rig.open(path) as rig:
        motor = set_function(motor_of(rig), quintic(0.2, 0.5))
        motor.start()
        motor.wait_until_done(timeout_s=5)
        late = motor.hardware.stream.late
        assert late > 50
        times = motor._motion_times()
        assert times is not None
        assert f"{late} of 500 set-points were late" in times.source


def test_lost_set_point_skips_one_period(rig: Rig):
    motor = set_function(motor_of(rig), quintic(1.0, 1.0))
    motor.start()
    rig.runtime.run_for(0.4)
    rule = FaultRule(name="lost", kind=FaultKind.DROP, identifier=LEFT, limit=1)
    rig.faults.inject("can0", rule)
    motor.wait_until_done(timeout_s=3)
    assert rig.controllers["left"].snapshot()["demand_inc"] == round(INC_PER_RAD)
