"""Interrupted motions of a CiA 402 motor: faults, lost drives, lost hosts."""

from collections.abc import Callable
from contextlib import suppress

import can
import pytest

from motorhil.emulators.can.error_confinement import ErrorState
from motorhil.emulators.can.fault_rules import FaultKind, FaultRule
from motorhil.emulators.can.frame import pack
from motorhil.harness.rig.config.scaffold import EXAMPLES
from motorhil.harness.rig.rig import Rig
from motorhil.motorapi.adaptations.cia402.motor import Cia402Motor
from motorhil.motorapi.commands import ControlMode, ControlVariable
from motorhil.motorapi.errors import DeviceFault, LinkError, MotionInterrupted
from motorhil.motorapi.group import MotorGroup
from motorhil.motorapi.motor import Motor
from motorhil.motorapi.state import MotorState
from motorhil.motorapi.trajectory import ComplexTrajectory, TrapezoidalTrajectory
from tests.support.motors.drive_rigs import drive
from tests.support.motors.streaming import quintic
from tests.support.motors.wheels import MS, WINDOW_RAD, frames_on, go_to, motor_of, truth

OpenRig = Callable[..., Rig]
READY_TO_SWITCH_ON = 2.0


@pytest.fixture
def rig(open_rig: OpenRig) -> Rig:
    return open_rig(drive("left", 1), drive("right", 2))


def test_fault_in_motion_ends_the_wait_at_its_frame(rig: Rig):
    motor = motor_of(rig)
    go_to(motor, 3.0)
    heard = frames_on(rig)
    rig.runtime.run_for(0.3)
    rig.controllers["left"].stimulate("fault", 0x3210)
    with pytest.raises(DeviceFault, match=r"fault 3210h \(DC link over-voltage\)") as caught:
        motor.wait_until_done(timeout_s=5)
    first = next(
        time_ns
        for time_ns, _, can_id, data in heard
        if can_id == 0x181 and int.from_bytes(data[:2], "little") & 0x08
    )
    assert rig.runtime.now_ns() == first
    assert caught.value.code == 0x3210
    with pytest.raises(DeviceFault):
        motor.start()
    rig.runtime.run_for(1.0)
    motor.reset_fault()
    assert motor.fault() is None
    assert motor.state() is MotorState.DISABLED
    go_to(motor, 0.0)
    motor.wait_until_done(timeout_s=5)
    assert [emergency.code for emergency in motor.hardware.emergencies] == [0x3210, 0x0000]


def test_lost_drive_ends_the_wait_within_heartbeat_time(rig: Rig):
    motor = motor_of(rig)
    go_to(motor, 3.0)
    heard = frames_on(rig)
    rig.runtime.run_for(0.25)
    lost_ns = rig.runtime.now_ns()
    rig.faults.inject("can0", FaultRule("cut", FaultKind.CUT, ports=("left",), from_ns=lost_ns))
    with pytest.raises(LinkError, match="can0 node 1: no heartbeat for 300 ms"):
        motor.wait_until_done(timeout_s=5)
    last = max(time_ns for time_ns, _, can_id, _ in heard if can_id == 0x701)
    assert rig.runtime.now_ns() == last + 300 * MS
    assert rig.runtime.now_ns() <= lost_ns + 300 * MS
    assert motor.state() is MotorState.OFFLINE
    with pytest.raises(LinkError):
        motor.position()


def test_rebooted_drive_is_brought_up_again(rig: Rig):
    motor = motor_of(rig)
    go_to(motor, 1.0)
    motor.wait_until_done(timeout_s=5)
    motor.home(37)
    motor.hardware.node.bus.nmt(0x81, 1)
    rig.runtime.run_for(0.5)
    assert not motor.is_referenced()
    go_to(motor, 0.25)
    motor.wait_until_done(timeout_s=5)


def test_drive_that_rebooted_unheard_is_brought_up_again(rig: Rig):
    motor = motor_of(rig)
    go_to(motor, 1.0)
    motor.wait_until_done(timeout_s=5)
    motor.home(37)
    unheard = FaultRule("unheard", FaultKind.DROP, sender="left")
    rig.faults.inject("can0", unheard)
    motor.hardware.node.bus.nmt(0x81, 1)
    rig.runtime.run_for(1.0)
    assert motor.state() is MotorState.OFFLINE
    rig.faults.lift("can0", "unheard")
    rig.runtime.run_for(1.0)
    assert not motor.is_referenced()
    go_to(motor, 0.25)
    motor.wait_until_done(timeout_s=5)


