"""The host's CAN controller in bus-off or error passive, or without ACK.

The messages are injected; a cut of the host has the corresponding effect on the bus.
"""

from collections.abc import Callable

import pytest

from motorhil.emulators.can.fault_rules import FaultKind, FaultRule
from motorhil.harness.rig.rig import Rig
from motorhil.motorapi.commands import ControlMode
from motorhil.motorapi.errors import DeadlineExceeded, LinkError
from motorhil.motorapi.functions import Polynomial
from motorhil.motorapi.group import MotorGroup
from motorhil.motorapi.motor import Motor
from motorhil.motorapi.runtime.can_link import CanLink
from motorhil.motorapi.runtime.can_sources import BusCondition
from motorhil.motorapi.state import MotorState
from motorhil.motorapi.trajectory import ComplexTrajectory, TrapezoidalTrajectory
from tests.support.motors import software_rigs
from tests.support.motors.bus_errors import (
    ACTIVE,
    NO_ACKNOWLEDGE,
    OFF,
    PASSIVE,
    go_off,
    message,
    tell,
    tell_at,
)
from tests.support.motors.drive_rigs import drive
from tests.support.motors.scripted import ScriptedBus, frame
from tests.support.motors.wheels import MS, WINDOW_RAD, frames_on, go_to, motor_of, truth

OpenRig = Callable[..., Rig]

IS_OFF = r"can0: bus-off: nothing is sent or received since {:.6f} s; "


@pytest.fixture
def rig(open_rig: OpenRig) -> Rig:
    return open_rig(drive("left", 1), drive("right", 2))


def now_ns(rig: Rig) -> int:
    return rig.runtime.now_ns()


def test_bus_off_ends_a_wait_at_once_and_motor_recovers(rig: Rig):
    motor = motor_of(rig)
    go_to(motor, 1.0)
    off_ns = now_ns(rig) + 200 * MS
    go_off(rig, off_ns, 30 * MS)
    with pytest.raises(LinkError, match=IS_OFF.format(off_ns / 1e9)) as failed:
        motor.wait_until_done(timeout_s=5)
    assert now_ns(rig) == off_ns
    assert failed.value.since_ns == off_ns
    assert failed.value.remedy
    assert motor.state() is MotorState.OFFLINE
    rig.runtime.run_for(0.04)
    assert motor.state() is MotorState.ENABLED
    rig.runtime.run_for(2.0)
    go_to(motor, 0.5)
    motor.wait_until_done(timeout_s=5)
    assert truth(rig) == pytest.approx(0.5, abs=WINDOW_RAD)


def test_drive_after_long_bus_off_is_set_up_again(rig: Rig):
    motor = motor_of(rig)
    go_to(motor, 3.0)
    go_off(rig, now_ns(rig) + 200 * MS, 2000 * MS)
    with pytest.raises(LinkError):
        motor.wait_until_done(timeout_s=5)
    rig.runtime.run_for(2.5)
    before = truth(rig)
    rig.runtime.run_for(1.0)
    assert truth(rig) == before  # nothing begins without a command
    if motor.fault() is not None:
        motor.reset_fault()
    go_to(motor, 0.5)
    motor.wait_until_done(timeout_s=5)
    assert truth(rig) == pytest.approx(0.5, abs=WINDOW_RAD)


def test_bus_off_calls_fail_at_once_and_send_nothing(rig: Rig):
    motor = motor_of(rig)
    go_to(motor, 0.5)
    motor.wait_until_done(timeout_s=5)
    heard = frames_on(rig)
    tell(rig, OFF)
    before_ns = now_ns(rig)
    for action in (motor.start, motor.enable, motor.disable, motor.stop, motor.home):
        with pytest.raises(LinkError, match="bus-off"):
            action()
    with pytest.raises(LinkError, match="bus-off"):
        motor.hardware.read(0x6064)
    assert now_ns(rig) == before_ns
    rig.runtime.run_for(1.0)  # its heartbeats are due meanwhile
    assert [can_id for _, sender, can_id, _ in heard if sender == "host"] == []
    tell(rig, "20000100#0000000000000000")
    rig.runtime.run_for(0.2)
    assert [can_id for _, sender, can_id, _ in heard if sender == "host"] == [0x77F] * 2


