"""The host against a bus that loses frames where it hurts, and against strangers on it.

Every call ends, at the target or with the right error; nothing moves that was not told to.
"""

import pytest

from emulators.media.faults import FaultKind, FaultRule
from motorapi import ControlMode, ControlVariable, Motor, MotorGroup, TrapezoidalTrajectory
from motorapi.errors import (
    DeadlineExceeded,
    DeviceFault,
    LinkError,
    MotionInterrupted,
    MotorError,
)
from motorapi.state import MotorState
from tests.crosscheck.rigs import INC_PER_RAD, demand, is_at_rest, moving, stranger, two_drives

DROP = FaultKind.DROP


def both(rig) -> MotorGroup:
    group = MotorGroup(rig.motors["left"], rig.motors["right"])
    group.for_each(Motor.set_control_mode, ControlMode.TRAJECTORY)
    group.set_trajectory(TrapezoidalTrajectory(0.3), TrapezoidalTrajectory(-0.2))
    return group


def test_a_set_point_whose_sync_was_lost_does_not_start_at_the_next_one():
    lost = FaultRule("lost", DROP, identifier=0x80, ports=("left",), limit=1)
    with two_drives(lost) as rig:
        with pytest.raises(DeadlineExceeded, match="left: set-point acknowledge"):
            both(rig).start()
        rig.runtime.run_for(1.0)
        before = demand(rig, "left"), demand(rig, "right")
        assert before[0] == 0
        assert abs(before[1]) < 0.2 * INC_PER_RAD + 1  # stopped, not far on its way
        stranger(rig)("080#", "080#")
        rig.runtime.run_for(0.5)
        assert (demand(rig, "left"), demand(rig, "right")) == before


def test_after_a_start_that_failed_a_sync_does_not_halt_what_was_started_since():
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
def test_a_set_point_that_was_lost_ends_the_start_and_stops_the_other(identifier):
    with two_drives(FaultRule("lost", DROP, identifier=identifier, limit=1)) as rig:
        with pytest.raises(DeadlineExceeded, match="set-point acknowledge"):
            both(rig).start()
        rig.runtime.run_for(0.5)
        assert is_at_rest(rig, "left", "right")
        both(rig).start()  # and it can be done again
        both(rig).wait_until_done(5)


@pytest.mark.parametrize("how", ["stop", "halt", "quick_stop"])
@pytest.mark.parametrize("lost", [1, 3])
def test_a_stop_that_was_lost_is_sent_again(how, lost):
    with two_drives() as rig:
        motor = rig.motors["left"]
        motor.set_control_mode(ControlMode.SETPOINT, ControlVariable.VELOCITY)
        motor.set_setpoint(2.0)
        motor.start()
        motor.wait_until_done(5)
        rig.faults.inject("can0", FaultRule("lost", DROP, identifier=0x201, limit=lost))
        getattr(motor, how)()
        rig.runtime.run_for(1.0)  # nobody waits for it
        assert is_at_rest(rig, "left")
        motor.wait_until_done(1)


def test_a_stop_is_not_repeated_to_a_drive_that_was_told_something_else_since():
    with two_drives(FaultRule("lost", DROP, identifier=0x201, limit=1)) as rig:
        motor = moving(rig.motors["left"])
        motor.stop()
        motor.disable()
        rig.runtime.run_for(1.0)
        assert motor.state() is MotorState.DISABLED
        assert rig.controllers["left"].snapshot()["state"] == 1  # switch on disabled


# What another master may do in mid-motion, and the error it must give
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
def test_what_another_master_ends_is_over_and_the_motor_can_be_used_again(what):
    text, error = OTHER_MASTER[what]
    with two_drives() as rig:
        motor = moving(rig.motors["left"])
        stranger(rig)(text)
        with pytest.raises(error):
            motor.wait_until_done(5)
        rig.runtime.run_for(0.5)
        begun = demand(rig)
        motor.set_trajectory(TrapezoidalTrajectory(0.25))
        motor.start()  # without a stop(): what was reported as ended has ended
        motor.wait_until_done(5)
        assert demand(rig) - begun == pytest.approx(0.25 * INC_PER_RAD, abs=40)


@pytest.mark.parametrize(
    "texts",
    [
        ("201#0F01",),  # halt
        ("601#237A600010270000", "201#0F00", "201#3F00"),  # another target
        ("601#2F60600003000000",),  # another mode
        ("601#2300180181010080",),  # no status any more
    ],
    ids=["halt", "target", "mode", "status"],
)
def test_what_another_master_changes_behind_our_back_never_is_success(texts):
    with two_drives() as rig:
        motor = moving(rig.motors["left"])
        stranger(rig)(*texts)
        with pytest.raises(MotorError):
            motor.wait_until_done(3)
        motor.stop()


def test_strangers_that_only_talk_change_nothing():
    with two_drives() as rig:
        motor = moving(rig.motors["left"])
        say = stranger(rig)
        say("080#", "77F#05", "77F#00", "700#05", "601#R8", "581#4341600008000000", "181#3706")
        say("601#4041600000000000", "681#0000", "7E5#0400000000000000", "100#000000000000")
        motor.wait_until_done(5)
        assert demand(rig) == pytest.approx(INC_PER_RAD, abs=1)
        assert motor.hardware.node.malformed == 1  # the TPDO of two bytes


def test_an_emcy_storm_ends_nothing_and_the_fault_is_told_by_its_own_code():
    with two_drives() as rig:
        motor = moving(rig.motors["left"])
        port = rig.world.add_host("can0", "storm", lambda *_: None)
        from tests.crosscheck.wire import frame

        storm = rig.runtime.every(0.0005, lambda: port.send(frame("081#2082110000000000")))
        motor.wait_until_done(5)
        assert demand(rig) == pytest.approx(INC_PER_RAD, abs=1)
        rig.controllers["left"].stimulate("fault", 0x2310)
        rig.runtime.run_for(0.05)
        fault = motor.fault()
        assert fault is not None
        assert fault.code == 0x2310  # not 8220h, which a Roboteq repeats for ever
        storm.cancel()


def test_a_fault_keeps_its_code_when_a_lesser_error_goes():
    with two_drives() as rig:
        motor = moving(rig.motors["left"])
        rig.controllers["left"].stimulate("fault", 0x2310)
        with pytest.raises(DeviceFault, match="2310h"):
            motor.wait_until_done(5)
        stranger(rig)("081#0000030000000000")  # error reset, but 1001h: one of two remains
        assert motor.hardware.node.error_code == 0x2310


def test_a_failed_start_of_a_motor_somebody_else_enabled_leaves_it_enabled():
    """What overwrites the latch must not bring a controlword that nobody commanded."""
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
            if raw[:4] == b"\x01\x04\0\0" and not armed:  # RPDO 3 of the left one
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
