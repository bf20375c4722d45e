"""CAN FD in the medium: two rates, senders and receivers."""

import pytest

from motorhil.emulators.can.bus.bus import CanBus
from motorhil.emulators.can.bus.fault_plan import FaultPlan
from motorhil.emulators.can.controller_config import CanNode, FrameSupport
from motorhil.emulators.can.error_confinement import ErrorState
from motorhil.emulators.can.fault_rules import FaultKind, FaultRule
from motorhil.emulators.can.frame import BRS, EFF_FLAG, can_id_of, pack, pack_fd
from motorhil.emulators.can.frame_length import frame_bits
from tests.support.can.deliveries import confirmed, expire_all, heard, run
from tests.support.can.faulty_bus import no_draw
from tests.support.can.fd_frame_bits import FdFields, phases

FD = CanNode(frames=FrameSupport.FD)
TOLERANT = CanNode(frames=FrameSupport.FD_TOLERANT)
FRAME = pack_fd(0x123, bytes.fromhex("0011223344556677"))  # 128 bits, by the vectors


def fd_bus(*chips, bitrate=500_000, data_bitrate=2_000_000):
    bus = CanBus("can0", bitrate, data_bitrate_bit_s=data_bitrate)
    for number, chip in enumerate(chips):
        bus.attach(f"node-{number}", chip)
    return bus


def test_frame_takes_its_bits_at_both_rates():
    # Source: CANFDFrameGenerator.h has 128 bits (test_can_fd_bits). By hand: 17 from start of frame
    # to BRS, without a stuff bit; 12 from ACK slot to intermission; so 99 between them.
    bus = fd_bus(FD, FD)
    deliveries = run(bus, [(0, 0, FRAME)])
    ends_ns = (17 + 12 - 3) * 2000 + 99 * 500
    assert heard(deliveries, 1) == [(ends_ns, FRAME)]
    assert confirmed(deliveries, 0) == [(ends_ns, FRAME)]


@pytest.mark.parametrize(("data_bitrate", "data_bit_ns"), [(500_000, 2000), (8_000_000, 125)])
@pytest.mark.parametrize("can_id", [0x7FF, 0x1FFFFFFF | EFF_FLAG])
def test_data_rates_from_equal_to_sixteenfold(data_bitrate, data_bit_ns, can_id):
    bus = fd_bus(FD, FD, data_bitrate=data_bitrate)
    frame = pack_fd(can_id, bytes(64))
    fields = FdFields(can_id & 0x1FFFFFFF, can_id > 0x7FF, True, False, bytes(64))
    nominal, data = phases(fields)
    [(ends_ns, _)] = heard(run(bus, [(0, 0, frame)]), 1)
    assert ends_ns == (nominal - 3) * 2000 + data * data_bit_ns


def test_frame_without_bit_rate_switch_is_nominal():
    bus = fd_bus(FD, FD)
    frame = pack_fd(0x123, bytes(64), 0)
    [(ends_ns, _)] = heard(run(bus, [(0, 0, frame)]), 1)
    assert ends_ns == (frame_bits(frame) - 3) * 2000


def test_next_frame_starts_after_three_nominal_bits():
    bus = fd_bus(FD, FD)
    deliveries = run(bus, [(0, 0, FRAME), (0, 0, FRAME), (0, 0, pack(0x7FF))])
    first, second, third = [time_ns for time_ns, _ in heard(deliveries, 1)]
    assert second - first == first + 3 * 2000
    assert third - second == (3 + 50 - 3) * 2000  # classical, 50 bits: can-physics.md 6.2


def test_load_and_counts_include_both_rates():
    bus = fd_bus(FD, FD)
    deliveries = run(bus, [(0, 0, FRAME), (0, 1, pack(0x80))])
    [(at_80_ns, _)] = heard(deliveries, 0)
    statistics = bus.statistics
    assert at_80_ns == (51 - 3) * 2000  # it wins; the other one follows
    [(ends_ns, _)] = heard(deliveries, 1)
    assert statistics.busy_ns() == ends_ns + 3 * 2000
    assert (statistics.frames, statistics.bits) == (2, 51 + 128)
    assert statistics.counts() == {0x80: 1, 0x123: 1}
    assert statistics.load(0, 2 * (ends_ns + 6000)) == pytest.approx(0.5)  # a float division


def test_arbitration_is_independent_of_format():
    bus = fd_bus(FD, FD, FD)
    frames = [pack_fd(0x300, bytes(12)), pack(0x200), pack_fd(0x100, b"", 0)]
    deliveries = run(bus, [(0, port, frame) for port, frame in enumerate(frames)])
    assert [can_id_of(frame) for _, (frame, _, _) in deliveries] == [0x100, 0x200, 0x300]


def test_fd_tolerant_node_hears_classical_frames_only():
    bus = fd_bus(FD, TOLERANT, FD)
    deliveries = run(bus, [(0, 0, FRAME), (0, 0, pack(0x80)), (0, 1, pack(0x81))])
    assert [can_id_of(frame) for _, frame in heard(deliveries, 1)] == [0x80]
    assert sorted(can_id_of(frame) for _, frame in heard(deliveries, 2)) == [0x80, 0x81, 0x123]


