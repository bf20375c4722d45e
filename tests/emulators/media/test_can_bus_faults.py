"""What faults do to the traffic of a bus."""

import random

import pytest
from hypothesis import event, given
from hypothesis import strategies as st

from emulators.media.can_bus import DELIVERED, CanBus, QueueOrder
from emulators.media.can_frame import pack
from emulators.media.delivery import HEARD, KIND_MASK, LOST
from emulators.media.faults import FaultKind, FaultPlan, FaultRule
from tests.emulators.media import wire
from tests.emulators.media.driving import BIT, Submission, confirmed, expire_all, heard, run

SYNC = pack(0x080)  # 51 bits with intermission (can-utils, can-physics.md 6.2)
STATUS = pack(0x181, bytes.fromhex("3706"))  # 66 bits
HEARTBEAT = pack(0x701, b"\x05")  # 58 bits
LEFT, RIGHT, HOST = 0, 1, 2
NAMES = ("left", "right", "host")


def _bus(*rules: FaultRule, seed: int = 1) -> CanBus:
    bus = CanBus("can0", faults=FaultPlan(rules, random.Random(seed).random))
    for name in NAMES:
        bus.attach(name)
    return bus


def test_a_dropped_frame_is_sent_for_all_its_sender_knows_and_nobody_hears_it():
    bus = _bus(FaultRule("noise", FaultKind.DROP, identifier=0x181))
    deliveries = run(bus, [(0, LEFT, STATUS), (0, RIGHT, SYNC)])
    assert deliveries[1] == ((51 + 63) * BIT, (STATUS, LEFT, LOST))
    assert deliveries[0] == (48 * BIT, (SYNC, RIGHT, DELIVERED))
    assert confirmed(deliveries, LEFT) == [((51 + 63) * BIT, STATUS)]
    assert [frame for _, frame in heard(deliveries, HOST)] == [SYNC]
    assert bus.statistics.frames == 2
    assert bus.take_fault_events() == [((51 + 63) * BIT, "noise", "drop", STATUS)]
    assert bus.faults_fired() == {"noise": 1}


def test_a_frame_can_be_dropped_for_some_only():
    bus = _bus(FaultRule("deaf", FaultKind.DROP, ports=("right",)))
    deliveries = run(bus, [(0, HOST, SYNC)])
    assert heard(deliveries, LEFT) == [(48 * BIT, SYNC)]
    assert heard(deliveries, RIGHT) == []
    assert confirmed(deliveries, HOST) == [(48 * BIT, SYNC)]


def test_a_frame_dropped_for_all_there_are_is_lost():
    bus = _bus(FaultRule("deaf", FaultKind.DROP, ports=("right", "left")))
    assert run(bus, [(0, HOST, SYNC)]) == [(48 * BIT, (SYNC, HOST, LOST))]


def test_a_drop_on_a_bus_with_one_node_is_lost_and_no_fault_there_is_none():
    bus = CanBus("can0", faults=FaultPlan([FaultRule("x", FaultKind.DROP, limit=1)], _no_draw))
    bus.attach("left")
    kinds = [kind for _, (_, _, kind) in run(bus, [(0, 0, SYNC), (0, 0, SYNC)])]
    assert kinds == [LOST, DELIVERED]


def test_a_delayed_frame_is_sent_in_time_and_heard_later():
    bus = _bus(FaultRule("gateway", FaultKind.DELAY, delay_ns=777, identifier=0x080))
    deliveries = run(bus, [(0, HOST, SYNC)])
    assert confirmed(deliveries, HOST) == [(48 * BIT, SYNC)]
    assert heard(deliveries, LEFT) == heard(deliveries, RIGHT) == [(48 * BIT + 777, SYNC)]


def test_a_delayed_frame_is_overtaken_and_takes_the_bus_no_second_time():
    bus = _bus(FaultRule("gateway", FaultKind.DELAY, delay_ns=100 * BIT, identifier=0x080))
    deliveries = run(bus, [(0, HOST, SYNC), (0, RIGHT, STATUS)])
    assert heard(deliveries, LEFT) == [((51 + 63) * BIT, STATUS), (148 * BIT, SYNC)]
    assert bus.statistics.bits == 51 + 66


