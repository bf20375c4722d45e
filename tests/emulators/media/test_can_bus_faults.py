"""What faults do to the traffic of a bus."""

import pytest

from emulators.media.can_bus import DELIVERED, CanBus
from emulators.media.can_frame import pack
from emulators.media.can_node import CanNode, QueueOrder
from emulators.media.delivery import LOST
from emulators.media.faults import FaultKind, FaultPlan, FaultRule
from tests.emulators.media.driving import BIT, confirmed, expire_all, heard, run
from tests.emulators.media.faulty import HOST, LEFT, RIGHT, STATUS, SYNC, bus_with, cut, no_draw


def test_a_dropped_frame_is_sent_for_all_its_sender_knows_and_nobody_hears_it():
    bus = bus_with(FaultRule("noise", FaultKind.DROP, identifier=0x181))
    deliveries = run(bus, [(0, LEFT, STATUS), (0, RIGHT, SYNC)])
    assert deliveries[1] == ((51 + 63) * BIT, (STATUS, LEFT, LOST))
    assert deliveries[0] == (48 * BIT, (SYNC, RIGHT, DELIVERED))
    assert confirmed(deliveries, LEFT) == [((51 + 63) * BIT, STATUS)]
    assert [frame for _, frame in heard(deliveries, HOST)] == [SYNC]
    assert bus.statistics.frames == 2
    assert bus.take_fault_events() == [((51 + 63) * BIT, "noise", "drop", STATUS)]
    assert bus.faults_fired() == {"noise": 1}


def test_a_frame_can_be_dropped_for_some_only():
    bus = bus_with(FaultRule("deaf", FaultKind.DROP, ports=("right",)))
    deliveries = run(bus, [(0, HOST, SYNC)])
    assert heard(deliveries, LEFT) == [(48 * BIT, SYNC)]
    assert heard(deliveries, RIGHT) == []
    assert confirmed(deliveries, HOST) == [(48 * BIT, SYNC)]


def test_a_frame_dropped_for_all_there_are_is_lost():
    bus = bus_with(FaultRule("deaf", FaultKind.DROP, ports=("right", "left")))
    assert run(bus, [(0, HOST, SYNC)]) == [(48 * BIT, (SYNC, HOST, LOST))]


def test_a_delayed_frame_is_sent_in_time_and_heard_later():
    bus = bus_with(FaultRule("gateway", FaultKind.DELAY, delay_ns=777, identifier=0x080))
    deliveries = run(bus, [(0, HOST, SYNC)])
    assert confirmed(deliveries, HOST) == [(48 * BIT, SYNC)]
    assert heard(deliveries, LEFT) == heard(deliveries, RIGHT) == [(48 * BIT + 777, SYNC)]


def test_a_delayed_frame_is_overtaken_and_takes_the_bus_no_second_time():
    bus = bus_with(FaultRule("gateway", FaultKind.DELAY, delay_ns=100 * BIT, identifier=0x080))
    deliveries = run(bus, [(0, HOST, SYNC), (0, RIGHT, STATUS)])
    assert heard(deliveries, LEFT) == [((51 + 63) * BIT, STATUS), (148 * BIT, SYNC)]
    assert bus.statistics.bits == 51 + 66


def test_a_delay_for_some_leaves_the_others_in_time():
    bus = bus_with(FaultRule("slow", FaultKind.DELAY, delay_ns=5, ports=("right",)))
    deliveries = run(bus, [(0, HOST, SYNC)])
    assert heard(deliveries, LEFT) == [(48 * BIT, SYNC)]
    assert heard(deliveries, RIGHT) == [(48 * BIT + 5, SYNC)]
    assert confirmed(deliveries, HOST) == [(48 * BIT, SYNC)]


def test_frames_heard_late_at_the_same_time_come_in_the_order_they_were_sent():
    bus = bus_with(
        FaultRule("long", FaultKind.DELAY, identifier=0x080, delay_ns=200 * BIT),
        FaultRule("short", FaultKind.DELAY, identifier=0x181, delay_ns=(200 - 66) * BIT),
    )
    deliveries = run(bus, [(0, LEFT, SYNC), (0, RIGHT, STATUS)])
    assert heard(deliveries, HOST) == [(248 * BIT, SYNC), (248 * BIT, STATUS)]


