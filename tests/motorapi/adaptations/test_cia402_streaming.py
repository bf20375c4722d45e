"""Trajectories that no profile of a drive can follow: streamed in csp, one set-point per SYNC."""

from collections.abc import Callable
from itertools import pairwise
from math import pi, sin
from pathlib import Path

import pytest

from emulators.firmware.gains import ServoGains
from emulators.media.faults import FaultKind, FaultRule
from emulators.plant.presets import WHEEL_60W
from harness.rig import Rig
from motorapi import MotorGroup, TrapezoidalTrajectory
from motorapi.adaptations.cia402 import Cia402Motor, Cia402Parameters
from motorapi.arguments import MotorPosition
from motorapi.commands import ControlMode, ControlVariable, DerivativeLimits
from motorapi.errors import (
    DeviceFault,
    LimitError,
    LinkError,
    MotionInterrupted,
    StateError,
    UnsupportedError,
    UsageError,
)
from motorapi.functions import Constant, Cosine, Function, Polynomial
from motorapi.state import MotorState
from motorapi.synchronization import SyncLevel
from motorapi.trajectory import ComplexTrajectory
from tests.motorapi.adaptations.conftest import HEAD, drive

OpenRig = Callable[..., Rig]
MS = 1_000_000
INC_PER_RAD = 132_000 / (2 * pi)  # 2000 x 66, our own drive's default motor and gear
SYNC, LEFT, RIGHT = 0x080, 0x301, 0x302
EVERY_MS = "set_point_period_ms = 1\nservo_period_ms = 1"


def quintic(distance: float, duration_s: float) -> Function:
    """From rest to rest, and no acceleration at either end."""
    shape = Polynomial((0.0, 0.0, 0.0, 10.0 * distance, -15.0 * distance, 6.0 * distance))
    return shape.scaled(duration_s).restricted(0.0, duration_s)


@pytest.fixture
def rig(open_rig: OpenRig) -> Rig:
    return open_rig(drive("left", 1, motor=EVERY_MS), drive("right", 2, motor=EVERY_MS))


def motor_of(rig: Rig, name: str = "left") -> Cia402Motor:
    motor = rig.motors[name]
    assert isinstance(motor, Cia402Motor)
    return motor


def set_function(
    motor: Cia402Motor,
    function: Function,
    variable: ControlVariable = ControlVariable.POSITION,
    argument: MotorPosition | None = None,
    *,
    relative: bool = True,
) -> Cia402Motor:
    motor.set_control_mode(ControlMode.TRAJECTORY, variable)
    motor.set_trajectory(ComplexTrajectory(function, relative=relative), argument)
    return motor


class Tap:
    """SYNCs and set-points as they were on the bus: (time, identifier, controlword, target)."""

    def __init__(self, rig: Rig) -> None:
        self.frames: list[tuple[int, int, int, int]] = []
        rig.world.tap_frames(self._on_frame)

    def _on_frame(self, bus: str, time_ns: int, sender: str, frame: bytes) -> None:
        can_id = int.from_bytes(frame[:4], "little")
        if can_id in (SYNC, LEFT, RIGHT):
            target = int.from_bytes(frame[10:14], "little", signed=True)
            word = int.from_bytes(frame[8:10], "little")
            self.frames.append((time_ns, can_id, word, target))

    def latched(self, can_id: int) -> list[tuple[int, int]]:
        """(time of SYNC, target): what each SYNC made count, none between two of them twice."""
        result, waiting = [], []
        for time_ns, found, _, target in self.frames:
            if found == can_id:
                waiting.append(target)
            elif found == SYNC and waiting:
                assert len(waiting) == 1, f"{len(waiting)} set-points before one SYNC"
                result.append((time_ns, waiting.pop()))
        assert not waiting
        return result


# --- the drive follows as theory predicts --------------------------------------------------------

G = WHEEL_60W.torque_constant_n_m_a / WHEEL_60W.inertia_kg_m2() * WHEEL_60W.increments_per_rad()
"""Acceleration per current of the motor with its load [increments/s^2/A], by hand."""


