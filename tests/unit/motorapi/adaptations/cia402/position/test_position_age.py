"""Positions of a drive whose status TPDO does not arrive, while its heartbeat does."""

from collections.abc import Callable

import pytest

from motorhil.emulators.can.fault_rules import FaultKind, FaultRule
from motorhil.harness.rig.rig import Rig
from motorhil.motorapi.adaptations.canopen.bus import open_bus, release_bus
from motorhil.motorapi.adaptations.canopen.errors import SdoAborted
from motorhil.motorapi.adaptations.cia402.bringup import HwOptions
from motorhil.motorapi.adaptations.cia402.motion_status import RestWatch
from motorhil.motorapi.adaptations.cia402.node import DriveNode, TpdoDecoder
from motorhil.motorapi.errors import DeadlineExceeded, LinkError
from motorhil.motorapi.runtime.can_link import can_frame
from motorhil.motorapi.state import MotorState
from motorhil.motorapi.trajectory import MotorPosition
from tests.support.motors.drive_rigs import drive
from tests.support.motors.wheels import MS, WINDOW_RAD, go_to, motor_of, truth

OpenRig = Callable[..., Rig]
POSITION_ENTRY = bytes.fromhex("20006460")  # 6064h in a mapping, 32 bits


@pytest.fixture
def rig(open_rig: OpenRig) -> Rig:
    return open_rig(drive("left", 1))


def lose(rig: Rig, can_id: int) -> None:
    rule = FaultRule(
        f"lose {can_id:X}", FaultKind.DROP, identifier=can_id, from_ns=rig.runtime.now_ns()
    )
    rig.faults.inject("can0", rule)


def test_position_without_its_tpdo_is_read_by_sdo(rig: Rig):
    motor = motor_of(rig)
    go_to(motor, 2.0)
    rig.runtime.run_for(0.2)
    lose(rig, 0x181)
    for _ in range(6):
        rig.runtime.run_for(0.15)
        # age: two SDO transfers, at 3 rad/s
        assert motor.position() == pytest.approx(truth(rig), abs=0.01)
    motor.wait_until_done(timeout_s=5)
    assert truth(rig) == pytest.approx(2.0, abs=WINDOW_RAD)


def test_end_of_motion_without_its_tpdo_is_polled(rig: Rig):
    motor = motor_of(rig)
    go_to(motor, 2.0)
    rig.runtime.run_for(0.2)
    lose(rig, 0x181)
    motor.wait_until_done()  # for ever, before
    assert rig.runtime.now_ns() < 1_600 * MS + 500 * MS  # 0.97 s of motion from 0.5 s on
    motor.stop()
    motor.wait_until_done()
    motor.disable()
    motor.enable()
    go_to(motor, 1.0)
    motor.wait_until_done(timeout_s=5)
    assert motor.position() == pytest.approx(1.0, abs=WINDOW_RAD)
    rig.faults.lift("can0", "lose 181")
    go_to(motor, 2.0)
    motor.wait_until_done(timeout_s=5)
    assert motor.hardware.node.is_told


def test_position_that_no_way_brings_is_an_error(rig: Rig):
    motor = motor_of(rig)
    go_to(motor, 2.0)
    lose(rig, 0x181)
    lose(rig, 0x581)
    rig.runtime.run_for(0.15)
    with pytest.raises(DeadlineExceeded, match="6041h"):
        motor.position()


def test_leader_without_its_tpdo_is_out_of_date(rig: Rig):
    motor = motor_of(rig)
    go_to(motor, 2.0)
    argument = MotorPosition(motor)
    rig.runtime.run_for(0.2)
    assert argument.value() == pytest.approx(truth(rig), abs=0.1)
    lose(rig, 0x181)
    rig.runtime.run_for(0.5)
    with pytest.raises(LinkError, match="out of date"):
        argument.value()
    latest = motor.latest()
    assert latest is not None
    assert latest.state is MotorState.OFFLINE
    assert motor.state() is MotorState.ENABLED  # asked for by SDO


def test_lost_drive_is_named_before_its_status_is_missed(rig: Rig):
    motor = motor_of(rig)
    go_to(motor, 3.0)
    for can_id in (0x181, 0x581, 0x701):
        lose(rig, can_id)
    with pytest.raises(LinkError, match="no heartbeat for 300 ms"):
        motor.wait_until_done(timeout_s=5)


def test_statusword_without_position_shows_no_standstill(rig: Rig):
    bus = open_bus(rig.bus("can0"), rig.runtime)
    node = DriveNode(bus, 9, HwOptions())
    node.watch = RestWatch(commanded_ns=0, needs_bit=False)
    decoder = TpdoDecoder(node, (0x6041_0010,))
    for time_ms in range(0, 100, 10):
        decoder.decode(can_frame(0x189, bytes((0x37, 0x02))), time_ms * MS)
    assert node.statusword == 0x0237
    assert node.watch.ended_ns is None
    node.close()
    release_bus(bus)


@pytest.mark.parametrize("times", [1, 1000])
def test_position_that_is_not_mapped_is_read_by_sdo(rig: Rig, times: int):
    """The drive refuses to map 6064h, or aborts once while its PDOs are set up."""
    motor = motor_of(rig)
    sdo = motor.hardware.node.sdo
    download = sdo.download
    refused: list[int] = []

    def refusing(index: int, subindex: int, data: bytes, *, stops: bool = False) -> None:
        if data == POSITION_ENTRY and len(refused) < times:
            refused.append(index)
            raise SdoAborted(node_id=1, index=index, subindex=subindex, abort_code=0x0604_0041)
        download(index, subindex, data, stops=stops)

    sdo.download = refusing  # type: ignore[method-assign]
    motor.enable()
    go_to(motor, 2.0)
    assert refused
    for _ in range(6):
        rig.runtime.run_for(0.15)
        assert motor.position() == pytest.approx(truth(rig), abs=0.01)
    motor.wait_until_done(timeout_s=5)
    assert truth(rig) == pytest.approx(2.0, abs=WINDOW_RAD)
