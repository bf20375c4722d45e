"""Recorded nodes with hosts other than the recorded one; frames follow CiA 301."""

import struct

from motorhil.harness.replay.device_node import RecordedNode
from motorhil.traces.can_frame import EFF, RTR, classic
from motorhil.traces.exchange.canopen import CanopenExchanges
from motorhil.traces.schema import Direction

MS = 1_000_000
BOOT_UP = (0, 0x701, b"\0")
READ_STATUSWORD = bytes.fromhex("4041600000000000")
READ_POSITION = bytes.fromhex("4064600000000000")


def node(*frames, any_set_point=False):
    """Return node 1 of a recording of (ms, identifier, data)."""
    cutter = CanopenExchanges("can0", 0, None, None, any_set_point)
    for time_ms, can_id, data in frames:
        cutter.take(int(time_ms * MS), classic(can_id, data), Direction.UNKNOWN, "")
    found = RecordedNode(cutter.logs()[1], cutter.decoder, 1)
    found.start(0)
    return found


def played(one, *told, until_ms=1000):
    """Return the frames (identifier, data) that the node sends for (ms, identifier, data)."""
    out = []

    def go_on(now_ns):
        while (due_ns := one.next_deadline_ns()) is not None and due_ns <= now_ns:
            one.expire(due_ns)
            out.extend(one.take_output())

    for time_ms, can_id, data in told:
        go_on(int(time_ms * MS))
        assert can_id in one.identifiers()
        one.receive(classic(can_id, data), int(time_ms * MS))
        out.extend(one.take_output())
    go_on(until_ms * MS)
    return [(int.from_bytes(f[:4], "little"), f[8 : 8 + f[4]].hex()) for f in out]


def write(time_ms, index, subindex, value, size=4):
    """Return an expedited download and its confirmation."""
    place = struct.pack("<HB", index, subindex)
    command = {1: 0x2F, 2: 0x2B, 4: 0x23}[size]
    return (
        (time_ms, 0x601, bytes([command]) + place + value.to_bytes(4, "little")),
        (time_ms + 0.5, 0x581, b"\x60" + place + bytes(4)),
    )


def asked(frames):
    return [one for one in frames if one[1] not in (0x581, 0x181, 0x701)]


def test_broadcast_before_first_frame_applies_to_node():
    one = node((0, 0, b"\x81\0"), (50, 0x701, b"\0"), (60, 0, b"\1\0"), (100, 0x701, b"\5"))
    assert played(one, (10, 0, b"\x81\0"), (80, 0, b"\1\0")) == [(0x701, "00"), (0x701, "05")]
    assert not one.player.mismatches


def test_boot_up_is_not_an_answer_to_guarding():
    """The recorded host guarded the node before it was present; the node boots in any case."""
    guard = 0x701 | RTR
    one = node((0, guard, b""), (300, 0x701, b"\0"), (500, guard, b""), (501, 0x701, b"\x7f"))
    assert played(one, (400, guard, b""))[0] == (0x701, "00")


def test_toggle_bit_alternates_with_every_guarding():
    guard = 0x701 | RTR
    one = node(BOOT_UP, (5, guard, b""), (6, 0x701, b"\x7f"), (9, guard, b""), (10, 0x701, b"\xff"))
    told = played(one, *[(10 + number, guard, b"") for number in range(0, 50, 10)])
    assert [data for _, data in told[1:]] == ["7f", "ff", "7f", "ff", "7f"]


def test_periodic_frames_beyond_the_bus_are_not_continued():
    """An adapter stamps a batch of heartbeats at intervals of 1 us."""
    one = node(*((1 + place / 1000, 0x701, b"\5") for place in range(20)))
    assert len(played(one)) == 20
    one = node(*((1 + place / 1000, 0x701, b"\5") for place in range(20)))
    ((kind, text),) = one.take_events()
    told = "more periodic frames than the bus can carry, so not continued: 701h every 0.999 us"
    assert (kind, text) == ("warning", told)