def test_a_delay_for_some_leaves_the_others_in_time():
    bus = _bus(FaultRule("slow", FaultKind.DELAY, delay_ns=5, ports=("right",)))
    deliveries = run(bus, [(0, HOST, SYNC)])
    assert heard(deliveries, LEFT) == [(48 * BIT, SYNC)]
    assert heard(deliveries, RIGHT) == [(48 * BIT + 5, SYNC)]
    assert confirmed(deliveries, HOST) == [(48 * BIT, SYNC)]


def test_frames_heard_late_at_the_same_time_come_in_the_order_they_were_sent():
    bus = _bus(
        FaultRule("long", FaultKind.DELAY, identifier=0x080, delay_ns=200 * BIT),
        FaultRule("short", FaultKind.DELAY, identifier=0x181, delay_ns=(200 - 66) * BIT),
    )
    deliveries = run(bus, [(0, LEFT, SYNC), (0, RIGHT, STATUS)])
    assert heard(deliveries, HOST) == [(248 * BIT, SYNC), (248 * BIT, STATUS)]


def test_what_a_rule_delayed_still_comes_when_the_rule_has_gone():
    bus = _bus(FaultRule("gateway", FaultKind.DELAY, delay_ns=100 * BIT))
    run(bus, [(0, LEFT, SYNC)], until_ns=100 * BIT)
    bus.lift("gateway", 100 * BIT)
    assert heard(expire_all(bus, 10**9), HOST) == [(148 * BIT, SYNC)]


def test_frames_delayed_alike_stay_in_order():
    bus = _bus(FaultRule("gateway", FaultKind.DELAY, delay_ns=100 * BIT))
    frames = [pack(0x181, bytes([number])) for number in range(10)]
    deliveries = run(bus, [(0, LEFT, frame) for frame in frames])
    assert [frame for _, frame in heard(deliveries, HOST)] == frames


def test_a_duplicate_is_heard_sent_again_after_an_error_frame_and_confirmed_once():
    # Source: ISO 11898-1: an error in the last bit of EOF; error flag 6 bits, delimiter 8 bits.
    bus = _bus(FaultRule("eof", FaultKind.DUPLICATE, limit=1))
    deliveries = run(bus, [(0, LEFT, STATUS)])
    again_ns = (66 + 14 + 63) * BIT
    assert heard(deliveries, HOST) == [(63 * BIT, STATUS), (again_ns, STATUS)]
    assert confirmed(deliveries, LEFT) == [(again_ns, STATUS)]
    assert bus.statistics.frames == 1
    assert bus.statistics.busy_ns() == (66 + 14 + 66) * BIT


def test_a_rule_that_duplicates_everything_sends_everything_twice_not_for_ever():
    bus = _bus(FaultRule("eof", FaultKind.DUPLICATE))
    deliveries = run(bus, [(0, LEFT, STATUS), (0, LEFT, STATUS), (0, RIGHT, SYNC)])
    assert [frame for _, frame in heard(deliveries, HOST)] == [SYNC] * 2 + [STATUS] * 4
    assert bus.faults_fired() == {"eof": 3}


def test_a_frame_sent_again_has_to_win_the_bus_again():
    bus = _bus(FaultRule("eof", FaultKind.DUPLICATE, identifier=0x181))
    deliveries = run(bus, [(0, LEFT, STATUS), (5 * BIT, RIGHT, SYNC)])
    assert [frame for _, frame in heard(deliveries, HOST)] == [STATUS, SYNC, STATUS]
    assert bus.arbitration_losses(LEFT) == 1


def test_a_duplicate_for_some_is_heard_once_by_the_others():
    bus = _bus(FaultRule("eof", FaultKind.DUPLICATE, ports=("right",)))
    deliveries = run(bus, [(0, HOST, SYNC)])
    assert [len(heard(deliveries, port)) for port in (LEFT, RIGHT)] == [1, 2]