def test_what_a_rule_delayed_still_comes_when_the_rule_has_gone():
    bus = bus_with(FaultRule("gateway", FaultKind.DELAY, delay_ns=100 * BIT))
    run(bus, [(0, LEFT, SYNC)], until_ns=100 * BIT)
    bus.lift("gateway", 100 * BIT)
    assert heard(expire_all(bus, 10**9), HOST) == [(148 * BIT, SYNC)]


def test_frames_delayed_alike_stay_in_order():
    bus = bus_with(FaultRule("gateway", FaultKind.DELAY, delay_ns=100 * BIT))
    frames = [pack(0x181, bytes([number])) for number in range(10)]
    deliveries = run(bus, [(0, LEFT, frame) for frame in frames])
    assert [frame for _, frame in heard(deliveries, HOST)] == frames


def test_a_duplicate_is_heard_sent_again_after_an_error_frame_and_confirmed_once():
    # Source: ISO 11898-1: an error in the last bit of EOF; the error flag is intermission's first
    # six bits to the others, whose overload flags end a bit later; delimiter 8 bits.
    bus = bus_with(FaultRule("eof", FaultKind.DUPLICATE, limit=1))
    deliveries = run(bus, [(0, LEFT, STATUS)])
    again_ns = (66 + 15 + 63) * BIT
    assert heard(deliveries, HOST) == [(63 * BIT, STATUS), (again_ns, STATUS)]
    assert confirmed(deliveries, LEFT) == [(again_ns, STATUS)]
    assert bus.statistics.frames == 1
    assert bus.statistics.busy_ns() == (66 + 15 + 66) * BIT


def test_a_rule_that_duplicates_everything_sends_everything_twice_not_for_ever():
    bus = bus_with(FaultRule("eof", FaultKind.DUPLICATE))
    deliveries = run(bus, [(0, LEFT, STATUS), (0, LEFT, STATUS), (0, RIGHT, SYNC)])
    assert [frame for _, frame in heard(deliveries, HOST)] == [SYNC] * 2 + [STATUS] * 4
    assert bus.faults_fired() == {"eof": 3}


def test_a_frame_sent_again_has_to_win_the_bus_again():
    bus = bus_with(FaultRule("eof", FaultKind.DUPLICATE, identifier=0x181))
    deliveries = run(bus, [(0, LEFT, STATUS), (5 * BIT, RIGHT, SYNC)])
    assert [frame for _, frame in heard(deliveries, HOST)] == [STATUS, SYNC, STATUS]
    assert bus.arbitration_losses(LEFT) == 1


def test_a_duplicate_for_some_is_heard_once_by_the_others():
    bus = bus_with(FaultRule("eof", FaultKind.DUPLICATE, ports=("right",)))
    deliveries = run(bus, [(0, HOST, SYNC)])
    assert [len(heard(deliveries, port)) for port in (LEFT, RIGHT)] == [1, 2]


def test_a_duplicate_that_is_displaced_before_it_is_repeated_is_still_repeated_once():
    bus = CanBus("can0", faults=FaultPlan([FaultRule("eof", FaultKind.DUPLICATE)], no_draw))
    host = bus.attach("host", CanNode(QueueOrder.PRIORITY))
    bus.attach("left")
    deliveries = run(bus, [(0, host, STATUS), (10 * BIT, host, SYNC)])
    assert [frame for _, frame in heard(deliveries, 1)].count(STATUS) == 2
    assert [frame for _, frame in heard(deliveries, 1)].count(SYNC) == 2
    assert [frame for _, frame in confirmed(deliveries, host)] == [SYNC, STATUS]


def test_a_duplicate_does_not_reach_a_port_cut_off_with_either_copy():
    bus = bus_with(FaultRule("eof", FaultKind.DUPLICATE), cut(0, None, "right"))
    deliveries = run(bus, [(0, LEFT, STATUS)])
    assert heard(deliveries, RIGHT) == []
    assert len(heard(deliveries, HOST)) == 2


