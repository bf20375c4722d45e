"""Takeover on demand from a living owner."""

import pytest

from motorhil.motorapi import (
    DeadlineExceeded,
    LockAction,
    MotionInterrupted,
    MotorBusyError,
    MotorGroup,
    StateError,
    TrapezoidalTrajectory,
    UsageError,
    WallRuntime,
)
from motorhil.motorapi.locking import witness
from motorhil.motorapi.locking.directory import LockDirectory
from motorhil.motorapi.locking.process_lock import ProcessLock
from tests.support.motors.plain import PlainBus, PlainHwMotor, PlainMotor
from tests.support.motors.takeover_owners import LONG_S, actions, follow, heard, rove


def test_takeover_on_demand_refuses_the_loser_by_name(world, logical):
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
            a.start()  # also when it is free again, until the loser acquires it
    a.enable()
    a.start()
    a.stop()


@pytest.mark.parametrize("is_released", [False, True])
def test_owner_in_a_removed_lock_file_is_told_of_the_next(tmp_path, is_released, monkeypatch):
    monkeypatch.setattr(witness, "PLACE", "/nonexistent")  # or the next one would be refused
    runtime, directory = WallRuntime(), LockDirectory(tmp_path)

    def motor(name):
        lock = ProcessLock("m1", "motor 1", directory)
        return PlainMotor(PlainHwMotor(runtime, 1, PlainBus(f"of {name}"), lock=lock), name=name)

    a, b = motor("a"), motor("b")
    try:
        follow(a)
        a.set_trajectory(TrapezoidalTrajectory(0.01, duration_s=2 * LONG_S))
        with a.reserve("survey") as reservation:
            a.start()
            (tmp_path / "m1").unlink()
            with pytest.raises(DeadlineExceeded):
                a.wait_until_done(0.2)  # no other process has it
            with b.reserve("rescue"):
                if is_released:
                    b.enable()
                else:
                    with pytest.raises(MotionInterrupted, match=r"rescue.*its lock file had been"):
                        a.wait_until_done(LONG_S)
            with pytest.raises(MotionInterrupted, match="its lock file had been removed"):
                a.wait_until_done(LONG_S)
            assert not reservation.is_held
            with pytest.raises(MotorBusyError, match="its lock file had been removed"):
                a.start()
    finally:
        runtime.close()


def test_takeover_interrupts_the_motion_and_brings_to_rest(world, logical):
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


def test_motion_without_reservation_is_taken_over_on_demand(world, logical):
    a, b, *_ = logical
    rove(a)
    a.start()
    with pytest.raises(MotorBusyError), b.reserve():
        pass
    with b.reserve("rescue", take_over=True), pytest.raises(MotionInterrupted, match="took"):
        a.wait_until_done(LONG_S)
    a.start()  # not reserved before: it may be acquired again
    a.stop()


def test_rest_after_the_loss_does_not_count_as_done(world, logical, monkeypatch):
    monkeypatch.setattr(
        "motorhil.motorapi.ownership.claim.LOOK_PERIOD_S", LONG_S
    )  # no check before
    a, b, *_ = logical
    follow(a, 1.0)
    a.start()
    with b.reserve("rescue", take_over=True):
        a.hw.freeze()  # as a drive stopped by another owner
        with pytest.raises(MotionInterrupted, match="took"):
            a.is_done()


def test_loser_may_reserve_again_inside_its_block(world, logical):
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


def test_two_owners_take_the_motor_from_each_other(world, logical):
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


def test_waiters_keep_their_order_through_a_takeover(world, logical):
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


def test_takeover_notifies_listeners(world, logical):
    a, b, *_ = logical
    told = heard(a)
    if world.kind == "strangers":
        b.ownership.listeners.append(told.append)
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


@pytest.mark.parametrize("take_over", ["no", float("nan"), 1, None])
def test_take_over_accepts_booleans_only(world, logical, take_over):
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


def test_reservation_repr_shows_whether_it_is_held(world, logical):
    a, b, *_ = logical
    with a.reserve() as first:
        assert repr(first) == f"<Reservation of {a.name}: held>"
        with b.reserve("rescue", take_over=True) as second:
            assert repr(first) == f"<Reservation of {a.name}: lost to {first.lost_to}>"
    assert repr(second) == f"<Reservation of {b.name}: given back>"


def test_low_level_access_of_another_thread_is_not_taken(world, logical):
    a, b, *_ = logical
    if world.kind == "strangers":
        return  # that of another process is: the hardware object's commands are fenced
    a._open_low_level = lambda: a.hw
    a._close_low_level = lambda: None
    with a.low_level():
        party = world.runtime.spawn("b", lambda: b.reserve(take_over=True).__enter__())
        assert party.join(LONG_S)
        assert isinstance(party.error, MotorBusyError)
        assert "low-level access" in str(party.error)
    a.enable()


def test_start_in_progress_fails_at_a_takeover_without_stop(world):
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
    with b.reserve("rescue", take_over=True):  # waits for the end of the present operation
        assert party.join(LONG_S)
        assert [type(error) for error in errors] == [MotorBusyError]
        assert errors[0].taken_over == "on demand"
        assert b.velocity() == 0.0
        a.hw.acts_s = 0.0
        follow(b)
        b.start()
        b.wait_until_done(LONG_S)


def test_own_reservation_is_not_taken_over(world, logical):
    a, *_ = logical
    with a.reserve("outer") as outer, a.reserve("inner", take_over=True) as inner:
        assert outer.token == inner.token
        assert outer.is_held
        rove(a)
        a.start()
        with pytest.raises(StateError):
            a.home()
        a.stop()
