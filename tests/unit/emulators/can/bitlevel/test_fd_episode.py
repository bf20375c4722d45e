"""CAN FD frames on the wire, with and without errors."""

import pytest
from hypothesis import event, example, given
from hypothesis import strategies as st

from motorhil.emulators.can import error_confinement as told
from motorhil.emulators.can.bitlevel.controller import CanStation
from motorhil.emulators.can.bitlevel.encoder import WireFrame
from motorhil.emulators.can.bitlevel.episode import Disturbance, EventKind, Station, run_episode
from motorhil.emulators.can.controller_config import FrameSupport
from motorhil.emulators.can.error_confinement import Confinement
from motorhil.emulators.can.frame_length import LENGTHS_MASK, measure, phases_of
from tests.support.can import fd_frame_bits as wire_fd
from tests.support.can import frame_bits as wire
from tests.support.can.fd_frame_bits import FdFields, fd_fields

FD = FrameSupport.FD
ONES = FdFields(0x2AA, False, True, False, b"\xff" * 3)
SENT = wire_fd.on_the_wire(ONES)
FLAG = "000000"
QUIET = "1" * 11


def receiver(support: FrameSupport = FD) -> CanStation:
    station = CanStation([], Confinement(), support=support)
    station.begin_idle()
    return station


def play(station: CanStation, sampled: str) -> str:
    """Return the levels that the node drives while it samples these levels."""
    drives = ""
    for bit, level in enumerate(sampled.replace(" ", "")):
        drives += str(station.drives)
        station.hear(int(level), bit)
    return drives


def errors(station: CanStation) -> list[tuple[int, int, int]]:
    return [
        (bit, m[10], m[11])
        for bit, kind, m in station.journal.notes
        if kind == EventKind.ERROR.value
    ]


def test_long_division_equals_crc_catalogue():
    """CRC RevEng: check values of CRC-17/CAN-FD and CRC-21/CAN-FD, whose registers begin empty."""
    bits = "".join(f"{byte:08b}" for byte in b"123456789")
    assert wire_fd.remainder(bits, wire_fd.GENERATOR_17, 0) == 0x04F03
    assert wire_fd.remainder(bits, wire_fd.GENERATOR_21, 0) == 0x0ED841


@given(fd_fields())
def test_sender_equals_bitwise_construction(frame):
    sent = WireFrame(frame.can_frame())
    assert "".join(map(str, sent.levels)) == wire_fd.on_the_wire(frame)
    assert (sent.fast_from, sent.fast_to) == wire_fd.data_phase(frame)


@given(fd_fields())
def test_bit_count_equals_bus_length(frame):
    first, end = wire_fd.data_phase(frame)
    nominal = len(wire_fd.on_the_wire(frame)) + 3 - (end - first)
    assert phases_of(measure(frame.can_frame()) & LENGTHS_MASK) == (nominal, end - first)


@given(fd_fields(), st.integers(2, 10))
def test_fd_nodes_accept_and_tolerant_nodes_wait(frame, ratio):
    stations = [Station(0, (frame.can_frame(),), support=FD), Station(1, support=FD)]
    tolerant = Station(2, support=FrameSupport.FD_TOLERANT)
    episode = run_episode([*stations, tolerant], ratio=ratio)
    last = len(wire_fd.on_the_wire(frame)) - 1
    assert [(e.bit, e.port, e.kind) for e in episode.events] == [
        (last - 1, 1, EventKind.ACCEPTED),
        (last, 0, EventKind.SENT),
    ]
    assert episode.events[0].frame == frame.can_frame()
    assert episode.bits == last + 4
    first, end = wire_fd.data_phase(frame)
    assert episode.fast == (((first, end),) if frame.brs else ())
    assert episode.end_ns(episode.bits - 1, 1000, 125) == 1000 * (last + 4) - 875 * (end - first)
    assert [outcome.integrating for outcome in episode.outcomes] == [0, 0, 0]
    event(f"{len(frame.data)} bytes")


