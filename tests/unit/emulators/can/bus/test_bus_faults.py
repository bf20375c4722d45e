"""Effects of faults on the traffic of a bus."""

import random

import pytest

from motorhil.emulators.can.bus.bus import CanBus
from motorhil.emulators.can.bus.fault_plan import FaultPlan
from motorhil.emulators.can.bus.port import DELIVERED, LOST
from motorhil.emulators.can.controller_config import CanNode, QueueOrder
from motorhil.emulators.can.fault_rules import FaultKind, FaultRule
from motorhil.emulators.can.frame import pack
from tests.support.can.deliveries import BIT, confirmed, expire_all, heard, run
from tests.support.can.faulty_bus import HOST, LEFT, RIGHT, STATUS, SYNC, bus_with, cut, no_draw


def test_dropped_frame_is_confirmed_but_not_received():
    bus = bus_with(FaultRule("noise", FaultKind.DROP, identifier=0x181))
    deliveries = run(bus, [(0, LEFT, STATUS), (0, RIGHT, SYNC)])
    assert deliveries[1] == ((51 + 63) * BIT, (STATUS, LEFT, LOST))
    assert deliveries[0] == (48 * BIT, (SYNC, RIGHT, DELIVERED))
    assert confirmed(deliveries, LEFT) == [((51 + 63) * BIT, STATUS)]
    assert [frame for _, frame in heard(deliveries, HOST)] == [SYNC]
    assert bus.statistics.frames == 2
    assert bus.take_fault_events() == [((51 + 63) * BIT, "noise", "drop", STATUS)]
    assert bus.faults_fired() == {"noise": 1}


def test_frame_may_be_dropped_for_some_ports():
    bus = bus_with(FaultRule("deaf", FaultKind.DROP, ports=("right",)))
    deliveries = run(bus, [(0, HOST, SYNC)])
    assert heard(deliveries, LEFT) == [(48 * BIT, SYNC)]
    assert heard(deliveries, RIGHT) == []
    assert confirmed(deliveries, HOST) == [(48 * BIT, SYNC)]


def test_frame_dropped_for_all_ports_is_lost():
    bus = bus_with(FaultRule("deaf", FaultKind.DROP, ports=("right", "left")))
    assert run(bus, [(0, HOST, SYNC)]) == [(48 * BIT, (SYNC, HOST, LOST))]


def test_delayed_frame_is_sent_in_time_and_heard_later():
    bus = bus_with(FaultRule("gateway", FaultKind.DELAY, delay_ns=777, identifier=0x080))
    deliveries = run(bus, [(0, HOST, SYNC)])
    assert confirmed(deliveries, HOST) == [(48 * BIT, SYNC)]
    assert heard(deliveries, LEFT) == heard(deliveries, RIGHT) == [(48 * BIT + 777, SYNC)]


def test_delayed_frame_is_overtaken_without_second_transmission():
    bus = bus_with(FaultRule("gateway", FaultKind.DELAY, delay_ns=100 * BIT, identifier=0x080))
    deliveries = run(bus, [(0, HOST, SYNC), (0, RIGHT, STATUS)])
    assert heard(deliveries, LEFT) == [((51 + 63) * BIT, STATUS), (148 * BIT, SYNC)]
    assert bus.statistics.bits == 51 + 66


def test_delay_for_some_ports_keeps_others_in_time():
    bus = bus_with(FaultRule("slow", FaultKind.DELAY, delay_ns=5, ports=("right",)))
    deliveries = run(bus, [(0, HOST, SYNC)])
    assert heard(deliveries, LEFT) == [(48 * BIT, SYNC)]
    assert heard(deliveries, RIGHT) == [(48 * BIT + 5, SYNC)]
    assert confirmed(deliveries, HOST) == [(48 * BIT, SYNC)]


def test_simultaneous_late_frames_keep_sending_order():
    bus = bus_with(
        FaultRule("long", FaultKind.DELAY, identifier=0x080, delay_ns=200 * BIT),
        FaultRule("short", FaultKind.DELAY, identifier=0x181, delay_ns=(200 - 66) * BIT),
    )
    deliveries = run(bus, [(0, LEFT, SYNC), (0, RIGHT, STATUS)])
    assert heard(deliveries, HOST) == [(248 * BIT, SYNC), (248 * BIT, STATUS)]


