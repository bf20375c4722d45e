"""Heartbeat producer 1017h and consumer 1016h (CiA 301, 7.2.8.2.2), to the nanosecond."""

from emulators.canopen.nmt import NmtState
from tests.emulators.canopen.bench_node import MS, Bench, dictionary


def test_heartbeats_follow_the_boot_up_by_whole_periods_and_tell_the_state():
    od = dictionary()
    od.get(0x1017).set_default(100)
    bench = Bench(od)
    bench.run(450 * MS)
    bench.tell(0x000, b"\x01\x00")
    bench.run(550 * MS)
    bench.tell(0x000, b"\x02\x00")
    bench.run(600 * MS)
    assert bench.heard() == [
        (300 * MS, "702 00"),
        (400 * MS, "702 7F"),
        (500 * MS, "702 05"),
        (600 * MS, "702 04"),
    ]


def test_a_thousand_heartbeats_do_not_drift():
    od = dictionary()
    od.get(0x1017).set_default(7)
    bench = Bench(od)
    bench.run(300 * MS + 7000 * MS)
    times = [time_ns for time_ns, _ in bench.heard()]
    assert times == [300 * MS + 7 * MS * n for n in range(1001)]


def test_writing_1017h_starts_heartbeats_at_once_and_0_ends_them():
    bench = Bench().boot()
    bench.tell(0x602, "2B 17 10 00 0A 00 00 00")
    bench.run(320 * MS)
    assert bench.heard() == [
        (300 * MS, "702 7F"),
        (301 * MS, "582 60 17 10 00 00 00 00 00"),
        (310 * MS, "702 7F"),
        (320 * MS, "702 7F"),
    ]
    assert bench.download(0x1017, 0, 0, 2) == ""
    assert bench.node.next_deadline_ns() is None


def test_a_late_caller_gets_one_heartbeat_not_a_burst():
    od = dictionary()
    od.get(0x1017).set_default(10)
    bench = Bench(od).boot()
    bench.now_ns = 355 * MS  # due were 310, 320, ... 350 ms
    bench.node.expire(bench.now_ns)
    bench.drain()
    assert bench.heard() == [(355 * MS, "702 7F")]
    assert bench.node.next_deadline_ns() == 365 * MS


def test_watching_begins_with_the_first_heartbeat():
    bench = Bench().boot()
    assert bench.download(0x1016, 1, 0x0005_0064, 4) == ""  # node 5, 100 ms
    bench.wait(1000 * MS)
    assert "lost" not in bench.host.names()
    bench.tell(0x705, b"\x00")  # its boot-up message counts
    assert bench.node.next_deadline_ns() == bench.now_ns + 100 * MS


def test_a_lost_heartbeat_is_reported_once_on_time_and_ends_operational():
    bench = Bench().operate()
    assert bench.download(0x1016, 2, 0x0005_0064, 4) == ""
    bench.run(400 * MS)
    bench.tell(0x705, b"\x05")
    bench.run(450 * MS)
    bench.tell(0x705, b"\x05")
    bench.run(550 * MS - 1)
    assert bench.node.state == NmtState.OPERATIONAL
    bench.run(2000 * MS)
    lost = [call for call in bench.host.calls if call[0] in ("lost", "nmt")]
    assert lost == [("nmt", 0x7F, 550 * MS), ("lost", 5, 550 * MS)]
    # CiA 301: 8130h life guard or heartbeat error; 1001h generic and communication
    assert bench.heard() == [(550 * MS, "082 30 81 11 05 00 00 00 00")]
    assert bench.od.integer(0x1001, 0, 0) == 0x11


def test_a_heartbeat_that_comes_back_repairs_the_error_and_is_watched_again():
    bench = Bench().operate()
    assert bench.download(0x1016, 1, 0x0005_0064, 4) == ""
    bench.tell(0x705, b"\x05")
    bench.wait(500 * MS)
    bench.frames()
    bench.tell(0x705, b"\x05")
    assert bench.frames() == ["082 00 00 00 00 00 00 00 00"]  # error reset
    assert bench.od.integer(0x1001, 0, 1) == 0
    bench.wait(100 * MS)
    assert bench.frames() == ["082 30 81 11 05 00 00 00 00"]


def test_1029h_says_what_a_lost_heartbeat_does():
    for behaviour, state in ((1, NmtState.OPERATIONAL), (2, NmtState.STOPPED)):
        bench = Bench().operate()
        assert bench.download(0x1029, 1, behaviour, 1) == ""
        assert bench.download(0x1016, 1, 0x0005_0064, 4) == ""
        bench.tell(0x705, b"\x05")
        bench.wait(100 * MS)
        assert bench.node.state == state


def test_several_nodes_are_watched_each_by_its_own_time():
    bench = Bench().boot()
    assert bench.download(0x1016, 1, 0x0005_0064, 4) == ""
    assert bench.download(0x1016, 2, 0x0006_0032, 4) == ""
    start = bench.now_ns
    bench.tell(0x705, b"\x05")
    bench.tell(0x706, b"\x05")
    bench.tell(0x707, b"\x05")  # nobody's business
    bench.wait(200 * MS)
    lost = [call for call in bench.host.calls if call[0] == "lost"]
    assert lost == [("lost", 6, start + 50 * MS), ("lost", 5, start + 100 * MS)]


def test_a_node_watched_twice_is_refused_and_an_entry_may_be_rewritten():
    bench = Bench().boot()
    assert bench.download(0x1016, 1, 0x0005_0064, 4) == ""
    assert bench.download(0x1016, 2, 0x0005_0032, 4) == "0604 0043"
    assert bench.download(0x1016, 1, 0x0005_0032, 4) == ""
    assert bench.download(0x1016, 2, 0x0005_0000, 4) == ""  # no time: not watched


def test_a_lost_node_that_is_no_longer_to_be_watched_is_no_error_any_more():
    bench = Bench().boot()
    assert bench.download(0x1016, 1, 0x0005_0064, 4) == ""
    bench.tell(0x705, b"\x05")
    bench.wait(150 * MS)
    assert bench.od.integer(0x1001, 0, 0) == 0x11
    assert bench.download(0x1016, 1, 0, 4) == ""
    assert bench.od.integer(0x1001, 0, 1) == 0


def test_reset_forgets_whom_it_watched():
    bench = Bench().boot()
    assert bench.download(0x1016, 1, 0x0005_0064, 4) == ""
    bench.tell(0x705, b"\x05")
    bench.tell(0x000, b"\x82\x00")
    bench.wait(1000 * MS)
    assert "lost" not in bench.host.names()