def test_drive_reboot_in_motion_raises_link_error(rig: Rig):
    motor = motor_of(rig)
    go_to(motor, 3.0)
    rig.runtime.run_for(0.2)
    motor.hardware.node.bus.nmt(0x81, 1)
    with pytest.raises(LinkError):
        motor.wait_until_done(timeout_s=5)


def test_set_up_by_a_reader_keeps_loss_of_the_motion(rig: Rig):
    motor = motor_of(rig)
    reader = Cia402Motor(motor.hardware, motor.model, name="reader")
    go_to(motor, 3.0)
    rig.runtime.run_for(0.2)
    motor.hardware.node.bus.nmt(0x81, 1)
    rig.runtime.run_for(0.5)
    reader.position()
    with pytest.raises(LinkError, match="it has booted and lost its configuration"):
        motor.wait_until_done(timeout_s=5)
    reader.close()


def test_foreign_switch_off_interrupts_the_motion(rig: Rig):
    motor = motor_of(rig)
    go_to(motor, 3.0)
    rig.runtime.run_for(0.2)
    motor.hardware.control.send_controlword(0x0000)
    with pytest.raises(MotionInterrupted, match="switch on disabled"):
        motor.wait_until_done(timeout_s=5)


def by_rpdo(word: int) -> can.Message:
    return can.Message(arbitration_id=0x201, data=word.to_bytes(2, "little"), is_extended_id=False)


def by_sdo(word: int) -> can.Message:
    data = bytes.fromhex("2B 40 60 00") + word.to_bytes(2, "little") + bytes(2)  # CiA 301: 2 bytes
    return can.Message(arbitration_id=0x601, data=data, is_extended_id=False)


def begin(motor: Cia402Motor, kind: str) -> None:
    if kind == "pp":
        go_to(motor, 3.0)
        return
    variable = ControlVariable.POSITION if kind == "csp" else ControlVariable.VELOCITY
    motor.set_control_mode(ControlMode.TRAJECTORY, variable)
    motor.set_trajectory(
        ComplexTrajectory(quintic(2.0, 3.0))
        if kind == "csp"
        else TrapezoidalTrajectory(2.0, duration_s=2.0)
    )
    motor.start()


@pytest.mark.parametrize("message", [by_rpdo, by_sdo])
@pytest.mark.parametrize(
    ("word", "told"),
    [
        (0x010F, "to stop"),  # halt
        (0x0007, "to stop"),  # disable operation
        (0x003F, "to move elsewhere"),  # new set-point, change immediately
    ],
)
@pytest.mark.parametrize("kind", ["pp", "pv", "csp"])
def test_another_masters_command_interrupts_the_motion(rig: Rig, kind, word, told, message):
    motor = motor_of(rig)
    begin(motor, kind)
    rig.runtime.run_for(0.3)
    with can.Bus(interface="emulated", channel="can0") as bus:
        bus.send(message(word))
        rig.runtime.run_for(0.001)
        if word == 0x003F and kind != "pp":  # these bits have no meaning there
            motor.wait_until_done(timeout_s=5)
            return
        by = rf"another program, which told the drive {told} \(controlword {word:04X}h\)"
        with pytest.raises(MotionInterrupted, match=by):
            motor.wait_until_done()
    motor.stop()
    with suppress(MotionInterrupted):
        motor.wait_until_done(timeout_s=5)
    go_to(motor, 0.5)
    motor.wait_until_done(timeout_s=5)
    assert abs(truth(rig) - 0.5) <= WINDOW_RAD


def test_halt_that_was_not_heard_interrupts_the_motion(rig: Rig):
    motor = motor_of(rig)
    go_to(motor, 3.0)
    rig.runtime.run_for(0.2)
    motor.hardware.control.send_controlword(0x010F)  # as an input of the drive would
    with pytest.raises(MotionInterrupted, match="stands short of its target"):
        motor.wait_until_done()
    # begun at 0.46 s, 1.3 s of motion, half a second at rest, and a status period
    assert rig.runtime.now_ns() <= 2_300 * MS
    go_to(motor, 0.1)
    motor.wait_until_done(timeout_s=5)


def test_drive_leaving_operational_raises_link_error(rig: Rig):
    motor = motor_of(rig)
    go_to(motor, 3.0)
    rig.runtime.run_for(0.2)
    motor.hardware.node.bus.nmt(0x80, 1)
    with pytest.raises(LinkError, match="NMT state is 7Fh"):
        motor.wait_until_done(timeout_s=5)


