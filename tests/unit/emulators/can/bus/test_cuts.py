"""Effects of cuts on the traffic of a bus."""

import pytest

from motorhil.emulators.can.bus.bus import CanBus
from motorhil.emulators.can.bus.fault_plan import FaultPlan
from motorhil.emulators.can.fault_rules import FaultKind, FaultRule
from tests.support.can.deliveries import BIT, confirmed, expire_all, heard, run, traffic
from tests.support.can.faulty_bus import (
    END,
    HEARTBEAT,
    HOST,
    LEFT,
    NAMES,
    RIGHT,
    STATUS,
    SYNC,
    bus_with,
    cut,
    no_draw,
)

# --- cut


@pytest.mark.parametrize(
    ("from_ns", "until_ns", "hears"),
    [
        (END + 1, None, True),
        (END, None, False),
        (END - 1, END, False),  # part of a frame is not a frame
        (1, 2, False),
        (0, END, False),
    ],
)
def test_port_hears_only_frames_within_its_presence(from_ns, until_ns, hears):
    bus = bus_with(cut(from_ns, until_ns, "right"))
    deliveries = run(bus, [(0, LEFT, SYNC)])
    assert heard(deliveries, RIGHT) == ([(END, SYNC)] if hears else [])
    assert heard(deliveries, HOST) == [(END, SYNC)]
    assert confirmed(deliveries, LEFT) == [(END, SYNC)]


@pytest.mark.parametrize(("back_ns", "frames"), [(40 * BIT, 2), (40 * BIT + 1, 1), (49 * BIT, 1)])
def test_returning_port_integrates_by_11_recessive_bits(back_ns, frames):
    # ISO 11898-1, bus integration. SYNC is recessive from its ACK delimiter (40) on, STATUS begins
    # at 51. A port that returns later has the same 11 bits between STATUS and HEARTBEAT.
    bus = bus_with(cut(1, back_ns, "right"))
    deliveries = run(bus, [(0, LEFT, SYNC), (0, LEFT, STATUS), (0, HOST, HEARTBEAT)])
    both = [((51 + 63) * BIT, STATUS), ((51 + 66 + 55) * BIT, HEARTBEAT)]
    assert heard(deliveries, RIGHT) == both[-frames:]


def test_frame_of_cut_port_waits_until_return():
    bus = bus_with(cut(0, 500 * BIT, "left"))
    deliveries = run(bus, [(BIT, LEFT, STATUS), (BIT, LEFT, SYNC), (2 * BIT, RIGHT, HEARTBEAT)])
    assert heard(deliveries, HOST) == [
        (57 * BIT, HEARTBEAT),
        ((500 + 11 + 63) * BIT, STATUS),
        ((500 + 11 + 66 + 48) * BIT, SYNC),
    ]
    # On its stub: ACK slot 54, error flag 6, delimiter 8, intermission 3: 72 bits per attempt.
    assert bus.take_fault_events() == [
        (0, "cable", "left cut off", b""),
        ((1 + 72) * BIT, "left", "nobody acknowledges", STATUS),
        (500 * BIT, "cable", "left back", b""),
    ]


def test_returning_port_waits_for_busy_bus():
    bus = bus_with(cut(0, 10 * BIT, "left"))
    deliveries = run(bus, [(BIT, LEFT, SYNC), (BIT, RIGHT, STATUS), (BIT, HOST, HEARTBEAT)])
    assert [frame for _, (frame, _, _) in deliveries] == [STATUS, SYNC, HEARTBEAT]


@pytest.mark.parametrize(("back", "first"), [(-1, SYNC), (0, SYNC), (1, STATUS)])
def test_returning_port_joins_until_frame_has_started(back, first):
    bus = bus_with(cut(0, 9 * BIT + back, "left"))  # 11 recessive bits, then it takes part
    bus.submit(LEFT, SYNC, 0)
    run(bus, until_ns=20 * BIT - 2)
    bus.submit(RIGHT, STATUS, 20 * BIT)
    deliveries = traffic(expire_all(bus, 10**9))
    assert deliveries[0][1][0] == first
    assert bus.statistics.busy_ns() == (51 + 66) * BIT
    assert len(deliveries) == 2


def test_frame_of_sender_cut_in_flight_is_sent_again():
    bus = bus_with(cut(20 * BIT, 500 * BIT, "left"))
    # STATUS is recessive in bits 18 and 19, and from 20 on: bit 23 is the sixth. Error flags of all
    # (24 to 29), delimiter (8), intermission (3): the next frame begins at 41.
    deliveries = run(bus, [(0, LEFT, STATUS), (0, LEFT, SYNC), (0, RIGHT, HEARTBEAT)])
    assert heard(deliveries, HOST) == [
        ((41 + 55) * BIT, HEARTBEAT),
        ((500 + 11 + 63) * BIT, STATUS),
        ((500 + 11 + 66 + 48) * BIT, SYNC),
    ]
    assert bus.statistics.busy_ns() == (41 + 58 + 66 + 51) * BIT
    assert [bus.node(port).confinement.rec for port in (RIGHT, HOST)] == [0, 0]  # 1, and received


