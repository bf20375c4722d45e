"""SYNC: counter, window, producer, refusals (CiA 301, 7.2.5; 1005h to 1007h, 1019h).

Error codes are those of CiA 301's table of EMCY error codes. Refusal codes are as in CANopenNode
(301/CO_SYNC.c, CO_PDO.c).
"""

import pytest

from motorhil.emulators.canopen.object_dictionary import ObjectDictionary
from tests.support.canopen.node_bench import (
    MS,
    UNSIGNED8,
    UNSIGNED32,
    Bench,
    dictionary,
    put,
    put_pdo,
)

US = 1000
STATUSWORD, TARGET = 0x6041_0010, 0x607A_0020
GENERATE, INVALID = 0x4000_0000, 0x8000_0000


def whole(period_us: int = 0, window_us: int = 0, overflow: int = 0) -> ObjectDictionary:
    """Return a dictionary with all objects of SYNC, one synchronous RPDO and TPDO."""
    od = dictionary()
    put(od, 0x1006, 0, UNSIGNED32, period_us)
    put(od, 0x1007, 0, UNSIGNED32, window_us)
    put(od, 0x1019, 0, UNSIGNED8, overflow)
    put_pdo(od, 0x1400, (TARGET,), 1)
    put_pdo(od, 0x1800, (STATUSWORD,), 1)
    put(od, 0x1800, 6, UNSIGNED8, 0)
    return od


def test_sync_of_wrong_length_is_ignored_with_one_emcy_8240h():
    bench = Bench(whole()).operate()
    bench.tell(0x080, "01")
    bench.tell(0x080, "02")
    # 8240h, register generic + communication; ours adds the number of bytes received
    assert bench.frames() == ["082 40 82 11 01 00 00 00 00"]
    assert ("sync", bench.now_ns) not in bench.host.calls
    bench.tell(0x080)
    assert bench.frames() == ["082 00 00 00 00 00 00 00 00", "182 40 02"]


def test_sync_without_counter_is_wrong_if_1019h_is_set():
    bench = Bench(whole(overflow=4)).operate()
    bench.tell(0x080)
    assert bench.frames() == ["082 40 82 11 00 00 00 00 00"]
    bench.tell(0x080, "01")
    assert bench.frames() == ["082 00 00 00 00 00 00 00 00", "182 40 02"]


def test_sync_length_matters_in_pre_operational():
    bench = Bench(whole()).boot()
    bench.tell(0x080, "01")
    assert bench.frames() == ["082 40 82 11 01 00 00 00 00"]
    bench.tell(0x080)
    assert bench.frames() == ["082 00 00 00 00 00 00 00 00"]
    assert bench.host.calls == []


@pytest.mark.parametrize(
    ("kind", "start", "sent_at"),
    [
        (2, 0, [2, 4, 6, 8]),  # without: every second one
        (2, 1, [1, 3, 5, 7]),
        (4, 3, [3, 7]),
        (1, 4, [4, 5, 6, 7, 8]),
    ],
)
def test_tpdo_starts_at_sync_start_value(kind, start, sent_at):
    od = whole(overflow=8)
    od.get(0x1800, 2).default = kind
    od.get(0x1800, 6).default = start
    bench = Bench(od).operate()
    found = []
    for counter in range(1, 9):
        bench.tell(0x080, bytes((counter,)))
        if bench.frames():
            found.append(counter)
    assert found == sent_at


def test_sync_start_value_without_counter_has_no_effect():
    od = whole()
    od.get(0x1800, 6).default = 200
    bench = Bench(od).operate()
    bench.tell(0x080)
    assert bench.frames() == ["182 40 02"]


def test_rpdo_after_window_is_ignored_until_next_sync():
    bench = Bench(whole(window_us=1000)).operate()
    bench.tell(0x202, "01 00 00 00")  # no SYNC yet: no window
    bench.tell(0x080)
    assert bench.od.integer(0x607A, 0, 0) == 1
    bench.wait(1000 * US)
    bench.tell(0x202, "02 00 00 00")  # the window's last instant
    bench.wait(1)
    bench.tell(0x202, "03 00 00 00")
    bench.tell(0x202, "04 00 00 00")
    bench.tell(0x080)
    assert bench.od.integer(0x607A, 0, 0) == 2
    late = [text for _, text in bench.node.take_events()]
    assert late == ["RPDO 1 came 0.001 us after its window: left out"]
    bench.tell(0x202, "05 00 00 00")
    bench.wait(1000 * US + 2)
    bench.tell(0x202, "06 00 00 00")  # late again, after one that was not
    assert len(bench.node.take_events()) == 1


def test_window_of_0_never_closes():
    bench = Bench(whole()).operate()
    bench.tell(0x080)
    bench.wait(500 * MS)
    bench.tell(0x202, "05 00 00 00")
    bench.tell(0x080)
    assert bench.od.integer(0x607A, 0, 0) == 5


def test_event_driven_rpdo_ignores_window():
    od = whole(window_us=1000)
    od.get(0x1400, 2).default = 255
    bench = Bench(od).operate()
    bench.tell(0x080)
    bench.wait(5 * MS)
    bench.tell(0x202, "07 00 00 00")
    assert bench.od.integer(0x607A, 0, 0) == 7


def test_tpdo_leaving_bus_after_window_is_reported():
    bench = Bench(whole(window_us=1000)).operate()
    bench.is_bus_stuck = True
    bench.tell(0x080)
    frame = bytes.fromhex("82010000 02000000 4002000000000000".replace(" ", ""))
    bench.now_ns += 1000 * US + 1
    bench.node.sent(frame, bench.now_ns)
    bench.drain()
    assert bench.frames() == ["182 40 02", "082 00 81 11 01 00 00 00 00"]
    bench.is_bus_stuck = False
    bench.tell(0x080)  # the next one leaves at once
    assert bench.frames() == ["182 40 02", "082 00 00 00 00 00 00 00 00"]


