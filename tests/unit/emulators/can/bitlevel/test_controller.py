"""One CAN controller against handmade transcripts of the wire.

A transcript has the levels that the controller samples, bit by bit (0 dominant, 1 recessive), and
the levels that it drives meanwhile. Frames come from `wire`, which shares no code with the
emulator. The bits after an error are drawn here. Rules are those of ISO 11898-1, fault confinement,
a to i.
"""

import pytest

from motorhil.emulators.can import error_confinement as told
from motorhil.emulators.can.bitlevel.controller import (
    NOTE_ACCEPTED,
    NOTE_ERROR,
    NOTE_FAILED,
    NOTE_LOST,
    NOTE_SENT,
    NOTE_STATE,
    OFF,
    CanStation,
)
from motorhil.emulators.can.error_confinement import Confinement
from tests.support.can import frame_bits as wire

FIELDS = wire.Fields(0x2AA, False, False, 1, b"\x0f")
FRAME = FIELDS.can_frame()
SENT = wire.on_the_wire(FIELDS)  # the sender's levels; its ACK slot is recessive
ACK_SLOT = len(SENT) - 9
READ = SENT[:ACK_SLOT] + "0" + SENT[ACK_SLOT + 1 :]  # levels on the wire
HEARD = "1" * ACK_SLOT + "0" + "1" * 8  # levels of a receiver meanwhile

FLAG = "000000"
DELIMITER = "11111111"
INTERMISSION = "111"
QUIET = DELIMITER + INTERMISSION  # the bits after a flag, in the best case


def sender(tec: int = 0, rec: int = 0, **kinds: bool) -> CanStation:
    station = CanStation([FRAME], Confinement(tec, rec), **kinds)
    station.begin_idle()
    return station


def receiver(rec: int = 0, tec: int = 0) -> CanStation:
    station = CanStation([], Confinement(tec, rec))
    station.begin_idle()
    return station


def play(station: CanStation, sampled: str) -> str:
    """Return the levels driven while sampling these levels. Spaces are for the reader."""
    drives = ""
    for bit, level in enumerate(sampled.replace(" ", "")):
        drives += str(station.drives)
        station.hear(int(level), bit)
    return drives


def check(station: CanStation, sampled: str, drives: str) -> None:
    assert play(station, sampled) == drives.replace(" ", "")


def counters(station: CanStation) -> tuple[int, int]:
    return station.confinement.tec, station.confinement.rec


def errors(station: CanStation) -> list[tuple[int, int, int]]:
    """Return (bit, data[2], data[3]) of each reported error."""
    return [(bit, m[10], m[11]) for bit, kind, m in station.journal.notes if kind == NOTE_ERROR]


def kinds(station: CanStation) -> list[int]:
    return [kind for _, kind, _ in station.journal.notes]


# --- without errors


def test_sent_frame_counts_at_its_last_bit():  # g
    station = sender(tec=5)
    check(station, READ, SENT)
    assert station.journal.notes == [(len(SENT) - 1, NOTE_SENT, FRAME)]
    assert counters(station) == (4, 0)
    check(station, INTERMISSION + "1111", "1111111")


def test_receiver_acknowledges_and_accepts_before_last_bit():
    station = receiver()
    check(station, READ + INTERMISSION, HEARD + INTERMISSION)
    assert station.journal.notes == [(len(SENT) - 2, NOTE_ACCEPTED, FRAME)]


@pytest.mark.parametrize(("rec", "after"), [(0, 0), (1, 0), (127, 126), (128, 127), (255, 127)])
def test_receiver_counts_down_in_ack_slot(rec, after):  # h
    station = receiver(rec)
    play(station, READ[:ACK_SLOT])
    assert counters(station) == (0, rec)
    play(station, "0")
    assert counters(station) == (0, after)


def test_arbitration_loser_receives_and_acknowledges():
    station = sender()
    winner = wire.Fields(0x2A9, False, False, 1, b"\x0f")
    bits = wire.on_the_wire(winner)
    ack = len(bits) - 9
    lost_in = next(bit for bit in range(len(bits)) if bits[bit] != SENT[bit])
    check(
        station,
        bits[:ack] + "0" + bits[ack + 1 :] + INTERMISSION + "0",
        SENT[: lost_in + 1] + "1" * (ack - lost_in - 1) + "0" + "1" * 8 + INTERMISSION + "0",
    )
    assert station.journal.notes == [
        (lost_in, NOTE_LOST, FRAME),
        (len(bits) - 2, NOTE_ACCEPTED, winner.can_frame()),
    ]