def test_host_silent_for_a_while_is_named_as_the_cause(rig: Rig):
    motor = motor_of(rig)
    go_to(motor, 3.0)
    lose = FaultRule("lose", FaultKind.DROP, identifier=0x77F, from_ns=rig.runtime.now_ns())
    rig.faults.inject("can0", lose)
    # CiA 301, 1029h: a node that misses its host leaves OPERATIONAL; its heartbeat says so
    with pytest.raises(LinkError, match=r"NMT state is 7Fh.*, after EMCY 8130h .* host was not"):
        motor.wait_until_done(timeout_s=5)
    rig.faults.lift("can0", "lose")
    rig.runtime.run_for(0.2)
    go_to(motor, 0.1)
    motor.wait_until_done(timeout_s=5)
    assert abs(truth(rig) - 0.1) <= WINDOW_RAD


def test_drive_stops_when_the_host_falls_silent(rig: Rig):
    motor = motor_of(rig)
    go_to(motor, 3.0)
    rig.runtime.run_for(0.2)
    motor.hardware.close()  # the host's end: no further heartbeats
    rig.runtime.run_for(1.0)
    assert rig.controllers["left"].snapshot()["velocity_rad_s"] == 0.0
    assert truth(rig) < 2.5


def with_late_status(skip, limit):
    """Return two wheels; after `skip` statuses, `limit` of the left drive arrive 0.11 s late."""
    rig = Rig.open(EXAMPLES / "two_wheels.toml")
    late = FaultRule(
        "late",
        FaultKind.DELAY,
        identifier=0x181,
        skip=skip,
        limit=limit,
        delay_ns=111_000_000,
    )
    rig.faults.inject("can0", late)
    return rig


@pytest.mark.parametrize("stop", [Motor.stop, Motor.quick_stop])
@pytest.mark.parametrize("skip", range(5))
def test_stop_reaches_a_drive_whose_old_status_comes_late(stop, skip):
    with with_late_status(skip, 2) as rig:
        motor = rig.motors["left"]
        motor.enable()
        motor.set_control_mode(ControlMode.SETPOINT)
        motor.set_setpoint(6.0)
        motor.start()
        with pytest.raises(MotionInterrupted, match="ended by the drive, now in state"):
            motor.wait_until_done(timeout_s=0.5)
        stop(motor)
        rig.runtime.run_for(0.5)
        assert rig.controllers["left"].snapshot()["velocity_rad_s"] == 0.0


@pytest.mark.parametrize("stop", [Motor.stop, Motor.quick_stop])
def test_stop_of_a_drive_that_another_program_has_switched_off_enables_nothing(stop):
    with Rig.open(EXAMPLES / "two_wheels.toml") as rig:
        motor = rig.motors["left"]
        motor.enable()
        rig.runtime.send(rig.bus("can0"), pack(0x601, bytes.fromhex("2B 40 60 00 06 00 00 00")))
        rig.runtime.run_for(0.05)
        off = rig.controllers["left"].snapshot()["state"]
        assert off == READY_TO_SWITCH_ON
        stop(motor)
        for _ in range(30):
            rig.runtime.run_for(0.1)
            assert rig.controllers["left"].snapshot()["state"] == off


def bus_off(rig):
    """Let the host go bus-off, by errors in its frames; it recovers by itself."""
    rig.faults.inject("can0", FaultRule("off", FaultKind.ERROR, ports=("host",), bit=40))
    rig.runtime.wait_until(
        lambda: rig.faults.bus_state("can0")["host"].state is ErrorState.BUS_OFF, 1.0
    )
    rig.faults.lift("can0", "off")
    assert rig.faults.bus_state("can0")["host"].state is ErrorState.BUS_OFF


def stop_both(motor):
    """Stop the motor with its group."""
    MotorGroup(motor).stop()


@pytest.mark.parametrize("stop", [Motor.stop, Motor.quick_stop, stop_both])
@pytest.mark.parametrize("is_streamed", [False, True])
def test_stop_asked_for_while_the_bus_is_off_reaches_the_drive_after_it(stop, is_streamed):
    with Rig.open(EXAMPLES / "two_wheels.toml") as rig:
        motor = rig.motors["left"]
        motor.enable()
        motor.set_control_mode(ControlMode.TRAJECTORY)
        far = quintic(6.0, 8.0) if is_streamed else None
        motor.set_trajectory(
            TrapezoidalTrajectory(12.0) if far is None else ComplexTrajectory(far, relative=True)
        )
        motor.start()
        rig.runtime.run_for(0.4)
        bus_off(rig)
        with pytest.raises(LinkError, match="bus-off"):
            stop(motor)
        rig.runtime.run_for(0.7)
        there = rig.controllers["left"].snapshot()
        assert motor.fault() is None
        assert there["velocity_rad_s"] == 0.0
        assert there["position_rad"] < 5.0