def test_producer_sends_sync_from_pre_operational_on():
    od = whole(period_us=10_000, overflow=3)
    od.get(0x1005).default = GENERATE | 0x80
    bench = Bench(od)
    bench.run(345 * MS)
    # the first one cycle after boot-up at 300 ms
    assert bench.heard() == [
        (300 * MS, "702 00"),
        *((at * MS, f"080 0{n}") for at, n in ((310, 1), (320, 2), (330, 3), (340, 1))),
    ]
    bench.tell(0x000, b"\x02\x00")
    bench.wait(50 * MS)
    assert bench.heard() == []
    bench.tell(0x000, b"\x80\x00")
    bench.wait(10 * MS)
    assert bench.frames() == ["080 01"]


def test_producer_processes_own_pdos_with_its_sync():
    od = whole(period_us=10_000)
    od.get(0x1005).default = GENERATE | 0x80
    bench = Bench(od).operate()
    bench.tell(0x202, "09 00 00 00")
    assert bench.od.integer(0x607A, 0, 0) == 0
    bench.wait(10 * MS)
    assert bench.frames() == ["080", "182 40 02"]
    assert bench.od.integer(0x607A, 0, 0) == 9


def test_new_period_starts_at_write_and_0_ends_it():
    bench = Bench(whole()).boot()
    assert bench.download(0x1005, 0, GENERATE | 0x80, 4) == ""
    bench.wait(100 * MS)
    assert bench.frames() == []
    written_at = bench.now_ns
    assert bench.download(0x1006, 0, 20_000, 4) == ""
    bench.run(written_at + 45 * MS)
    assert bench.heard() == [(written_at + at * MS, "080") for at in (20, 40)]
    assert bench.download(0x1006, 0, 0, 4) == ""
    bench.wait(100 * MS)
    assert bench.frames() == []


@pytest.mark.parametrize(
    ("value", "code"),
    [(0, ""), (1, "0609 0030"), (2, ""), (240, ""), (241, "0609 0030"), (255, "0609 0030")],
)
def test_1019h_accepts_0_and_2_to_240(value, code):
    bench = Bench(whole()).boot()
    assert bench.download(0x1019, 0, value, 1) == code


def test_1019h_is_locked_while_1006h_is_set():
    bench = Bench(whole(period_us=1000)).boot()
    assert bench.download(0x1019, 0, 4, 1) == "0800 0022"
    assert bench.download(0x1006, 0, 0, 4) == ""
    assert bench.download(0x1019, 0, 4, 1) == ""


def test_producer_identifier_is_locked():
    bench = Bench(whole()).boot()
    assert bench.download(0x1005, 0, GENERATE | 0x81, 4) == ""
    assert bench.download(0x1005, 0, GENERATE | 0x82, 4) == "0609 0030"
    assert bench.download(0x1005, 0, 0x82, 4) == ""
    assert bench.download(0x1005, 0, GENERATE | 0x82, 4) == ""


@pytest.mark.parametrize("cob_id", [GENERATE | 0x80, 0x2000_0080, 0x0000_0601])
def test_1005h_of_node_without_producer_refuses_bit_30(cob_id):
    bench = Bench().boot()  # without 1006h
    assert bench.download(0x1005, 0, cob_id, 4) == "0609 0030"


def test_period_below_100_us_is_refused():
    bench = Bench(whole()).boot()
    assert bench.download(0x1006, 0, 99, 4) == "0609 0032"
    assert bench.download(0x1006, 0, 100, 4) == ""


def test_sync_start_value_is_0_to_240_and_locked_when_valid():
    bench = Bench(whole()).boot()
    assert bench.download(0x1800, 6, 2, 1) == "0609 0030"
    assert bench.download(0x1800, 1, INVALID | 0x182, 4) == ""
    assert bench.download(0x1800, 6, 241, 1) == "0609 0030"
    assert bench.download(0x1800, 6, 240, 1) == ""


# --- deadline monitoring of RPDOs (140Xh:5)


def awaited(kind: int) -> Bench:
    od = whole()
    od.get(0x1400, 2).default = kind
    od.get(0x1400, 5).default = 20
    return Bench(od).operate()


@pytest.mark.parametrize("kind", [1, 254, 255])
def test_missing_rpdo_is_reported_once_by_emcy_8250h(kind):
    bench = awaited(kind)
    bench.wait(100 * MS)
    assert bench.frames() == []  # the first one starts it
    bench.tell(0x202, "01 00 00 00")
    started_at = bench.now_ns
    bench.run(started_at + 20 * MS - 1)
    assert bench.heard() == []
    bench.wait(50 * MS)
    assert bench.heard() == [(started_at + 20 * MS, "082 50 82 11 01 00 00 00 00")]
    assert bench.node.take_events() == [("warning", "RPDO 1 did not come for 20 ms")]
    bench.tell(0x202, "02 00 00 00")
    assert bench.frames() == ["082 00 00 00 00 00 00 00 00"]
    bench.tell(0x000, b"\x80\x00")  # no RPDO is awaited without PDOs
    bench.wait(50 * MS)
    assert bench.frames() == []


def test_rpdo_in_time_is_never_missed():
    bench = awaited(255)
    for value in range(10):
        bench.tell(0x202, bytes((value, 0, 0, 0)))
        bench.wait(20 * MS - 1)
    assert bench.frames() == []