def test_delayed_frame_arrives_after_rule_is_lifted():
    bus = bus_with(FaultRule("gateway", FaultKind.DELAY, delay_ns=100 * BIT))
    run(bus, [(0, LEFT, SYNC)], until_ns=100 * BIT)
    bus.lift("gateway", 100 * BIT)
    assert heard(expire_all(bus, 10**9), HOST) == [(148 * BIT, SYNC)]


def test_equally_delayed_frames_stay_in_order():
    bus = bus_with(FaultRule("gateway", FaultKind.DELAY, delay_ns=100 * BIT))
    frames = [pack(0x181, bytes([number])) for number in range(10)]
    deliveries = run(bus, [(0, LEFT, frame) for frame in frames])
    assert [frame for _, frame in heard(deliveries, HOST)] == frames


def test_duplicate_is_sent_again_and_confirmed_once():
    # Source: ISO 11898-1: an error in the last bit of EOF. The error flag is the first six bits of
    # intermission for the others, whose overload flags end one bit later; delimiter 8 bits.
    bus = bus_with(FaultRule("eof", FaultKind.DUPLICATE, limit=1))
    deliveries = run(bus, [(0, LEFT, STATUS)])
    again_ns = (66 + 15 + 63) * BIT
    assert heard(deliveries, HOST) == [(63 * BIT, STATUS), (again_ns, STATUS)]
    assert confirmed(deliveries, LEFT) == [(again_ns, STATUS)]
    assert bus.statistics.frames == 1
    assert bus.statistics.busy_ns() == (66 + 15 + 66) * BIT


def test_duplicate_rule_for_all_frames_repeats_each_once():
    bus = bus_with(FaultRule("eof", FaultKind.DUPLICATE))
    deliveries = run(bus, [(0, LEFT, STATUS), (0, LEFT, STATUS), (0, RIGHT, SYNC)])
    assert [frame for _, frame in heard(deliveries, HOST)] == [SYNC] * 2 + [STATUS] * 4
    assert bus.faults_fired() == {"eof": 3}


def test_repeated_frame_must_win_arbitration_again():
    bus = bus_with(FaultRule("eof", FaultKind.DUPLICATE, identifier=0x181))
    deliveries = run(bus, [(0, LEFT, STATUS), (5 * BIT, RIGHT, SYNC)])
    assert [frame for _, frame in heard(deliveries, HOST)] == [STATUS, SYNC, STATUS]
    assert bus.arbitration_losses(LEFT) == 1


def test_duplicate_for_some_ports_is_heard_once_by_others():
    bus = bus_with(FaultRule("eof", FaultKind.DUPLICATE, ports=("right",)))
    deliveries = run(bus, [(0, HOST, SYNC)])
    assert [len(heard(deliveries, port)) for port in (LEFT, RIGHT)] == [1, 2]


def test_displaced_duplicate_is_repeated_once():
    bus = CanBus("can0", faults=FaultPlan([FaultRule("eof", FaultKind.DUPLICATE)], no_draw))
    host = bus.attach("host", CanNode(QueueOrder.PRIORITY))
    bus.attach("left")
    deliveries = run(bus, [(0, host, STATUS), (10 * BIT, host, SYNC)])
    assert [frame for _, frame in heard(deliveries, 1)].count(STATUS) == 2
    assert [frame for _, frame in heard(deliveries, 1)].count(SYNC) == 2
    assert [frame for _, frame in confirmed(deliveries, host)] == [SYNC, STATUS]


def test_duplicate_does_not_reach_cut_port():
    bus = bus_with(FaultRule("eof", FaultKind.DUPLICATE), cut(0, None, "right"))
    deliveries = run(bus, [(0, LEFT, STATUS)])
    assert heard(deliveries, RIGHT) == []
    assert len(heard(deliveries, HOST)) == 2


def test_repetition_after_lifted_rule_leaves_no_state():
    bus = bus_with(FaultRule("eof", FaultKind.DUPLICATE))
    run(bus, [(0, LEFT, STATUS)], until_ns=100 * BIT)
    bus.lift("eof", 100 * BIT)
    expire_all(bus, 500 * BIT)
    bus.inject(FaultRule("noise", FaultKind.DROP), 500 * BIT)
    deliveries = run(bus, [(600 * BIT, LEFT, STATUS)])
    assert deliveries == [(663 * BIT, (STATUS, LEFT, LOST))]


