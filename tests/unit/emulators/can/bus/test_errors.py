"""Errors on a bus: bus-off, lone nodes, noise, babble, shorts, splits."""

import random

import pytest

from motorhil.emulators.can import error_confinement as told
from motorhil.emulators.can.bus.bus import CanBus
from motorhil.emulators.can.bus.fault_plan import FaultPlan
from motorhil.emulators.can.bus.port import KIND_MASK, TOLD
from motorhil.emulators.can.controller_config import CanNode, FrameSupport
from motorhil.emulators.can.error_confinement import ErrorState
from motorhil.emulators.can.fault_rules import FaultKind, FaultRule, FrameError, WireLevel
from motorhil.emulators.can.frame import BRS, can_id_of, pack, pack_fd
from tests.support.can.deliveries import (
    BIT,
    Timed,
    confirmed,
    expire_all,
    heard,
    run,
    traffic,
)
from tests.support.can.faulty_bus import HEARTBEAT, HOST, LEFT, RIGHT, STATUS, SYNC, bus_with
from tests.support.can.noisy_bus import noisy_hours

RATES = [125_000, 250_000, 500_000, 1_000_000]
# The bits of STATUS around the struck one, 20: ...1 1 [0] 0 0 1 1...
STRUCK = 20
OFF_BITS = 16 * 44 + 8 + 15 * 49 + STRUCK + 1
BACK_BITS = OFF_BITS - (STRUCK + 1) + 30 + 128 * 11


def classes(deliveries: list[Timed], port: int, wanted: int) -> list[int]:
    """Return when this port's controller reported these classes of errors."""
    return [
        time_ns
        for time_ns, (frame, sender, kind) in deliveries
        if sender == port and kind & KIND_MASK == TOLD and can_id_of(frame) & wanted
    ]


def struck_bus(rate: int, chip: CanNode) -> CanBus:
    rule = FaultRule("strike", FaultKind.ERROR, identifier=0x181, bit=STRUCK)
    bus = CanBus("can0", rate, FaultPlan([rule], random.Random(1).random))
    bus.attach("left", chip)
    bus.attach("right")
    return bus


@pytest.mark.parametrize("rate", RATES)
def test_bus_off_and_recovery_are_exact_to_the_bit(rate):
    """By hand, from ISO 11898-1.

    Active, 44 bits per attempt: bit error in 20, its flag 21 to 26, whose sixth bit is the stuff
    error of the others, theirs 27 to 32, delimiter to 40, intermission to 43. After 16 of them TEC
    is 128, and it suspends 8 bits. Passive, 41 + 8: its flag is recessive, the others see the sixth
    recessive bit in 23, their flags are 24 to 29, delimiter to 37, intermission to 40. In the 32nd
    attempt TEC is 256 at the end of bit 20. The wire is recessive from that attempt's bit 30 on.
    """
    bit_ns = 10**9 // rate
    bus = struck_bus(rate, CanNode())
    deliveries = run(bus, [(0, 0, STATUS)])
    assert classes(deliveries, 0, told.MESSAGE_BUS_OFF) == [OFF_BITS * bit_ns]
    assert classes(deliveries, 0, told.RESTARTED) == [BACK_BITS * bit_ns]
    assert bus.node(0).aborted == 1
    assert bus.node(0).confinement.tec == 0
    assert bus.node(1).confinement.rec == 32
    assert bus.pending(0) == 0


@pytest.mark.parametrize("rate", RATES)
def test_recovery_by_command_takes_128_runs_of_11_bits(rate):
    bit_ns = 10**9 // rate
    bus = struck_bus(rate, CanNode(recovery_ns=None))
    deliveries = run(bus, [(0, 0, STATUS)])
    assert classes(deliveries, 0, told.RESTARTED) == []
    assert bus.error_state(0) is ErrorState.BUS_OFF
    assert bus.node(0).confinement.tec == 255  # as reported
    bus.restart(0, 10**12)
    deliveries = expire_all(bus, 2 * 10**12)
    assert classes(deliveries, 0, told.RESTARTED) == [10**12 + 1408 * bit_ns]
    with pytest.raises(ValueError, match=r"left is not bus-off \(TEC 0, REC 0\)"):
        bus.restart(0, 2 * 10**12)