def test_remote_frame_loses_to_data_frame_in_rtr():
    remote = wire.Fields(0x2AA, False, True, 1, b"")
    station = CanStation([remote.can_frame()], Confinement())
    station.begin_idle()
    check(station, READ, "0 01010101010 1".replace(" ", "") + HEARD[13:])
    assert [(bit, kind) for bit, kind, _ in station.journal.notes] == [
        (12, NOTE_LOST),
        (len(SENT) - 2, NOTE_ACCEPTED),
    ]


def test_arbitration_loser_counts_as_receiver():  # a
    station = CanStation([wire.Fields(0x07F, False, False, 0, b"").can_frame()], Confinement())
    station.begin_idle()
    play(station, "0 0000 1 0 11111 1")  # lost in the second bit after the stuff bit
    assert counters(station) == (0, 1)
    assert kinds(station) == [NOTE_LOST, NOTE_ERROR]


def test_dlc_above_eight_means_eight_bytes():
    odd = wire.Fields(0x2AA, False, False, 15, bytes(range(8)))
    bits = wire.on_the_wire(odd)
    station = receiver()
    play(station, bits[:-9] + "0" + bits[-8:])
    ((_, kind, frame),) = station.journal.notes
    assert kind == NOTE_ACCEPTED
    assert frame == wire.Fields(0x2AA, False, False, 8, bytes(range(8))).can_frame()


# --- errors of a receiver


def test_six_equal_bits_are_stuff_error():  # a
    station = receiver()
    check(station, "000000" + FLAG + QUIET, "111111" + FLAG + QUIET)
    assert counters(station) == (0, 1)
    assert errors(station) == [(5, told.STUFF_ERROR, told.ID_28_21)]


def test_five_equal_bits_are_no_error():
    station = receiver()
    check(station, "00000 1 00000 1", "111111111111")
    assert errors(station) == []


def test_dominant_bit_after_flag_counts_eight():  # b
    station = receiver()
    check(station, "000000" + FLAG + "0", "111111" + FLAG + "1")
    assert counters(station) == (0, 1 + 8)
    play(station, "000000")  # the second to the seventh
    assert counters(station) == (0, 9)


def test_each_eight_dominant_bits_after_flag_count():  # f
    station = receiver()
    play(station, "000000" + FLAG + "0000000")
    assert counters(station) == (0, 9)
    play(station, "0")  # the 14th consecutive
    assert counters(station) == (0, 17)
    play(station, "0000000")
    assert counters(station) == (0, 17)
    play(station, "0")
    assert counters(station) == (0, 25)
    check(station, QUIET, QUIET)


def test_bit_error_in_receiver_flag_counts_and_restarts_it():  # e, not a
    station = receiver()
    check(station, "000000 00 1" + FLAG + QUIET, "111111 00 0" + FLAG + QUIET)
    assert counters(station) == (0, 1 + 8)
    assert errors(station)[1] == (8, told.BIT0_ERROR, told.ACTIVE_FLAG)


def test_crc_error_is_signalled_after_ack_without_ack():
    station = receiver()
    last = SENT[ACK_SLOT - 2]  # of the CRC; its inversion causes no stuff error here
    assert len(set(SENT[ACK_SLOT - 6 : ACK_SLOT - 2])) == 2
    wrong = SENT[: ACK_SLOT - 2] + ("1" if last == "0" else "0") + "1"
    check(station, wrong + "0 1" + FLAG + QUIET, "1" * ACK_SLOT + "1 1" + FLAG + QUIET)
    assert counters(station) == (0, 1)
    assert errors(station) == [(ACK_SLOT + 1, 0, told.CRC_SEQUENCE)]


@pytest.mark.parametrize(
    ("bit", "place"),
    [
        (-10, told.CRC_DELIMITER),
        (-8, told.ACK_DELIMITER),
        (-7, told.END_OF_FRAME),
        (-2, told.END_OF_FRAME),
    ],
)
def test_dominant_bit_in_fixed_field_is_form_error(bit, place):
    station = receiver(rec=10)
    position = len(SENT) + bit
    check(station, READ[:position] + "0" + FLAG, HEARD[: position + 1] + FLAG)
    assert errors(station) == [(position, told.FORM_ERROR, place)]
    # h has counted if the ACK slot was heard
    assert counters(station) == (0, 11 if position < ACK_SLOT else 10)
    assert NOTE_ACCEPTED not in kinds(station)