def test_a_duplicate_that_is_displaced_before_it_is_repeated_is_still_repeated_once():
    bus = CanBus("can0", faults=FaultPlan([FaultRule("eof", FaultKind.DUPLICATE)], _no_draw))
    host = bus.attach("host", QueueOrder.PRIORITY)
    bus.attach("left")
    deliveries = run(bus, [(0, host, STATUS), (10 * BIT, host, SYNC)])
    assert [frame for _, frame in heard(deliveries, 1)].count(STATUS) == 2
    assert [frame for _, frame in heard(deliveries, 1)].count(SYNC) == 2
    assert [frame for _, frame in confirmed(deliveries, host)] == [STATUS, SYNC]


def test_a_duplicate_does_not_reach_a_port_cut_off_with_either_copy():
    bus = _bus(FaultRule("eof", FaultKind.DUPLICATE), _cut(0, None, "right"))
    deliveries = run(bus, [(0, LEFT, STATUS)])
    assert heard(deliveries, RIGHT) == []
    assert len(heard(deliveries, HOST)) == 2


def test_a_frame_repeated_after_its_rule_has_gone_leaves_nothing_behind():
    bus = _bus(FaultRule("eof", FaultKind.DUPLICATE))
    run(bus, [(0, LEFT, STATUS)], until_ns=100 * BIT)
    bus.lift("eof", 100 * BIT)
    expire_all(bus, 500 * BIT)
    bus.inject(FaultRule("noise", FaultKind.DROP), 500 * BIT)
    deliveries = run(bus, [(600 * BIT, LEFT, STATUS)])
    assert deliveries == [(663 * BIT, (STATUS, LEFT, LOST))]


def test_corrupted_data_are_heard_by_those_hit_and_the_sender_knows_the_true_ones():
    flipped = pack(0x181, bytes.fromhex("3707"))
    rule = FaultRule("ram", FaultKind.CORRUPT, flip=b"\x00\x01", ports=("right",))
    bus = _bus(rule)
    deliveries = run(bus, [(0, LEFT, STATUS)])
    assert heard(deliveries, RIGHT) == [(63 * BIT, flipped)]
    assert heard(deliveries, HOST) == [(63 * BIT, STATUS)]
    assert confirmed(deliveries, LEFT) == [(63 * BIT, STATUS)]
    assert bus.take_fault_events() == [(63 * BIT, "ram", "corrupt", STATUS)]


def test_corrupted_data_without_a_choice_of_ports_reach_everybody():
    bus = _bus(FaultRule("ram", FaultKind.CORRUPT, flip=b"\xff"))
    deliveries = run(bus, [(0, LEFT, STATUS)])
    assert heard(deliveries, RIGHT) == heard(deliveries, HOST) != [(63 * BIT, STATUS)]
    assert len(heard(deliveries, HOST)) == 1


# --- cut


def _cut(from_ns: int, until_ns: int | None, *ports: str) -> FaultRule:
    return FaultRule("cable", FaultKind.CUT, ports=ports, from_ns=from_ns, until_ns=until_ns)


END = 48 * BIT  # of a SYNC submitted at 0


@pytest.mark.parametrize(
    ("from_ns", "until_ns", "hears"),
    [
        (END + 1, None, True),
        (END, None, False),
        (END - 1, END, False),  # a part of a frame is no frame
        (1, 2, False),
        (0, END, False),
    ],
)
def test_a_port_hears_the_frames_it_was_there_for_from_start_to_end(from_ns, until_ns, hears):
    bus = _bus(_cut(from_ns, until_ns, "right"))
    deliveries = run(bus, [(0, LEFT, SYNC)])
    assert heard(deliveries, RIGHT) == ([(END, SYNC)] if hears else [])
    assert heard(deliveries, HOST) == [(END, SYNC)]
    assert confirmed(deliveries, LEFT) == [(END, SYNC)]


def test_a_port_back_between_two_frames_hears_the_second():
    bus = _bus(_cut(1, 49 * BIT, "right"))
    deliveries = run(bus, [(0, LEFT, SYNC), (0, LEFT, STATUS)])
    assert heard(deliveries, RIGHT) == [((51 + 63) * BIT, STATUS)]


