import pytest

from motorhil.emulators.can.bus.bus import CanBus
from motorhil.emulators.can.bus.port import DELIVERED
from motorhil.emulators.can.controller_config import CanNode, QueueOrder
from motorhil.emulators.can.frame import EFF_FLAG, RTR_FLAG, pack, pack_remote
from motorhil.emulators.can.frame_length import frame_bits
from tests.support.can.deliveries import BIT, confirmed, expire_all, heard, run

# Exact lengths with intermission: can-physics.md 6.2 (can-utils).
SYNC = pack(0x080)  # 51 bits
STATUS = pack(0x181, bytes.fromhex("3706"))  # 66 bits
HEARTBEAT = pack(0x701, b"\x05")  # 58 bits
COMMAND = pack(0x201, bytes.fromhex("0F0010270000"))  # 104 bits


def _bus(*names: str, queue: QueueOrder = QueueOrder.FIFO) -> CanBus:
    bus = CanBus("can0")
    for name in names:
        bus.attach(name, CanNode(queue))
    bus.attach("ear")  # a node that acknowledges
    return bus


def _sent(deliveries):
    return [(time_ns, frame) for time_ns, (frame, _, _) in deliveries]


@pytest.mark.parametrize(
    "bitrate_bit_s",
    [1_000_000, 800_000, 500_000, 250_000, 125_000, 100_000, 50_000, 20_000, 10_000],
)
def test_frame_on_idle_bus_takes_its_bits(bitrate_bit_s):
    bus = CanBus("can0", bitrate_bit_s)
    port = bus.attach("left")
    bus.attach("ear")
    bus.submit(port, STATUS, 7)
    end_ns = 7 + 63 * (10**9 // bitrate_bit_s)
    assert bus.next_deadline_ns() == end_ns
    assert bus.expire(end_ns - 1) == []
    assert bus.expire(end_ns) == [(STATUS, port, DELIVERED)]
    assert bus.expire(end_ns) == []
    assert bus.next_deadline_ns() is None


@pytest.mark.parametrize("bitrate_bit_s", [0, -1, 83_333, 300_000])
def test_bit_of_fractional_nanoseconds_is_refused(bitrate_bit_s):
    with pytest.raises(ValueError, match=f"{bitrate_bit_s} bit/s"):
        CanBus("can0", bitrate_bit_s)


def test_next_frame_starts_after_intermission():
    bus = _bus("left", "right")
    assert _sent(run(bus, [(0, 0, SYNC), (0, 1, STATUS)])) == [
        (48 * BIT, SYNC),
        ((51 + 63) * BIT, STATUS),
    ]


def test_frame_submitted_in_intermission_waits_for_its_end():
    for wait_ns, start_ns in ((0, 51), (2 * BIT, 51), (3 * BIT, 51), (3 * BIT + 1, 51)):
        bus = _bus("left")
        run(bus, [(0, 0, SYNC)])
        bus.submit(0, STATUS, 48 * BIT + wait_ns)
        assert bus.next_deadline_ns() == max(start_ns * BIT, 48 * BIT + wait_ns) + 63 * BIT


@pytest.mark.parametrize(("later_ns", "first"), [(0, SYNC), (999, SYNC), (1000, STATUS)])
def test_frame_submitted_in_first_bit_joins_arbitration(later_ns, first):
    bus = _bus("left", "right")
    deliveries = run(bus, [(0, 0, STATUS), (later_ns, 1, SYNC)])
    assert _sent(deliveries)[0] == ((frame_bits(first) - 3) * BIT, first)
    assert _sent(deliveries)[1][0] == (51 + 66 - 3) * BIT  # the start does not move


def test_frame_submitted_in_intermission_joins_arbitration():
    for after_ns, second in ((0, SYNC), (2999, SYNC), (3999, SYNC), (4000, STATUS)):
        bus = _bus("left", "right", "sync")
        bus.submit(0, HEARTBEAT, 0)
        bus.submit(1, STATUS, 0)
        deliveries = expire_all(bus, 65 * BIT)  # STATUS won, and is complete at 63
        assert _sent(deliveries) == [(63 * BIT, STATUS)]
        bus.submit(1, STATUS, 63 * BIT)
        bus.submit(2, SYNC, 63 * BIT + after_ns)
        assert _sent(expire_all(bus, 10**9))[0][1] == second


def test_most_dominant_frame_wins():
    rivals = [
        pack_remote(0x123 << 18 | EFF_FLAG),
        pack(0x123 << 18 | EFF_FLAG),
        pack_remote(0x123),
        pack(0x124),
        pack(0x123),
        pack(0x122),
    ]
    bus = _bus(*"abcdef")
    deliveries = run(bus, [(0, port, frame) for port, frame in enumerate(rivals)])
    order = [5, 4, 2, 1, 0, 3]
    assert [port for _, (_, port, _) in deliveries] == order


def test_fifo_sends_in_submission_order_after_losses():
    bus = _bus("left", "right")
    deliveries = run(
        bus, [(0, 0, HEARTBEAT), (0, 0, SYNC), (0, 1, STATUS), (0, 1, COMMAND), (0, 0, STATUS)]
    )
    assert [frame for _, frame in _sent(deliveries)] == [STATUS, COMMAND, HEARTBEAT, SYNC, STATUS]


def test_priority_queue_sends_most_urgent_and_equals_in_order():
    first, second = pack(0x181, b"\x01"), pack(0x181, b"\x02")
    bus = _bus("host", queue=QueueOrder.PRIORITY)
    deliveries = run(
        bus,
        [(0, 0, COMMAND), (BIT, 0, HEARTBEAT), (BIT, 0, first), (BIT, 0, second), (BIT, 0, SYNC)],
    )
    sent = [frame for _, frame in _sent(deliveries)]
    assert sent == [COMMAND, SYNC, first, second, HEARTBEAT]


def test_priority_queue_replaces_candidate_until_start():
    for later_ns, first in ((0, SYNC), (999, SYNC), (1000, COMMAND)):
        bus = _bus("host", queue=QueueOrder.PRIORITY)
        assert _sent(run(bus, [(0, 0, COMMAND), (later_ns, 0, SYNC)]))[0][1] == first


def test_priority_queue_lets_urgent_frame_compete_instead():
    bus = CanBus("can0")
    left = bus.attach("left")
    host = bus.attach("host", CanNode(QueueOrder.PRIORITY))
    other = bus.attach("other")
    submissions = [
        (0, left, STATUS),
        (2 * BIT, host, HEARTBEAT),
        (2 * BIT, other, COMMAND),
        (3 * BIT, host, SYNC),
    ]
    sent = [frame for _, frame in _sent(run(bus, submissions))]
    assert sent == [STATUS, SYNC, COMMAND, HEARTBEAT]
    assert bus.arbitration_losses(host) == 1  # HEARTBEAT against COMMAND


def test_priority_queue_counts_losses_of_replaced_candidate():
    bus = CanBus("can0")
    left = bus.attach("left")
    host = bus.attach("host", CanNode(QueueOrder.PRIORITY))
    submissions = [(0, left, STATUS), (0, host, HEARTBEAT), (999, host, SYNC)]
    assert [frame for _, frame in _sent(run(bus, submissions))] == [SYNC, STATUS, HEARTBEAT]
    assert bus.arbitration_losses(host) == 1  # HEARTBEAT against STATUS, later
    bus = CanBus("can0")
    left = bus.attach("left")
    host = bus.attach("host", CanNode(QueueOrder.PRIORITY))
    submissions = [(0, left, STATUS), (0, left, STATUS), (0, host, HEARTBEAT)]
    run(bus, [*submissions, (64 * BIT, host, SYNC)])
    assert bus.arbitration_losses(host) == 2  # HEARTBEAT against both; SYNC against none


def test_displaced_frame_stays_first_of_its_node():
    bus = _bus("left", "right")
    deliveries = run(bus, [(0, 0, STATUS), (1, 1, SYNC), (2, 0, HEARTBEAT)])
    assert [frame for _, frame in _sent(deliveries)] == [SYNC, STATUS, HEARTBEAT]


def test_hundred_nodes_send_in_identifier_order():
    bus = _bus(*[f"node {number}" for number in range(100)])
    submissions = [(0, port, pack(0x200 + port * 37 % 100)) for port in range(100)]
    deliveries = run(bus, submissions)
    identifiers = [frame[0] | frame[1] << 8 for _, frame in _sent(deliveries)]
    assert identifiers == list(range(0x200, 0x264))
    assert {port for _, (_, port, _) in deliveries} == set(range(100))
    assert sum(bus.arbitration_losses(port) for port in range(100)) == 99 * 100 // 2


def test_frame_is_delivered_to_all_but_sender():
    bus = _bus("left", "right", "host")
    deliveries = run(bus, [(0, 1, SYNC)])
    assert [len(heard(deliveries, port)) for port in range(3)] == [1, 0, 1]


def test_equal_frames_of_two_nodes_are_sent_as_one():
    bus = _bus("left", "right")
    deliveries = run(bus, [(0, 0, STATUS), (0, 1, STATUS)])
    assert _sent(deliveries) == [(63 * BIT, STATUS)] * 2
    assert [len(confirmed(deliveries, port)) for port in range(2)] == [1, 1]
    assert [len(heard(deliveries, port)) for port in range(3)] == [0, 0, 1]
    assert bus.statistics.frames == 1
    assert bus.statistics.collisions() == {0x181: 1}


def test_different_frames_with_one_identifier_collide():
    # Among 01h and 02h the first is dominant in the first difference: its sender reads no error
    # there.
    # After 16 attempts at TEC + 8 both are error passive, and the other's error flag destroys
    # nothing.
    for order in ([0, 1], [1, 0]):
        bus = _bus("left", "right")
        twins = [pack(0x181, b"\x01"), pack(0x181, b"\x02")]
        deliveries = run(bus, [(0, port, twins[port]) for port in order])
        assert [frame for _, frame in heard(deliveries, 2)] == twins
        assert bus.statistics.collisions() == {0x181: 17}
        assert [bus.node(port).confinement.tec for port in range(2)] == [127, 135]


def test_programs_sharing_controller_never_collide():
    bus = CanBus("can0")
    for name in ("host", "host-2"):
        bus.attach(name, CanNode(shared=True))
    bus.attach("ear")
    twins = [pack(0x181, b"\x01"), pack(0x181, b"\x02")]
    deliveries = run(bus, [(0, 1, twins[1]), (0, 0, twins[0])])
    assert [frame for _, frame in heard(deliveries, 2)] == twins
    assert bus.statistics.collisions() == {0x181: 1}
    assert bus.statistics.errors == 0


def test_same_identifier_at_different_times_does_not_collide():
    bus = _bus("left", "right")
    run(bus, [(0, 0, STATUS), (BIT, 1, STATUS)])
    assert bus.statistics.collisions() == {}


def test_collision_counts_after_more_urgent_frame():
    bus = _bus("left", "right", "host")
    run(bus, [(0, 0, STATUS), (0, 1, STATUS), (0, 2, SYNC)])
    assert bus.statistics.collisions() == {0x181: 1}


def test_collision_counts_once_if_other_node_withdraws():
    bus = _bus("left", "right")
    run(bus, [(0, 0, STATUS), (0, 1, STATUS)], until_ns=BIT)
    bus.withdraw(1)
    run(bus, [(1000 * BIT, 0, STATUS), (2000 * BIT, 0, SYNC)])
    assert bus.statistics.collisions() == {0x181: 1}


def test_data_and_remote_frame_of_identifier_do_not_collide():
    bus = _bus("left", "right")
    run(bus, [(0, 0, pack_remote(0x181)), (0, 1, pack(0x181))])
    assert bus.statistics.collisions() == {}


def test_lost_arbitrations_are_counted():
    bus = _bus("left", "right")
    run(bus, [(0, 1, HEARTBEAT), (0, 0, STATUS), (10 * BIT, 0, SYNC)], until_ns=20 * BIT)
    assert bus.arbitration_losses(1) == 1
    expire_all(bus, 70 * BIT)  # SYNC has won the second arbitration
    assert bus.arbitration_losses(1) == 2
    expire_all(bus, 10**9)
    assert bus.arbitration_losses(1) == 2
    assert bus.arbitration_losses(0) == 0


def test_pending_counts_incomplete_frames():
    bus = _bus("left", "right")
    run(bus, [(0, 0, SYNC), (0, 0, SYNC), (0, 1, STATUS)], until_ns=48 * BIT - 1)
    assert [bus.pending(0), bus.pending(1)] == [2, 1]
    expire_all(bus, 48 * BIT)
    assert [bus.pending(0), bus.pending(1)] == [1, 1]
    expire_all(bus, 10**9)
    assert [bus.pending(0), bus.pending(1)] == [0, 0]


def test_withdraw_keeps_only_frame_in_flight():
    bus = _bus("left", "right")
    submissions = [(0, 0, SYNC), (0, 0, STATUS), (0, 1, STATUS), (0, 1, HEARTBEAT)]
    run(bus, submissions, until_ns=BIT)
    assert bus.withdraw(0) == 1
    assert bus.withdraw(1) == 2
    assert _sent(expire_all(bus, 10**9)) == [(48 * BIT, SYNC)]
    assert bus.arbitration_losses(1) == 1
    bus.submit(1, STATUS, 10**9)
    assert _sent(expire_all(bus, 2 * 10**9)) == [(10**9 + 63 * BIT, STATUS)]


def test_withdraw_of_most_urgent_keeps_order_of_others():
    bus = _bus(*"abcdefgh")
    run(bus, [(0, 0, SYNC)], until_ns=BIT)
    for port, can_id in enumerate((0x101, 0x105, 0x102, 0x106, 0x107, 0x103, 0x104), 1):
        bus.submit(port, pack(can_id), 2 * BIT)
    bus.withdraw(1)
    identifiers = [frame[0] for _, frame in _sent(expire_all(bus, 10**9))]
    assert identifiers == [0x80, 2, 3, 4, 5, 6, 7]


def test_statistics_count_frames_bits_and_identifiers():
    bus = _bus("left", "right")
    remote = pack_remote(0x701)
    run(bus, [(0, 0, STATUS), (0, 1, SYNC), (60 * BIT, 0, remote), (60 * BIT, 0, STATUS)])
    statistics = bus.statistics
    assert statistics.frames == 4
    assert statistics.bits == 51 + 2 * 66 + frame_bits(remote)
    assert statistics.busy_ns() == statistics.bits * BIT
    assert statistics.counts() == {0x080: 1, 0x181: 2, 0x701 | RTR_FLAG: 1}
    assert list(statistics.counts()) == [0x080, 0x181, 0x701 | RTR_FLAG]


def test_bus_without_pauses_has_load_one():
    bus = _bus("left")
    run(bus, [(0, 0, STATUS)] * 10)
    assert bus.statistics.load(0, 660 * BIT) == 1.0
    assert bus.statistics.load(330 * BIT, 990 * BIT) == 0.5
    assert bus.statistics.peak_load(660 * BIT) == 1.0
    assert bus.statistics.peak_load(1320 * BIT) == 0.5


def test_late_call_gets_all_deliveries_in_order():
    bus = _bus("left", "right")
    for _ in range(3):
        bus.submit(0, STATUS, 0)
        bus.submit(1, SYNC, 0)
    assert [frame for frame, _, _ in bus.expire(10**9)] == [SYNC] * 3 + [STATUS] * 3
    assert bus.next_deadline_ns() is None


def test_ports_have_ordered_numbers_and_unique_names():
    bus = _bus("left")
    assert bus.port_names() == ["left", "ear"]
    assert bus.attach("host") == 2
    with pytest.raises(ValueError, match="already a port named left"):
        bus.attach("left")


def test_unsendable_frame_is_refused_without_effect():
    bus = _bus("left")
    with pytest.raises(ValueError, match="16 bytes"):
        bus.submit(0, b"short", 0)
    assert bus.next_deadline_ns() is None
    assert bus.pending(0) == 0
