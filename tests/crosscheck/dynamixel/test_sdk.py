"""The maker's SDK (dynamixel-sdk 4.1.0, Apache-2.0) with emulated servos.

In virtual time with a port of ours, and on a pseudo-terminal with the SDK's own port. Three of its
defects matter here: it sends FF FF FD unstuffed, forgets the error bytes of group reads, and seeks
ids of a fast bulk read among addresses and lengths.
"""

import subprocess
from collections.abc import Iterator
from contextlib import suppress
from math import pi
from pathlib import Path

import pytest
from dynamixel_sdk import (
    COMM_NOT_AVAILABLE,
    COMM_RX_TIMEOUT,
    COMM_SUCCESS,
    GroupBulkRead,
    GroupBulkWrite,
    GroupSyncRead,
    GroupSyncWrite,
    PacketHandler,
    PortHandler,
)

from motorhil.motorapi import ControlMode, MotorModel
from motorhil.motorapi.adaptations.dynamixel import DynamixelHwMotor, DynamixelMotor
from motorhil.motorapi.runtime.byte_streams import SerialLine
from tests.support.dynamixel.bench import Bench, SdkPort
from tests.system.wall.test_serve import MOTORHIL

GOAL, POSITION = 116, 132
OK = (COMM_SUCCESS, 0)
UNITS = (1, 2, 5)


@pytest.fixture
def bench() -> Bench:
    return Bench(*({"unit": unit, "initial_position_rad": unit * pi / 16} for unit in UNITS))


@pytest.fixture
def port(bench) -> SdkPort:
    return SdkPort(bench)


@pytest.fixture
def sdk() -> PacketHandler:
    return PacketHandler(2.0)


def test_sdk_pings_one_and_all(port, sdk):
    assert sdk.ping(port, 2) == (1200, 0, 0)
    assert sdk.ping(port, 3)[1] == COMM_RX_TIMEOUT
    assert sdk.broadcastPing(port) == ({unit: [1200, 52] for unit in UNITS}, COMM_SUCCESS)


@pytest.mark.parametrize("baud", [9600, 57_600, 115_200, 2_000_000, 4_000_000])
def test_sdk_pings_all_at_every_rate(sdk, baud):
    bench = Bench({"unit": 1}, {"unit": 3}, {"unit": 4}, baud=baud)
    assert sdk.broadcastPing(SdkPort(bench))[0] == {unit: [1200, 52] for unit in (1, 3, 4)}


def test_sdk_reads_and_writes_every_size(port, sdk):
    assert sdk.read1ByteTxRx(port, 1, 7) == (1, *OK)
    assert sdk.read2ByteTxRx(port, 1, 0) == (1200, *OK)
    assert sdk.read4ByteTxRx(port, 1, POSITION) == (2048 + 128, *OK)
    assert sdk.readTxRx(port, 1, 144, 3) == ([50, 0, 30], *OK)
    assert sdk.write1ByteTxRx(port, 1, 65, 1) == OK
    assert sdk.write2ByteTxRx(port, 1, 84, 500) == OK
    assert sdk.write4ByteTxRx(port, 1, 112, 300) == OK
    assert sdk.writeTxRx(port, 1, 108, 8, [10, 0, 0, 0, 100, 0, 0, 0]) == OK
    assert sdk.readTxRx(port, 1, 108, 8)[0] == [10, 0, 0, 0, 100, 0, 0, 0]
    assert sdk.read2ByteTxRx(port, 1, 84)[0] == 500
    assert sdk.write1ByteTxRx(port, 1, 132, 1) == (COMM_SUCCESS, 7)


def test_sdk_writes_and_reads_marks_of_headers(port, sdk):
    data = [0xFF, 0xFF, 0xFD]  # of the indirect data, which it sends unstuffed, and gets stuffed
    assert sdk.writeTxRx(port, 1, 208, 3, data) == OK
    assert sdk.readTxRx(port, 1, 208, 3) == (data, *OK)


def test_sdk_registers_a_write_and_acts(port, sdk):
    assert sdk.regWriteTxRx(port, 1, 112, 4, [44, 1, 0, 0]) == OK
    assert sdk.read1ByteTxRx(port, 1, 69)[0] == 1
    sdk.action(port, 1)
    port.bench.run_ms(5)
    assert sdk.read4ByteTxRx(port, 1, 112)[0] == 300


def test_sdk_moves_a_motor_and_clears_its_turns(bench, port, sdk):
    assert sdk.write1ByteTxRx(port, 1, 11, 4) == OK
    assert sdk.write1ByteTxRx(port, 1, 64, 1) == OK
    assert sdk.write4ByteTxRx(port, 1, 112, 300) == OK
    assert sdk.write4ByteTxRx(port, 1, GOAL, 9000) == OK
    while sdk.read1ByteTxRx(port, 1, 122)[0]:
        pass
    bench.run_ms(200)
    assert abs(sdk.read4ByteTxRx(port, 1, POSITION)[0] - 9000) <= 1
    assert abs(bench.truth()["position_rad"] - (9000 - 2048) * 2 * pi / 4096) < 0.002
    assert sdk.clearMultiTurn(port, 1) == OK
    assert abs(sdk.read4ByteTxRx(port, 1, POSITION)[0] - 9000 % 4096) <= 1


def test_sdk_reboots_and_resets(bench, port, sdk):
    assert sdk.write1ByteTxRx(port, 1, 9, 5) == OK
    assert sdk.reboot(port, 1) == OK
    assert sdk.ping(port, 1)[1] == COMM_RX_TIMEOUT
    bench.run_ms(500)
    assert sdk.read1ByteTxRx(port, 1, 9) == (5, *OK)
    assert sdk.factoryReset(port, 1, 0x02) == OK
    bench.run_ms(500)
    assert sdk.read1ByteTxRx(port, 1, 9) == (250, *OK)