def test_what_a_port_cut_off_wants_to_send_waits_until_it_is_back():
    bus = _bus(_cut(0, 500 * BIT, "left"))
    deliveries = run(bus, [(BIT, LEFT, STATUS), (BIT, LEFT, SYNC), (2 * BIT, RIGHT, HEARTBEAT)])
    assert heard(deliveries, HOST) == [
        (57 * BIT, HEARTBEAT),
        (563 * BIT, STATUS),
        (614 * BIT, SYNC),
    ]
    assert bus.take_fault_events() == [
        (0, "cable", "left cut off", b""),
        (500 * BIT, "cable", "left back", b""),
    ]


def test_a_port_that_comes_back_while_the_bus_is_taken_waits_for_its_turn():
    bus = _bus(_cut(0, 10 * BIT, "left"))
    deliveries = run(bus, [(BIT, LEFT, SYNC), (BIT, RIGHT, STATUS), (BIT, HOST, HEARTBEAT)])
    assert [frame for _, (frame, _, _) in deliveries] == [STATUS, SYNC, HEARTBEAT]


@pytest.mark.parametrize(("back_ns", "first"), [(BIT - 1, SYNC), (BIT, SYNC), (BIT + 1, STATUS)])
def test_a_port_that_comes_back_takes_part_until_a_frame_has_started(back_ns, first):
    bus = _bus(_cut(0, back_ns, "left"))
    bus.submit(LEFT, SYNC, 0)
    run(bus, until_ns=BIT - 1)
    bus.submit(RIGHT, STATUS, BIT)
    deliveries = expire_all(bus, 10**9)
    assert deliveries[0][1][0] == first
    assert bus.statistics.busy_ns() == (51 + 66) * BIT
    assert len(deliveries) == 2


def test_a_frame_whose_sender_is_cut_off_is_destroyed_and_sent_again_later():
    bus = _bus(_cut(20 * BIT, 500 * BIT, "left"))
    deliveries = run(bus, [(0, LEFT, STATUS), (0, LEFT, SYNC), (0, RIGHT, HEARTBEAT)])
    assert heard(deliveries, HOST) == [
        ((66 + 55) * BIT, HEARTBEAT),
        (563 * BIT, STATUS),
        ((566 + 48) * BIT, SYNC),
    ]
    assert bus.statistics.busy_ns() == (66 + 58 + 66 + 51) * BIT


def test_a_sender_back_before_its_destroyed_frame_ends_sends_it_again_at_once():
    bus = _bus(_cut(20 * BIT, 30 * BIT, "left"))
    deliveries = run(bus, [(0, LEFT, STATUS), (0, LEFT, SYNC)])
    assert heard(deliveries, HOST) == [((66 + 63) * BIT, STATUS), ((132 + 48) * BIT, SYNC)]


@pytest.mark.parametrize("from_ns", [0, 999])
def test_a_sender_cut_off_at_the_start_leaves_the_bus_to_the_next(from_ns):
    bus = _bus(_cut(from_ns, None, "left"))
    deliveries = run(bus, [(0, LEFT, SYNC), (0, RIGHT, STATUS), (0, HOST, HEARTBEAT)])
    assert [(time_ns, frame) for time_ns, (frame, _, _) in deliveries] == [
        (63 * BIT, STATUS),
        ((66 + 55) * BIT, HEARTBEAT),
    ]
    assert bus.pending(LEFT) == 1
    assert bus.arbitration_losses(HOST) == 1


def test_a_sender_cut_off_in_its_first_bit_leaves_its_start_to_the_other():
    bus = _bus(_cut(100 * BIT + 999, None, "left"))
    deliveries = run(bus, [(100 * BIT, LEFT, SYNC), (100 * BIT, RIGHT, STATUS)])
    assert deliveries == [(163 * BIT, (STATUS, RIGHT, 1 << LEFT << 2))]


def test_a_sender_cut_off_alone_at_its_start_leaves_the_bus_idle():
    bus = _bus(_cut(1, None, "left"))
    assert run(bus, [(0, LEFT, SYNC)]) == []
    assert bus.next_deadline_ns() is None
    assert run(bus, [(10 * BIT, RIGHT, STATUS)]) == [(73 * BIT, (STATUS, RIGHT, 1 << LEFT << 2))]