def test_error_free_frame_counts_as_one_recessive_run():
    """ACK delimiter, end of frame and intermission; no other part of a frame is as long."""
    rule = FaultRule("strike", FaultKind.ERROR, identifier=0x181, bit=STRUCK)
    bus = bus_with(rule)
    run(bus, [(0, LEFT, STATUS)], until_ns=OFF_BITS * BIT)
    start_ns = (OFF_BITS + 20) * BIT
    deliveries = run(bus, [(start_ns, RIGHT, SYNC)] * 200)
    last = [time_ns for time_ns, _ in heard(deliveries, HOST)]
    (back_ns,) = classes(deliveries, LEFT, told.RESTARTED)
    # From bit 30 of its last attempt on the wire is recessive until the first SYNC, which may begin
    # in bit 41: that is the first run, and each SYNC gives another.
    assert back_ns == last[126] + 3 * BIT


def test_frames_of_bus_off_node_are_aborted_and_reported():
    bus = struck_bus(1_000_000, CanNode(recovery_ns=None))
    run(bus, [(0, 0, STATUS), (0, 0, SYNC)], until_ns=10**9)
    bus.submit(0, HEARTBEAT, 10**9)
    assert bus.pending(0) == 0
    events = [event[2:] for event in bus.take_fault_events() if event[1] == "left"]
    assert events == [
        ("bus-off", b""),
        ("not sent: bus-off", STATUS),
        ("not sent: bus-off", SYNC),
        ("not sent: bus-off", HEARTBEAT),
    ]


@pytest.mark.parametrize("waits", [False, True], ids=["nobody waits", "a less urgent frame waits"])
def test_passive_node_suspends_after_successful_frame(waits):
    """16 attempts of 44 bits, then passive: 8, and one of 41 + 8; STATUS has 66, HEARTBEAT 58.

    Lengths by can-utils, with intermission. Then TEC is 135, and SYNC (51) has to wait for 8 bits
    more, or for the frame that another node begins in them.
    """
    rule = FaultRule("strike", FaultKind.ERROR, identifier=0x181, bit=STRUCK, limit=17)
    bus = bus_with(rule)
    begins = 16 * 44 + 8 + 49
    submitted = [(0, LEFT, STATUS), (0, LEFT, SYNC)]
    if waits:
        submitted.append(((begins + 30) * BIT, RIGHT, HEARTBEAT))
    deliveries = run(bus, submitted)
    assert bus.node(LEFT).confinement.tec == 134
    after = begins + 66
    sync_begins = after + (58 if waits else 8)
    ends = [(begins + 63, STATUS), (sync_begins + 48, SYNC)]
    assert confirmed(deliveries, LEFT) == [(bit * BIT, frame) for bit, frame in ends]


def test_error_bit_beyond_frame_has_no_effect():
    """SYNC has 51 bits with intermission, STATUS 66 (can-utils): 51 is the 52nd."""
    bus = bus_with(FaultRule("strike", FaultKind.ERROR, bit=51, limit=1))
    deliveries = run(bus, [(0, LEFT, SYNC), (0, LEFT, STATUS), (0, LEFT, STATUS)])
    assert bus.faults_fired() == {"strike": 1}
    assert [frame for _, frame in confirmed(deliveries, LEFT)] == [SYNC, STATUS, STATUS]
    assert [what for _, _, what, frame in bus.take_fault_events() if frame == SYNC] == []
    (struck_ns,) = classes(deliveries, LEFT, told.PROTOCOL)
    assert struck_ns == (51 + 52) * BIT


# --- missing acknowledgement