def test_five_equal_bits_before_fixed_stuff_bit_add_none():
    zero = FdFields(0x2AA, False, False, False, b"\xe0")
    sent = wire_fd.dynamically_stuffed(zero)
    assert sent.endswith("11100000")
    levels = "".join(map(str, WireFrame(zero.can_frame()).levels))
    assert levels[len(sent)] == "1"  # the fixed one
    # The fixed bit is not counted: 0 01010101010 00 1 00000 [1] 01 11100000 has one stuff bit, not
    # two.
    assert levels[len(sent) + 1 : len(sent) + 5] == "0011"


def test_passive_sender_sets_esi():
    stations = [Station(0, (ONES.can_frame(),), tec=128, support=FD), Station(1, support=FD)]
    accepted, sent = [
        e for e in run_episode(stations).events if e.kind in (EventKind.ACCEPTED, EventKind.SENT)
    ]
    assert accepted.frame[5] == 0b111  # FDF, ESI, BRS
    assert sent.frame == ONES.can_frame()


def test_wrong_fixed_stuff_bit_is_form_error():
    start = len(wire_fd.dynamically_stuffed(ONES))
    station = receiver()
    wrong = SENT[:start] + SENT[start - 1] + FLAG + QUIET
    assert play(station, wrong) == "1" * (start + 1) + FLAG + QUIET
    assert errors(station) == [(start, told.FORM_ERROR, told.CRC_SEQUENCE)]


@pytest.mark.parametrize("acknowledged", ["1 1", "1 0", "0 0", "0"])
@pytest.mark.parametrize("bit", [2, 22])
def test_wrong_stuff_count_or_crc_is_signalled_after_ack(bit, acknowledged):
    """After the first fixed stuff bit come the 4 bits of the stuff count.

    The last of them precedes a fixed stuff bit, which would be wrong then, so it is not tested.
    With two bits of ACK slot the flag begins in the fourth bit after the CRC delimiter (ISO
    16845-1, 7.6.10).
    """
    place = len(wire_fd.dynamically_stuffed(ONES)) + bit
    wrong = SENT[:place] + ("0" if SENT[place] == "1" else "1") + SENT[place + 1 :]
    ack_slot = len(SENT) - 9
    station = receiver()
    sampled = wrong[:ack_slot] + acknowledged.replace(" ", "") + "1"
    assert play(station, sampled + FLAG + QUIET) == "1" * len(sampled) + FLAG + QUIET
    assert errors(station) == [(len(sampled) - 1, 0, told.CRC_SEQUENCE)]


def test_missing_ack_in_two_bit_slot_is_ack_error():
    """ISO 16845-1, 8.2.6 and 8.6.8: the error flag begins after both."""
    ack_slot = len(SENT) - 9
    sender = CanStation([ONES.can_frame()], Confinement(), support=FD)
    sender.begin_idle()
    assert (
        play(sender, SENT[:ack_slot] + "11" + FLAG + QUIET) == SENT[: ack_slot + 2] + FLAG + QUIET
    )
    assert errors(sender) == [(ack_slot + 1, told.TRANSMITTING, told.ACK_SLOT)]
    assert sender.confinement.tec == 8


def test_acknowledgement_may_be_one_bit_late():
    """ISO 16845-1, 8.2.7: the CRC delimiter up to two bits long."""
    ack_slot = len(SENT) - 9
    sender = CanStation([ONES.can_frame()], Confinement(), support=FD)
    sender.begin_idle()
    play(sender, SENT[:ack_slot] + "10" + SENT[ack_slot + 1 :] + "111")
    assert [kind for _, kind, _ in sender.journal.notes] == [EventKind.SENT.value]


@pytest.mark.parametrize("third", ["000", "100"])
def test_third_bit_is_ack_delimiter(third):
    ack_slot = len(SENT) - 9
    sender = CanStation([ONES.can_frame()], Confinement(), support=FD)
    sender.begin_idle()
    play(sender, SENT[:ack_slot] + third)
    ((bit, _, place),) = errors(sender)
    assert (bit, place) == (ack_slot + 2, told.ACK_DELIMITER)


