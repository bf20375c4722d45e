"""Heartbeat producer 1017h and consumer 1016h (CiA 301, 7.2.8.2.2), to the nanosecond."""

from motorhil.emulators.canopen.nmt import NmtState
from tests.support.canopen.node_bench import MS, Bench, dictionary


def test_heartbeats_follow_boot_up_with_state():
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


def test_thousand_heartbeats_do_not_drift():
    od = dictionary()
    od.get(0x1017).set_default(7)
    bench = Bench(od)
    bench.run(300 * MS + 7000 * MS)
    times = [time_ns for time_ns, _ in bench.heard()]
    assert times == [300 * MS + 7 * MS * n for n in range(1001)]


def test_1017h_write_starts_heartbeats_and_0_ends_them():
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


def test_late_caller_gets_one_heartbeat():
    od = dictionary()
    od.get(0x1017).set_default(10)
    bench = Bench(od).boot()
    bench.now_ns = 355 * MS  # due were 310, 320, ... 350 ms
    bench.node.expire(bench.now_ns)
    bench.drain()
    assert bench.heard() == [(355 * MS, "702 7F")]
    assert bench.node.next_deadline_ns() == 365 * MS


def test_consumer_starts_with_first_heartbeat():
    bench = Bench().boot()
    assert bench.download(0x1016, 1, 0x0005_0064, 4) == ""  # node 5, 100 ms
    bench.wait(1000 * MS)
    assert "lost" not in bench.host.names()
    bench.tell(0x705, b"\x00")  # its boot-up message counts
    assert bench.node.next_deadline_ns() == bench.now_ns + 100 * MS


def test_lost_heartbeat_is_reported_once_and_ends_operational():
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


def test_returning_heartbeat_repairs_error_and_is_watched():
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


def test_lost_heartbeat_follows_1029h():
    for behaviour, state in ((1, NmtState.OPERATIONAL), (2, NmtState.STOPPED)):
        bench = Bench().operate()
        assert bench.download(0x1029, 1, behaviour, 1) == ""
        assert bench.download(0x1016, 1, 0x0005_0064, 4) == ""
        bench.tell(0x705, b"\x05")
        bench.wait(100 * MS)
        assert bench.node.state == state


def test_nodes_are_watched_by_their_own_times():
    bench = Bench().boot()
    assert bench.download(0x1016, 1, 0x0005_0064, 4) == ""
    assert bench.download(0x1016, 2, 0x0006_0032, 4) == ""
    start = bench.now_ns
    bench.tell(0x705, b"\x05")
    bench.tell(0x706, b"\x05")
    bench.tell(0x707, b"\x05")  # not watched
    bench.wait(200 * MS)
    lost = [call for call in bench.host.calls if call[0] == "lost"]
    assert lost == [("lost", 6, start + 50 * MS), ("lost", 5, start + 100 * MS)]


def test_duplicate_node_is_refused_and_rewrite_accepted():
    bench = Bench().boot()
    assert bench.download(0x1016, 1, 0x0005_0064, 4) == ""
    assert bench.download(0x1016, 2, 0x0005_0032, 4) == "0604 0043"
    assert bench.download(0x1016, 1, 0x0005_0032, 4) == ""
    assert bench.download(0x1016, 2, 0x0005_0000, 4) == ""  # no time: not watched


def test_lost_node_removed_from_1016h_is_repaired():
    bench = Bench().boot()
    assert bench.download(0x1016, 1, 0x0005_0064, 4) == ""
    bench.tell(0x705, b"\x05")
    bench.wait(150 * MS)
    assert bench.od.integer(0x1001, 0, 0) == 0x11
    assert bench.download(0x1016, 1, 0, 4) == ""
    assert bench.od.integer(0x1001, 0, 1) == 0


def test_1016h_write_leaves_other_entries_as_they_are():
    bench = Bench().boot()
    assert bench.download(0x1016, 1, 0x0005_0064, 4) == ""
    assert bench.download(0x1016, 2, 0x0006_00C8, 4) == ""
    bench.tell(0x705, b"\x05")
    bench.wait(150 * MS)
    bench.tell(0x706, b"\x05")
    assert bench.download(0x1016, 2, 0x0006_00C8, 4) == ""  # not heard since
    assert bench.od.integer(0x1001, 0, 0) == 0x11  # node 5 is still lost
    bench.wait(300 * MS)
    lost = [call for call in bench.host.calls if call[0] == "lost"]
    assert [node_id for _, node_id, _ in lost] == [5]
    bench.tell(0x706, b"\x05")
    start = bench.now_ns
    assert bench.download(0x1016, 1, 0x0005_0064, 4) == ""
    assert bench.od.integer(0x1001, 0, 1) == 0
    bench.wait(300 * MS)
    assert bench.host.calls[-1] == ("lost", 6, start + 200 * MS)


def test_reset_clears_watched_nodes():
    bench = Bench().boot()
    assert bench.download(0x1016, 1, 0x0005_0064, 4) == ""
    bench.tell(0x705, b"\x05")
    bench.tell(0x000, b"\x82\x00")
    bench.wait(1000 * MS)
    assert "lost" not in bench.host.names()