def test_lone_node_is_passive_after_16_attempts_and_never_off():
    """72 bits per attempt (54 to the ACK slot, 1, flag 6, delimiter 8, intermission 3)."""
    bus = CanBus("can0")
    bus.attach("left")
    deliveries = run(bus, [(0, 0, STATUS)], until_ns=3600 * 10**9)
    passive_ns = classes(deliveries, 0, told.CONTROLLER)
    assert passive_ns == [(11 * 72 + 55) * BIT, (15 * 72 + 55) * BIT]  # warning at 96, and 128
    assert bus.node(0).confinement.tec == 128
    assert len(deliveries) < 40  # an hour of attempts costs nothing
    assert [what for _, _, what, _ in bus.take_fault_events()] == ["nobody acknowledges"]
    bus.attach("right", now_ns=3600 * 10**9)
    deliveries = expire_all(bus, 3601 * 10**9)
    assert [frame for _, frame in heard(deliveries, 1)] == [STATUS]
    assert len(confirmed(deliveries, 0)) == 1
    assert bus.node(0).confinement.tec == 127


def test_one_shot_frame_is_tried_once():
    bus = CanBus("can0")
    bus.attach("left", CanNode(one_shot=True))
    assert traffic(run(bus, [(0, 0, STATUS)])) == []
    assert (bus.pending(0), bus.node(0).aborted) == (0, 1)
    assert ("left", "not sent: one-shot", STATUS) in [
        event[1:] for event in bus.take_fault_events()
    ]


def test_one_shot_frame_losing_arbitration_is_not_sent():
    bus = CanBus("can0")
    bus.attach("left", CanNode(one_shot=True))
    bus.attach("right")
    deliveries = run(bus, [(0, 0, STATUS), (0, 1, SYNC)])
    assert [frame for _, (frame, _, _) in traffic(deliveries)] == [SYNC]
    assert bus.node(0).aborted == 1


# --- one error


@pytest.mark.parametrize("error", FrameError)
def test_each_error_kind_repeats_classical_frame(error):
    bus = bus_with(FaultRule("strike", FaultKind.ERROR, error=error, limit=1))
    deliveries = run(bus, [(0, LEFT, STATUS)])
    times = 2 if error is FrameError.LAST else 1
    assert [frame for _, frame in heard(deliveries, HOST)] == [STATUS] * times
    assert bus.faults_fired() == {"strike": 1}
    assert bus.node(LEFT).confinement.tec == 7  # 8, and sent
    seen = {
        frame[10]
        for _, (frame, _, kind) in deliveries
        if kind & KIND_MASK == TOLD and can_id_of(frame) & told.PROTOCOL
    }
    wanted = {
        FrameError.BIT: told.BIT0_ERROR,  # a dominant bit of the length
        FrameError.STUFF: told.STUFF_ERROR,
        FrameError.FORM: told.FORM_ERROR,
        FrameError.CRC: 0,
        FrameError.ACK: told.TRANSMITTING,
        FrameError.LAST: told.OVERLOAD,  # to the others
    }[error]
    assert any(one & 0x7F == wanted & 0x7F for one in seen), [hex(one) for one in seen]


@pytest.mark.parametrize("error", FrameError)
@pytest.mark.parametrize(("length", "flags"), [(0, 0), (16, BRS), (20, BRS), (64, 0)])
def test_each_error_kind_repeats_can_fd_frame(error, length, flags):
    """CRC-17 and CRC-21, with and without a switch; a CRC error appears at the end."""
    chip = CanNode(frames=FrameSupport.FD)
    rule = FaultRule("strike", FaultKind.ERROR, error=error, limit=1)
    bus = CanBus("can0", 500_000, FaultPlan([rule], random.Random(1).random), 2_000_000)
    sender, ear = bus.attach("sender", chip), bus.attach("ear", chip)
    frame = pack_fd(0x123, bytes(length), flags)
    deliveries = run(bus, [(0, sender, frame)])
    *before, (end_ns, _) = heard(deliveries, ear)
    assert len(before) == (error is FrameError.LAST)
    plain = CanBus("can0", 500_000, data_bitrate_bit_s=2_000_000)
    for name in ("sender", "ear"):
        plain.attach(name, chip)
    ((plain_ns, _),) = heard(run(plain, [(0, sender, frame)]), ear)
    assert end_ns > plain_ns
    assert bus.node(sender).confinement.tec == 7
    if error is FrameError.CRC:
        first = min(classes(deliveries, ear, told.PROTOCOL))
        assert 0 < plain_ns - first <= 9 * 2 * BIT  # CRC delimiter, ACK, its delimiter, EOF


# --- noise, babble, shorts, splits


