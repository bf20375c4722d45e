"""The host on a bus with targeted losses, and with foreign nodes.

Every call ends, at the target or with the right error, and no motor moves without a command.
"""

import pytest

from motorhil.emulators.can.fault_rules import FaultKind, FaultRule
from motorhil.motorapi import ControlMode, ControlVariable, Motor, MotorGroup, TrapezoidalTrajectory
from motorhil.motorapi.errors import (
    DeadlineExceeded,
    DeviceFault,
    LinkError,
    MotionInterrupted,
    MotorError,
)
from motorhil.motorapi.state import MotorState
from tests.support.canopen.two_drives import (
    INC_PER_RAD,
    demand,
    is_at_rest,
    moving,
    stranger,
    two_drives,
)

DROP = FaultKind.DROP


def both(rig) -> MotorGroup:
    group = MotorGroup(rig.motors["left"], rig.motors["right"])
    group.for_each(Motor.set_control_mode, ControlMode.TRAJECTORY)
    group.set_trajectory(TrapezoidalTrajectory(0.3), TrapezoidalTrajectory(-0.2))
    return group


def test_set_point_without_sync_does_not_start_at_next_one():
    lost = FaultRule("lost", DROP, identifier=0x80, ports=("left",), limit=1)
    with two_drives(lost) as rig:
        with pytest.raises(DeadlineExceeded, match="left: set-point acknowledge"):
            both(rig).start()
        rig.runtime.run_for(1.0)
        before = demand(rig, "left"), demand(rig, "right")
        assert before[0] == 0
        assert abs(before[1]) < 0.2 * INC_PER_RAD + 1  # stopped near its start
        stranger(rig)("080#", "080#")
        rig.runtime.run_for(0.5)
        assert (demand(rig, "left"), demand(rig, "right")) == before


def test_sync_after_failed_start_keeps_later_motion():
    lost = FaultRule("lost", DROP, identifier=0x80, ports=("left",), limit=1)
    with two_drives(lost) as rig:
        with pytest.raises(DeadlineExceeded):
            both(rig).start()
        rig.runtime.run_for(0.5)
        left = moving(rig.motors["left"], 0.4)
        stranger(rig)("080#")
        left.wait_until_done(5)
        assert demand(rig) == pytest.approx(0.4 * INC_PER_RAD, abs=1)


@pytest.mark.parametrize("identifier", [0x301, 0x302], ids=["left", "right"])
def test_lost_set_point_fails_start_and_stops_other_motor(identifier):
    with two_drives(FaultRule("lost", DROP, identifier=identifier, limit=1)) as rig:
        with pytest.raises(DeadlineExceeded, match="set-point acknowledge"):
            both(rig).start()
        rig.runtime.run_for(0.5)
        assert is_at_rest(rig, "left", "right")
        both(rig).start()  # and it can be repeated
        both(rig).wait_until_done(5)


@pytest.mark.parametrize("how", ["stop", "halt", "quick_stop"])
@pytest.mark.parametrize("lost", [1, 3])
def test_lost_stop_is_sent_again(how, lost):
    with two_drives() as rig:
        motor = rig.motors["left"]
        motor.set_control_mode(ControlMode.SETPOINT, ControlVariable.VELOCITY)
        motor.set_setpoint(2.0)
        motor.start()
        motor.wait_until_done(5)
        rig.faults.inject("can0", FaultRule("lost", DROP, identifier=0x201, limit=lost))
        getattr(motor, how)()
        rig.runtime.run_for(1.0)  # no call waits for it
        assert is_at_rest(rig, "left")
        motor.wait_until_done(1)


def test_stop_is_not_repeated_after_other_command():
    with two_drives(FaultRule("lost", DROP, identifier=0x201, limit=1)) as rig:
        motor = moving(rig.motors["left"])
        motor.stop()
        motor.disable()
        rig.runtime.run_for(1.0)
        assert motor.state() is MotorState.DISABLED
        assert rig.controllers["left"].snapshot()["state"] == 1  # switch on disabled


# Actions of another master in mid-motion, and the expected error.
OTHER_MASTER = {
    "disable voltage by SDO": ("601#2B40600000000000", MotionInterrupted),
    "disable voltage by RPDO": ("201#0000", MotionInterrupted),
    "shutdown": ("201#0600", MotionInterrupted),
    "switch on": ("201#0700", MotionInterrupted),
    "NMT pre-operational": ("000#8001", LinkError),
    "NMT stop": ("000#0201", LinkError),
    "NMT reset communication": ("000#8201", LinkError),
    "NMT reset node": ("000#8101", LinkError),
}


