"""Low-level access to a drive: full function, exclusive to one thread.

Source: the paper, Requirement 2.
"""

import pytest

from motorhil.harness.rig.rig import Rig
from motorhil.motorapi.adaptations.cia402.hardware import Cia402HwMotor
from motorhil.motorapi.adaptations.cia402.motor import Cia402Motor
from motorhil.motorapi.commands import ControlMode
from motorhil.motorapi.errors import DeadlineExceeded, MotorBusyError, MotorError, UsageError
from motorhil.motorapi.group import MotorGroup
from motorhil.motorapi.motor import Motor
from motorhil.motorapi.state import MotorState
from tests.support.motors.low_level import go_to, sent_on

# --- functions of the holder ------------------------------------------------------------------


def test_hardware_offers_all_objects_and_frames(rig: Rig, motor: Cia402Motor):
    with motor.low_level() as hardware:
        assert hardware is motor.hardware
        assert hardware.read("device_type") & 0xFFFF == 402
        hardware.write(0x6065, 4321)
        assert hardware.read(0x6065) == 4321
        # CiA 301, SDO upload of 6065h: 40h, index, sub-index; answered 43h with 4 bytes
        with hardware.listen(0x581) as inbox:
            sent = hardware.send_frame(0x601, bytes.fromhex("4065600000000000"))
            answer = inbox.receive(timeout_s=0.1)
        assert answer.data == bytes.fromhex("43656000") + (4321).to_bytes(4, "little")
        assert sent.time_ns is not None
        assert answer.time_ns > sent.time_ns
        hardware.enable()
        assert motor.state() is MotorState.ENABLED


def test_invalid_frames_are_refused(motor: Cia402Motor):
    with motor.low_level() as hardware:
        for can_id, data in ((0x800, b""), (-1, b""), ("601", b""), (0x601, bytes(9))):
            with pytest.raises(UsageError):
                hardware.send_frame(can_id, data)
        assert hardware.send_frame(0x1ABCDEF, b"\1", extended=True).frame[:4] == bytes.fromhex(
            "efcdab81"
        )
        with hardware.listen(0x123) as inbox, pytest.raises(DeadlineExceeded, match="123h"):
            inbox.receive(timeout_s=0.01)


def test_entering_and_leaving_access_sends_nothing(rig: Rig, fresh: Cia402Motor):
    sent = sent_on(rig)
    with fresh.low_level():
        rig.runtime.run_for(0.5)
    rig.runtime.run_for(0.5)
    assert sent == []


# --- refusals for others ----------------------------------------------------------------------

REFUSED = (
    Motor.start,
    Motor.enable,
    Motor.disable,
    Motor.home,
    Motor.reset_fault,
    Motor.stop,
    Motor.quick_stop,
    Motor.halt,
    Motor.torque,
    Motor.following_error,
    Motor.is_referenced,
)


def test_sending_operations_of_others_are_refused_by_holder(
    rig: Rig, motor: Cia402Motor, other: Cia402Motor
):
    go_to(motor, 0.2)
    motor.wait_until_done(timeout_s=5)
    assert other.position() == motor.position()  # both know the drive's units now
    rig.runtime.run_for(0.2)
    sent = sent_on(rig)
    begun_ns = rig.runtime.now_ns()
    with motor.low_level():
        for one in (motor, other):
            one.set_control_mode(ControlMode.SETPOINT)
            one.set_setpoint(0.5)  # setting is local
            for refused in REFUSED:
                with pytest.raises(MotorBusyError) as caught:
                    refused(one)
                error = caught.value
                assert error.holder == f"low_level() of {motor.name}"
                assert error.purpose == "low-level access"
                assert error.since_ns == begun_ns
            group = MotorGroup(one)
            for call in (group.start, group.stop, group.sync_capability):
                with pytest.raises(MotorBusyError):
                    call()
            # the last received values are available
            assert one.state() is MotorState.ENABLED
            assert one.fault() is None
            assert one.position() == pytest.approx(0.2, abs=2e-3)  # the drive's position window
            one.wait_until_done(timeout_s=0)  # nothing is active
            assert one.is_done()
            assert one.latest() is not None
        rig.runtime.run_for(0.2)
    assert sent == []
    other.stop()
    other.wait_until_done(timeout_s=1)
    go_to(motor, 0.3)
    motor.wait_until_done(timeout_s=5)