def test_of_two_too_fast_periods_the_longer_is_continued():
    """A heartbeat takes some 60 us of 80 us, a PDO of 8 bytes some 120 us of 200 us."""
    frames = [(1 + place * 0.08, 0x701, b"\5") for place in range(20)]
    frames += [(1.01 + place * 0.2, 0x181, bytes(range(8))) for place in range(20)]
    told = [identifier for identifier, _ in played(node(*sorted(frames)), until_ms=100)]
    assert told.count(0x701) == 20
    assert told.count(0x181) > 400


def test_equal_pdo_after_own_boot_up_is_a_new_command():
    frames = (
        *(BOOT_UP, (10, 0x201, b"\6\0"), (12, 0x181, b"\x31\2")),
        *((100, 0x701, b"\0"), (110, 0x201, b"\6\0"), (115, 0x181, b"\x33\2")),
    )
    told = played(node(*frames), *asked(frames))
    assert told == [(0x701, "00"), (0x181, "3102"), (0x701, "00"), (0x181, "3302")]


def test_second_reset_is_found_after_skipped_commands():
    reset = b"\x81\1"
    frames = (
        *(BOOT_UP, (5, 0, reset), (50, 0x701, b"\0"), *write(60, 0x2000, 0, 1)),
        *(*write(70, 0x2001, 0, 2), (80, 0, reset), (130, 0x701, b"\0"), *write(140, 0x2002, 0, 3)),
    )
    told = played(node(*frames), (5, 0, reset), frames[3], (80, 0, reset))
    assert [data for can_id, data in told if can_id == 0x701] == ["00", "00", "00"]


LATE = (
    *(BOOT_UP, (10, 0x601, READ_STATUSWORD), (20, 0x601, READ_POSITION)),
    (22, 0x581, bytes.fromhex("4b41600031020000")),
    (23, 0x581, bytes.fromhex("4364600001000000")),
)
"""The host gave up waiting for the first answer, which arrived later."""


def test_late_answer_is_matched_with_its_request():
    assert played(node(*LATE), (10, 0x601, READ_STATUSWORD))[1:] == [(0x581, "4b41600031020000")]
    assert played(node(*LATE), (10, 0x601, READ_POSITION))[1:] == [(0x581, "4364600001000000")]
    assert len(played(node(*LATE), *LATE[1:3])) == 3


def test_reserved_bytes_of_sdo_requests_are_ignored():
    """Upload: bytes 4 to 7; expedited download of one byte: 5 to 7; upload segment: 1 to 7."""
    frames = (
        *(BOOT_UP, (10, 0x601, bytes.fromhex("40416000ffaabbcc"))),
        (11, 0x581, bytes.fromhex("4b41600031020000")),
        (20, 0x601, bytes.fromhex("2f60600001eeeeee")),
        (21, 0x581, bytes.fromhex("6060600000000000")),
        (30, 0x601, bytes.fromhex("4008100001020304")),
        (31, 0x581, bytes.fromhex("4108100007000000")),
        (32, 0x601, bytes.fromhex("6008100001020304")),
        (33, 0x581, bytes.fromhex("01") + b"motorhi"),
    )
    told = (
        *((10, 0x601, READ_STATUSWORD), (20, 0x601, bytes.fromhex("2f60600001000000"))),
        *((30, 0x601, bytes.fromhex("4008100000000000")), (35, 0x601, b"\x60" + bytes(7))),
    )
    one = node(*frames)
    assert [data for _, data in played(one, *told)[1:]] == [
        frames[number][2].hex() for number in (2, 4, 6, 8)
    ]
    assert not one.player.mismatches
    assert played(node(*frames), (20, 0x601, bytes.fromhex("2f60600003000000")))[1][1][:2] == "80"