def test_a_frame_repeated_after_its_rule_has_gone_leaves_nothing_behind():
    bus = bus_with(FaultRule("eof", FaultKind.DUPLICATE))
    run(bus, [(0, LEFT, STATUS)], until_ns=100 * BIT)
    bus.lift("eof", 100 * BIT)
    expire_all(bus, 500 * BIT)
    bus.inject(FaultRule("noise", FaultKind.DROP), 500 * BIT)
    deliveries = run(bus, [(600 * BIT, LEFT, STATUS)])
    assert deliveries == [(663 * BIT, (STATUS, LEFT, LOST))]


def test_corrupted_data_are_heard_by_those_hit_and_the_sender_knows_the_true_ones():
    flipped = pack(0x181, bytes.fromhex("3707"))
    rule = FaultRule("ram", FaultKind.CORRUPT, flip=b"\x00\x01", ports=("right",))
    bus = bus_with(rule)
    deliveries = run(bus, [(0, LEFT, STATUS)])
    assert heard(deliveries, RIGHT) == [(63 * BIT, flipped)]
    assert heard(deliveries, HOST) == [(63 * BIT, STATUS)]
    assert confirmed(deliveries, LEFT) == [(63 * BIT, STATUS)]
    assert bus.take_fault_events() == [(63 * BIT, "ram", "corrupt", STATUS)]


def test_corrupted_data_without_a_choice_of_ports_reach_everybody():
    bus = bus_with(FaultRule("ram", FaultKind.CORRUPT, flip=b"\xff"))
    deliveries = run(bus, [(0, LEFT, STATUS)])
    assert heard(deliveries, RIGHT) == heard(deliveries, HOST) != [(63 * BIT, STATUS)]
    assert len(heard(deliveries, HOST)) == 1


# --- while it runs


def test_a_rule_can_come_and_go_while_the_bus_runs():
    bus = bus_with()
    bus.submit(LEFT, STATUS, 0)
    bus.inject(cut(0, None, "right"), 10)
    assert heard(expire_all(bus, 100 * BIT), RIGHT) == []
    bus.lift("cable", 100 * BIT)
    bus.submit(LEFT, STATUS, 111 * BIT)  # 11 recessive bits later
    deliveries = expire_all(bus, 10**9)
    assert deliveries == [(174 * BIT, (STATUS, LEFT, DELIVERED))]
    assert bus.take_fault_events() == [
        (10, "cable", "right cut off", b""),
        (100 * BIT, "cable", "right back", b""),
    ]


def test_a_cut_lifted_during_a_frame_leaves_the_port_deaf_to_it_and_then_costs_nothing():
    bus = bus_with(cut(0, None, "right"))
    run(bus, [(0, LEFT, STATUS), (0, LEFT, SYNC)], until_ns=10 * BIT)
    bus.lift("cable", 10 * BIT)
    assert heard(expire_all(bus, 10**9), RIGHT) == [((66 + 48) * BIT, SYNC)]
    assert not bus._faulty


def test_lifting_a_cut_sends_what_has_waited():
    bus = bus_with(cut(0, None, "left"))
    bus.submit(LEFT, STATUS, 0)
    expire_all(bus, 10**9)
    assert bus.next_deadline_ns() is None  # it is passive, and tries in vain for ever
    bus.lift("cable", 10**9)
    assert confirmed(expire_all(bus, 2 * 10**9), LEFT) == [(10**9 + (11 + 63) * BIT, STATUS)]


def test_a_bus_without_a_plan_takes_no_rules():
    bus = CanBus("can0")
    with pytest.raises(ValueError, match="can0 has no fault plan"):
        bus.inject(FaultRule("x", FaultKind.DROP), 0)
    with pytest.raises(ValueError, match="can0 has no fault plan"):
        bus.lift("x", 0)
    assert bus.take_fault_events() == []
    assert bus.faults_fired() == {}