@pytest.mark.parametrize(
    ("support", "sampled"),
    [
        (FrameSupport.FD_TOLERANT, "0 01010101010 00 1"),  # FDF
        (FrameSupport.FD, "0 01010101010 00 11"),  # FDF and res: a future format
    ],
)
def test_protocol_exception_waits_for_11_recessive_bits(support, sampled):
    station = receiver(support)
    assert play(station, sampled) == "1" * len(sampled.replace(" ", ""))
    play(station, "1010" * 30 + "1111111111")
    assert station.waits_for == 1
    station.hear(1, 0)
    assert station.is_ready()
    assert station.journal.notes == []


def test_second_dominant_bit_belongs_to_ack_slot():
    ack_slot = len(SENT) - 9
    stretched = SENT[:ack_slot] + "00" + SENT[ack_slot + 1 :]
    station = receiver()
    play(station, stretched + "111")
    assert [kind for _, kind, _ in station.journal.notes] == [EventKind.ACCEPTED.value]
    sender = CanStation([ONES.can_frame()], Confinement(), support=FD)
    sender.begin_idle()
    play(sender, stretched + "111")
    assert [kind for _, kind, _ in sender.journal.notes] == [EventKind.SENT.value]
    station = receiver()
    play(station, SENT[:ack_slot] + "000")
    assert errors(station) == [(ack_slot + 2, told.FORM_ERROR, told.ACK_DELIMITER)]


def test_classical_controller_reads_fd_frame_until_error():
    """By hand: ONES, 4 bits at the data rate to a nominal one, sampled in the last.

    ... FDF 1, res 0, BRS 1 is bit 16; then 0 0011 and ones, whose stuff bits are 25, 31, 37 and 43.
    The classical one samples 20, 24, 28 and 32 as 1 after BRS: five; and 36, a stuff error. Its
    flag is on the wire from 37. The sender's 1 in bit 38 is the first to be dominated. The other
    receiver's sixth dominant bit is 42, so its flag is a nominal bit behind that of the other two:
    they end with the sixth nominal bit (40, 44, 45, ... 48) and with 49; then 8 and 3.
    """
    stations = [Station(0, (ONES.can_frame(),), support=FD), Station(1, support=FD), Station(2)]
    episode = run_episode(stations, ratio=4)
    assert SENT.startswith(
        "0" + "01010101010" + "00" + "101" + "00011" + "111" + "0" + "11111" + "0"
    )
    assert [(e.bit, e.port, e.frame[10]) for e in episode.events if e.kind is EventKind.ERROR] == [
        (36, 2, told.STUFF_ERROR),
        (38, 0, told.BIT1_ERROR | told.TRANSMITTING),
        (42, 1, told.STUFF_ERROR),
    ]
    assert episode.fast == ((17, 45),)
    assert episode.bits == 50 + 8 + 3
    assert [(outcome.tec, outcome.rec) for outcome in episode.outcomes] == [(8, 0), (0, 1), (0, 9)]


def test_fd_frame_without_switch_ends_as_classical_form_error():
    """By hand, 123h: FDF is r0; res, BRS, ESI and the first bit of the DLC, 0001, are a DLC of 1.

    The other three bits and five of the first byte are its data; the last three of that byte, 11h
    and 2h are its CRC; the next bit, of the next 2h, the CRC delimiter: with two stuff bits it is
    44, and dominant, a form error. The sender's next recessive bit is 46.
    """
    frame = FdFields(0x123, False, False, False, bytes.fromhex("0011223344556677"))
    stations = [Station(0, (frame.can_frame(),), support=FD), Station(1)]
    episode = run_episode([*stations, Station(2, support=FrameSupport.FD_TOLERANT)])
    sent = wire_fd.on_the_wire(frame)
    assert sent.startswith(
        "0" + "00100100011" + "00" + "1" + "0001" + "00000" + "1" + "00000" + "1"
    )
    assert sent[44] == sent[45] == "0" != sent[46]
    assert [(e.bit, e.port, e.frame[11]) for e in episode.events if e.kind is EventKind.ERROR] == [
        (44, 1, told.CRC_DELIMITER),
        (46, 0, told.DATA),
    ]
    assert episode.bits == 47 + 6 + 8 + 3
    assert [(outcome.tec, outcome.rec) for outcome in episode.outcomes] == [(8, 0), (0, 9), (0, 0)]


