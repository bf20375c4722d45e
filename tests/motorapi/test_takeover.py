"""A motor is taken from who lives, by lease or on demand: the same wherever owners live.

- "parties": logical motors of one process, in virtual time, without a lock.
- "threads": logical motors of one process, on the wall's clock, with a lock between processes.
- "strangers": each has a hardware object and a lock of his own, as in processes of their own.
"""

from types import SimpleNamespace

import pytest

from emulators.event_queue import EventQueue
from harness.virtual_time import VirtualRuntime
from motorapi import (
    ControlMode,
    ControlVariable,
    LockAction,
    MotionInterrupted,
    MotorBusyError,
    MotorGroup,
    StateError,
    TrapezoidalTrajectory,
    UsageError,
    WallRuntime,
)
from motorapi.lock_directory import LockDirectory
from motorapi.process_lock import ProcessLock
from tests.motorapi.plain import PlainBus, PlainHwMotor, PlainMotor

LONG_S = 20.0


@pytest.fixture(params=["parties", "threads", "strangers"])
def world(request, tmp_path):
    """Somewhere to live, with logical motors a to d of one physical one."""
    virtual = request.param == "parties"
    runtime = VirtualRuntime(EventQueue()) if virtual else WallRuntime()
    directory = LockDirectory(tmp_path)

    def hardware(bus, node):
        lock = None if virtual else ProcessLock(f"m{node}", f"motor {node}", directory)
        return PlainHwMotor(runtime, node, bus, lock=lock)

    def motors(names, node=1):
        if request.param == "strangers":
            return [PlainMotor(hardware(PlainBus(f"of {n}"), node), name=n) for n in names]
        shared = hardware(PlainBus("bus"), node)
        return [PlainMotor(shared, name=name) for name in names]

    def pass_s(time_s):
        runtime.wait_until(lambda: False, time_s)

    yield SimpleNamespace(
        runtime=runtime,
        motors=motors,
        pass_s=pass_s,
        kind=request.param,
        virtual=virtual,
        lease_s=0.1 if virtual else 0.4,  # far longer than a busy machine delays anybody
    )
    runtime.close()


@pytest.fixture
def logical(world):
    return world.motors("abcd")


def rove(motor):
    """It goes on for ever, once it is started."""
    motor.set_control_mode(ControlMode.SETPOINT, ControlVariable.VELOCITY)
    motor.set_setpoint(0.1)


def follow(motor, way=0.01):
    motor.set_control_mode(ControlMode.TRAJECTORY)
    motor.set_trajectory(TrapezoidalTrajectory(way))


def heard(motor):
    told = []
    motor._physical.ownership.listeners.append(told.append)
    return told


def elsewhere(world, action):
    """It is done, in another thread: whoever waits in this one is alive, and his leases last."""
    party = world.runtime.spawn("elsewhere", action)
    assert party.join(LONG_S)
    if party.error is not None:
        raise party.error


def actions(told, motor):
    return [event.action.name for event in told if motor.name in event.owner.split()]


def test_on_demand_it_is_taken_from_who_lives_and_he_is_refused_by_the_name_of_who_took_it(
    world, logical
):
    a, b, *_ = logical
    rove(a)
    with a.reserve("survey") as first:
        assert (first.is_held, first.lost_to) == (True, None)
        with b.reserve("rescue", take_over=True) as second:
            assert second.token > first.token
            assert second.is_held
            assert not first.is_held
            assert "rescue" in first.lost_to
            assert first.lost_to.endswith("which took it over (on demand)")
            for refused in (a.start, a.enable, a.home, first.renew, lambda: a.start(1.0)):
                with pytest.raises(MotorBusyError, match=r"a was taken over \(on demand\)") as told:
                    refused()
                assert told.value.taken_over == "on demand"
                assert "rescue" in str(told.value)
            follow(b)
            b.start()
            b.wait_until_done(LONG_S)
        with pytest.raises(MotorBusyError, match="taken over"):
            a.start()  # also when it is free again, until he takes it
    a.enable()
    a.start()
    a.stop()


def test_who_waits_has_it_when_the_lease_of_who_does_nothing_is_over(world, logical):
    a, b, *_ = logical
    rove(a)
    follow(b)
    with a.reserve("survey", lease_s=world.lease_s) as first:
        begun_ns = world.runtime.now_ns()
        with pytest.raises(MotorBusyError, match="survey"):
            b.start()
        elsewhere(world, lambda: b.start(timeout_s=LONG_S))
        waited_s = (world.runtime.now_ns() - begun_ns) / 1e9
        assert waited_s >= world.lease_s * 0.9
        if world.virtual:
            assert waited_s == world.lease_s
        assert first.lost_to.endswith(
            f"which took it over (its lease of {world.lease_s} s was over)"
        )
        with pytest.raises(MotorBusyError, match=rf"\(its lease of {world.lease_s} s was over\)"):
            a.start()
        b.wait_until_done(LONG_S)