def test_a_candidate_cut_off_while_it_waits_competes_no_more():
    bus = _bus(_cut(20 * BIT, None, "left"))
    deliveries = run(bus, [(0, RIGHT, STATUS), (10 * BIT, LEFT, SYNC), (10 * BIT, HOST, HEARTBEAT)])
    assert [frame for _, (frame, _, _) in deliveries] == [STATUS, HEARTBEAT]
    assert bus.arbitration_losses(LEFT) == 0


def test_arbitrations_lost_before_a_cut_count():
    bus = _bus(_cut(20 * BIT, None, "left"))
    run(bus, [(0, LEFT, STATUS), (0, RIGHT, SYNC)])
    assert bus.arbitration_losses(LEFT) == 1


def test_a_port_that_comes_back_in_the_intermission_waits_for_its_end():
    bus = _bus(_cut(0, 49 * BIT, "left"))
    deliveries = run(bus, [(0, LEFT, STATUS), (0, RIGHT, SYNC)])
    assert [time_ns for time_ns, _ in deliveries] == [48 * BIT, (51 + 63) * BIT]


def test_a_port_attached_during_a_cut_is_cut_off():
    bus = CanBus("can0", faults=FaultPlan([_cut(0, 10 * BIT, "left")], _no_draw))
    for name in NAMES:
        bus.attach(name)
    deliveries = run(bus, [(0, LEFT, SYNC), (0, RIGHT, STATUS)])
    assert heard(deliveries, LEFT) == []
    assert [frame for _, (frame, _, _) in deliveries] == [STATUS, SYNC]


def test_a_delayed_frame_does_not_reach_a_port_cut_off_meanwhile():
    delay = FaultRule("gateway", FaultKind.DELAY, delay_ns=100)
    bus = _bus(delay, _cut(END + 50, None, "right"))
    deliveries = run(bus, [(0, LEFT, SYNC)])
    assert heard(deliveries, RIGHT) == []
    assert heard(deliveries, HOST) == [(END + 100, SYNC)]
    assert bus.take_fault_events()[-1] == (END + 50, "cable", "right cut off", b"")


def test_withdrawing_from_a_port_cut_off_forgets_all_its_frames():
    bus = _bus(_cut(0, 10 * BIT, "left"))
    run(bus, [(0, LEFT, SYNC), (0, LEFT, STATUS)], until_ns=BIT)
    assert bus.pending(LEFT) == 2
    assert bus.withdraw(LEFT) == 2
    assert expire_all(bus, 10**9) == []


# --- while it runs


def test_a_rule_can_come_and_go_while_the_bus_runs():
    bus = _bus()
    bus.submit(LEFT, STATUS, 0)
    bus.inject(_cut(0, None, "right"), 10)
    assert heard(expire_all(bus, 100 * BIT), RIGHT) == []
    bus.lift("cable", 100 * BIT)
    bus.submit(LEFT, STATUS, 100 * BIT)
    deliveries = expire_all(bus, 10**9)
    assert deliveries == [(163 * BIT, (STATUS, LEFT, DELIVERED))]
    assert bus.take_fault_events() == [
        (10, "cable", "right cut off", b""),
        (100 * BIT, "cable", "right back", b""),
    ]


def test_a_cut_lifted_during_a_frame_leaves_the_port_deaf_to_it_and_then_costs_nothing():
    bus = _bus(_cut(0, None, "right"))
    run(bus, [(0, LEFT, STATUS), (0, LEFT, SYNC)], until_ns=10 * BIT)
    bus.lift("cable", 10 * BIT)
    assert heard(expire_all(bus, 10**9), RIGHT) == [((66 + 48) * BIT, SYNC)]
    assert not bus._faulty


def test_lifting_a_cut_sends_what_has_waited():
    bus = _bus(_cut(0, None, "left"))
    bus.submit(LEFT, STATUS, 0)
    assert bus.next_deadline_ns() is None
    bus.lift("cable", 100)
    assert bus.next_deadline_ns() == 100 + 63 * BIT