def test_sender_silent_in_data_phase_is_detected_there():
    """Five recessive bits, and a missing stuff bit; one flag of six nominal bits."""
    first, _ = wire_fd.data_phase(ONES)
    ones = SENT.index("11111", first)
    stations = [Station(0, (ONES.can_frame(),), support=FD, leaves_at=ones + 5)]
    episode = run_episode([*stations, Station(1, support=FD)], ratio=4)
    assert [(e.bit, e.port, e.kind) for e in episode.events] == [(ones + 5, 1, EventKind.ERROR)]
    assert episode.fast == ((first, ones + 6),)
    assert episode.bits == ones + 6 + 6 + 8 + 3


def test_error_in_data_phase_is_signalled_at_nominal_rate():
    """By hand, 4 bits at the data rate to a nominal one.

    The sender misreads the third of five data bits 1. Its flag begins, the others sample 4 dominant
    bits in its first nominal bit and the sixth in its second. Their flags take the rest of it and
    five more: together 7 nominal bits, then delimiter and intermission.
    """
    first, _ = wire_fd.data_phase(ONES)
    struck = SENT.index("11111", first) + 2
    stations = [Station(0, (ONES.can_frame(),), support=FD), Station(1, support=FD)]
    episode = run_episode(stations, [Disturbance(struck, ports=0b01)], ratio=4)
    assert [(e.bit, e.port, e.kind) for e in episode.events] == [
        (struck, 0, EventKind.ERROR),
        (struck, 0, EventKind.FAILED),
        (struck + 6, 1, EventKind.ERROR),
    ]
    assert episode.fast == ((first, struck + 1 + 8),)
    assert episode.bits == struck + 1 + 8 + (7 - 2) + 8 + 3
    # nominal bits: 17 to the data phase, and 7 + 8 + 3
    assert episode.end_ns(first, 400, 100) == first * 400 + 100
    in_phase = struck + 1 - first
    nominal = first + 7 + 8 + 3
    assert episode.end_ns(episode.bits - 1, 400, 100) == nominal * 400 + in_phase * 100
    assert [(outcome.tec, outcome.rec) for outcome in episode.outcomes] == [(8, 0), (0, 1)]


def test_each_data_phase_has_its_own_grid():
    """Twice in one episode: an error passive receiver misreads a bit of the first error delimiter.

    The receiver is therefore not ready when the frame is sent again.
    """
    first, _ = wire_fd.data_phase(ONES)
    struck = SENT.index("11111", first) + 2
    again = struck + 1 + 8 + (7 - 2) + 8 + 3
    stations = [Station(0, (ONES.can_frame(),), support=FD), Station(1, support=FD)]
    strikes = [
        Disturbance(struck, ports=0b001),
        Disturbance(again - 5, ports=0b100),
        Disturbance(again + struck, ports=0b001),
    ]
    episode = run_episode([*stations, Station(2, rec=200, support=FD)], strikes, ratio=4)
    assert episode.fast[:2] == (
        (first, struck + 1 + 8),
        (again + first, again + struck + 1 + 8),
    )
    failed = [e.bit for e in episode.events if e.kind is EventKind.FAILED]
    assert failed == [struck, again + struck]