def test_bus_off_ends_a_waiting_sdo_transfer_at_once(rig: Rig):
    motor = motor_of(rig)
    motor.enable()
    off_ns = now_ns(rig) + MS // 2
    go_off(rig, off_ns, MS)
    with pytest.raises(LinkError, match="bus-off"):
        motor.hardware.read(0x6064)
    assert now_ns(rig) == off_ns
    rig.runtime.run_for(0.1)
    assert isinstance(motor.hardware.read(0x6064), int)


def test_bus_off_shorter_than_a_step_is_noticed_by_waiters():
    bus = ScriptedBus(confirms=False)
    link = CanLink(bus, bus.runtime)
    sent = link.send_tracked(frame("301#0F00"))

    def off_and_on(_now_ns: int) -> None:
        for text in (OFF, "20000100#0000000000000000"):
            bus._tell(message(text), bus.runtime.now_ns(), False)

    bus.queue.alarm(off_and_on).set(3 * MS)
    with pytest.raises(LinkError, match=r"the bus was off at 0\.003000 s and has recovered"):
        link.confirmed([sent])
    assert bus.runtime.now_ns() == 3 * MS


def test_bus_off_drops_frames_without_late_confirmation():
    bus = ScriptedBus(confirms=False)
    link = CanLink(bus, bus.runtime)
    lost = link.send_tracked(frame("080#"))
    bus.deliver(message(OFF))
    bus.deliver(message("20000100#0000000000000000"))
    bus.runtime.run_for(0.001)
    again = link.send_tracked(frame("080#"))
    bus.confirm("080#")
    link.confirmed([again])
    assert lost.time_ns is None


def test_bus_off_ends_a_stream_and_the_motor_recovers(rig: Rig):
    motor = motor_of(rig)
    motor.set_control_mode(ControlMode.TRAJECTORY)
    motor.set_trajectory(ComplexTrajectory(Polynomial([0, 0, 0.75, -0.25]), 0, 2, relative=True))
    motor.start()
    heard = frames_on(rig)
    off_ns = now_ns(rig) + 502 * MS
    go_off(rig, off_ns, 50 * MS)
    with pytest.raises(LinkError, match="bus-off"):
        motor.wait_until_done(timeout_s=5)
    assert now_ns(rig) == off_ns
    rig.runtime.run_for(1.0)
    assert [
        time_ns for time_ns, _, can_id, _ in heard if can_id == 0x080 and time_ns > off_ns
    ] == []
    motor.stop()
    motor.wait_until_done(timeout_s=5)
    go_to(motor, 0.25)
    motor.wait_until_done(timeout_s=5)
    assert truth(rig) == pytest.approx(0.25, abs=WINDOW_RAD)


def test_bus_off_fails_a_group_once_and_it_recovers(rig: Rig):
    group = MotorGroup(motor_of(rig, "left"), motor_of(rig, "right"))
    group.for_each(Motor.set_control_mode, ControlMode.TRAJECTORY)
    group.set_trajectory(TrapezoidalTrajectory(1.0), TrapezoidalTrajectory(-1.0))
    group.start()
    off_ns = now_ns(rig) + 100 * MS
    go_off(rig, off_ns, 20 * MS)
    with pytest.raises(LinkError, match="bus-off") as failed:
        group.wait_until_done(timeout_s=5)
    assert now_ns(rig) == off_ns
    assert any("from left" in note for note in failed.value.__notes__)
    rig.runtime.run_for(2.0)
    group.set_trajectory(TrapezoidalTrajectory(0.5), TrapezoidalTrajectory(0.5))
    group.start()
    group.wait_until_done(timeout_s=5)


