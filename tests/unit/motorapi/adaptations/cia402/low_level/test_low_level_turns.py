"""Begin, order and end of low-level access.

Source: the paper, Requirement 2.
"""

from collections.abc import Callable

import pytest

from motorhil.harness.rig.rig import Rig
from motorhil.motorapi.adaptations.canopen.errors import SdoAborted
from motorhil.motorapi.adaptations.cia402.hardware import Cia402HwMotor
from motorhil.motorapi.adaptations.cia402.motor import Cia402Motor
from motorhil.motorapi.commands import ControlMode, ControlVariable
from motorhil.motorapi.errors import MotorBusyError, MotorError, StateError, UsageError
from motorhil.motorapi.functions import Sine
from motorhil.motorapi.motor import Motor
from motorhil.motorapi.state import MotorState
from motorhil.motorapi.trajectory import ComplexTrajectory, TrapezoidalTrajectory
from tests.support.motors.drive_rigs import drive
from tests.support.motors.low_level import OpenRig, go_to, sent_on


@pytest.fixture
def rig(open_rig: OpenRig) -> Rig:
    return open_rig(drive("left", 1))


@pytest.fixture
def motor(rig: Rig) -> Cia402Motor:
    """Return a motor whose drive is up."""
    motor = rig.motors["left"]
    assert isinstance(motor, Cia402Motor)
    motor.hardware.connect()
    return motor


@pytest.fixture
def fresh(rig: Rig) -> Cia402Motor:
    """Return a motor whose drive is still booting."""
    motor = rig.motors["left"]
    assert isinstance(motor, Cia402Motor)
    return motor


@pytest.fixture
def other(motor: Cia402Motor) -> Cia402Motor:
    return Cia402Motor(motor.hardware, motor.model, name="other")


# --- begin ------------------------------------------------------------------------------------


def test_access_during_own_motion_is_refused(rig: Rig, motor: Cia402Motor):
    go_to(motor, 1.0)
    with pytest.raises(StateError, match=r"start\(\) of left is active"), motor.low_level():
        raise AssertionError("it was given")
    motor.wait_until_done(timeout_s=5)
    with motor.low_level():
        pass


def test_access_during_anothers_motion_names_it(motor: Cia402Motor, other: Cia402Motor):
    go_to(other, 1.0)
    with pytest.raises(MotorBusyError, match=r"start\(\) of other"), motor.low_level():
        raise AssertionError("it was given")
    other.wait_until_done(timeout_s=5)


def test_access_during_a_velocity_is_refused_until_stopped(rig: Rig, motor: Cia402Motor):
    motor.set_control_mode(ControlMode.SETPOINT, ControlVariable.VELOCITY)
    motor.set_setpoint(0.5)
    motor.start()
    motor.wait_until_done(timeout_s=5)
    for timeout_s in (None, 0.5):
        with pytest.raises(StateError), motor.low_level(timeout_s=timeout_s):
            raise AssertionError("it was given")
    assert rig.runtime.now_ns() > 500_000_000
    motor.stop()
    with motor.low_level(timeout_s=5):
        assert motor.velocity is not None


def test_access_waits_for_a_motion_and_its_waiter_gets_the_end(
    rig: Rig, motor: Cia402Motor, other: Cia402Motor
):
    motor.set_control_mode(ControlMode.TRAJECTORY)
    motor.set_trajectory(TrapezoidalTrajectory(1.0))
    motor.start()
    done: list[int] = []
    waiter = rig.runtime.spawn(
        "waiter", lambda: (motor.wait_until_done(), done.append(rig.runtime.now_ns()))
    )
    with other.low_level(timeout_s=5) as hardware:
        entered_ns = rig.runtime.now_ns()
        rig.runtime.wait_until(lambda: bool(done), 0.01)
        assert done == [entered_ns]
        hardware.disable()
        rig.runtime.run_for(0.1)
    assert waiter.join(1.0)
    assert waiter.error is None
    motor.wait_until_done()  # it did end at its target, regardless of the holder's later actions


