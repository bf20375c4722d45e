"""Consistency of EMCY, error register 1001h, history 1003h and error code 603Fh.

Expected: CiA 301, 7.2.7 (EMCY, its state machine: 00xxh with the register of what remains), 7.5.2.2
(1001h), 7.5.2.4 (1003h); CiA 402-2, 603Fh; Faulhaber's golden frame of a following error, `11 86 20
02 ..`: code, register with bit 5, vendor bytes. Faulhaber leaves bit 0 of the register clear. CiA
301 requires it with any error, and so do we.
"""

import pytest

from tests.support.canopen.drive_wire import MS, Wire

HEARTBEAT = 0x7F_0064  # node 127, 100 ms


def emergencies(wire: Wire, since: int = 0) -> list[str]:
    return [text[4:] for text in wire.since(since) if text.startswith("085#")]


def test_following_error_emcy_equals_real_drive(wire):
    wire.set(0x6065, 0, 1, 4)
    wire.enable(1)
    wire.set(0x607A, 0, 100_000, 4)
    wire.controlword(0x1F)
    wire.run(200 * MS)
    (told,) = emergencies(wire)
    assert told[:4] == "1186"
    assert int(told[4:6], 16) & ~0x01 == 0x20
    assert int(told[4:6], 16) == wire.read(0x1001) == 0x21
    assert wire.read(0x603F) == wire.read(0x1003, 1) & 0xFFFF == 0x8611


def test_register_collects_error_classes_until_reset(wire):
    wire.operational()
    for code in (0x2310, 0x4310, 0x3210):
        wire.stimulate("fault", code)
        wire.run(5 * MS)
    # current, temperature, voltage: bits 1, 3 and 2 appear one by one and stay
    assert emergencies(wire) == ["1023030000000000", "10430B0000000000", "10320F0000000000"]
    assert wire.read(0x1001) == 0x0F
    assert [wire.read(0x1003, sub) for sub in range(4)] == [3, 0x3210, 0x4310, 0x2310]
    wire.controlword(0x80)
    wire.run(1 * MS)
    assert emergencies(wire)[-1] == "0000000000000000"
    assert wire.read(0x1001) == 0
    assert wire.read(0x1003) == 3  # the history stays
    wire.set(0x1003, 0, 0, 1)
    assert wire.read(0x1003) == 0


def test_returning_host_keeps_fault_of_its_absence(wire):
    wire.set(0x1016, 1, HEARTBEAT, 4)
    wire.enable(1)
    wire.tell("77F#05")
    count = len(wire.log)
    wire.run(150 * MS)
    assert emergencies(wire, count) == ["3081117F00000000"]  # 8130h, node 127
    assert wire.statusword() & 0x4F == 0x08
    wire.tell("77F#05")
    wire.run(5 * MS)
    # the heartbeat is back; the drive still is in fault, and the register shows it
    assert emergencies(wire, count)[1:] == ["0000110000000000"]
    assert (wire.read(0x1001), wire.read(0x603F)) == (0x11, 0x8130)
    wire.tell("77F#05", "000#0105")
    wire.controlword(0x80)
    wire.run(5 * MS)
    assert emergencies(wire, count)[2:] == ["0000000000000000"]
    assert (wire.read(0x1001), wire.read(0x603F)) == (0, 0)


def test_fault_reset_without_host_keeps_communication_error(wire):
    wire.set(0x1029, 1, 1, 1)  # stay operational
    wire.set(0x1016, 1, HEARTBEAT, 4)
    wire.enable(1)
    wire.tell("77F#05")
    wire.run(150 * MS)
    wire.controlword(0x80)
    wire.run(5 * MS)
    assert emergencies(wire)[-1] == "0000110000000000"
    assert wire.read(0x1001) == 0x11


@pytest.mark.parametrize("command", ["0205", "8205"])
def test_fault_without_emcy_is_in_register(wire, command):
    wire.enable(1)
    count = len(wire.log)
    wire.tell(f"000#{command}")
    wire.run(50 * MS)
    if command == "0205":
        wire.tell("000#8005")
    assert emergencies(wire, count) == []  # neither in STOPPED nor while initialising
    assert wire.statusword() & 0x4F == 0x08
    assert (wire.read(0x603F), wire.read(0x1001)) == (0x8100, 0x11)


def test_reset_node_clears_errors_and_history(wire):
    wire.operational()
    wire.stimulate("fault", 0x2310)
    wire.run(5 * MS)
    wire.tell("000#8105")
    wire.run(310 * MS)
    assert [wire.read(*place) for place in ((0x1001,), (0x603F,), (0x1003, 0))] == [0, 0, 0]
    assert wire.statusword() & 0x4F == 0x40


def test_emergencies_use_1014h(wire):
    wire.set(0x1014, 0, 0x8000_0085, 4)
    count = len(wire.log)
    wire.stimulate("fault", 0x2310)
    wire.run(5 * MS)
    assert wire.since(count) == []
    wire.set(0x1014, 0, 0x99, 4)
    wire.stimulate("fault", 0x4310)
    wire.run(5 * MS)
    assert wire.since(count)[-1] == "099#10430B0000000000"


def test_canopen_consumer_agrees(connected):
    wire, network, node = connected
    for code in (0x2310, 0x4310):
        wire.stimulate("fault", code)
        network.pump(5 * MS)
    assert [(one.code, one.register) for one in node.emcy.active] == [
        (0x2310, 0x03),
        (0x4310, 0x0B),
    ]
    node.sdo[0x6040].raw = 0x80
    network.pump(5 * MS)
    assert node.emcy.active == []
    assert [one.code for one in node.emcy.log] == [0x2310, 0x4310, 0]