def test_own_acknowledgement_read_recessive_is_bit_error():
    station = receiver(rec=10)
    check(station, SENT[: ACK_SLOT + 1] + FLAG, HEARD[: ACK_SLOT + 1] + FLAG)
    assert errors(station) == [(ACK_SLOT, told.BIT0_ERROR, told.ACK_SLOT)]
    assert not station.journal.notes[0][2][0] & told.NO_ACKNOWLEDGE  # of the sender
    assert counters(station) == (0, 11)


@pytest.mark.parametrize(("extended", "reserved"), [(False, 1), (True, 1), (True, 2), (True, 3)])
def test_recessive_reserved_bit_is_accepted_as_classical(extended, reserved):
    """ISO 16845-1, 7.1.4 and 7.1.5: r1 and r0 of either level are accepted, and acknowledged."""
    fields = wire.Fields(0x0AAAAAAA if extended else 0x2AA, extended, False, 1, b"\x0f")
    field = wire.unstuffed(fields)
    places = 2 if extended else 1
    first = 33 if extended else 14
    odd = field[:first] + f"{reserved:0{places}b}" + field[first + places :]
    bits = wire.stuffed(wire.with_crc(odd)) + wire.TAIL
    station = receiver()
    ack = len(bits) - 9
    check(
        station,
        bits[:ack] + "0" + bits[ack + 1 :] + INTERMISSION,
        "1" * ack + "0" + "1" * 8 + INTERMISSION,
    )
    assert station.journal.notes == [(len(bits) - 2, NOTE_ACCEPTED, fields.can_frame())]


# --- errors of a transmitter


def test_transmitter_counts_eight_and_sends_again():  # c
    station = sender()
    broken = len(SENT) - 30
    wrong = "1" if SENT[broken] == "0" else "0"
    check(
        station,
        SENT[:broken] + wrong + FLAG + QUIET + READ,
        SENT[: broken + 1] + FLAG + QUIET + SENT,
    )
    assert counters(station) == (8 - 1, 0)
    assert kinds(station) == [NOTE_ERROR, NOTE_FAILED, NOTE_SENT]


def test_one_shot_frame_is_not_sent_again():
    station = sender(one_shot=True)
    check(station, "1" + FLAG + QUIET + "11111", "0" + FLAG + QUIET + "11111")
    assert station.frames == []


def test_transmitter_ignores_dominant_bits_before_eighth():  # b, f
    station = sender()
    play(station, "1" + FLAG + "0000000")
    assert counters(station) == (8, 0)
    play(station, "0")
    assert counters(station) == (16, 0)


def test_bit_error_in_transmitter_flag_counts_and_restarts_it():  # d, not c twice
    station = sender()
    check(station, "1 00000 1" + FLAG + QUIET, "0 00000 0" + FLAG + QUIET)
    assert counters(station) == (16, 0)


def test_missing_ack_counts_for_active_transmitter():  # c
    station = sender(tec=120)
    check(station, SENT[: ACK_SLOT + 1] + FLAG, SENT[: ACK_SLOT + 1] + FLAG)
    assert counters(station) == (128, 0)
    (_, _, message), *_ = station.journal.notes
    assert message[0] & told.NO_ACKNOWLEDGE


def test_missing_ack_does_not_count_for_passive_transmitter():  # c, exception 1
    station = sender(tec=128)
    check(station, SENT[: ACK_SLOT + 1] + "111111" + QUIET, SENT[: ACK_SLOT + 1] + "111111" + QUIET)
    assert counters(station) == (128, 0)


def test_missing_ack_counts_with_dominant_bit_in_passive_flag():  # c, exception 1 does not hold
    station = sender(tec=128)
    play(station, SENT[: ACK_SLOT + 1] + "11 0")
    assert counters(station) == (136, 0)
    play(station, "00000")
    assert counters(station) == (136, 0)


def test_missing_ack_exception_ends_with_its_flag():  # c, exception 1; then d alone
    """Unacknowledged and passive; a dominant first bit of intermission causes an overload flag.

    A bit of that flag is read recessive: 8 for that. Dominant bits in the passive error flag after
    it are other nodes' flags.
    """
    station = sender(tec=128)
    play(station, SENT[: ACK_SLOT + 1] + "111111" + DELIMITER)
    assert counters(station) == (128, 0)
    check(station, "0 001 000000 1".replace(" ", ""), "1" + "000" + "111111" + "1")
    assert counters(station) == (136, 0)


