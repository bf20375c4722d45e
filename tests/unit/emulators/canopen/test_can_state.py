"""Error messages of the CAN controller: EMCY 8120h and 8140h, 1029h, bus-off.

EMCY: CiA 301, 7.2.7 (code, 1001h, five bytes of the vendor), codes of table 26. Error messages are
written here as candump shows them on SocketCAN: identifier with its classes, eight bytes, of which
[1] is the controller's state, [6] TEC, [7] REC (linux/can/error.h).
"""

import pytest

from motorhil.emulators.can.error_confinement import CONTROLLER, TX_PASSIVE, pack_error
from motorhil.emulators.canopen.emcy import CanState, state_in
from motorhil.emulators.canopen.nmt import NmtState
from tests.support.canopen.node_bench import MS, Bench, dictionary, frame, put_pdo

PASSIVE = (0x2000_0204, "00 20 00 00 00 00 80 00")
PASSIVE_BY_HEARING = (0x2000_0204, "00 10 00 00 00 00 00 87")
WARNING = (0x2000_0204, "00 08 00 00 00 00 7F 00")
ACTIVE = (0x2000_0004, "00 40 00 00 00 00 00 00")
OFF = (0x2000_0040, "00 00 00 00 00 00 00 00")
RESTARTED = (0x2000_0100, "00 00 00 00 00 00 00 00")
NO_ACKNOWLEDGE = (0x2000_0020, "00 00 00 00 00 00 00 00")
BIT_ERROR = (0x2000_0088, "00 00 90 0A 00 00 00 00")  # bit1 error while sending data
OVERFLOW = (0x2000_0004, "00 01 00 00 00 00 00 00")

IS_PASSIVE = "082 20 81 11 00 00 00 00 00"
IS_OVER = "082 00 00 00 00 00 00 00 00"
WAS_OFF = "082 40 81 11 00 00 00 00 00"


def history(bench: Bench) -> list[int]:
    """Return 1003h, newest first."""
    count = bench.od.integer(0x1003, 0, 0)
    return [bench.od.integer(0x1003, sub, 0) for sub in range(1, count + 1)]


@pytest.mark.parametrize("message", [PASSIVE, PASSIVE_BY_HEARING])
@pytest.mark.parametrize("back", [ACTIVE, WARNING, RESTARTED])
def test_error_passive_is_reported_until_repaired(message, back):
    bench = Bench().operate()
    bench.tell(*message)
    assert bench.frames() == [IS_PASSIVE]
    assert bench.od.integer(0x1001, 0, 0) == 0x11
    assert history(bench) == [0x8120]
    assert bench.node.state == NmtState.OPERATIONAL  # 1029h concerns worse errors
    bench.tell(*message)
    bench.tell(*PASSIVE_BY_HEARING)
    assert bench.frames() == []  # reported once
    bench.tell(*back)
    assert bench.frames() == [IS_OVER]
    assert bench.od.integer(0x1001, 0, 0) == 0
    assert history(bench) == [0x8120]


@pytest.mark.parametrize("message", [ACTIVE, WARNING, RESTARTED, NO_ACKNOWLEDGE, BIT_ERROR])
def test_message_without_state_change_is_not_reported(message):
    bench = Bench().operate()
    bench.tell(*message)
    bench.tell(*OVERFLOW)
    assert bench.frames() == []
    assert history(bench) == []


def test_single_errors_and_overflows_keep_error_passive():
    bench = Bench().operate()
    for message in (PASSIVE, NO_ACKNOWLEDGE, BIT_ERROR, OVERFLOW):
        bench.tell(*message)
    assert bench.frames() == [IS_PASSIVE]


@pytest.mark.parametrize(
    ("behaviour", "state"),
    [
        (0, NmtState.PRE_OPERATIONAL),
        (1, NmtState.OPERATIONAL),
        (2, NmtState.STOPPED),
    ],
)
def test_bus_off_is_communication_error_to_1029h(behaviour, state):
    od = dictionary()
    od.get(0x1029, 1).set_default(behaviour)
    bench = Bench(od).operate()
    bench.tell(*OFF)
    assert bench.node.state == state
    assert ("bus-off", 300 * MS) in bench.host.calls
    assert bench.frames() == []
    assert history(bench) == []  # no EMCY, no history
    bench.host.calls.clear()
    bench.tell(*OFF)
    assert bench.host.calls == []  # reported once
    bench.tell(*RESTARTED)
    assert bench.frames() == ([WAS_OFF, IS_OVER] if state != NmtState.STOPPED else [])
    assert history(bench) == [0x8140]
    assert bench.od.integer(0x1001, 0, 0) == 0
    assert bench.node.state == state  # it recovers its state without booting