def test_corrupted_data_reach_only_ports_hit():
    flipped = pack(0x181, bytes.fromhex("3707"))
    rule = FaultRule("ram", FaultKind.CORRUPT, flip=b"\x00\x01", ports=("right",))
    bus = bus_with(rule)
    deliveries = run(bus, [(0, LEFT, STATUS)])
    assert heard(deliveries, RIGHT) == [(63 * BIT, flipped)]
    assert heard(deliveries, HOST) == [(63 * BIT, STATUS)]
    assert confirmed(deliveries, LEFT) == [(63 * BIT, STATUS)]
    assert bus.take_fault_events() == [(63 * BIT, "ram", "corrupt", STATUS)]


def test_corrupted_data_without_ports_reach_all():
    bus = bus_with(FaultRule("ram", FaultKind.CORRUPT, flip=b"\xff"))
    deliveries = run(bus, [(0, LEFT, STATUS)])
    assert heard(deliveries, RIGHT) == heard(deliveries, HOST) != [(63 * BIT, STATUS)]
    assert len(heard(deliveries, HOST)) == 1


# --- changes at run time


def test_rule_may_be_added_and_lifted_at_run_time():
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


def test_cut_lifted_during_frame_hides_only_that_frame():
    bus = bus_with(cut(0, None, "right"))
    run(bus, [(0, LEFT, STATUS), (0, LEFT, SYNC)], until_ns=10 * BIT)
    bus.lift("cable", 10 * BIT)
    assert heard(expire_all(bus, 10**9), RIGHT) == [((66 + 48) * BIT, SYNC)]
    assert not bus._faulty


def test_lifted_cut_sends_waiting_frames():
    bus = bus_with(cut(0, None, "left"))
    bus.submit(LEFT, STATUS, 0)
    expire_all(bus, 10**9)
    assert bus.next_deadline_ns() is None  # it is passive, and repeats its frame for ever
    bus.lift("cable", 10**9)
    assert confirmed(expire_all(bus, 2 * 10**9), LEFT) == [(10**9 + (11 + 63) * BIT, STATUS)]


def test_bus_without_plan_refuses_rules():
    bus = CanBus("can0")
    with pytest.raises(ValueError, match="can0 has no fault plan"):
        bus.inject(FaultRule("x", FaultKind.DROP), 0)
    with pytest.raises(ValueError, match="can0 has no fault plan"):
        bus.lift("x", 0)
    assert bus.take_fault_events() == []
    assert bus.faults_fired() == {}


@pytest.mark.parametrize("seed", range(20))
def test_bus_with_ended_rules_is_one_without_faults(seed):
    """A rule that never hits keeps the faults possible, and must change nothing."""
    never = FaultRule("never", FaultKind.DROP, identifier=0x7FF)
    seen = []
    for more in ([], [never]):
        draw = random.Random(seed)
        kinds = (FaultKind.DROP, FaultKind.DUPLICATE, FaultKind.ERROR, FaultKind.CORRUPT)
        more_of = {FaultKind.ERROR: {"bit": 20}, FaultKind.CORRUPT: {"flip": b"\x01"}}
        rules = [
            FaultRule(
                *(kind.value, kind),
                limit=draw.randrange(1, 3),
                until_ns=draw.randrange(1, 4000) * BIT,
                **more_of.get(kind, {}),
            )
            for kind in kinds
        ]
        late = FaultRule("late", FaultKind.DELAY, delay_ns=150 * BIT, until_ns=2000 * BIT)
        bus = bus_with(*rules, late, *more)
        traffic = [
            (
                draw.randrange(8000) * BIT,
                draw.choice((HOST, LEFT, RIGHT)),
                pack(can_id, b"\x55" * 4),
            )
            for can_id in draw.sample(range(0x700), 60)
        ]
        deliveries = run(bus, sorted(traffic, key=lambda one: one[0]))
        seen.append((deliveries, bus.faults_fired(), bus.statistics.bits, bus.take_fault_events()))
        assert bus.deadline_ns() < 0
    seen[1][1].pop("never")
    assert seen[0] == seen[1]
    assert sum(seen[0][1].values()) >= 3