def test_noise_inverts_bits_at_its_rate():
    """1e-3 over 2000 frames: about 150 expected; tolerance of 5 sigma of a binomial."""
    bus = bus_with(FaultRule("noise", FaultKind.NOISE, bit_error_rate=1e-3), seed=3)
    frames = 2000
    submissions = [(number * 400 * BIT, LEFT, STATUS) for number in range(frames)]
    deliveries = run(bus, submissions)
    assert len(confirmed(deliveries, LEFT)) == frames
    bits = bus.statistics.bits + bus.statistics.bits_lost
    expected = bits * 1e-3
    assert abs(bus.faults_fired()["noise"] - expected) < 5 * expected**0.5
    assert bus.statistics.errors > 100


def test_babbling_node_lets_only_more_urgent_frames_pass():
    babble = FaultRule(
        "idiot", FaultKind.BABBLE, identifier=0x100, sender="right", until_ns=2000 * BIT
    )
    bus = bus_with(babble)
    deliveries = run(bus, [(10 * BIT, LEFT, STATUS), (10 * BIT, HOST, SYNC)])
    order = [frame for _, frame in heard(deliveries, HOST)]
    assert order[-1] == STATUS
    assert set(order[:-1]) == {pack(0x100)}
    assert confirmed(deliveries, RIGHT) == []  # its node has not submitted anything
    assert confirmed(deliveries, HOST)[0][0] < 200 * BIT


@pytest.mark.parametrize("level", WireLevel)
def test_short_stops_bus_until_it_ends(level):
    short = FaultRule("short", FaultKind.SHORT, level=level, from_ns=20 * BIT, until_ns=400 * BIT)
    bus = bus_with(short)
    deliveries = run(bus, [(0, LEFT, STATUS), (100 * BIT, RIGHT, SYNC)])
    assert all(time_ns > 400 * BIT for time_ns, _ in traffic(deliveries))
    given_up = bus.node(LEFT).aborted + bus.node(RIGHT).aborted
    assert len(heard(deliveries, HOST)) + given_up == 2
    assert bus.node(LEFT).errors > 0