def predicted_error(
    positions: list[float], gains: ServoGains, friction_a: float, substeps: int = 20
) -> list[float]:
    """Following error [inc] at each millisecond of a demand, by the servo's differential equations.

    P position loop with velocity feed-forward f, PI velocity loop, an inertia, and dry friction:

        i = kp_v e_v + integral of ki_v e_v,  e_v = f x'(t + T/2) + kp (x - y) - y'(t - T),
        y'' = G (i - friction sign y')

    with T = 1 ms: what is fed forward is the step to come, half of it ahead; what is measured is
    the average over 2 T, T old. Error constants, with a = G kp_v, b = G ki_v and no friction:
    E/X = (s^3 + (1 - f) s (a s + b)) / (s^3 + (a s + b)(s + kp)), so velocity leaves (1 - f) v/kp,
    jerk j/(b kp), and the two times 3/2 T per kp of acceleration (of f = 1), the motor leading.
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
    motor.start()
    times = motor._motion_times()
    assert times is not None
    assert times.started_ns is not None
    started_ns = times.started_ns

    # 1. On the bus: every millisecond one set-point, each of them the function's.
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
    assert (motor.hardware.stream.sent, motor.hardware.stream.late) == (1500, 0)
    syncs = [time for time, _ in latched]
    assert all(abs(b - a - MS) <= 1000 for a, b in pairwise(syncs))
    assert syncs[1] == started_ns

    # 2. In the drive: the demand is the target of SYNC k at the second tick after it, evenly.
    for time_ns, target in latched:
        at = time_ns // MS + 2
        if at in truth:
            assert truth[at][0] == target

    # 3. The motor: where the equations of the servo say, but for 2.5 increments: whole counts of
    # the encoder in position and velocity, whole targets.
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


def test_a_group_begins_at_the_same_sync_and_ends_with_it(rig: Rig):
    left, right = motor_of(rig), motor_of(rig, "right")
    set_function(left, quintic(1.0, 1.0))
    set_function(right, quintic(-0.5, 1.0))
    group = MotorGroup(left, right)
    capability = group.sync_capability()
    assert capability.level is SyncLevel.CYCLIC
    assert capability.start_skew_s == 1e-3  # the servo's tick, the most there is after one SYNC
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
    assert quality.end_skew_s <= 0.02  # as far as a TPDO every 20 ms can tell


def test_who_begins_beside_its_trajectory_goes_there_first_and_the_others_wait(rig: Rig):
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


def test_afterwards_the_drive_s_own_profiles_go_on_from_there(rig: Rig):
    motor = set_function(motor_of(rig), quintic(0.5, 0.7))
    for _ in range(2):
        motor.start()
        motor.wait_until_done(timeout_s=3)
    assert motor.position() == pytest.approx(1.0, abs=10 / INC_PER_RAD)
    motor.set_trajectory(TrapezoidalTrajectory(0.25))
    motor.start()
    motor.wait_until_done(timeout_s=3)
    assert rig.controllers["left"].snapshot()["demand_inc"] == round(1.25 * INC_PER_RAD)
    assert motor.hardware.link.sync_period_ns is None


def test_what_cannot_be_streamed_is_refused_before_anything_is_sent(rig: Rig):
    motor = motor_of(rig)
    motor.set_control_mode(ControlMode.TRAJECTORY, ControlVariable.TORQUE)
    with pytest.raises(UnsupportedError, match="position and velocity"):
        motor.set_trajectory(ComplexTrajectory(quintic(1.0, 1.0)))
    smooth = TrapezoidalTrajectory(1.0, limits=DerivativeLimits(first=1.0, second=10.0))
    with pytest.raises(UnsupportedError, match="no ramp at a constant rate"):
        motor.set_trajectory(smooth)
    assert motor.state() is MotorState.OFFLINE  # not even connected


def test_a_drive_without_csp_says_so_and_stays_where_it_is(open_rig: OpenRig):
    rig = open_rig(drive("left", 1, controller='supported_modes = ["pp", "pv"]'))
    motor = motor_of(rig)
    motor.enable()
    with pytest.raises(UnsupportedError, match="where the drive has csp"):
        set_function(motor, quintic(1.0, 1.0))
    assert motor.hardware.link.sync_period_ns is None


def test_all_drives_of_a_bus_share_one_period(open_rig: OpenRig):
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


def test_a_motor_that_streams_is_not_started_again_before_it_rests(rig: Rig):
    motor = set_function(motor_of(rig), quintic(1.0, 1.0))
    motor.start()
    rig.runtime.run_for(0.3)
    with pytest.raises(StateError, match="stop"):
        motor.start()
    motor.wait_until_done(timeout_s=3)


def test_a_group_in_pp_does_not_count_on_a_sync_that_runs_for_others(open_rig: OpenRig):
    rig = open_rig(*(drive(name, n, motor=EVERY_MS) for n, name in enumerate("abc", 1)))
    set_function(motor_of(rig, "a"), quintic(2.0, 2.0)).start()
    group = MotorGroup(motor_of(rig, "b"), motor_of(rig, "c"))
    group.for_each(Cia402Motor.set_control_mode, ControlMode.TRAJECTORY)
    group.set_trajectory(TrapezoidalTrajectory(0.2), TrapezoidalTrajectory(0.2))
    capability = group.sync_capability()
    assert capability.level is SyncLevel.SEQUENTIAL
    assert "SYNC runs already" in capability.reason
    group.start()
    group.wait_until_done(timeout_s=3)
    for name in "bc":
        assert rig.controllers[name].snapshot()["demand_inc"] == round(0.2 * INC_PER_RAD)
    motor_of(rig, "a").wait_until_done(timeout_s=3)


# --- stopping in mid-stream ----------------------------------------------------------------------


def demands(rig: Rig, name: str, for_s: float) -> list[float]:
    """The demand at every millisecond from now on [increments]."""
    result = []
    for _ in range(round(for_s * 1e3)):
        rig.runtime.run_for(1e-3)
        result.append(rig.controllers[name].snapshot()["demand_inc"])
    return result


@pytest.mark.parametrize("how", ["stop", "halt", "quick_stop"])
@pytest.mark.parametrize(
    ("others", "offset_us"), [(False, 500), (True, 40), (True, 500), (True, 930), (True, 990)]
)
def test_in_mid_stream_it_brakes_within_the_model_s_limit(
    rig: Rig, how: str, others: bool, offset_us: int
):
    """At any moment between two SYNCs, which go on for others or not: a set-point that waits for
    the next one must not take the stop back."""
    motor = set_function(motor_of(rig), quintic(2.0, 1.5))
    other = set_function(motor_of(rig, "right"), quintic(2.0, 1.5))
    MotorGroup(motor, other).start() if others else motor.start()
    rig.runtime.run_for(0.6 + offset_us * 1e-6)
    getattr(motor, how)()
    at = demands(rig, "left", 0.5)
    steps = [b - a for a, b in pairwise(at)]
    fastest = steps[0]
    assert 30 < fastest < 53  # 2.2 rad/s or so, in increments a millisecond
    changes = [b - a for a, b in pairwise(steps)]
    limit = 10.0 * INC_PER_RAD * 1e-6  # acceleration_max of the model, here also deceleration
    assert min(changes) >= -limit - 2.0  # each demand is rounded: a second difference by at most 2
    assert max(changes) <= 2.0
    rested = next(k for k, step in enumerate(steps) if step == 0 and not any(steps[k:]))
    assert rested * 1e-3 == pytest.approx(fastest * 1e3 / INC_PER_RAD / 10.0, abs=0.01)
    motor.wait_until_done(timeout_s=2)
    assert motor.state() is (MotorState.STOPPED if how == "quick_stop" else MotorState.ENABLED)
    assert motor.hardware.stream is not None
    assert motor.hardware.stream.ended
    word = motor.hardware.read("controlword")
    assert word == (0x0002 if how == "quick_stop" else 0x010F)  # no set-point took it back
    if others:
        other.wait_until_done(timeout_s=3)
        assert rig.controllers["right"].snapshot()["demand_inc"] == round(2.0 * INC_PER_RAD)
    still = rig.controllers["left"].snapshot()["demand_inc"]
    rig.runtime.run_for(0.5)
    assert rig.controllers["left"].snapshot()["demand_inc"] == still
    motor.enable()
    motor.start()  # and it works again
    motor.wait_until_done(timeout_s=3)
    assert rig.controllers["left"].snapshot()["demand_inc"] == pytest.approx(
        still + 2.0 * INC_PER_RAD, abs=1
    )


def test_a_stop_whose_first_frames_are_lost_is_in_the_next_set_points(rig: Rig):
    motor = set_function(motor_of(rig), quintic(2.0, 1.5))
    motor.start()
    rig.runtime.run_for(0.6005)  # between a set-point and the next SYNC
    for name, identifier in (("word", 0x201), ("set-point", LEFT)):
        rule = FaultRule(name=name, kind=FaultKind.DROP, identifier=identifier, limit=1)
        rig.faults.inject("can0", rule)
    motor.stop()
    rig.runtime.run_for(0.004)
    assert motor.hardware.stream.ended
    assert motor.hardware.link.sync_period_ns is None
    assert motor.hardware.read("controlword") == 0x010F
    motor.wait_until_done(timeout_s=1)


def test_a_stop_by_another_logical_motor_ends_the_stream(rig: Rig):
    motor = set_function(motor_of(rig), quintic(2.0, 1.5))
    second = Cia402Motor(motor.hardware, motor.model, name="second")
    motor.start()
    rig.runtime.run_for(0.5)
    second.stop()
    with pytest.raises(MotionInterrupted, match=r"stop\(\) of second"):
        motor.wait_until_done(timeout_s=1)
    second.wait_until_done(timeout_s=2)
    assert motor.hardware.stream.ended
    assert rig.controllers["left"].snapshot()["velocity_rad_s"] == 0.0


def test_a_fault_in_mid_stream_ends_both(rig: Rig):
    motor = set_function(motor_of(rig), quintic(2.0, 1.5))
    motor.start()
    rig.runtime.run_for(0.5)
    rig.controllers["left"].stimulate("fault", 0x2310)
    with pytest.raises(DeviceFault, match="2310"):
        motor.wait_until_done(timeout_s=2)
    rig.runtime.run_for(0.1)
    assert motor.hardware.stream.ended
    assert motor.hardware.link.sync_period_ns is None


def test_a_drive_that_is_heard_no_more_is_braked_all_the_same(rig: Rig):
    motor = set_function(motor_of(rig), quintic(4.0, 3.0))
    motor.start()
    rig.runtime.run_for(1.0)
    rule = FaultRule(name="deaf", kind=FaultKind.DROP, sender="left")
    rig.faults.inject("can0", rule)
    with pytest.raises(LinkError, match="no heartbeat"):
        motor.wait_until_done(timeout_s=2)
    at = demands(rig, "left", 0.5)
    steps = [b - a for a, b in pairwise(at)]
    assert steps[0] > 30
    assert steps[-1] == 0
    assert min(b - a for a, b in pairwise(steps)) >= -10.0 * INC_PER_RAD * 1e-6 - 2.0
    assert motor.hardware.stream.ended


def test_who_begins_to_stream_beside_another_disturbs_nobody(rig: Rig):
    left = set_function(motor_of(rig), quintic(1.0, 1.0))
    right = set_function(motor_of(rig, "right"), quintic(-1.0, 1.0))
    tap = Tap(rig)
    left.start()
    rig.runtime.run_for(0.3)
    right.start()
    for motor in (left, right):
        motor.wait_until_done(timeout_s=3)
    for can_id, distance in ((LEFT, 1.0), (RIGHT, -1.0)):
        function = quintic(distance, 1.0)
        expected = [round(function.value(k * 1e-3) * INC_PER_RAD) for k in range(1001)]
        latched = tap.latched(can_id)
        assert [target for _, target in latched] == expected
        # SYNC wins every arbitration, but waits for a frame under way and for the host's own
        # before it: at most 0.135 ms each, two of them.
        assert all(abs(b - a - MS) <= 300_000 for (a, _), (b, _) in pairwise(latched))
    assert left.hardware.stream.late == right.hardware.stream.late == 0


def test_switching_off_ends_the_stream(rig: Rig):
    motor = set_function(motor_of(rig), quintic(2.0, 1.5))
    motor.start()
    rig.runtime.run_for(0.3)
    motor.stop()
    motor.wait_until_done(timeout_s=2)
    motor.start()
    rig.runtime.run_for(0.3)
    motor.disable()
    rig.runtime.run_for(0.1)
    assert motor.state() is MotorState.DISABLED
    assert motor.hardware.stream.ended


# --- late, lost ----------------------------------------------------------------------------------


def test_late_set_points_are_counted_and_told(tmp_path: Path):
    """At 125 kbit/s SYNC and one set-point take 1.2 ms: every 1 ms is too much."""
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


def test_a_lost_set_point_leaves_one_period_out_and_the_next_one_catches_up(rig: Rig):
    motor = set_function(motor_of(rig), quintic(1.0, 1.0))
    motor.start()
    rig.runtime.run_for(0.4)
    rule = FaultRule(name="lost", kind=FaultKind.DROP, identifier=LEFT, limit=1)
    rig.faults.inject("can0", rule)
    motor.wait_until_done(timeout_s=3)
    assert rig.controllers["left"].snapshot()["demand_inc"] == round(INC_PER_RAD)


# --- velocity, by its integral -------------------------------------------------------------------


def test_a_trajectory_of_velocity_is_followed_by_its_integral(rig: Rig):
    """v = 1 - cos(2 pi t) over 2 s: 2 rad; the position at any time is t - sin(2 pi t) / 2 pi."""
    function = (Constant(1.0) - Cosine(1.0, 2 * pi)).restricted(0.0, 2.0)
    motor = set_function(motor_of(rig), function, ControlVariable.VELOCITY, relative=False)
    tap = Tap(rig)
    motor.start()
    motor.wait_until_done(timeout_s=3)
    expected = [k * 1e-3 - sin(2 * pi * k * 1e-3) / (2 * pi) for k in range(2001)]
    targets = [target for _, target in tap.latched(LEFT)]
    # A whole number and a half are told apart by the last bit of the sum: one increment's rounding.
    off = [target - x * INC_PER_RAD for target, x in zip(targets, expected, strict=True)]
    assert max(abs(one) for one in off) <= 0.5 + 1e-6
    rig.runtime.run_for(0.2)
    assert rig.controllers["left"].snapshot()["velocity_rad_s"] == 0.0
    assert motor.hardware.stream.ended


def test_a_velocity_that_does_not_end_at_0_goes_on(rig: Rig):
    ramp = Polynomial((0.0, 0.0, 3.0, -2.0)).restricted(0.0, 1.0)  # 0 to 1 rad/s
    motor = set_function(motor_of(rig), ramp, ControlVariable.VELOCITY, relative=False)
    motor.start()
    motor.wait_until_done(timeout_s=2)
    before = rig.controllers["left"].snapshot()
    rig.runtime.run_for(2.0)
    after = rig.controllers["left"].snapshot()
    assert after["demand_inc"] - before["demand_inc"] == pytest.approx(2.0 * INC_PER_RAD, abs=2)
    motor.stop()
    motor.wait_until_done(timeout_s=2)
    assert rig.controllers["left"].snapshot()["velocity_rad_s"] == 0.0
    assert motor.hardware.stream.ended


def test_a_velocity_over_another_argument_is_summed_up_cycle_by_cycle(rig: Rig):
    """v = x, and x comes to grow by 1 in a second: the way is the integral of x over time."""
    motor, argument = motor_of(rig), Jumps()
    line = Polynomial((0.0, 1.0)).restricted(0.0, 1.0)
    motor.set_control_mode(ControlMode.TRAJECTORY, ControlVariable.VELOCITY)
    motor.set_trajectory(ComplexTrajectory(line), argument)
    motor.start()
    way = [0.0]

    def go_on() -> None:
        argument.now += 1e-3
        way[0] += min(argument.now, 1.0) * 1e-3

    ramp = rig.runtime.every(1e-3, go_on)
    motor.wait_until_done(timeout_s=3)
    rig.runtime.run_for(1.0)  # it goes on at 1 rad/s, as it ended
    at = rig.controllers["left"].snapshot()["demand_inc"]
    ramp.cancel()
    # read up to 1 ms ago, latched 1 ms later, reached 1 to 2 ms after that: 4 ms at 1 rad/s
    assert 0.0 <= way[0] * INC_PER_RAD - at <= 4e-3 * INC_PER_RAD
    motor.stop()
    motor.wait_until_done(timeout_s=2)


def test_a_function_of_velocity_begins_at_rest(rig: Rig):
    motor = motor_of(rig)
    motor.set_control_mode(ControlMode.SETPOINT, ControlVariable.VELOCITY)
    motor.set_setpoint(1.0)
    motor.start()
    motor.wait_until_done(timeout_s=2)
    rig.runtime.run_for(0.2)
    ramp = Polynomial((1.0, 0.0, 3.0, -2.0)).restricted(0.0, 1.0)  # from 1 to 2 rad/s
    set_function(motor, ramp, ControlVariable.VELOCITY, relative=False)
    with pytest.raises(StateError, match="changes to csp at rest"):
        motor.start()
    rig.runtime.run_for(0.2)
    assert rig.controllers["left"].snapshot()["velocity_rad_s"] == pytest.approx(1.0, abs=0.05)
    motor.stop()


def test_a_simple_trajectory_of_velocity_is_the_drive_s_ramp(rig: Rig):
    """From 0 to 2 rad/s in 0.8 s, then to -1 rad/s in 1.5 s: pv, with equal ramps up and down."""
    motor = motor_of(rig)
    motor.set_control_mode(ControlMode.TRAJECTORY, ControlVariable.VELOCITY)
    rates = []
    for final, duration_s in ((2.0, 0.8), (-1.0, 1.5)):
        motor.set_trajectory(
            TrapezoidalTrajectory(final, initial=2.0 * (final < 0), duration_s=duration_s)
        )
        motor.start()
        began = rig.controllers["left"].snapshot()["velocity_rad_s"]
        rig.runtime.run_for(duration_s / 2)
        half = rig.controllers["left"].snapshot()["velocity_rad_s"]
        rates.append((half - began) / (duration_s / 2))
        motor.wait_until_done(timeout_s=3)  # as soon as it is within the drive's velocity window
        rig.runtime.run_for(0.1)
        assert rig.controllers["left"].snapshot()["velocity_rad_s"] == pytest.approx(
            final, abs=0.03
        )
    assert rates == pytest.approx([2.5, -2.0], rel=0.02)
    motor.stop()


# --- over another motor's position ---------------------------------------------------------------

GEAR = Polynomial((0.0, 0.5)).restricted(-10.0, 10.0)  # half as far as the leader
LEADER = "status_period_ms = 1\nstatus_inhibit_ms = 0\nset_point_period_ms = 1"


@pytest.fixture
def geared(open_rig: OpenRig) -> Rig:
    """The right one may follow the left one, which tells its position every millisecond."""
    return open_rig(drive("left", 1, motor=LEADER), drive("right", 2, motor=EVERY_MS))


def test_a_motor_follows_another_as_by_a_gear(geared: Rig):
    left, right = motor_of(geared), motor_of(geared, "right")
    left.enable()
    cam = GEAR.restricted(-10.0, 1.0)
    set_function(right, cam, argument=MotorPosition(left))
    right.start()
    left.set_control_mode(ControlMode.TRAJECTORY)
    left.set_trajectory(TrapezoidalTrajectory(-0.5))
    left.start()
    worst = 0.0
    for _ in range(30):
        geared.runtime.run_for(0.02)
        leads = geared.controllers["left"].snapshot()["position_rad"]
        follows = geared.controllers["right"].snapshot()["position_rad"]
        worst = max(worst, abs(follows - 0.5 * leads))
    left.wait_until_done(timeout_s=2)
    # What was measured up to 1 ms ago is sent, latched 1 ms later and reached 1 to 2 ms after that.
    assert worst <= 0.5 * 3.0 * 4.5e-3 + 5 / INC_PER_RAD
    assert not right.is_done()  # the cam ends at 1 rad only
    left.set_trajectory(TrapezoidalTrajectory(1.6))
    left.start()
    right.wait_until_done(timeout_s=3)
    left.wait_until_done(timeout_s=3)
    assert geared.controllers["right"].snapshot()["demand_inc"] == pytest.approx(
        0.5 * INC_PER_RAD, abs=1
    )  # where the cam ends, half of 1 rad
    assert right.hardware.stream.ended


def test_how_fast_the_leader_may_be_is_checked_before_the_start(geared: Rig):
    """Its model says 3 rad/s: five times that is more than the follower's 3 rad/s."""
    left, right = motor_of(geared), motor_of(geared, "right")
    steep = Polynomial((0.0, 5.0)).restricted(-10.0, 10.0)
    with pytest.raises(LimitError, match="while the position of left changes fastest"):
        set_function(right, steep, argument=MotorPosition(left))
    assert right.state() is MotorState.OFFLINE