def test_a_bus_without_a_plan_takes_no_rules():
    bus = CanBus("can0")
    with pytest.raises(ValueError, match="can0 has no fault plan"):
        bus.inject(FaultRule("x", FaultKind.DROP), 0)
    with pytest.raises(ValueError, match="can0 has no fault plan"):
        bus.lift("x", 0)
    assert bus.take_fault_events() == []
    assert bus.faults_fired() == {}


# --- whatever the faults


def _no_draw() -> float:
    raise AssertionError("a draw where none is needed")


KINDS = st.sampled_from(FaultKind)
SOME_PORTS = st.lists(st.sampled_from(NAMES), max_size=2, unique=True).map(tuple)


@st.composite
def rules(draw: st.DrawFn) -> tuple[FaultRule, ...]:
    made = []
    for number in range(draw(st.integers(0, 4))):
        kind = draw(KINDS)
        from_ns = draw(st.integers(0, 400)) * BIT // 2
        until_ns = from_ns + draw(st.integers(1, 400)) * BIT // 2
        if kind is FaultKind.CUT:
            ports = draw(SOME_PORTS) or ("left",)
            rule = FaultRule(f"{number}", kind, ports=ports, from_ns=from_ns, until_ns=until_ns)
        else:
            rule = FaultRule(
                f"{number}",
                kind,
                ports=draw(SOME_PORTS),
                from_ns=from_ns,
                until_ns=draw(st.sampled_from([None, until_ns])),
                probability=draw(st.sampled_from([1.0, 0.5])),
                limit=draw(st.sampled_from([None, 2])),
                delay_ns=draw(st.integers(1, 300)) * BIT if kind is FaultKind.DELAY else 0,
            )
        made.append(rule)
    return tuple(made)


@st.composite
def traffic(draw: st.DrawFn) -> list[Submission]:
    submissions = []
    now_ns = 0
    for frame in draw(st.lists(wire.fields(), max_size=12)):
        now_ns += draw(st.sampled_from([0, 0, 500, 1000, 30_000, 60_000, 250_000]))
        submissions.append((now_ns, draw(st.integers(0, 2)), frame.can_frame()))
    return submissions


@given(rules(), traffic())
def test_no_fault_loses_reorders_or_doubles_what_a_node_knows_to_have_sent(plan, submissions):
    bus = _bus(*plan)
    deliveries = run(bus, submissions)
    for port in (LEFT, RIGHT, HOST):
        wanted = [frame for _, sender, frame in submissions if sender == port]
        assert [frame for _, frame in confirmed(deliveries, port)] == wanted
        assert bus.pending(port) == 0
    assert bus.next_deadline_ns() is None
    assert bus.statistics.frames == len(submissions)
    assert len(bus.take_fault_events()) >= sum(bus.faults_fired().values())
    event("faults fired" if sum(bus.faults_fired().values()) else "none fired")


@given(rules(), traffic(), st.integers(0, 3))
def test_the_same_seed_makes_the_same_faults(plan, submissions, seed):
    first, second = _bus(*plan, seed=seed), _bus(*plan, seed=seed)
    assert run(first, submissions) == run(second, submissions)
    assert first.take_fault_events() == second.take_fault_events()


@given(traffic())
def test_an_empty_plan_changes_nothing(submissions):
    plain = CanBus("can0")
    for name in NAMES:
        plain.attach(name)
    assert run(plain, submissions) == run(_bus(), submissions)


@given(traffic())
def test_a_plan_that_hits_nothing_changes_nothing(submissions):
    other = FaultRule("elsewhere", FaultKind.DROP, sender="nobody")
    assert run(_bus(), submissions) == run(_bus(other), submissions)


@given(rules(), traffic())
def test_nobody_hears_a_frame_more_often_than_faults_explain(plan, submissions):
    bus = _bus(*plan)
    deliveries = run(bus, submissions)
    twice = sum(bus.faults_fired()[rule.name] for rule in plan if rule.kind is FaultKind.DUPLICATE)
    sent = sum(1 for _, (_, _, kind) in deliveries if kind & KIND_MASK != HEARD)
    for port in (LEFT, RIGHT, HOST):
        own = len(confirmed(deliveries, port))
        assert len(heard(deliveries, port)) <= sent - own + twice