def test_who_asks_after_the_lease_is_over_need_not_wait(world, logical):
    a, b, *_ = logical
    with a.reserve("survey", lease_s=world.lease_s):
        world.pass_s(world.lease_s * 1.01)
        with b.reserve():
            pass
        with b.reserve():
            pass


def test_without_a_lease_nobody_has_it_but_on_demand(world, logical):
    a, b, *_ = logical
    follow(b)
    with a.reserve("survey") as first:
        world.pass_s(world.lease_s)
        with pytest.raises(MotorBusyError, match="survey"):
            b.start(timeout_s=world.lease_s)
        assert first.is_held


def test_a_lease_goes_on_with_every_operation_every_wait_and_every_renewal(world, logical):
    a, b, *_ = logical
    follow(a, 0.05)
    with a.reserve("survey", lease_s=world.lease_s) as first:
        wait = lambda: a.wait_until_done(LONG_S)  # noqa: E731
        for use in (a.enable, first.renew, a.start, wait, first.renew, a.enable, first.renew):
            world.pass_s(world.lease_s * 0.3)
            with pytest.raises(MotorBusyError, match="survey"):
                b.enable()
            use()
        assert first.is_held
    assert first.lost_to is None


def test_who_waits_for_a_motion_longer_than_his_lease_keeps_it(world, logical):
    a, b, *_ = logical
    follow(a)
    a.set_trajectory(TrapezoidalTrajectory(0.01, duration_s=2.5 * world.lease_s))
    refused = []

    def meddle():
        for _ in range(6):
            world.pass_s(world.lease_s / 3)
            try:
                b.enable()
            except MotorBusyError as error:
                refused.append(error)

    with a.reserve("survey", lease_s=world.lease_s) as first:
        a.start()
        party = world.runtime.spawn("meddles", meddle)
        a.wait_until_done(LONG_S)
        assert first.is_held
        assert party.join(LONG_S)
    assert len(refused) == 6


def test_also_who_waits_for_it_in_another_thread_uses_it(world, logical):
    a, b, *_ = logical
    follow(a)
    a.set_trajectory(TrapezoidalTrajectory(0.01, duration_s=2 * world.lease_s))
    with a.reserve("survey", lease_s=world.lease_s) as first:
        a.start()
        elsewhere(world, lambda: a.wait_until_done(LONG_S))
        with pytest.raises(MotorBusyError, match="survey"):
            b.enable()
        assert first.is_held


def test_what_it_does_for_the_loser_is_interrupted_and_it_is_brought_to_rest(world, logical):
    a, b, *_ = logical
    follow(a)
    a.set_trajectory(TrapezoidalTrajectory(0.01, duration_s=2 * LONG_S))
    endings = []
    with a.reserve("survey"):
        a.start()
        a.on_done(endings.append)
        with b.reserve("rescue", take_over=True):
            with pytest.raises(MotionInterrupted, match="took it over") as told:
                a.wait_until_done(LONG_S)
            assert "rescue" in told.value.by
            if world.kind != "strangers":
                assert ("_stop",) in b.hw.log
                assert b.velocity() == 0.0
            follow(b)
            b.start()
            b.wait_until_done(LONG_S)
    (ending,) = endings
    assert isinstance(ending.error, MotionInterrupted)


def test_a_motion_that_nobody_reserved_is_taken_over_on_demand_as_well(world, logical):
    a, b, *_ = logical
    rove(a)
    a.start()
    with pytest.raises(MotorBusyError), b.reserve():
        pass
    with b.reserve("rescue", take_over=True), pytest.raises(MotionInterrupted, match="took"):
        a.wait_until_done(LONG_S)
    a.start()  # he had not reserved it: he may take it again
    a.stop()


def test_what_has_come_to_rest_after_it_was_lost_is_not_taken_for_done(world, logical, monkeypatch):
    monkeypatch.setattr("motorapi.patience.LOOK_PERIOD_S", LONG_S)  # nobody looks before
    a, b, *_ = logical
    follow(a, 1.0)
    a.start()
    with b.reserve("rescue", take_over=True):
        a.hw.freeze()  # as a drive that was stopped for somebody else
        with pytest.raises(MotionInterrupted, match="took"):
            a.is_done()