def test_split_bus_is_two_buses():
    split = FaultRule("cable", FaultKind.SPLIT, ports=("a", "b"), from_ns=0)
    whole = CanBus("can0", faults=FaultPlan([split], random.Random(1).random))
    for name in "abcd":
        whole.attach(name)
    halves = [CanBus("one"), CanBus("two")]
    for number, name in enumerate("abcd"):
        halves[number // 2].attach(name)
    draw = random.Random(7)
    plans: list[list[tuple[int, int, bytes]]] = [[], []]
    both = []
    for number in range(300):
        port = draw.randrange(4)
        time_ns = number * 60 * BIT + draw.randrange(40 * BIT)
        frame = pack(0x100 + 4 * draw.randrange(64) + port, draw.randbytes(draw.randrange(9)))
        both.append((time_ns, port, frame))
        plans[port // 2].append((time_ns, port % 2, frame))
    deliveries = run(whole, both)
    for half in range(2):
        alone = run(halves[half], plans[half])
        here = [one for one in deliveries if one[1][1] // 2 == half]
        assert [(time_ns, frame) for time_ns, (frame, _, _) in here] == [
            (time_ns, frame) for time_ns, (frame, _, _) in alone
        ]
        for port in range(2):
            assert heard(deliveries, 2 * half + port) == heard(alone, port)
    assert whole.statistics.frames == 300


def test_noisy_hour_loses_or_doubles_no_frame_silently():
    """`make bench` runs 24 hours: 15 CPU s on one core."""
    bus, tally = noisy_hours(1, rate=3e-5)
    struck = bus.faults_fired()["noise"]
    assert struck > 100
    assert tally.wrong == []
    assert tally.confirmed == tally.submitted
    assert bus.statistics.errors >= struck


@pytest.mark.parametrize(
    ("kind", "noticed"),
    [(FaultKind.DROP, ["10000 of 0 is lost"]), (FaultKind.DUPLICATE, ["10000 of 0 came twice"])],
)
def test_lost_or_doubled_frame_in_noisy_hour_is_detected(kind, noticed):
    planted = FaultRule("planted", kind, sender="left", skip=10_000, limit=1)
    _, tally = noisy_hours(1, planted=(planted,))
    assert tally.wrong == noticed
    assert tally.confirmed == tally.submitted


def test_cost_of_endless_noise_is_proportional_to_time():
    """Eight nodes each misread one bit in ten.

    All hear the 11 recessive bits of a delimiter and an intermission with a chance of 0.9 ** 88,
    once in 10,000 tries. Computing the whole episode before playing it would not end; the next
    events are known early.
    """
    names = tuple("abcdefgh")
    rule = FaultRule("storm", FaultKind.NOISE, bit_error_rate=0.1, ports=names, until_ns=3000 * BIT)
    bus = CanBus("can0", faults=FaultPlan([rule], random.Random(1).random))
    for name in names:
        bus.attach(name)
    bus.submit(0, STATUS, 0)
    expire_all(bus, 3000 * BIT - 1)
    assert bus._playback is not None
    assert not bus._playback.end.is_over
    assert 3000 <= bus._playback.end.bits <= 2 * 3000 + 512
    expire_all(bus, 3000 * BIT)  # its last inverted bit was before
    assert bus._playback.end.is_over
    assert bus._playback.end.bits <= 3000 + 14 + 8 + 3
    deliveries = expire_all(bus, 10**9)
    assert bus.node(0).aborted + len(confirmed(deliveries, 0)) == 1


def test_same_seed_gives_same_errors():
    def story(seed):
        rule = FaultRule("noise", FaultKind.NOISE, bit_error_rate=1e-3)
        bus = bus_with(rule, seed=seed)
        return run(bus, [(number * 300 * BIT, number % 3, STATUS) for number in range(300)])

    assert story(1) == story(1)
    assert story(1) != story(2)


# --- found by the state machine test


def test_noise_beginning_in_frame_strikes_none_of_its_bits():
    bus = bus_with(seed=2)
    bus.submit(LEFT, STATUS, 0)
    expire_all(bus, 40 * BIT)
    noise = FaultRule("noise", FaultKind.NOISE, bit_error_rate=0.1)
    bus.inject(noise, 40 * BIT + 500)
    bus.inject(FaultRule("short", FaultKind.SHORT, level=WireLevel.DOMINANT), 40 * BIT + 500)
    due_ns = bus.next_deadline_ns()
    assert due_ns is not None
    assert due_ns > 40 * BIT + 500


def test_short_with_changed_level_ends_after_both():
    bus = bus_with(
        FaultRule("low", FaultKind.SHORT, level=WireLevel.DOMINANT, until_ns=500 * BIT),
        FaultRule("high", FaultKind.SHORT, level=WireLevel.RECESSIVE, until_ns=600 * BIT),
    )
    deliveries = run(bus, [(700 * BIT, LEFT, STATUS)])
    assert heard(deliveries, HOST) == [(763 * BIT, STATUS)]


def test_recovery_delay_precedes_counting():
    """Exact to the bit, as without the delay; recessive bits before its end do not count."""
    bus = struck_bus(1_000_000, CanNode(recovery_ns=5000 * BIT))
    deliveries = run(bus, [(0, 0, STATUS)])
    assert classes(deliveries, 0, told.RESTARTED) == [(OFF_BITS + 5000 + 1408) * BIT]


def test_lone_node_moved_to_other_wire_is_not_acknowledged():
    """At any bit of its frame it becomes alone on another wire: no node has received it.

    A fixed bug: behind the ACK slot the frame was taken for sent, and lost unnoticed.
    """
    confinement = []
    for bit in range(80):  # an attempt has 8 bits less
        until_ns = 20_000_000 + bit * BIT
        cut = FaultRule("cut", FaultKind.CUT, ports=("left",), until_ns=until_ns)
        split = FaultRule("split", FaultKind.SPLIT, ports=("left",), from_ns=10_000_000)
        bus = bus_with(cut, split)
        deliveries = run(bus, [(0, LEFT, STATUS)], until_ns=until_ns + 100 * BIT)
        assert traffic(deliveries) == []
        confinement.append(bus.node(LEFT).confinement.tec)
    assert confinement == [128] * 80