def test_earlier_fault_is_reported_to_the_waiter(rig: Rig, motor: Cia402Motor):
    go_to(motor, 1.0)
    rig.controllers["left"].stimulate("fault", 0x3210)
    rig.runtime.run_for(0.1)
    with motor.low_level() as hardware:
        hardware.reset_fault()
        hardware.enable()
    with pytest.raises(MotorError, match="3210h"):
        motor.wait_until_done()


def test_access_during_a_stream_is_refused(rig: Rig, motor: Cia402Motor):
    motor.enable()
    stream = motor.hardware.stream_positions(0.01, lambda cycle: 0)
    with pytest.raises(StateError, match="streamed"), motor.low_level():
        raise AssertionError("it was given")
    sent = sent_on(rig)
    rig.runtime.run_for(0.1)
    assert len([one for one in sent if one[1] == 0x301]) >= 9  # it continues
    stream.cancel()
    with motor.low_level():
        pass


def test_access_waits_for_a_bring_up(rig: Rig, fresh: Cia402Motor):
    """A reader brings the drive up; access is granted after that, not in the middle of it."""
    other = Cia402Motor(fresh.hardware, fresh.model, name="other")
    read: list[float] = []
    reader = rig.runtime.spawn("reader", lambda: read.append(other.position()))
    rig.runtime.run_for(0.31)  # the drive has booted, and is being brought up
    assert not read
    with fresh.low_level() as hardware:
        assert len(read) == 1
        assert hardware.facts is not None
        sent = sent_on(rig)
        rig.runtime.run_for(0.1)
        assert sent == []
    assert reader.join(1.0)
    assert reader.error is None


def test_access_waits_until_earlier_frames_are_sent(rig: Rig, motor: Cia402Motor):
    motor.enable()
    rig.runtime.run_for(0.1)
    sent = sent_on(rig)
    motor.hardware.control.send_holding_word()  # waits for the bus
    with motor.low_level():
        entered_ns = rig.runtime.now_ns()
        rig.runtime.run_for(0.1)
    assert [can_id for _, can_id, _ in sent] == [0x201]
    assert sent[0][0] <= entered_ns


# --- order ------------------------------------------------------------------------------------


def test_access_is_granted_first_come_first_served(rig: Rig, motor: Cia402Motor):
    order: list[str] = []

    def take(one: Motor, wait_s: float) -> Callable[[], None]:
        def party() -> None:
            rig.runtime.run_for(wait_s)
            with one.low_level(timeout_s=10.0):
                order.append(one.name)
                rig.runtime.run_for(0.5)

        return party

    motors = [Cia402Motor(motor.hardware, motor.model, name=f"m{k}") for k in range(4)]
    parties = [
        rig.runtime.spawn(one.name, take(one, wait_s))
        for one, wait_s in zip(motors, (0.3, 0.1, 0.2, 0.0), strict=True)
    ]
    assert all(party.join(10.0) for party in parties)
    assert [party.error for party in parties] == [None] * 4
    assert order == ["m3", "m1", "m2", "m0"]


def test_access_timeout_names_the_holder(rig: Rig, motor: Cia402Motor, other: Cia402Motor):
    def hold() -> None:
        with motor.low_level():
            rig.runtime.run_for(1.0)

    begun_at_ns = rig.runtime.now_ns()
    party = rig.runtime.spawn("holder", hold)
    rig.runtime.run_for(0.1)
    for timeout_s, waited_ns in ((None, 0), (0.0, 0), (0.25, 250_000_000)):
        begun_ns = rig.runtime.now_ns()
        with (
            pytest.raises(MotorBusyError, match=r"low_level\(\) of left"),
            other.low_level(timeout_s=timeout_s),
        ):
            raise AssertionError("it was given")
        assert rig.runtime.now_ns() == begun_ns + waited_ns
    with other.low_level(timeout_s=5.0):
        assert rig.runtime.now_ns() == begun_at_ns + 1_000_000_000
    assert party.join(1.0)


def test_operation_behind_a_waiter_is_refused_during_access(
    rig: Rig, motor: Cia402Motor, other: Cia402Motor
):
    told: list[tuple[int, str]] = []

    def enable() -> None:
        try:
            other.enable()
        except MotorBusyError as error:
            told.append((rig.runtime.now_ns(), error.holder))

    go_to(motor, 0.5)

    def access() -> None:
        with motor.low_level(timeout_s=5.0):
            rig.runtime.run_for(1.0)

    first = rig.runtime.spawn("first", access)
    rig.runtime.run_for(0.01)
    second = rig.runtime.spawn("second", enable)
    assert first.join(10.0)
    assert second.join(10.0)
    assert len(told) == 1
    assert told[0][1] == "low_level() of left"


