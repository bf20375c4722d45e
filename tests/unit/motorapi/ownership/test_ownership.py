"""Logical motors of one process that wait for each other, in virtual time."""

from types import SimpleNamespace

import pytest

from motorhil.motorapi import (
    ControlMode,
    ControlVariable,
    MotionInterrupted,
    Motor,
    MotorBusyError,
    MotorGroup,
    StateError,
    TrapezoidalTrajectory,
    UsageError,
    WallRuntime,
)
from motorhil.motorapi.locking.directory import LockDirectory
from motorhil.motorapi.locking.process_lock import ProcessLock
from motorhil.motorapi.ownership.physical_motor import (
    ActiveMotion,
    RunStatus,
    register_physical_motor,
)
from tests.support.motors.plain import PlainBus, PlainHwMotor, PlainMotor

MS = 1_000_000


def follow(motor, way):
    motor.set_control_mode(ControlMode.TRAJECTORY)
    motor.set_trajectory(TrapezoidalTrajectory(way))


@pytest.fixture
def logical(hw):
    """Return logical motors of one physical motor, each with a distance of 0.1 rad."""
    motors = [PlainMotor(hw, name=name) for name in "abcd"]
    for motor in motors:
        follow(motor, 0.1)
    return motors


def spawn_moves(runtime, motors, order, timeout_s=60.0):
    """Spawn one party per move, in this order of requests."""

    def move(motor):
        motor.start(timeout_s)
        order.append((motor.name, runtime.now_ns()))
        motor.wait_until_done()

    return [runtime.spawn(motor.name, lambda motor=motor: move(motor)) for motor in motors]


def join(parties):
    for party in parties:
        assert party.join(timeout_s=100)
        if party.error is not None:
            raise party.error


def test_waiter_starts_at_the_end_of_the_motion_before_it(runtime, logical):
    a, b, *_ = logical
    a.start()
    a_takes_s = a.progress().expected_s
    b.start(timeout_s=10)
    assert 0 <= runtime.now_ns() - a_takes_s * 1e9 <= 2 * MS  # the motor is polled every ms
    assert a.is_done()
    b.wait_until_done()
    assert b.position() == pytest.approx(0.2)  # a sum of two 0.1


def test_waiter_at_its_timeout_is_refused_with_the_holder(runtime, logical):
    a, b, *_ = logical
    a.set_control_mode(ControlMode.SETPOINT, ControlVariable.VELOCITY)
    a.set_setpoint(1.0)
    a.start()
    for timeout_s in (0.0, 0.5):
        begun_ns = runtime.now_ns()
        with pytest.raises(MotorBusyError, match=r"b is held by start\(\) of a"):
            b.start(timeout_s=timeout_s)
        assert runtime.now_ns() - begun_ns == round(timeout_s * 1e9)
    a.stop()
    b.start(timeout_s=0.0)  # no traces of the waiters that gave up


def test_waiters_start_in_the_order_of_requests(runtime, logical):
    order = []
    join(spawn_moves(runtime, logical, order))
    assert [name for name, _ in order] == ["a", "b", "c", "d"]
    times = [time_ns for _, time_ns in order]
    assert times == sorted(set(times))


def test_request_without_timeout_does_not_overtake_waiters(runtime, logical):
    a, b, c, _ = logical
    with a.reserve():
        parties = spawn_moves(runtime, [b], [])
        runtime.run_for(0.01)
    with pytest.raises(MotorBusyError, match=r"c is held by start\(\) of b, which waits for it,"):
        c.start()  # free, but b came before
    join(parties)
    c.start()


def test_reservation_holds_over_several_motions(runtime, logical, hw):
    a, b, *_ = logical
    with a.reserve("survey"):
        runtime.run_for(1.0)
        for _ in range(2):
            with pytest.raises(MotorBusyError) as caught:
                b.start()
            told = caught.value
            assert (told.motor, told.holder, told.purpose) == ("b", "reserve() of a", "survey")
            assert told.since_ns == 0
            a.start()
            a.wait_until_done()
        for refused in (b.enable, b.disable, b.home, b.reset_fault):
            with pytest.raises(MotorBusyError, match="survey"):
                refused()
        assert b.position() == a.position()  # reading is free
    b.start()
    b.wait_until_done()
    assert hw.physical.token == 2


def test_reserved_motor_may_be_stopped_by_anyone(logical):
    a, b, *_ = logical
    with a.reserve():
        a.start()
        b.stop()
        with pytest.raises(MotionInterrupted, match=r"stop\(\) of b"):
            a.wait_until_done()
        with pytest.raises(MotorBusyError):
            b.start()


def test_motion_active_after_its_reservation_holds_the_motor(logical):
    a, b, *_ = logical
    with a.reserve():
        a.start()
    with pytest.raises(MotorBusyError, match=r"start\(\) of a"):
        b.start()
    a.wait_until_done()
    b.start()


def test_reservation_ends_with_its_block_in_any_case(logical):
    a, b, *_ = logical
    with pytest.raises(RuntimeError), a.reserve():
        raise RuntimeError
    b.start()


def test_reservations_of_one_motor_may_be_nested(logical):
    a, b, *_ = logical
    with a.reserve("outer"):
        with a.reserve("inner"):
            pass
        with pytest.raises(MotorBusyError, match="outer"):
            b.start()
    b.start()


def test_reservation_waits_for_the_motion_of_another(runtime, logical):
    a, b, *_ = logical
    a.start()
    with pytest.raises(MotorBusyError, match=r"start\(\) of a"), b.reserve():
        pass
    with b.reserve(timeout_s=10):
        assert a.is_done()
        b.start()


