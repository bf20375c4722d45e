"""TPDOs (CiA 301, 7.2.2): SYNC, events, timers and inhibit time."""

import pytest

from motorhil.emulators.canopen.codes import is_restricted
from tests.support.canopen.node_bench import MS, Bench, dictionary, put_pdo

STATUSWORD, POSITION = 0x6041_0010, 0x6064_0020


def bench_with(
    transmission_type: int,
    inhibit_100us: int = 0,
    event_ms: int = 0,
    entries: tuple[int, ...] = (STATUSWORD, POSITION),
) -> Bench:
    od = dictionary()
    put_pdo(od, 0x1800, entries, transmission_type)
    od.get(0x1800, 3).set_default(inhibit_100us)
    od.get(0x1800, 5).set_default(event_ms)
    return Bench(od).boot()


def start(bench: Bench) -> list[str]:
    bench.tell(0x000, b"\x01\x00")
    return bench.frames()


def change(bench: Bench) -> None:
    bench.node.object_changed(0x6041, 0, bench.now_ns)
    bench.drain()


def test_type_1_is_sampled_at_every_sync_after_device_call():
    bench = bench_with(1)
    assert start(bench) == []
    bench.od.get(0x6064).reader = lambda: 1000 + len(bench.host.calls)
    bench.host.calls.clear()
    bench.tell(0x080)
    # statusword 0240h, position 1002 = 3EAh: read after on_sync and before_read
    assert bench.frames() == ["182 40 02 EA 03 00 00"]
    assert bench.host.names() == ["sync", "read"]


@pytest.mark.parametrize("every", [2, 240])
def test_type_n_is_sampled_at_every_nth_sync(every):
    bench = bench_with(every)
    start(bench)
    sampled = []
    for count in range(1, 3 * every + 1):
        bench.tell(0x080)
        if bench.frames():
            sampled.append(count)
    assert sampled == [every, 2 * every, 3 * every]


def test_type_0_is_sampled_at_sync_after_event():
    bench = bench_with(0)
    assert start(bench) == []
    bench.tell(0x080)  # initial state, once
    assert len(bench.frames()) == 1
    bench.tell(0x080)
    assert bench.frames() == []
    change(bench)
    assert bench.frames() == []
    bench.tell(0x080)
    bench.tell(0x080)
    assert len(bench.frames()) == 1


@pytest.mark.parametrize("transmission_type", [254, 255])
def test_event_driven_tpdo_sends_initial_state_and_events(transmission_type):
    bench = bench_with(transmission_type)
    assert start(bench) == ["182 40 02 00 00 00 00"]
    bench.tell(0x080)
    assert bench.frames() == []
    bench.od.get(0x6041).value = 0x0231
    change(bench)
    assert bench.frames() == ["182 31 02 00 00 00 00"]
    bench.node.object_changed(0x6040, 0, bench.now_ns)  # not mapped
    bench.drain()
    assert bench.frames() == []
    assert bench.node.next_deadline_ns() is None


def test_events_in_inhibit_time_become_one_tpdo():
    bench = bench_with(255, inhibit_100us=50)  # 5 ms
    start(bench)
    begin = bench.now_ns
    bench.wait(1 * MS)
    change(bench)
    bench.wait(1 * MS)
    bench.od.get(0x6041).value = 0x0637
    change(bench)
    assert bench.heard() == []
    bench.wait(20 * MS)
    assert bench.heard() == [(begin + 5 * MS, "182 37 06 00 00 00 00")]
    change(bench)  # long after the inhibit time
    assert bench.heard() == [(begin + 22 * MS, "182 37 06 00 00 00 00")]


def test_event_at_end_of_inhibit_time_is_sent_at_once():
    bench = bench_with(255, inhibit_100us=50)
    start(bench)
    begin = bench.now_ns
    bench.run(begin + 5 * MS - 1)
    change(bench)
    assert bench.heard() == []
    bench.run(begin + 5 * MS)
    assert bench.heard() == [(begin + 5 * MS, "182 40 02 00 00 00 00")]
    bench.run(begin + 10 * MS)
    change(bench)
    assert bench.heard() == [(begin + 10 * MS, "182 40 02 00 00 00 00")]


