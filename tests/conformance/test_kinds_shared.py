"""Many users of one motor (3.5), on every kind of hardware."""

from functools import partial
from itertools import pairwise
from pathlib import Path
from threading import Thread

import pytest

from motorhil.motorapi import (
    ControlMode,
    DeadlineExceeded,
    MotionInterrupted,
    Motor,
    MotorBusyError,
    MotorGroup,
    MotorModel,
    TrapezoidalTrajectory,
    WallRuntime,
)
from motorhil.motorapi.adaptations.ideal.hardware import IdealHwMotor
from motorhil.motorapi.adaptations.ideal.motor import IdealMotor
from tests.support.motors.kinds import ACCELERATION_MAX, EVERY, VELOCITY_MAX, opened, true_position

SETPOINT, TRAJECTORY = ControlMode.SETPOINT, ControlMode.TRAJECTORY


@pytest.fixture(params=EVERY)
def kind(request):
    return EVERY[request.param]


USERS = ("ann", "ben", "cem", "dot")
TIMES = 3


def one_move(motor, way, duration_s):
    """Make one move, in code for a single thread."""
    motor.set_control_mode(ControlMode.TRAJECTORY)
    motor.set_trajectory(TrapezoidalTrajectory(way, duration_s=duration_s))
    motor.start()
    motor.wait_until_done()


def use(motor, place, log):
    """Move the motor `TIMES` times with own parameters, whenever it is free.

    A refused user has moved nothing and tries again; the code that moves knows no other users.
    """
    way, duration_s = 0.01 * (place + 1), 0.1 + 0.05 * place
    for _ in range(TIMES):
        while True:
            try:
                one_move(motor, way, duration_s)
                break
            except MotorBusyError:
                motor.runtime.wait_until(lambda: False, 0.002)
        log.append((motor.logical.run.since_ns, motor.runtime.now_ns(), motor.name, duration_s))


def check_log(log):
    """Check that each user moved as often as wanted, in turn, for the requested durations."""
    assert sorted(user for *_, user, _ in log) == sorted(USERS * TIMES)
    log.sort()
    for since_ns, waited_ns, user, duration_s in log:
        assert waited_ns - since_ns >= round(duration_s * 1e9), user
    for (before_ns, _, _, duration_s), (since_ns, *_) in pairwise(log):
        assert since_ns >= before_ns + round(duration_s * 1e9)


def test_single_threaded_code_works_in_many_parties(kind):
    log = []
    with opened(kind, Path("shared.toml"), USERS) as rig:
        motors = [rig.motors[name] for name in USERS]
        assert len({id(motor.hardware) for motor in motors}) == 1
        parties = [
            rig.runtime.spawn(motor.name, partial(use, motor, place, log))
            for place, motor in enumerate(motors)
        ]
        for party in parties:
            party.join()
            assert party.error is None
        goal = TIMES * sum(0.01 * (place + 1) for place in range(len(USERS)))
        assert abs(true_position(rig, USERS[0]) - goal) <= kind.window
    check_log(log)


def test_low_level_access_excludes_all_others(kind):
    with opened(kind, Path("shared.toml"), USERS[:2]) as rig:
        holder, other = (rig.motors[name] for name in USERS[:2])
        other.set_control_mode(SETPOINT)
        other.set_setpoint(0.1)
        with holder.low_level() as hardware:
            assert type(hardware) is type(holder.hardware)
            for operation in (other.start, other.stop, other.enable, other.home):
                with pytest.raises(MotorBusyError, match=r"low_level\(\) of ann"):
                    operation()
        other.start()
        other.wait_until_done(5)
        assert abs(true_position(rig, USERS[1]) - 0.1) <= kind.window


def stopped_for_others(rig):
    """Return a motor that Ann owns and moves at full speed, and that Ben has just stopped."""
    ann, ben, cem = (rig.motors[name] for name in USERS[:3])
    ann.set_control_mode(TRAJECTORY)
    ann.set_trajectory(TrapezoidalTrajectory(2.0))
    ann.start()
    rig.runtime.run_for(0.6)
    ben.stop()
    rig.runtime.run_for(0.01)
    assert abs(cem.velocity()) > 0.5
    return ben, cem


def speed_of(rig, motor):
    """Return the speed from its positions [rad/s]."""
    before = true_position(rig, motor.name)
    rig.runtime.run_for(0.05)
    return abs(true_position(rig, motor.name) - before) / 0.05


@pytest.mark.parametrize("timeout_s", [None, 5.0])
def test_motor_stopped_by_another_is_taken_over_at_rest(kind, timeout_s):
    with (
        opened(kind, Path("shared.toml"), USERS[:3]) as rig,
        rig.motors[USERS[0]].reserve("survey") as survey,
    ):
        ben, cem = stopped_for_others(rig)
        with cem.reserve("rescue", take_over=True, timeout_s=timeout_s):
            assert not survey.is_held
            assert speed_of(rig, cem) < 0.02
            with pytest.raises(MotionInterrupted, match="cem, which took the motor over"):
                ben.wait_until_done(5)
            one_move(cem, 0.1, 0.5)
        assert not cem.logical.physical.ownership.is_orphan


def test_rest_after_takeover_is_awaited_within_the_timeout(kind):
    with opened(kind, Path("shared.toml"), USERS[:3]) as rig, rig.motors[USERS[0]].reserve():
        ben, cem = stopped_for_others(rig)
        begun_ns = rig.runtime.now_ns()
        with (
            pytest.raises(DeadlineExceeded, match="rest of cem"),
            cem.reserve("rescue", take_over=True, timeout_s=0.05),
        ):
            pass
        assert rig.runtime.now_ns() - begun_ns < 200_000_000  # and the last request is answered
        with ben.reserve("rescue"):
            assert speed_of(rig, ben) < 0.02


@pytest.mark.wall
def test_single_threaded_code_works_in_many_threads():
    runtime = WallRuntime()
    hardware = IdealHwMotor(runtime, "shared")
    model = MotorModel(name="m", velocity_max=VELOCITY_MAX, acceleration_max=ACCELERATION_MAX)
    log, errors, seen = [], [], []

    def run(place, name):
        try:
            use(IdealMotor(hardware, model, name=name), place, log)
        except BaseException as error:
            errors.append(error)

    threads = [Thread(target=run, args=pair) for pair in enumerate(USERS)]
    for thread in threads:
        thread.start()
    onlooker = IdealMotor(hardware, model, name="onlooker")
    while any(thread.is_alive() for thread in threads):
        seen.append(onlooker.position())  # reading disturbs no other user
        runtime.wait_until(lambda: False, 0.005)
    runtime.close()
    assert errors == []
    check_log(log)
    assert onlooker.position() == pytest.approx(TIMES * 0.1, abs=1e-12)  # 12 sums of floats
    assert seen == sorted(seen)  # only forward, and never torn


@pytest.mark.wall
def test_ideal_motors_on_the_wall_clock_begin_simultaneously():
    runtime = WallRuntime()
    model = MotorModel(name="m", velocity_max=VELOCITY_MAX, acceleration_max=ACCELERATION_MAX)
    hardware = [IdealHwMotor(runtime, f"axis {n}") for n in range(8)]
    group = MotorGroup(*(IdealMotor(one, model, name=one.label) for one in hardware))
    group.for_each(Motor.set_control_mode, TRAJECTORY)
    group.set_trajectory(*(TrapezoidalTrajectory(0.01 * (n + 1)) for n in range(8)))
    group.start()
    group.wait_until_done(10.0)
    quality = group.sync_quality()
    runtime.close()
    assert (quality.start_skew_s, quality.end_skew_s) == (0.0, 0.0)