def test_the_loser_may_reserve_it_again_inside_of_his_block(world, logical):
    a, b, *_ = logical
    follow(a)
    with a.reserve("survey"):
        with b.reserve("rescue", take_over=True):
            pass
        with pytest.raises(MotorBusyError):
            a.start()
        with a.reserve("again") as again:
            a.start()
            a.wait_until_done(LONG_S)
            assert again.is_held
        with pytest.raises(MotorBusyError):
            a.start()
    a.start()


def test_two_take_it_from_each_other(world, logical):
    a, b, *_ = logical
    with (
        a.reserve("one") as one,
        b.reserve("two", take_over=True) as two,
        a.reserve("three", take_over=True) as three,
    ):
        assert (one.is_held, two.is_held, three.is_held) == (False, False, True)
        assert "three" in two.lost_to
        assert "two" in one.lost_to
        a.enable()
        with pytest.raises(MotorBusyError):
            b.enable()
    b.enable()


def test_those_who_wait_keep_their_order_through_a_takeover(world, logical):
    a, b, c, d = logical
    order = []

    def take(motor):
        with motor.reserve(motor.name, timeout_s=LONG_S):
            order.append(motor.name)

    with a.reserve("first"):
        parties = []
        for motor in (c, d):
            told = heard(motor)
            parties.append(world.runtime.spawn(motor.name, lambda motor=motor: take(motor)))
            assert world.runtime.wait_until(
                lambda told=told, motor=motor: "WAITING" in actions(told, motor), LONG_S
            )
            world.pass_s(0.03)  # it has its place, and waits
        with b.reserve("rescue", take_over=True):
            world.pass_s(0.05)
            assert order == []
    for party in parties:
        assert party.join(LONG_S)
        assert party.error is None
    assert order == ["c", "d"]


def test_listeners_are_told_what_happened(world, logical):
    a, b, *_ = logical
    told = heard(a)
    if world.kind == "strangers":
        b._physical.ownership.listeners.append(told.append)
    with a.reserve("survey") as first:
        with pytest.raises(MotorBusyError), b.reserve("impatient"):
            pass
        with b.reserve("rescue", take_over=True) as second, pytest.raises(MotorBusyError):
            a.enable()
    taken = [event for event in told if event.purpose in ("survey", "rescue", "impatient")]
    assert [(e.action.name, e.purpose, e.token) for e in taken if e.action.name != "LOST"] == [
        ("TAKEN", "survey", first.token),
        ("REFUSED", "impatient", 0),
        ("TAKEN_OVER", "rescue", second.token),
        ("RELEASED", "rescue", second.token),
    ]
    (lost,) = [event for event in taken if event.action is LockAction.LOST]
    assert (lost.owner, lost.token) == ("reserve() of a", first.token)
    assert ("reserve() of b" in lost.holder) == (world.kind != "strangers")


def test_a_lease_inside_of_another_is_that_of_the_inner_block(world, logical):
    a, b, *_ = logical
    with a.reserve("outer"):
        with a.reserve("inner", lease_s=world.lease_s):
            pass
        world.pass_s(world.lease_s * 1.5)
        with pytest.raises(MotorBusyError, match="outer"):
            b.enable()
        with a.reserve("inner", lease_s=world.lease_s) as inner:
            world.pass_s(world.lease_s * 1.5)
            b.enable()
            assert not inner.is_held


def test_a_motion_that_goes_on_after_the_block_has_no_lease(world, logical):
    a, b, *_ = logical
    follow(a)
    a.set_trajectory(TrapezoidalTrajectory(0.01, duration_s=3 * world.lease_s))
    with a.reserve("survey", lease_s=world.lease_s):
        a.start()
    world.pass_s(1.5 * world.lease_s)
    with pytest.raises(MotorBusyError):
        b.enable()
    a.wait_until_done(LONG_S)
    b.enable()


@pytest.mark.parametrize("lease_s", [0.0, 0.0099, -1.0, float("nan"), float("inf"), "soon", True])
def test_a_lease_nobody_could_have_is_refused(world, logical, lease_s):
    a, *_ = logical
    with pytest.raises(UsageError, match="lease_s"), a.reserve(lease_s=lease_s):
        pass
    a.enable()