def test_event_timer_is_exact_and_restarted_by_event():
    bench = bench_with(255, event_ms=20)
    start(bench)
    begin = bench.now_ns
    bench.run(begin + 50 * MS)
    change(bench)
    bench.run(begin + 90 * MS)
    times = [(time_ns - begin) // MS for time_ns, _ in bench.heard()]
    assert times == [20, 40, 50, 70, 90]
    assert bench.node.next_deadline_ns() == begin + 110 * MS


def test_event_timer_shorter_than_inhibit_time_yields():
    bench = bench_with(255, inhibit_100us=100, event_ms=4)
    start(bench)
    begin = bench.now_ns
    bench.wait(30 * MS)
    assert [(time_ns - begin) // MS for time_ns, _ in bench.heard()] == [10, 20, 30]


def test_synchronous_tpdo_ignores_event_timer():
    bench = bench_with(1, event_ms=20)
    start(bench)
    assert bench.node.next_deadline_ns() is None


def test_leaving_operational_stops_tpdos_and_timers():
    bench = bench_with(255, event_ms=20)
    change(bench)
    assert bench.heard() == []
    start(bench)
    bench.tell(0x000, b"\x80\x00")
    assert bench.node.next_deadline_ns() is None
    change(bench)
    assert bench.heard() == []
    assert start(bench) == ["182 40 02 00 00 00 00"]  # initial state again


@pytest.mark.parametrize("transmission_type", [254, 255])
def test_event_driven_tpdo_waits_for_previous_one(transmission_type):
    bench = bench_with(transmission_type)
    bench.is_bus_stuck = True
    assert len(start(bench)) == 1
    for value in (1, 2, 3):
        bench.wait(1 * MS)
        bench.od.get(0x6041).value = value
        change(bench)
    assert bench.frames() == []
    bench.is_bus_stuck = False
    bench.node.sent(bytes.fromhex("82010000 06000000") + bytes(8), bench.now_ns)
    bench.drain()
    assert bench.frames() == ["182 03 00 00 00 00 00"]  # the latest, not all of them


def test_event_timer_resumes_with_stuck_bus():
    bench = bench_with(255, event_ms=10)
    bench.is_bus_stuck = True
    start(bench)
    bench.wait(35 * MS)
    assert bench.heard() == []
    bench.is_bus_stuck = False
    bench.node.sent(bytes.fromhex("82010000 06000000") + bytes(8), bench.now_ns)
    bench.drain()
    freed = bench.now_ns
    bench.wait(20 * MS)
    assert [time_ns - freed for time_ns, _ in bench.heard()] == [0, 10 * MS, 20 * MS]


def test_synchronous_tpdo_on_full_bus_is_dropped_once_reported():
    bench = bench_with(1)
    start(bench)
    bench.node.take_events()
    bench.is_bus_stuck = True
    for _ in range(3):
        bench.tell(0x080)
    assert len(bench.frames()) == 1
    events = bench.node.take_events()
    assert [level for level, _ in events] == ["warning"]
    assert events[0][1].startswith("TPDO 1 had not left the bus")
    bench.is_bus_stuck = False
    bench.node.sent(bytes.fromhex("82010000 06000000") + bytes(8), bench.now_ns)
    bench.tell(0x080)
    assert len(bench.frames()) == 1


def test_bits_24_bit_integers_and_reals_are_packed():
    entries = (0x2003_0001, 0x2004_0018, 0x2005_0020)
    bench = bench_with(1, entries=entries)
    start(bench)
    bench.od.get(0x2003).value = 1
    bench.od.get(0x2004).value = -2
    bench.od.get(0x2005).value = 1.5
    bench.tell(0x080)
    payload = 1 | 0xFF_FFFE << 1 | 0x3FC0_0000 << 25  # by hand, as in test_rpdo
    assert bench.frames() == ["182 " + payload.to_bytes(8, "little").hex(" ").upper()]


def test_reader_value_is_cut_to_object():
    bench = bench_with(1)
    start(bench)
    bench.od.get(0x6064).reader = lambda: (1 << 31) + 5
    bench.tell(0x080)
    assert bench.frames() == ["182 40 02 05 00 00 80"]


def test_eight_bytes_fit():
    bench = bench_with(1, entries=(0x2006_0040,))
    start(bench)
    bench.od.get(0x2006).value = 0x8877_6655_4433_2211
    bench.tell(0x080)
    assert bench.frames() == ["182 11 22 33 44 55 66 77 88"]


def test_new_sync_identifier_is_used_at_once():
    bench = bench_with(1)
    start(bench)
    assert bench.download(0x1005, 0, 0x0000_0085, 4) == ""
    bench.tell(0x080)
    assert bench.frames() == []
    bench.tell(0x085)
    assert len(bench.frames()) == 1
    assert bench.download(0x1005, 0, 0x4000_0085, 4) == "0609 0030"  # without 1006h


def test_tpdos_of_sync_are_ordered_with_one_device_call():
    od = dictionary()
    put_pdo(od, 0x1800, (STATUSWORD,), 1)
    put_pdo(od, 0x1801, (POSITION,), 1)
    bench = Bench(od).operate()
    bench.tell(0x080)
    assert bench.frames() == ["182 40 02", "282 00 00 00 00"]
    assert bench.host.names() == ["sync", "read"]


def test_vendor_mapping_is_sign_extended_or_cut():
    bench = bench_with(1, entries=(0x2006_0020, 0x2004_0020))  # UNSIGNED64, INTEGER24
    start(bench)
    bench.od.get(0x2006).value = 0x1_0000_0005
    bench.od.get(0x2004).value = -2
    bench.tell(0x080)
    assert bench.frames() == ["182 05 00 00 00 FE FF FF FF"]
    bench.od.get(0x2006).value = 7
    bench.tell(0x080)
    assert bench.frames() == ["182 07 00 00 00 FE FF FF FF"]


# --- on request (CiA 301, 7.2.2.5.2: transmission types 252, 253; bit 30 of the COB-ID)

ASK = 0x4000_0182  # the remote frame, as Linux has it


def test_type_252_answers_with_sample_of_last_sync():
    bench = bench_with(252)
    assert start(bench) == []
    bench.tell(ASK)
    assert bench.frames() == []  # no SYNC has come yet
    place = [1000]
    bench.od.get(0x6064).reader = lambda: place[0]
    bench.tell(0x080)
    place[0] = 2000
    assert bench.frames() == []
    bench.tell(ASK)
    bench.tell(ASK)
    assert bench.frames() == ["182 40 02 E8 03 00 00"] * 2
    bench.tell(0x080)
    bench.tell(ASK)
    assert bench.frames() == ["182 40 02 D0 07 00 00"]


def test_type_253_answers_with_current_values_only():
    bench = bench_with(253, event_ms=5)
    assert start(bench) == []
    change(bench)
    bench.tell(0x080)
    bench.wait(100 * MS)
    assert bench.frames() == []
    bench.od.get(0x6064).reader = lambda: 3
    bench.tell(ASK)
    assert bench.frames() == ["182 40 02 03 00 00 00"]


def test_tpdo_answers_unless_cob_id_forbids_it():
    bench = bench_with(255)
    start(bench)
    bench.tell(ASK)
    assert bench.frames() == ["182 40 02 00 00 00 00"]
    assert bench.download(0x1800, 1, 0x4000_0182, 4) == ""
    bench.frames()
    bench.tell(ASK)
    assert bench.frames() == []
    assert ASK not in bench.node.identifiers()


@pytest.mark.parametrize("transmission_type", [252, 253])
def test_tpdo_in_flight_is_the_answer(transmission_type):
    bench = bench_with(transmission_type)
    start(bench)
    bench.tell(0x080)
    bench.is_bus_stuck = True
    for _ in range(3):
        bench.tell(ASK)
    assert len(bench.frames()) == 1


@pytest.mark.parametrize("command", [0x80, 0x02])
def test_request_outside_operational_is_ignored(command):
    bench = bench_with(253)
    start(bench)
    bench.tell(0x000, bytes((command, 0)))
    bench.tell(ASK)
    assert bench.frames() == []


def test_sample_is_dropped_on_leaving_operational():
    bench = bench_with(252)
    start(bench)
    bench.tell(0x080)
    bench.tell(0x000, b"\x80\x00")
    start(bench)
    bench.tell(ASK)
    assert bench.frames() == []


RESTRICTED = (  # CiA 301, 7.3.5, restricted CAN-IDs
    *((0x000, 0x07F), (0x101, 0x180), (0x581, 0x5FF), (0x601, 0x67F), (0x6E0, 0x6FF)),
    (0x701, 0x7FF),
)


@pytest.mark.parametrize(("first", "last"), RESTRICTED)
def test_restricted_identifiers_are_those_of_the_standard(first, last):
    assert (is_restricted(first), is_restricted(last)) == (True, True)
    assert not first or not is_restricted(first - 1)
    assert last == 0x7FF or not is_restricted(last + 1)