@pytest.mark.parametrize("timeout_s", [-1.0, "soon", float("nan")])
def test_invalid_access_timeout_is_refused(motor: Cia402Motor, timeout_s: float):
    with pytest.raises(UsageError, match="timeout_s"), motor.low_level(timeout_s=timeout_s):
        pass


# --- re-entry and end -------------------------------------------------------------------------


def test_nested_access_changes_nothing(motor: Cia402Motor, other: Cia402Motor):
    with motor.low_level() as outer:
        with motor.low_level() as inner:
            assert inner is outer
        with pytest.raises(MotorBusyError):
            motor.enable()  # the inner block has not ended it
        with pytest.raises(MotorBusyError), other.low_level(timeout_s=1.0):
            pass  # it would wait for itself
        outer.read("statusword")
    motor.enable()


def test_access_ends_with_any_exit_of_the_block(motor: Cia402Motor, other: Cia402Motor):
    with pytest.raises(ZeroDivisionError), motor.low_level():
        raise ZeroDivisionError
    other.stop()
    with pytest.raises(SdoAborted), motor.low_level() as hardware:
        hardware.upload(0x5FFF)
    other.enable()


def test_holders_writes_do_not_outlive_the_block(rig: Rig, motor: Cia402Motor):
    go_to(motor, 0.3)
    motor.wait_until_done(timeout_s=5)
    with motor.low_level() as hardware:
        hardware.write("profile_velocity", 1)  # so slow that it would never arrive
        hardware.write("modes_of_operation", 3)
        hardware.write(0x1400, b"\x01\x02\x00\x80", subindex=1)  # RPDO 1, the controlword: off
        hardware.write(0x1800, 0, subindex=5)  # TPDO 1 no longer repeats the status
    sent = sent_on(rig)
    go_to(motor, 0.6)
    motor.wait_until_done(timeout_s=5)
    assert motor.position() == pytest.approx(0.6, abs=2e-3)  # the drive's position window
    written = {
        int.from_bytes(data[1:3], "little")
        for _, can_id, data in sent
        if can_id == 0x601 and data[0] >> 5 == 1
    }
    assert {0x6060, 0x6081, 0x6083, 0x6084, 0x607A, 0x1400, 0x1800} <= written


def test_second_start_without_access_writes_only_changes(rig: Rig, motor: Cia402Motor):
    """Shows that the test above is not empty."""
    go_to(motor, 0.3)
    motor.wait_until_done(timeout_s=5)
    sent = sent_on(rig)
    go_to(motor, 0.6)
    motor.wait_until_done(timeout_s=5)
    written = {
        int.from_bytes(data[1:3], "little")
        for _, can_id, data in sent
        if can_id == 0x601 and data[0] >> 5 == 1
    }
    assert written == {0x6040, 0x607A}


def test_state_after_the_block_is_the_drives(motor: Cia402Motor):
    motor.enable()
    with motor.low_level():
        pass
    assert motor.state() is MotorState.ENABLED  # heard all the time, but not brought up yet
    assert isinstance(motor.hardware, Cia402HwMotor)


@pytest.mark.parametrize("stopped", [True, False])
def test_access_waits_for_the_last_frame_of_a_stream(rig: Rig, motor: Cia402Motor, stopped: bool):
    motor.set_control_mode(ControlMode.TRAJECTORY)
    motor.set_trajectory(ComplexTrajectory(Sine(0.1, 0.5).restricted(0.0, 2.0), relative=True))
    motor.start()
    sent = sent_on(rig)
    rig.runtime.run_for(0.3)
    if stopped:
        motor.stop()
    with motor.low_level(timeout_s=5):
        entered_ns = rig.runtime.now_ns()
        rig.runtime.run_for(0.5)
    assert {can_id for _, can_id, _ in sent} >= {0x301}
    assert max(time_ns for time_ns, _, _ in sent) <= entered_ns