def test_fd_and_classical_frame_of_identifier_differ_too_late():
    """FDF is not in the arbitration field, so the difference is a bit error, not a loss."""
    for extended, fdf in ((False, 14), (True, 33)):
        identifier = 0x0AAA_AAAA if extended else 0x2AA
        fd = FdFields(identifier, extended, False, False, b"")
        classical = wire.Fields(identifier, extended, False, 0, b"")
        stations = [
            Station(0, (fd.can_frame(),), support=FD),
            Station(1, (classical.can_frame(),)),
        ]
        first = run_episode(stations).events[0]
        assert (first.bit, first.port, first.kind) == (fdf, 0, EventKind.ERROR)
        assert (first.frame[10], first.frame[11]) == (
            told.BIT1_ERROR | told.TRANSMITTING,
            told.RESERVED_1 if extended else told.RESERVED_0,
        )


@pytest.mark.parametrize("turn", range(5))
def test_tolerant_controller_detects_activity_in_data_phase(turn):
    """One bit in five is dominant, and a nominal bit has five: single samples may all be equal."""
    pattern = ("01111" * 110)[turn : turn + 512]
    frame = FdFields(0x2AA, False, True, False, int(pattern, 2).to_bytes(64, "big"))
    stations = [Station(0, (frame.can_frame(),), support=FD), Station(1, support=FD)]
    tolerant = Station(2, support=FrameSupport.FD_TOLERANT)
    episode = run_episode([*stations, tolerant], ratio=5)
    assert [e.kind for e in episode.events] == [EventKind.ACCEPTED, EventKind.SENT]
    assert episode.outcomes[2].integrating == 0


@given(fd_fields(), st.integers(0, 700), st.integers(-1, 7), st.sampled_from([1, 2, 4, 5, 8]))
@example(FdFields(32016, True, False, False, b""), 38, 0b010, 2)  # res, at one receiver
@example(FdFields(32016, True, False, False, b""), 38, 0b110, 2)  # res, at both: no ACK
@example(FdFields(131, False, True, False, bytes(4)), 0, 0b010, 5)  # a start read one bit late
def test_flip_anywhere_loses_no_frame_unnoticed(frame, bit, ports, ratio):
    stations = [
        Station(0, (frame.can_frame(),), support=FD),
        Station(1, support=FD),
        Station(2, support=FD),
    ]
    episode = run_episode(stations, [Disturbance(bit, ports=ports)], ratio=ratio)
    sent = [e for e in episode.events if e.kind is EventKind.SENT]
    # a sender that misreads a bit of its identifier believes that it has lost arbitration
    failed = [e for e in episode.events if e.kind in (EventKind.FAILED, EventKind.LOST)]
    got = [e.port for e in episode.events if e.kind is EventKind.ACCEPTED]
    assert len(sent) + len(failed) == 1
    levels = wire_fd.on_the_wire(frame)
    levels = levels[:-9] + "0" + levels[-8:]  # the other receiver's ACK
    heard = levels[:bit] + levels[bit : bit + 1].translate({48: "1", 49: "0"}) + levels[bit + 1 :]
    first, after = wire_fd.data_phase(frame)  # until BRS a receiver samples at the nominal rate
    slow = heard[:first] + heard[first:after][ratio - 1 :: ratio] + heard[after:]
    excepted = wire_fd.takes_protocol_exception(slow)
    if sent:
        # a dominant ACK delimiter at one node delays its end of frame by a bit
        unaware = [port for port in (1, 2) if excepted and ports >> port & 1]
        assert sorted(got + unaware) == [1, 2]
        event("unnoticed" if unaware else "noticed")
    assert all(e.frame == frame.can_frame() for e in episode.events if e.kind is EventKind.ACCEPTED)
    assert episode.bits < len(wire_fd.on_the_wire(frame)) + 60
    event("sent" if sent else "failed")


def test_frame_of_unsupported_format_is_refused():
    with pytest.raises(ValueError, match="classical CAN controller cannot send CAN FD"):
        run_episode([Station(0, (ONES.can_frame(),))])