def test_fd_tolerant_node_does_not_acknowledge_fd_frames():
    bus = fd_bus(FD, TOLERANT)
    assert confirmed(run(bus, [(0, 0, FRAME)], until_ns=100_000_000), 0) == []
    assert bus.node(0).confinement.tec == 128


def test_classical_bus_refuses_fd_frame():
    bus = CanBus("can0", 500_000)
    port = bus.attach("node", FD)
    with pytest.raises(ValueError, match=r"123h: bus can0 is classical CAN.*data_bitrate_bit_s"):
        bus.submit(port, FRAME, 0)
    assert bus.pending(port) == 0
    assert bus.next_deadline_ns() is None


@pytest.mark.parametrize("support", [FrameSupport.CLASSICAL, FrameSupport.FD_TOLERANT])
def test_classical_node_cannot_send_fd_frame(support):
    bus = fd_bus(CanNode(frames=support), FD)
    with pytest.raises(ValueError, match=rf'node-0 on bus can0.*frames = "{support.value}"'):
        bus.submit(0, FRAME, 0)
    run(bus, [(0, 0, pack(0x80)), (0, 1, pack(0x81))])
    assert bus.statistics.frames == 2


NO_SWITCH = pack_fd(0x123, bytes.fromhex("0011223344556677"), 0)


def test_classical_node_destroys_fd_frame():
    """Its form error is in bit 44, the sender's bit error in 46: test_can_fd_episode, by hand."""
    bus = fd_bus(FD, TOLERANT, CanNode())
    bus.submit(0, NO_SWITCH, 0)
    deliveries = expire_all(bus, (47 + 6 + 8 + 3) * 2000)
    assert heard(deliveries, 2) == heard(deliveries, 1) == confirmed(deliveries, 0) == []
    told = [(frame[3], port) for _, (frame, port, kind) in deliveries if frame[3] & 0x20]
    assert {port for _, port in told} >= {0, 2}
    assert bus.node(0).confinement.tec == 8
    assert bus.node(2).confinement.rec == 9  # form error: a; a dominant bit after its flag: b
    assert bus.pending(0) == 1


def test_classical_node_destroys_frames_until_passive():
    """Rules a and b: each frame costs it 9.

    After 15 frames it is passive at 135, and its flag recessive. Its neighbour's TEC is at 120
    then, and decreases with every frame that now succeeds.
    """
    bus = fd_bus(FD, FD, CanNode())
    deliveries = run(bus, [(0, 0, NO_SWITCH)], until_ns=100_000_000)
    assert [frame for _, frame in heard(deliveries, 1)] == [NO_SWITCH]
    assert heard(deliveries, 2) == []
    assert bus.node(0).confinement.tec == 15 * 8 - 1
    assert bus.node(2).state() is ErrorState.PASSIVE
    again = [(frame, end) for end, frame in heard(run(bus, [(200_000_000, 2, pack(0x80))]), 1)]
    assert again[0][0] == pack(0x80)  # and not bus-off


def test_waiting_fd_frame_is_checked_at_submission():
    bus = fd_bus(TOLERANT, FD)
    bus.submit(0, pack(0x80), 0)
    with pytest.raises(ValueError, match="FD"):
        bus.submit(0, FRAME, 0)
    assert bus.pending(0) == 1
    assert len(expire_all(bus, 10**9)) == 1


@pytest.mark.parametrize(
    ("rates", "told"),
    [
        (
            (500_000, 250_000),
            "data bit rate of 250000 bit/s is below the nominal bit rate of 500000",
        ),
        ((500_000, 3_000_000), "3000000 bit/s is not a whole number"),
        ((500_000, 0), "0 bit/s is not a whole number"),
    ],
)
def test_invalid_rates_are_refused(rates, told):
    with pytest.raises(ValueError, match=told):
        CanBus("can0", rates[0], data_bitrate_bit_s=rates[1])


def test_error_passive_sender_sets_esi():
    """ESI, after 16 failures: TEC is 128, and decreases by one with each frame sent."""
    rule = FaultRule("strike", FaultKind.ERROR, bit=14, limit=16)
    bus = CanBus("can0", 500_000, FaultPlan([rule], no_draw), 2_000_000)
    for name in ("sender", "ear"):
        bus.attach(name, FD)
    frames = [pack_fd(number, b"") for number in (0, 0, 1)]
    deliveries = run(bus, [(0, 0, frame) for frame in frames])
    assert [frame[5] for _, frame in heard(deliveries, 1)] == [7, 5, 5]  # at 128, 127, 126
    assert [frame for _, frame in confirmed(deliveries, 0)] == frames


def test_frame_flags_are_delivered():
    bus = fd_bus(FD, FD)
    [(_, arrived)] = heard(run(bus, [(0, 0, pack_fd(1, b"\x01", BRS | 2))]), 1)
    assert arrived[5] == 7