class Jumps:
    """An argument that steps, as no motor does."""

    name = "position of something"
    rate_max = 1.0

    def __init__(self) -> None:
        self.now = 0.0
        self.rate = 0.0

    def value(self) -> float:
        return self.now


def test_a_step_beyond_the_limits_ends_the_motion_with_a_controlled_stop(rig: Rig):
    motor, argument = motor_of(rig), Jumps()
    motor.set_control_mode(ControlMode.TRAJECTORY)
    line = Polynomial((0.0, 1.0)).restricted(0.0, 10.0)
    motor.set_trajectory(ComplexTrajectory(line, relative=True), argument)
    motor.start()

    def go_on() -> None:  # up to 1 rad/s, at 5 rad/s2
        argument.rate = min(argument.rate + 5e-3, 1.0)
        argument.now += argument.rate * 1e-3

    ramp = rig.runtime.every(1e-3, go_on)
    rig.runtime.run_for(0.5)
    assert not motor.is_done()
    argument.now += 1.0
    at = demands(rig, "left", 0.4)
    ramp.cancel()
    steps = [b - a for a, b in pairwise(at)]
    changes = [b - a for a, b in pairwise(steps)]
    assert steps[-1] == 0
    assert min(changes) >= -10.0 * INC_PER_RAD * 1e-6 - 2.0
    assert max(steps) <= 23  # 1 rad/s: the step was never followed
    with pytest.raises(LimitError, match="position of something steps: set-points are 1 ms"):
        motor.wait_until_done(timeout_s=1)
    assert motor.hardware.stream.ended
    motor.set_trajectory(ComplexTrajectory(quintic(0.5, 0.7), relative=True))
    motor.start()
    motor.wait_until_done(timeout_s=3)