def test_sender_back_in_error_frame_sends_again_at_once():
    bus = bus_with(cut(20 * BIT, 30 * BIT, "left"))
    deliveries = run(bus, [(0, LEFT, STATUS), (0, LEFT, SYNC)])
    # The bus is recessive from 30 on, for 11 bits until 41 (see above).
    assert heard(deliveries, HOST) == [((41 + 63) * BIT, STATUS), ((41 + 66 + 48) * BIT, SYNC)]


@pytest.mark.parametrize("from_ns", [0, 999])
def test_sender_cut_at_start_frees_bus_for_next(from_ns):
    bus = bus_with(cut(from_ns, None, "left"))
    deliveries = traffic(run(bus, [(0, LEFT, SYNC), (0, RIGHT, STATUS), (0, HOST, HEARTBEAT)]))
    assert [(time_ns, frame) for time_ns, (frame, _, _) in deliveries] == [
        (63 * BIT, STATUS),
        ((66 + 55) * BIT, HEARTBEAT),
    ]
    assert bus.pending(LEFT) == 1
    assert bus.arbitration_losses(HOST) == 1


def test_sender_cut_in_first_bit_leaves_start_to_other():
    bus = bus_with(cut(100 * BIT + 999, None, "left"))
    deliveries = run(bus, [(100 * BIT, LEFT, SYNC), (100 * BIT, RIGHT, STATUS)])
    assert traffic(deliveries) == [(163 * BIT, (STATUS, RIGHT, 1 << LEFT << 2))]


def test_lone_sender_cut_at_start_leaves_bus_idle():
    bus = bus_with(cut(1, None, "left"))
    assert traffic(run(bus, [(0, LEFT, SYNC)])) == []
    assert bus.next_deadline_ns() is None
    deliveries = run(bus, [(10**9, RIGHT, STATUS)])
    assert deliveries == [(10**9 + 63 * BIT, (STATUS, RIGHT, 1 << LEFT << 2))]


def test_waiting_candidate_cut_off_leaves_arbitration():
    bus = bus_with(cut(20 * BIT, None, "left"))
    submissions = [(0, RIGHT, STATUS), (10 * BIT, LEFT, SYNC), (10 * BIT, HOST, HEARTBEAT)]
    deliveries = traffic(run(bus, submissions))
    assert [frame for _, (frame, _, _) in deliveries] == [STATUS, HEARTBEAT]
    assert bus.arbitration_losses(LEFT) == 0


def test_arbitrations_lost_before_cut_count():
    bus = bus_with(cut(20 * BIT, None, "left"))
    run(bus, [(0, LEFT, STATUS), (0, RIGHT, SYNC)])
    assert bus.arbitration_losses(LEFT) == 1


def test_port_returning_in_intermission_waits_for_its_end():
    bus = bus_with(cut(0, 49 * BIT, "left"))
    deliveries = run(bus, [(49 * BIT, LEFT, STATUS), (0, RIGHT, SYNC)][::-1])
    assert [time_ns for time_ns, _ in traffic(deliveries)] == [48 * BIT, (49 + 11 + 63) * BIT]


def test_port_attached_during_cut_is_cut_off():
    bus = CanBus("can0", faults=FaultPlan([cut(0, 10 * BIT, "left")], no_draw))
    for name in NAMES:
        bus.attach(name)
    deliveries = run(bus, [(0, LEFT, SYNC), (0, RIGHT, STATUS)])
    assert heard(deliveries, LEFT) == []
    assert [frame for _, (frame, _, _) in deliveries] == [STATUS, SYNC]


def test_delayed_frame_does_not_reach_cut_port():
    delay = FaultRule("gateway", FaultKind.DELAY, delay_ns=100)
    bus = bus_with(delay, cut(END + 50, None, "right"))
    deliveries = run(bus, [(0, LEFT, SYNC)])
    assert heard(deliveries, RIGHT) == []
    assert heard(deliveries, HOST) == [(END + 100, SYNC)]
    assert bus.take_fault_events()[-1] == (END + 50, "cable", "right cut off", b"")


def test_withdraw_at_cut_port_drops_all_frames():
    bus = bus_with(cut(0, 10 * BIT, "left"))
    run(bus, [(0, LEFT, SYNC), (0, LEFT, STATUS)], until_ns=BIT)
    assert bus.pending(LEFT) == 2
    assert bus.withdraw(LEFT) == 1  # the other one is on its stub
    deliveries = expire_all(bus, 10**9)
    assert [frame for _, (frame, _, _) in traffic(deliveries)] == [SYNC]