STUFFED = wire.Fields(
    0x7C1, False, False, 0, b""
)  # 0 11111[0]000001... five ones, then a stuff bit
ZEROS = wire.Fields(0x07F, False, False, 0, b"")  # 0 0000[1]1111... the stuff bit is recessive


def test_recessive_stuff_bit_lost_in_arbitration_is_free():  # c, exception 2
    station = CanStation([ZEROS.can_frame()], Confinement())
    station.begin_idle()
    assert wire.on_the_wire(ZEROS)[:6] == "000001"
    check(station, "000000" + FLAG + QUIET, "000001" + FLAG + QUIET)
    assert counters(station) == (0, 0)
    assert errors(station) == [(5, told.STUFF_ERROR | told.TRANSMITTING, told.ID_28_21)]


def test_dominant_stuff_bit_error_in_arbitration_counts():  # c
    station = CanStation([STUFFED.can_frame()], Confinement())
    station.begin_idle()
    assert wire.on_the_wire(STUFFED)[:7] == "0111110"
    check(station, "0111111" + FLAG, "0111110" + FLAG)
    assert counters(station) == (8, 0)


def test_recessive_stuff_bit_error_after_rtr_counts():  # c: it is not before RTR
    remote = wire.Fields(0x555, False, False, 0, b"")
    bits = wire.on_the_wire(remote)
    assert bits[:18] == "0 10101010101 0 0 0 00 1".replace(" ", "")  # RTR IDE r0 DLC [stuff]
    station = CanStation([remote.can_frame()], Confinement())
    station.begin_idle()
    check(station, bits[:17] + "0" + FLAG, bits[:18] + FLAG)
    assert counters(station) == (8, 0)


def test_dominant_last_bit_of_frame_fails_it():
    station = sender()
    check(station, READ[:-1] + "0" + FLAG, SENT + FLAG)
    assert kinds(station) == [NOTE_ERROR, NOTE_FAILED]
    assert counters(station) == (8, 0)


# --- error passive, bus-off


def test_error_to_passive_has_active_flag_and_next_a_passive():  # i
    station = sender(tec=120)
    check(
        station,
        "1" + FLAG + QUIET + "11111111" + "1" + "111111" + QUIET,
        "0" + FLAG + QUIET + "11111111" + "0" + "111111" + QUIET,
    )
    assert counters(station) == (136, 0)
    message = next(m for _, kind, m in station.journal.notes if kind == NOTE_STATE)
    assert message[9] == told.TX_PASSIVE


def test_passive_transmitter_suspends_after_frame():
    station = CanStation([FRAME, FRAME], Confinement(tec=140))
    station.begin_idle()
    check(station, READ + INTERMISSION + "11111111" + "0", SENT + INTERMISSION + "11111111" + "0")


def test_suspended_node_receives_other_frame():
    station = CanStation([FRAME], Confinement(tec=140))
    station.begin_idle(suspended=8)
    check(station, "1111111" + READ + INTERMISSION + "0", "1111111" + HEARD + INTERMISSION + "0")


def test_passive_receiver_is_not_suspended():
    station = CanStation([], Confinement(rec=200))
    station.begin_idle()
    play(station, "000000" + "111111" + DELIMITER + "11")
    station.frames.append(FRAME)
    check(station, "1" + "0", "1" + "0")


def test_six_equal_bits_of_either_level_end_passive_flag():
    station = receiver(rec=200)
    # Neither 111 nor 00000 is enough; six dominant bits are, and the next one counts by b.
    check(station, "000000 111 00000 1 000000", "1" * 21)
    assert counters(station) == (0, 201)
    play(station, "0")
    assert counters(station) == (0, 209)
    play(station, QUIET + READ)
    assert NOTE_ACCEPTED in kinds(station)


def test_eight_dominant_bits_after_passive_flag_count():  # f
    station = sender(tec=128)
    play(station, "1" + "000000")
    assert counters(station) == (136, 0)
    play(station, "0000000")
    assert counters(station) == (136, 0)
    play(station, "0")
    assert counters(station) == (144, 0)


def test_rec_stops_at_255():
    station = receiver(rec=250)
    play(station, "000000" + "000000" + "0" * 64)
    assert counters(station) == (0, 255)
    assert len(errors(station)) == 1  # from 255 on dominant bits are not reported any more