def test_refused_stop_names_the_alternatives(motor: Cia402Motor, other: Cia402Motor):
    with motor.low_level(), pytest.raises(MotorBusyError) as caught:
        other.stop()
    assert "the drive's own dead-man" in caught.value.__notes__[0]


def test_stop_from_a_callback_of_the_holder_is_refused(
    rig: Rig, motor: Cia402Motor, other: Cia402Motor
):
    refused: list[MotorError] = []

    def stop() -> None:
        try:
            other.stop()
        except MotorError as error:
            refused.append(error)

    motor.enable()
    with motor.low_level() as hardware:
        timer = rig.runtime.every(0.001, stop)  # runs in any thread that lets time pass
        sent = sent_on(rig)
        for _ in range(5):
            hardware.read("position_actual_value")
        timer.cancel()
    assert len(refused) >= 5
    assert {type(error) for error in refused} == {MotorBusyError}
    assert [can_id for _, can_id, _ in sent] == [0x601] * 5


BY_THE_OBJECT = (
    lambda hw: hw.write(0x6040, 0x0006),
    lambda hw: hw.download(0x6040, 0, b"\x06\0"),
    lambda hw: hw.send_frame(0x201, b"\x06\0"),
    Cia402HwMotor.enable,
    Cia402HwMotor.reset_fault,
    lambda hw: hw.stream_positions(0.01, lambda cycle: None),
)


def test_hardware_object_leaves_a_moving_motor_alone(
    rig: Rig, motor: Cia402Motor, other: Cia402Motor
):
    go_to(motor, 0.5)
    sent = sent_on(rig)
    for act in BY_THE_OBJECT:
        with pytest.raises(MotorBusyError, match=r"held by start\(\) of left .*low_level\(\)"):
            act(other.hardware)
    assert other.hardware.read("modes_of_operation_display") == 1  # reading is free: pp
    # CiA 301, SDO upload of 6061h; the controlword without new set-point ends the handshake
    assert {data for _, _, data in sent} <= {bytes.fromhex("4061600000000000"), b"\x0f\0"}
    motor.wait_until_done(5)
    assert abs(motor.position() - 0.5) < 0.001


def test_hardware_object_leaves_a_reserved_motor_alone(
    rig: Rig, motor: Cia402Motor, other: Cia402Motor
):
    with motor.reserve("survey"):
        for act in BY_THE_OBJECT:
            with pytest.raises(MotorBusyError, match=r"held by reserve\(\) of left for survey"):
                act(other.hardware)
        with motor.low_level() as hardware:
            hardware.write(0x6065, 4321)
        go_to(motor, 0.1)
        motor.wait_until_done(5)
    other.hardware.write(0x6065, 1234)  # a free motor
    assert other.hardware.read(0x6065) == 1234


def test_hardware_object_halts_a_moving_motor(motor: Cia402Motor, other: Cia402Motor):
    go_to(motor, 5.0)
    other.hardware.halt()  # a stop needs no ownership
    motor.runtime.wait_until(lambda: False, 3.0)
    assert motor.velocity() == 0.0


def test_hardware_object_is_refused_to_another_thread(rig: Rig, motor: Cia402Motor):
    motor.enable()
    hardware = motor.hardware
    refused: list[str] = []

    def intrude() -> None:
        for act in (
            lambda: hardware.read("statusword"),
            lambda: hardware.write(0x6065, 1),
            lambda: hardware.send_frame(0x601, bytes(8)),
            hardware.halt,
            hardware.quick_stop,
            lambda: hardware.sdo().__enter__(),
            lambda: hardware.stream_positions(0.01, lambda cycle: None),
        ):
            with pytest.raises(MotorBusyError, match=r"low_level\(\) of left"):
                act()
            refused.append("one")

    sent = sent_on(rig)
    with motor.low_level():
        party = rig.runtime.spawn("intruder", intrude)
        assert party.join(5.0)
    assert party.error is None
    assert len(refused) == 7
    assert sent == []


def test_access_to_a_silent_drive_needs_no_bring_up(rig: Rig, fresh: Cia402Motor):
    other = Cia402Motor(fresh.hardware, fresh.model, name="other")
    sent = sent_on(rig)
    with fresh.low_level():
        for reading in (other.position, other.velocity, other.state, other.fault):
            with pytest.raises(MotorBusyError):
                reading()
    assert sent == []
    assert other.position() == 0.0