def test_1029h_in_stopped_and_pre_operational_has_no_effect():
    bench = Bench().boot()
    bench.tell(*OFF)
    assert bench.node.state == NmtState.PRE_OPERATIONAL
    assert bench.host.names() == ["bus-off"]


def test_bus_off_node_is_silent_and_keeps_newest_frames():
    od = dictionary()
    od.get(0x1029, 1).set_default(1)
    od.get(0x1017).set_default(100)
    put_pdo(od, 0x1800, (0x6041_0010,), 255)
    bench = Bench(od).operate()
    bench.is_bus_stuck = True
    bench.tell(*OFF)
    bench.wait(1000 * MS)
    bench.node.emergency(0x2310, 0x03, b"", bench.now_ns)
    bench.node.emergency(0x0000, 0x00, b"", bench.now_ns)
    bench.drain()
    assert bench.frames() == []
    bench.tell(*RESTARTED)
    assert bench.frames() == [
        "702 05",  # one of eleven
        "082 10 23 03 00 00 00 00 00",
        IS_OVER,
        WAS_OFF,
        IS_OVER,
    ]
    bench.wait(100 * MS)
    assert bench.frames() == ["702 05"]


@pytest.mark.parametrize(("transmission_type", "after"), [(255, ["182 40 02"]), (1, [])])
def test_tpdo_lost_at_bus_off_is_not_awaited(transmission_type, after):
    od = dictionary()
    od.get(0x1029, 1).set_default(1)
    put_pdo(od, 0x1800, (0x6041_0010,), transmission_type)
    bench = Bench(od).boot()
    bench.is_bus_stuck = True  # its frames never leave the bus queue
    bench.tell(0x000, b"\x01\x02")
    bench.tell(0x080)
    assert bench.frames() == ["182 40 02"]
    bench.tell(*OFF)
    bench.is_bus_stuck = False
    bench.tell(*RESTARTED)
    assert bench.frames() == [*after, WAS_OFF, IS_OVER]
    bench.node.object_changed(0x6041, 0, bench.now_ns)
    bench.drain()
    bench.tell(0x080)
    assert bench.frames() == ["182 40 02"]
    assert list(bench.node.take_events())[-1] == ("info", "recovered from bus-off")


def test_boot_up_of_bus_off_node_waits_for_recovery():
    bench = Bench()
    bench.tell(*OFF)
    bench.run(400 * MS)
    assert bench.frames() == []
    bench.tell(*RESTARTED)
    assert bench.frames() == ["702 00", WAS_OFF, IS_OVER]


def test_passive_then_bus_off_recovers_to_passive():
    bench = Bench().operate()
    for message in (PASSIVE, OFF, PASSIVE, ACTIVE):
        bench.tell(*message)
    assert bench.frames() == [IS_PASSIVE, WAS_OFF, IS_OVER, IS_PASSIVE, IS_OVER]
    assert history(bench) == [0x8120, 0x8140, 0x8120]


@pytest.mark.parametrize("command", [0x81, 0x82])
def test_node_reset_keeps_bus_off(command):
    bench = Bench().operate()
    bench.tell(*PASSIVE)
    bench.tell(0x000, bytes((command, 2)))
    bench.wait(300 * MS)
    assert bench.od.integer(0x1001, 0, 0) == 0x11
    bench.frames()
    bench.tell(*ACTIVE)
    assert bench.frames() == [IS_OVER]


def test_can_state_changes_are_events():
    bench = Bench().operate()
    for message in (PASSIVE, ACTIVE, (0x2000_0240, "00 00 00 00 00 00 FF 00"), RESTARTED):
        bench.tell(*message)
    assert list(bench.node.take_events()) == [
        ("warning", "CAN error passive (TEC 128, REC 0)"),
        ("info", "CAN error active again"),
        ("error", "bus-off (TEC 255, REC 0)"),
        ("info", "recovered from bus-off"),
    ]


def test_error_messages_are_requested_in_every_state():
    bench = Bench()
    assert 0x2000_0000 in bench.node.identifiers()
    assert 0x2000_0000 in bench.operate().node.identifiers()


def test_messages_of_medium_are_understood():
    assert pack_error(CONTROLLER, controller=TX_PASSIVE, counters=(128, 0)) == frame(*PASSIVE)
    assert state_in(frame(*PASSIVE)) is CanState.PASSIVE
    assert state_in(frame(*BIT_ERROR)) is None