def test_sdk_sees_the_alert_and_the_data(bench, port, sdk):
    bench.stimulate("temperature_c", 80)
    assert sdk.read1ByteTxRx(port, 1, 70) == (4, COMM_SUCCESS, 0x80)


@pytest.mark.parametrize("fast", [False, True])
def test_sdk_reads_all_in_one_exchange(bench, port, sdk, fast):
    group = GroupSyncRead(port, sdk, POSITION, 4)
    for unit in (5, 1, 2):
        assert group.addParam(unit)
    assert (group.fastSyncRead() if fast else group.txRxPacket()) == COMM_SUCCESS
    assert [group.getData(unit, POSITION, 4) for unit in UNITS] == [2048 + 128 * n for n in UNITS]


@pytest.mark.parametrize("fast", [False, True])
def test_sdk_reads_different_items_in_one_exchange(bench, port, sdk, fast):
    group = GroupBulkRead(port, sdk)
    items = {5: (POSITION, 4), 1: (70, 1)} if fast else {5: (POSITION, 4), 2: (144, 2), 1: (146, 1)}
    for unit, (address, length) in items.items():
        assert group.addParam(unit, address, length)
    assert (group.fastBulkRead() if fast else group.txRxPacket()) == COMM_SUCCESS
    found = {unit: group.getData(unit, *where) for unit, where in items.items()}
    assert found == ({5: 2688, 1: 0} if fast else {5: 2688, 2: 50, 1: 30})


def test_sdk_writes_all_in_one_packet(bench, port, sdk):
    group = GroupSyncWrite(port, sdk, 112, 4)
    for unit in UNITS:
        assert group.addParam(unit, [unit, 0, 0, 0])
    assert group.txPacket() == COMM_SUCCESS
    bulk = GroupBulkWrite(port, sdk)
    assert bulk.addParam(1, 65, 1, [1])
    assert bulk.addParam(2, 108, 4, [7, 0, 0, 0])
    assert bulk.txPacket() == COMM_SUCCESS
    bench.run_ms(5)
    assert [sdk.read4ByteTxRx(port, unit, 112)[0] for unit in UNITS] == list(UNITS)
    assert sdk.read1ByteTxRx(port, 1, 65)[0] == 1
    assert sdk.read4ByteTxRx(port, 2, 108)[0] == 7
    assert sdk.broadcastPing(port)[1] != COMM_NOT_AVAILABLE


# ---- on a pseudo-terminal -------------------------------------------------------------------

RIG = """\
bus.line = {kind = "serial", baud_bit_s = 57_600}
[controller.pan]
kind = "dynamixel"
bus = "line"
unit = 1
boot_up_s = 0
[controller.tilt]
kind = "dynamixel"
bus = "line"
unit = 2
boot_up_s = 0
"""


@pytest.fixture
def served(tmp_path: Path) -> Iterator[PortHandler]:
    (tmp_path / "rig.toml").write_text(RIG)
    link = tmp_path / "line"
    process = subprocess.Popen(
        [*MOTORHIL, "serve", str(tmp_path / "rig.toml"), "--serial", str(link)],
        stdout=subprocess.PIPE,
        text=True,
    )
    try:
        assert process.stdout is not None
        told = process.stdout.readline()
        assert told.endswith("(as at 57600 bit/s 8N1) at " + f"{link}, units 1, 2\n")
        port = PortHandler(str(link))
        assert port.setBaudRate(57_600)
        yield port
        port.closePort()
    finally:
        process.terminate()
        process.communicate(timeout=20)


@pytest.mark.wall
def test_sdk_drives_a_served_rig_on_a_terminal(served, sdk):
    # Its timeout of 34 ms is of the wall. A busy machine may miss it: then the request is repeated,
    # and the late answer to a write, which has no data, may be taken for that to a read.
    def tried(call, *values):
        for _ in range(50):
            with suppress(IndexError):
                result = call(served, *values)
                if result[-2] == COMM_SUCCESS:  # the last one is the drive's error, often 0, too
                    return result
        pytest.fail("no answer")

    assert tried(sdk.ping, 2)[0] == 1200
    assert tried(sdk.read4ByteTxRx, 1, POSITION)[0] == 2048
    tried(sdk.write1ByteTxRx, 1, 64, 1)
    tried(sdk.write4ByteTxRx, 1, GOAL, 3000)
    for _ in range(1000):
        if abs(tried(sdk.read4ByteTxRx, 1, POSITION)[0] - 3000) <= 2:
            break
    else:
        pytest.fail("the motor does not arrive")


@pytest.mark.wall
def test_own_motor_drives_a_served_rig_on_a_terminal(served):
    served.closePort()
    line = SerialLine(served.getPortName(), baud_bit_s=57_600, parity="N")
    hardware = DynamixelHwMotor(line, 2, runtime=line.wall, timeout_s=2.0)
    motor = DynamixelMotor(
        hardware, MotorModel(velocity_max=4.0, acceleration_max=8.0, gear_ratio=1.0)
    )
    try:
        motor.set_control_mode(ControlMode.SETPOINT)
        motor.set_setpoint(0.5)
        motor.start()
        motor.wait_until_done(20)
        assert motor.position() == pytest.approx(0.5, abs=0.005)
        motor.disable()
    finally:
        motor.close()
        hardware.close()
        line.close()
    served.openPort()