def test_an_argument_that_becomes_too_fast_ends_it_too(rig: Rig):
    """It says 1 rad/s at most, and comes to more than the motor's 3 rad/s, never abruptly."""
    motor, argument = motor_of(rig), Jumps()
    motor.set_control_mode(ControlMode.TRAJECTORY)
    line = Polynomial((0.0, 1.0)).restricted(0.0, 10.0)
    motor.set_trajectory(ComplexTrajectory(line, relative=True), argument)
    motor.start()

    def go_on() -> None:
        argument.rate += 8e-3
        argument.now += argument.rate * 1e-3

    ramp = rig.runtime.every(1e-3, go_on)
    with pytest.raises(LimitError, match=r"velocity 3\.0"):
        motor.wait_until_done(timeout_s=2)
    ramp.cancel()


def test_it_does_not_jump_onto_an_argument_that_moves(rig: Rig):
    """From rest to 1 rad/s within a period would be 1000 rad/s2: refused, and nothing moves."""
    motor, argument = motor_of(rig), Jumps()
    motor.set_control_mode(ControlMode.TRAJECTORY)
    line = Polynomial((0.0, 1.0)).restricted(0.0, 10.0)
    motor.set_trajectory(ComplexTrajectory(line, relative=True), argument)
    ramp = rig.runtime.every(1e-3, lambda: setattr(argument, "now", argument.now + 1e-3))
    motor.start()
    with pytest.raises(LimitError, match="velocity at the start"):
        motor.wait_until_done(timeout_s=1)
    assert rig.controllers["left"].snapshot()["demand_inc"] == 0
    ramp.cancel()