@pytest.mark.parametrize("what", OTHER_MASTER)
def test_motion_ended_by_other_master_leaves_motor_usable(what):
    text, error = OTHER_MASTER[what]
    with two_drives() as rig:
        motor = moving(rig.motors["left"])
        stranger(rig)(text)
        with pytest.raises(error):
            motor.wait_until_done(5)
        rig.runtime.run_for(0.5)
        begun = demand(rig)
        motor.set_trajectory(TrapezoidalTrajectory(0.25))
        motor.start()  # without a stop(): a motion reported as ended has ended
        motor.wait_until_done(5)
        assert demand(rig) - begun == pytest.approx(0.25 * INC_PER_RAD, abs=40)


@pytest.mark.parametrize(
    "texts",
    [
        ("201#0F01",),  # halt
        ("601#237A600010270000", "201#0F00", "201#3F00"),  # another target
        ("601#2F60600003000000",),  # another mode
    ],
    ids=["halt", "target", "mode"],
)
def test_changes_by_other_master_are_never_success(texts):
    with two_drives() as rig:
        motor = moving(rig.motors["left"])
        stranger(rig)(*texts)
        with pytest.raises(MotorError):
            motor.wait_until_done(3)
        motor.stop()


def test_motion_whose_status_another_master_switches_off_is_followed_by_sdo():
    with two_drives() as rig:
        begun = demand(rig)
        motor = moving(rig.motors["left"])
        stranger(rig)("601#2300180181010080")  # TPDO 1 is not valid from now on
        motor.wait_until_done(3)
        assert demand(rig) - begun == pytest.approx(1.0 * INC_PER_RAD, abs=40)


def test_foreign_traffic_has_no_effect():
    with two_drives() as rig:
        motor = moving(rig.motors["left"])
        say = stranger(rig)
        say("080#", "77F#05", "77F#00", "700#05", "601#R8", "581#4341600008000000", "181#3706")
        say("601#4041600000000000", "681#0000", "7E5#0400000000000000", "100#000000000000")
        motor.wait_until_done(5)
        assert demand(rig) == pytest.approx(INC_PER_RAD, abs=1)
        assert motor.hardware.node.malformed == 1  # the TPDO of two bytes


def test_emcy_storm_keeps_motion_and_fault_code():
    with two_drives() as rig:
        motor = moving(rig.motors["left"])
        port = rig.world.add_host("can0", "storm", lambda *_: None)
        from tests.support.canopen.drive_wire import frame

        storm = rig.runtime.every(0.0005, lambda: port.send(frame("081#2082110000000000")))
        motor.wait_until_done(5)
        assert demand(rig) == pytest.approx(INC_PER_RAD, abs=1)
        rig.controllers["left"].stimulate("fault", 0x2310)
        rig.runtime.run_for(0.05)
        fault = motor.fault()
        assert fault is not None
        assert fault.code == 0x2310  # not 8220h, which a Roboteq repeats for ever
        storm.cancel()


def test_fault_keeps_its_code_when_lesser_error_ends():
    with two_drives() as rig:
        motor = moving(rig.motors["left"])
        rig.controllers["left"].stimulate("fault", 0x2310)
        with pytest.raises(DeviceFault, match="2310h"):
            motor.wait_until_done(5)
        stranger(rig)("081#0000030000000000")  # error reset, but 1001h: one of two remains
        assert motor.hardware.node.error_code == 0x2310


def test_failed_start_keeps_motor_enabled_by_other_program():
    """An overwritten latch must not cause a controlword that was not commanded."""
    with two_drives() as rig:
        group = MotorGroup(rig.motors["left"], rig.motors["right"])
        group.for_each(Motor.set_control_mode, ControlMode.SETPOINT, ControlVariable.VELOCITY)
        group.for_each(Motor.set_setpoint, 0.5)
        group.start()
        group.stop()
        group.wait_until_done(2)
        rig.motors["left"].hardware.control.forget()  # as if this program had just joined
        armed = []

        def on_frame(bus, now_ns, sender, raw):
            if raw[:4] == b"\x01\x04\0\0" and not armed:  # RPDO 3 of the left drive
                armed.append(now_ns)
                rig.world.queue.alarm(
                    lambda _: rig.faults.inject("can0", FaultRule("lost", DROP, identifier=0x602))
                ).set(now_ns + 1)

        rig.world.tap_frames(on_frame)
        with pytest.raises(DeadlineExceeded, match="node 2"):
            group.start()
        assert armed
        rig.runtime.run_for(0.5)
        assert rig.controllers["left"].snapshot()["state"] == 4
        assert is_at_rest(rig, "left", "right")