def test_bus_off_ends_a_servo_and_it_recovers(open_rig: OpenRig):
    rig = open_rig(software_rigs.node("node", 1), software_rigs.motor("left", "node"))
    motor = rig.motors["left"]
    motor.set_control_mode(ControlMode.TRAJECTORY)
    motor.set_trajectory(TrapezoidalTrajectory(1.0))
    motor.start()
    off_ns = now_ns(rig) + 100 * MS
    go_off(rig, off_ns, 20 * MS)
    with pytest.raises(LinkError, match="bus-off"):
        motor.wait_until_done(timeout_s=5)
    assert now_ns(rig) == off_ns
    assert motor.state() is MotorState.OFFLINE
    rig.runtime.run_for(2.0)
    motor.stop()
    motor.wait_until_done(timeout_s=5)
    motor.set_trajectory(TrapezoidalTrajectory(0.5))
    motor.start()
    motor.wait_until_done(timeout_s=5)


def test_error_passive_host_works_and_timeouts_name_it(rig: Rig):
    motor = motor_of(rig)
    motor.enable()
    tell(rig, PASSIVE)
    link = motor.hardware.link
    assert link.status.condition is BusCondition.PASSIVE
    assert link.status.counters == (128, 0)
    go_to(motor, 0.5)
    motor.wait_until_done(timeout_s=5)
    assert "error passive since" in link.status.trouble()  # no more: frames are acknowledged
    tell(rig, ACTIVE)
    assert link.status.trouble() == ""


def test_missing_ack_is_named_in_the_deadline_error(rig: Rig):
    motor = motor_of(rig)
    motor.enable()
    alone_ns = now_ns(rig) + MS // 10
    tell_at(rig, alone_ns, NO_ACKNOWLEDGE)
    rig.faults.inject("can0", FaultRule("alone", FaultKind.CUT, ports=("host",), from_ns=alone_ns))
    since = f"can0: no ACK since t = {alone_ns / 1e9:.6f} s"
    with pytest.raises(DeadlineExceeded, match=since):
        motor.hardware.read(0x6064)
    with pytest.raises(LinkError, match=rf"were not transmitted within 0.5 s; {since}"):
        motor.hardware.link.confirmed([motor.hardware.link.send_tracked(frame("301#0F00"))])


@pytest.mark.parametrize("classes", [0x000, 0x080, 0x081, 0x181, 0x201, 0x301])
def test_error_frame_is_not_handled_as_data_frame(rig: Rig, classes: int):
    """Its classes may equal the bits of SYNC, of the drive's EMCY, of its TPDO, or of our RPDOs."""
    motor = motor_of(rig)
    motor.enable()
    node = motor.hardware.node
    bus = motor.hardware.node.bus
    heard: list[int] = []
    bus.network.subscribe(classes, lambda can_id, data, time_s: heard.append(can_id))
    with motor.low_level() as hardware, hardware.listen() as inbox:
        before = (node.statusword, node.position_inc, node.malformed, bus.sync.count)
        tell(rig, f"{0x2000_0000 | classes:08X}#FFFF0F0000FF0000")
        after = (node.statusword, node.position_inc, node.malformed, bus.sync.count)
        with pytest.raises(DeadlineExceeded):
            inbox.receive(0.0)
    assert (after, list(node.emergencies), heard) == (before, [], [])


def test_network_hears_frames_of_further_nodes(rig: Rig):
    """A `canopen.Network` on the bus has subscribers of its own, as for a sensor."""
    motor = motor_of(rig)
    motor.enable()
    heard: list[tuple[int, bytes, float]] = []
    network = motor.hardware.node.bus.network
    network.subscribe(0x5A1, lambda *one: heard.append((one[0], bytes(one[1]), one[2])))
    tell(rig, "5A1#0102030405060708")
    tell(rig, "5A2#0807060504030201")
    assert [one[:2] for one in heard] == [(0x5A1, bytes(range(1, 9)))]
    assert 0.0 < heard[0][2] <= now_ns(rig) / 1e9