def test_extended_identifier_is_ignored():
    one = node(*LATE)
    one.receive(classic(0x601 | EFF, READ_STATUSWORD), 0)
    one.expire(15 * MS)
    assert [frame[:2] for frame in one.take_output()] == [b"\1\7"]


def test_unrecorded_pdo_is_a_mismatch():
    one = node(*LATE)
    played(one, (30, 0x201, b"\6\0"))
    assert [mismatch.came[:15] for mismatch in one.player.mismatches] == ["RPDO 1 to node "]


def test_sync_identifier_follows_1005h():
    """1005h = 85h, which is not the emergency of node 5; TPDO 1 answers every SYNC."""
    syncs = [(100 + 10 * n, 0x85, b"") for n in range(4)]
    answers = [(time_ms + 1, 0x181, bytes([n])) for n, (time_ms, _, _) in enumerate(syncs)]
    traffic = sorted([*syncs, *answers])
    one = node(BOOT_UP, *write(10, 0x1005, 0, 0x85), *write(12, 0x1800, 2, 1, 1), *traffic)
    writes = asked([*write(10, 0x1005, 0, 0x85), *write(12, 0x1800, 2, 1, 1)])
    told = played(one, *writes, (50, 0x85, b""), (70, 0x85, b""))
    assert told[-2:] == [(0x181, "00"), (0x181, "01")]


def test_unrecorded_sync_gets_the_last_answer():
    frames = (
        *(BOOT_UP, *write(12, 0x1800, 2, 1, 1), (100, 0x80, b""), (101, 0x181, b"\7")),
        *(*write(151, 0x6060, 0, 1, 1), *write(152, 0x6081, 0, 1)),
    )
    told = played(node(*frames), *asked(frames)[:3], (160, 0x80, b""))
    assert [data for can_id, data in told if can_id == 0x181] == ["07", "07"]


def test_set_point_position_in_pdo_may_change():
    frames = (
        *(BOOT_UP, *write(1, 0x1600, 1, 0x607A0020), *write(2, 0x1600, 2, 0x60400010)),
        *(*write(3, 0x1600, 0, 2, 1), (10, 0x201, bytes.fromhex("010000000600"))),
        *(*write(20, 0x1600, 1, 0x60400010), *write(21, 0x1600, 2, 0x607A0020)),
        (30, 0x201, bytes.fromhex("0f0001000000")),
    )
    host = [
        (time_ms, can_id, data if can_id != 0x201 else other)
        for (time_ms, can_id, data), other in zip(
            asked(frames),
            [b""] * 3
            + [bytes.fromhex("990000000600")]
            + [b""] * 2
            + [bytes.fromhex("0f0099000000")],
            strict=True,
        )
    ]
    one = node(*frames, any_set_point=True)
    played(one, *host)
    assert one.player.mismatches == []
    assert one.player.matched == 7


def test_aborted_transfer_keeps_other_pending_frames():
    """A SYNC has just requested a PDO when the client aborts its upload."""
    frames = (
        *(BOOT_UP, *write(12, 0x1800, 2, 1, 1), (100, 0x80, b""), (105, 0x181, b"\7")),
        *((110, 0x601, READ_STATUSWORD), (120, 0x581, bytes.fromhex("4b41600031020000"))),
    )
    abort = bytes.fromhex("8041600000000405")
    told = (*asked(frames)[:1], (50, 0x601, READ_STATUSWORD), (51, 0x80, b""), (53, 0x601, abort))
    assert played(node(*frames), *told)[2:] == [(0x181, "07")]


def test_unrecorded_segment_is_aborted_with_its_object():
    """CiA 301: an abort names index and sub-index of the transfer."""
    frames = (
        *(BOOT_UP, (10, 0x601, bytes.fromhex("4008100000000000"))),
        (11, 0x581, bytes.fromhex("4108100009000000")),
    )
    told = played(node(*frames), frames[1], (20, 0x601, b"\x60" + bytes(7)))
    assert told[-1] == (0x581, "8008100024000008")
