"""Leases: an expired lease permits a takeover, use of the motor renews it."""

import pytest

from motorhil.motorapi import (
    MotorBusyError,
    MotorGroup,
    TrapezoidalTrajectory,
    UsageError,
)
from tests.support.motors.takeover_owners import LONG_S, elsewhere, follow, rove


def test_waiter_takes_the_motor_when_an_idle_lease_expires(world, logical):
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


def test_request_after_lease_expiry_does_not_wait(world, logical):
    a, b, *_ = logical
    with a.reserve("survey", lease_s=world.lease_s):
        world.pass_s(world.lease_s * 1.01)
        with b.reserve():
            pass
        with b.reserve():
            pass


def test_motor_without_a_lease_is_taken_on_demand_only(world, logical):
    a, b, *_ = logical
    follow(b)
    with a.reserve("survey") as first:
        world.pass_s(world.lease_s)
        with pytest.raises(MotorBusyError, match="survey"):
            b.start(timeout_s=world.lease_s)
        assert first.is_held


def test_lease_is_renewed_by_operations_waits_and_renew(world, logical):
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


def test_wait_for_a_motion_longer_than_the_lease_keeps_it(world, logical):
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


def test_wait_in_another_thread_renews_the_lease(world, logical):
    a, b, *_ = logical
    follow(a)
    a.set_trajectory(TrapezoidalTrajectory(0.01, duration_s=2 * world.lease_s))
    with a.reserve("survey", lease_s=world.lease_s) as first:
        a.start()
        elsewhere(world, lambda: a.wait_until_done(LONG_S))
        with pytest.raises(MotorBusyError, match="survey"):
            b.enable()
        assert first.is_held


def test_nested_lease_is_that_of_the_inner_block(world, logical):
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


def test_motion_active_after_the_block_has_no_lease(world, logical):
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
def test_invalid_lease_raises(world, logical, lease_s):
    a, *_ = logical
    with pytest.raises(UsageError, match="lease_s"), a.reserve(lease_s=lease_s):
        pass
    a.enable()


def test_group_wait_for_one_motor_renews_the_others(world):
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
    world.runtime.wait_until(lambda: b2.ownership.is_here, LONG_S)
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


def test_wait_for_one_motor_renews_the_lease_of_another(world):
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