def test_tec_above_255_is_bus_off_at_once_and_counts_runs():  # i
    station = sender(tec=248)
    check(station, "1" + "0" * 5 + "1" * 10 + "0" + "1" * 22, "0" + "1" * 38)
    assert station.phase == OFF
    assert station.off_at == 0
    assert (station.recessive_runs, station.recessive_bits) == (2, 0)
    assert station.journal.notes[-1][1:] == (NOTE_FAILED, FRAME)
    assert station.journal.notes[-2][2][0] & told.MESSAGE_BUS_OFF


def test_tec_of_255_is_not_bus_off():  # i
    station = sender(tec=247)
    play(station, "1")
    assert counters(station) == (255, 0)
    check(station, "111111" + QUIET + "11111111" + READ, "111111" + QUIET + "11111111" + SENT)


# --- delimiters, overload, intermission


@pytest.mark.parametrize("recessive", range(1, 7))
def test_dominant_bit_in_delimiter_is_form_error(recessive):  # a
    station = receiver()
    quiet = "1" * recessive
    check(station, "000000" + FLAG + quiet + "0" + FLAG, "111111" + FLAG + quiet + "1" + FLAG)
    assert counters(station) == (0, 2)
    assert errors(station)[-1][1:] == (told.FORM_ERROR, told.DELIMITER)


def test_dominant_last_bit_of_delimiter_is_overload():
    station = receiver()
    check(
        station,
        "000000" + FLAG + "11111110" + FLAG + QUIET,
        "111111" + FLAG + DELIMITER + FLAG + QUIET,
    )
    assert counters(station) == (0, 1)


def test_dominant_last_bit_of_frame_is_overload_to_receiver():
    station = receiver(rec=5)
    check(station, READ[:-1] + "0" + FLAG + QUIET, HEARD + FLAG + QUIET)
    assert kinds(station) == [NOTE_ACCEPTED, NOTE_ERROR]
    assert errors(station) == [(len(SENT) - 1, told.OVERLOAD, told.END_OF_FRAME)]
    assert counters(station) == (0, 4)


@pytest.mark.parametrize("first", ["0", "10"])
def test_dominant_early_bit_of_intermission_is_overload(first):
    station = sender()
    check(station, READ + first + FLAG + QUIET, SENT + "1" * len(first) + FLAG + QUIET)
    assert counters(station) == (0, 0)
    assert kinds(station) == [NOTE_SENT, NOTE_ERROR]


def test_bit_error_in_overload_flag_is_error():  # d, e
    for station, frame, after in ((sender(), READ, (8, 0)), (receiver(), READ, (0, 8))):
        play(station, frame + "0" + "001")
        assert counters(station) == after
        check(station, FLAG + QUIET, FLAG + QUIET)


def test_dominant_bits_after_overload_flag_count_by_f_alone():  # not b
    station = receiver()
    play(station, READ + "0" + FLAG + "0000000")
    assert counters(station) == (0, 0)
    play(station, "0")
    assert counters(station) == (0, 8)


def test_overload_flag_after_error_flag_counts_by_f_alone():  # not b
    station = receiver()
    play(station, "000000" + FLAG + "1111111 0" + FLAG + "0")
    assert counters(station) == (0, 1)


def test_dominant_third_bit_of_intermission_starts_frame():
    station = receiver()
    check(station, READ + "11" + READ, HEARD + "11" + HEARD)
    assert kinds(station) == [NOTE_ACCEPTED, NOTE_ACCEPTED]


def test_pending_frame_uses_start_of_frame_one_bit_early():
    station = CanStation([FRAME, FRAME], Confinement())
    station.begin_idle()
    check(station, READ + "11" + READ, SENT + "11" + "1" + SENT[1:])
    assert kinds(station) == [NOTE_SENT, NOTE_SENT]


def test_suspended_node_ignores_start_of_frame_for_sending():
    station = CanStation([FRAME, FRAME], Confinement(tec=140))
    station.begin_idle()
    check(station, READ + "11" + READ, SENT + "11" + HEARD)
    assert kinds(station) == [NOTE_SENT, NOTE_ACCEPTED]


# --- return to the bus


def test_returning_node_listens_for_11_recessive_bits():
    station = CanStation([FRAME], Confinement())
    station.begin_integrating()
    check(station, "0" * 20 + "1" * 10 + "0" + "1" * 11 + "0", "1" * 42 + "0")


def test_stalled_node_returns_after_delimiter_and_intermission():
    station = CanStation([FRAME], Confinement(rec=255))
    station.begin_stalled()
    check(station, "000" + QUIET + "0", "111" + QUIET + "0")