def test_a_velocity_that_changes_too_fast_ends_it_as_well(rig: Rig):
    """The argument's speed goes from 1 to 0.2 rad/s in a millisecond: no step, but no motion."""
    motor, argument = motor_of(rig), Jumps()
    motor.set_control_mode(ControlMode.TRAJECTORY)
    line = Polynomial((0.0, 1.0)).restricted(0.0, 10.0)
    motor.set_trajectory(ComplexTrajectory(line, relative=True), argument)
    motor.start()
    asked = [1.0]

    def go_on() -> None:
        argument.rate = min(argument.rate + 9e-3, asked[0])
        argument.now += argument.rate * 1e-3

    ramp = rig.runtime.every(1e-3, go_on)
    rig.runtime.run_for(0.5)
    assert not motor.is_done()
    asked[0] = 0.2
    with pytest.raises(LimitError, match="change of velocity"):
        motor.wait_until_done(timeout_s=1)
    ramp.cancel()


def test_an_argument_that_fails_ends_the_motion_in_the_same_way(rig: Rig):
    motor, argument = motor_of(rig), Jumps()
    motor.set_control_mode(ControlMode.TRAJECTORY)
    line = Polynomial((0.0, 1.0)).restricted(0.0, 10.0)
    motor.set_trajectory(ComplexTrajectory(line, relative=True), argument)
    motor.start()
    rig.runtime.run_for(0.1)

    def broken() -> float:
        raise UsageError("it is gone")

    argument.value = broken  # type: ignore[method-assign]
    with pytest.raises(UsageError, match="it is gone"):
        motor.wait_until_done(timeout_s=1)
    assert motor.hardware.stream.ended