def test_owner_continues_while_another_waits(runtime, logical):
    a, b, *_ = logical
    with a.reserve():
        order = []
        parties = spawn_moves(runtime, [b], order)
        for _ in range(3):
            a.start()
            a.wait_until_done()
        a.disable()
        assert order == []
        asked_ns = runtime.now_ns()
    join(parties)
    assert order[0][1] - asked_ns <= 2 * MS


def test_own_motion_is_not_awaited(runtime, logical):
    a, *_ = logical
    a.start()
    with pytest.raises(StateError):
        a.start(timeout_s=10)
    assert runtime.now_ns() == 0


def test_low_level_access_and_reservation_exclude_each_other(runtime, logical):
    a, b, *_ = logical
    with a.reserve("survey"):
        with pytest.raises(MotorBusyError, match="survey"), b.low_level():
            pass
        with pytest.raises(MotorBusyError, match="survey"), b.low_level(timeout_s=0.5):
            pass
        assert runtime.now_ns() == 500 * MS


@pytest.mark.parametrize("timeout_s", [-1.0, float("nan"), "soon"])
def test_invalid_timeout_raises(logical, timeout_s):
    a, *_ = logical
    with pytest.raises(UsageError, match="timeout_s"):
        a.start(timeout_s)
    with pytest.raises(UsageError, match="timeout_s"), a.reserve(timeout_s=timeout_s):
        pass
    with pytest.raises(UsageError, match="describe it in words"), a.reserve(1):
        pass
    a.start()


def test_groups_in_opposite_orders_all_get_their_turn(runtime):
    bus = PlainBus()
    hardware = [PlainHwMotor(runtime, node, bus, acts_s=0.001) for node in (1, 2, 3)]

    def drive(name, order):
        group = MotorGroup(*(PlainMotor(hardware[k], name=f"{name}{k}") for k in order))
        group.for_each(Motor.set_control_mode, ControlMode.TRAJECTORY)
        group.set_trajectory(*[TrapezoidalTrajectory(0.01)] * 3)
        for _ in range(20):
            group.start(timeout_s=10)
            group.wait_until_done(timeout_s=5)

    join(
        [
            runtime.spawn("up", lambda: drive("up", (0, 1, 2))),
            runtime.spawn("down", lambda: drive("down", (2, 1, 0))),
        ]
    )
    assert [hw.position() for hw in hardware] == pytest.approx([0.4] * 3)  # sums of 0.01


def test_group_reserves_all_its_motors_or_none(runtime):
    bus = PlainBus()
    hardware = [PlainHwMotor(runtime, node, bus) for node in (1, 2)]
    group = MotorGroup(*(PlainMotor(one, name=f"g{one.node}") for one in hardware))
    group.for_each(Motor.set_control_mode, ControlMode.TRAJECTORY)
    group.set_trajectory(*[TrapezoidalTrajectory(0.01)] * 2)
    first, second = (PlainMotor(one, name=f"m{one.node}") for one in hardware)
    with group.reserve("survey"):
        for motor in (first, second):
            with pytest.raises(MotorBusyError, match=r"reserve\(\) of g\d for survey"):
                motor.enable()
        for _ in range(2):
            group.start()
            group.wait_until_done()
    with second.reserve("lunch"):
        for timeout_s in (None, 0.1):
            with pytest.raises(MotorBusyError, match="lunch"), group.reserve(timeout_s=timeout_s):
                pass
        first.enable()
    assert runtime.now_ns() >= 100 * MS
    second.enable()


def test_group_without_one_motor_holds_none(runtime):
    bus = PlainBus()
    hardware = [PlainHwMotor(runtime, node, bus) for node in (1, 2)]
    group = MotorGroup(*(PlainMotor(one, name=f"g{one.node}") for one in hardware))
    group.for_each(Motor.set_control_mode, ControlMode.TRAJECTORY)
    group.set_trajectory(*[TrapezoidalTrajectory(0.01)] * 2)
    second = PlainMotor(hardware[1], name="second")
    first = PlainMotor(hardware[0], name="first")
    with second.reserve("survey"):
        with pytest.raises(MotorBusyError, match="survey"):
            group.start(timeout_s=0.1)
        follow(first, 0.1)
        first.start()
    assert hardware[1].position() == 0.0


def test_token_grows_when_another_process_had_the_motor(tmp_path):
    directory = LockDirectory(tmp_path)
    stranger = ProcessLock("m1", "motor 1", directory)  # as in another process
    hardware = object.__new__(type("Hardware", (), {}))
    lock = ProcessLock("m1", "motor 1", directory)
    runtime = WallRuntime()
    physical = register_physical_motor(runtime, "m1", "motor 1", hardware, lock)
    owner = SimpleNamespace(name="a", runtime=runtime)
    tokens = []

    def operate():
        with physical.ownership.owned(owner, "enable() of a"):
            physical.take(owner, "a", RunStatus.DONE)
            tokens.append(physical.token)

    try:
        operate()
        operate()
        refused = pytest.raises(MotorBusyError, match=r"a is held by pid \d+ .* for x since")
        with stranger.acquire(runtime, "x"), refused:
            operate()
        operate()
        operate()
    finally:
        runtime.close()
    assert tokens == [1, 1, 2, 2]


def test_first_interruption_counts_and_none_after_the_end(motor):
    run = ActiveMotion("move", motor, 0, None)
    run.interrupt("stop() of a", 1)
    run.interrupt("disable() of b", 2)
    assert (run.interrupted_by, run.interrupted_at_ns) == ("stop() of a", 1)
    run = ActiveMotion("move", motor, 0, None)
    run.finished = True
    run.interrupt("stop() of a", 1)
    assert run.interrupted_by is None