@pytest.mark.parametrize("take_over", ["no", float("nan"), 1, None])
def test_a_motor_is_taken_over_by_true_and_nothing_else(world, logical, take_over):
    a, b, *_ = logical
    group = MotorGroup(b)
    for who in (b, group):
        with (
            a.reserve(),
            pytest.raises(UsageError, match=r"take_over = .*: give True or False"),
            who.reserve(take_over=take_over),
        ):
            pass
    a.enable()


def test_a_reservation_shows_whether_it_is_held(world, logical):
    a, b, *_ = logical
    with a.reserve() as first:
        assert repr(first) == f"<Reservation of {a.name}: held>"
        with b.reserve("rescue", take_over=True) as second:
            assert repr(first) == f"<Reservation of {a.name}: lost to {first.lost_to}>"
    assert repr(second) == f"<Reservation of {b.name}: given back>"


def test_low_level_access_of_another_thread_is_not_taken_over(world, logical):
    a, b, *_ = logical
    if world.kind == "strangers":
        return  # another process's is: the hardware object's commands are fenced
    a._open_low_level = lambda: a.hw
    a._close_low_level = lambda: None
    with a.low_level():
        party = world.runtime.spawn("b", lambda: b.reserve(take_over=True).__enter__())
        assert party.join(LONG_S)
        assert isinstance(party.error, MotorBusyError)
        assert "low-level access" in str(party.error)
    a.enable()


def test_a_group_that_waits_for_one_motor_keeps_its_lease_of_the_others(world):
    a1, b1 = world.motors(["a1", "b1"], node=1)
    a2, b2 = world.motors(["a2", "b2"], node=2)
    done = []

    def hold():
        with b2.reserve("long"):
            world.pass_s(3 * world.lease_s)
            with pytest.raises(MotorBusyError, match="survey"):
                b1.enable()
            done.append(True)

    party = world.runtime.spawn("b", hold)
    world.runtime.wait_until(lambda: b2._physical.ownership.is_here, LONG_S)
    with MotorGroup(a1, a2).reserve("survey", timeout_s=LONG_S, lease_s=world.lease_s) as both:
        assert both.is_held
        assert both.names == ("a1", "a2")
        assert both.tokens == tuple(one.token for one in both.members)
        assert party.join(LONG_S)
        both.renew()
        with b1.reserve(take_over=True):
            assert not both.is_held
            assert [one.is_held for one in both.members] == [False, True]
            assert "took it over" in both.lost_to
            with pytest.raises(MotorBusyError):
                both.renew()
    assert done == [True]


def test_who_waits_for_one_motor_keeps_the_lease_of_another(world):
    a1, b1 = world.motors(["a1", "b1"], node=1)
    (a2,) = world.motors(["a2"], node=2)
    follow(a2)
    a2.set_trajectory(TrapezoidalTrajectory(0.01, duration_s=2 * world.lease_s))
    errors = []

    def meddle():
        world.pass_s(1.5 * world.lease_s)
        try:
            b1.enable()
        except MotorBusyError as error:
            errors.append(error)

    with a1.reserve("survey", lease_s=world.lease_s) as first:
        party = world.runtime.spawn("b", meddle)
        a2.start()
        a2.wait_until_done(LONG_S)
        assert first.is_held
        assert party.join(LONG_S)
    assert len(errors) == 1


def test_a_start_under_way_fails_when_it_is_taken_over_and_stops_nothing_of_the_takers(world):
    if world.kind == "strangers":
        return
    a, b = world.motors("ab")
    a.hw.acts_s = 0.05
    follow(a, 1.0)
    errors = []

    def drive():
        try:
            with a.reserve("survey"):
                a.start()
        except (MotorBusyError, MotionInterrupted) as error:
            errors.append(error)

    party = world.runtime.spawn("a", drive)
    assert world.runtime.wait_until(lambda: a.hw.log != [], LONG_S)
    with b.reserve("rescue", take_over=True):  # waits for the end of what is under way
        assert party.join(LONG_S)
        assert [type(error) for error in errors] == [MotorBusyError]
        assert errors[0].taken_over == "on demand"
        assert b.velocity() == 0.0
        a.hw.acts_s = 0.0
        follow(b)
        b.start()
        b.wait_until_done(LONG_S)


def test_ones_own_reservation_is_not_taken_over_from_oneself(world, logical):
    a, *_ = logical
    with a.reserve("outer") as outer, a.reserve("inner", take_over=True) as inner:
        assert outer.token == inner.token
        assert outer.is_held
        rove(a)
        a.start()
        with pytest.raises(StateError):
            a.home()
        a.stop()
