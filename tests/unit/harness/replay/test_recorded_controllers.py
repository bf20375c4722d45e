"""Recorded nodes and units as controllers, frame by frame."""

import pytest

from motorhil.emulators.controller import ControllerContext
from motorhil.harness.replay.device_node import NO_DATA, RecordedNode, RecordedUnit, build
from motorhil.traces.can_frame import BRS, RTR, classic, flexible, remote
from motorhil.traces.decoding.canopen import CanopenDecoder
from motorhil.traces.exchange.canopen import CanopenExchanges
from motorhil.traces.exchange.modbus import modbus_logs
from motorhil.traces.formats.frames import Frame
from motorhil.traces.schema import Direction
from tests.support.checkout import CHECKOUT
from tests.unit.traces.exchange.test_exchange_logs import MS, adu, cut, frame

GOLDEN = CHECKOUT / "traces" / "golden"
BOOT = frame(0, 0x706, b"\0")
READ, KIND = bytes.fromhex("4000100000000000"), bytes.fromhex("4300100092010200")
READ_NAME = bytes.fromhex("4008100000000000")
NAMED = (
    bytes.fromhex("4108100009000000"),
    b"\x00motorhi",
    b"\x1bl!\0\0\0\0\0",
)  # CiA 301: segments
NEXT, LAST = bytes.fromhex("6000000000000000"), bytes.fromhex("7000000000000000")
ABORT = bytes.fromhex("8008100000000405")


def asked(data):
    return classic(0x606, data)


def node(*frames, boots=True):
    """Return node 6 from these frames, started and booted."""
    log = cut(*([BOOT] if boots else []), *frames)[6]
    made = RecordedNode(log, CanopenDecoder(), 6)
    made.start(0)
    made.expire(0)
    made.take_output()
    return made


def told(one, data, now_ms, wait_ms=5):
    """Return the data that the node sends within `wait_ms` of receiving a frame."""
    one.receive(data, now_ms * MS)
    one.expire((now_ms + wait_ms) * MS)
    return [sent[8 : 8 + sent[4]] for sent in one.take_output()]


def exchange(time_ms, request, response):
    return frame(time_ms, 0x606, request), frame(time_ms + 1, 0x586, response)


def name_upload(time_ms):
    requests = (READ_NAME, NEXT, LAST)
    both = zip(requests, NAMED, strict=True)
    return [
        one
        for number, (request, response) in enumerate(both)
        for one in exchange(time_ms + 2 * number, request, response)
    ]


def test_answer_starts_earlier_by_its_duration():
    """Complete 1 ms after its request: it started the duration of a frame of 8 bytes earlier."""
    one = node(*exchange(10, READ, KIND))
    one.receive(asked(READ), 100 * MS)
    begins_ns = one.next_deadline_ns()
    # ISO 11898-1: 47 bits and 64 of data, less 3 of intermission, and at most 24 stuff bits.
    assert 101 * MS - 132_000 <= begins_ns <= 101 * MS - 108_000


def test_segmented_upload_is_answered_turn_by_turn():
    one = node(*name_upload(10))
    got = [told(one, asked(data), ms) for ms, data in ((10, READ_NAME), (20, NEXT), (30, LAST))]
    assert got == [[data] for data in NAMED]


def test_aborted_transfer_is_not_continued():
    one = node(*name_upload(10), *exchange(50, READ, KIND))
    assert told(one, asked(READ_NAME), 100) == [NAMED[0]]
    one.receive(asked(NEXT), 110 * MS)
    assert told(one, asked(ABORT), 110) == []  # the pending segment is not sent either
    assert told(one, asked(LAST), 130)[0][:1] == b"\x80"  # no transfer is in progress
    assert told(one, asked(READ), 140) == [KIND]
    assert told(one, asked(READ_NAME), 150) == [NAMED[0]]


def test_reset_ends_a_transfer():
    one = node(*name_upload(10), frame(40, 0x000, b"\x81\x06"))
    assert told(one, asked(READ_NAME), 100) == [NAMED[0]]
    told(one, classic(0x000, b"\x81\x06"), 110)
    assert told(one, asked(NEXT), 120)[0][:1] == b"\x80"


def test_unrecorded_upload_is_aborted_and_reported_once():
    one = node(*exchange(10, READ, KIND))
    request = bytes.fromhex("4018100100000000")
    assert told(one, asked(request), 100) == [bytes.fromhex("8018100124000008")]
    assert NO_DATA == 0x0800_0024
    ((level, text),) = one.take_events()
    assert (level, one.snapshot(0)["mismatches"]) == ("error", 1.0)
    assert "the recording cannot answer" in text
    assert one.take_events() == []


@pytest.mark.parametrize(
    "request_", ["a0080000 00000000", "c0080000 00000000"], ids=["block upload", "block download"]
)
def test_block_transfer_start_is_answered(request_):
    """CiA 301: initiate block upload (ccs 5, cs 0), block download (ccs 6, cs 0) of 1008h."""
    begins = bytes.fromhex(request_[:2] + "081000" + "7f000000")
    answered = bytes.fromhex("c0081000 09000000")
    one = node(*exchange(10, begins, answered))
    assert told(one, asked(begins), 100) == [answered]


@pytest.mark.parametrize(
    ("data", "is_told"),
    [
        (b"\x80\x06", True),
        (b"\x80\x00", True),
        (b"\x80\x05", False),
        (b"\x80", False),
        (b"", False),
    ],
)
def test_nmt_command_applies_to_named_node_or_all(data, is_told):
    one = node()
    one.receive(classic(0x000, data), 10 * MS)
    assert len(one.take_events()) == is_told


def test_unanswerable_set_point_is_reported_once():
    one = node(frame(10, 0x206, b"\x0f"))
    for ms in (100, 120, 140):
        one.receive(classic(0x206, b"\x1f"), ms * MS)
    ((_, text),) = one.take_events()
    assert "expected, as at 0.010000 s of it: " in text
    assert not text.endswith(": ")
    one.receive(classic(0x206, b"\x0f"), 160 * MS)
    assert one.take_events() == []
    assert one.snapshot(0) == {"matched": 1.0, "mismatches": 1.0}


def test_equal_set_point_after_reset_is_a_new_command():
    beat = b"\x05"
    one = node(
        frame(10, 0x206, b"\x0f"),
        frame(20, 0x000, b"\x81\x06"),
        frame(30, 0x206, b"\x0f"),
        frame(31, 0x706, beat),
    )
    one.receive(classic(0x206, b"\x0f"), 10 * MS)
    one.receive(classic(0x000, b"\x81\x06"), 20 * MS)
    assert told(one, classic(0x206, b"\x0f"), 30) == [beat]
    assert one.snapshot(0)["matched"] == 3.0


def test_sync_triggers_once_then_is_a_poll():
    """The TPDO of type 1 answers each SYNC; the heartbeat reacts to the first one only."""
    typed = exchange(1, bytes.fromhex("2f001802 01000000"), bytes.fromhex("60001802 00000000"))
    one = node(
        *typed,
        frame(10, 0x206, b"\x0f"),
        frame(20, 0x080),
        frame(21, 0x186, b"\1"),
        frame(25, 0x706, b"\x05"),
        frame(40, 0x080),
        frame(41, 0x186, b"\2"),
    )
    told(one, asked(bytes.fromhex("2f00180201000000")), 1)
    told(one, classic(0x206, b"\x0f"), 10)
    got = [told(one, classic(0x080, b""), ms, 10) for ms in (100, 200, 300)]
    assert got == [[b"\1", b"\x05"], [b"\2"], [b"\2"]]
    assert one.snapshot(0) == {"matched": 3.0, "mismatches": 0.0}


def test_repeated_sync_gets_the_answer_of_the_triggering_one():
    typed = exchange(1, bytes.fromhex("2f001802 01000000"), bytes.fromhex("60001802 00000000"))
    one = node(*typed, frame(10, 0x206, b"\x0f"), frame(20, 0x080), frame(21, 0x186, b"\1"))
    told(one, asked(bytes.fromhex("2f00180201000000")), 1)
    told(one, classic(0x206, b"\x0f"), 10)
    assert [told(one, classic(0x080, b""), ms) for ms in (100, 200)] == [[b"\1"], [b"\1"]]


def test_remote_frame_is_accepted_and_answered():
    one = node(
        Frame(10 * MS, "can0", remote(0x186, 1)),
        frame(11, 0x186, b"\1"),
        frame(20, 0x206, b"\x0f"),
    )
    set_points = {0x206, 0x306, 0x406, 0x506}  # including those of the pre-defined connection set
    assert one.identifiers() == sorted({0x000, 0x080, 0x606, *set_points, RTR | 0x186})
    assert told(one, remote(0x186, 1), 100) == [b"\1"]


WRITE, ASK = bytes.fromhex("0600010003"), bytes.fromhex("03006B0001")


def with_crc(data):
    """Append the CRC of MODBUS over Serial Line V1.02, section 6.2.2, computed bit by bit."""
    crc = 0xFFFF
    for byte in data:
        crc ^= byte
        for _ in range(8):
            crc = crc >> 1 ^ (0xA001 if crc & 1 else 0)
    return data + crc.to_bytes(2, "little")


@pytest.fixture
def unit():
    log = modbus_logs(
        "rs485",
        [
            adu(1, ASK),
            adu(4, bytes.fromhex("0302022B"), to_server=False),
            adu(10, WRITE, unit=0),
            adu(20, WRITE),
            adu(23, WRITE, to_server=False),
            adu(30, b"\x07"),
            adu(33, b"\x07\x6d", to_server=False),
        ],
        0,
    )[1]
    made = RecordedUnit(log, 1)
    made.start(0)
    return made


def answer(unit, frame_, now_ms=100):
    unit.receive(frame_, now_ms * MS)
    unit.expire((now_ms + 10) * MS)
    return list(unit.take_output())


def test_request_to_unit_is_answered_with_crc(unit):
    assert answer(unit, with_crc(b"\1" + ASK)) == [with_crc(bytes.fromhex("010302022B"))]
    assert unit.take_events() == []


def test_shortest_request_has_four_bytes(unit):
    answer(unit, with_crc(b"\0" + WRITE), 50)
    answer(unit, with_crc(b"\1" + WRITE), 70)
    assert answer(unit, with_crc(b"\1\7")) == [with_crc(b"\1\7\x6d")]


@pytest.mark.parametrize(
    "spoiled", [b"", b"\xff\xff", with_crc(b"\1"), with_crc(b"\1" + ASK)[:-1] + b"\0", b"\2" + ASK]
)
def test_corrupted_or_foreign_request_is_ignored(unit, spoiled):
    assert (answer(unit, spoiled), unit.take_events()) == ([], [])
    assert answer(unit, with_crc(b"\2" + ASK)) == []


def test_broadcast_is_accepted_without_answer(unit):
    assert answer(unit, with_crc(b"\0" + WRITE)) == []
    assert unit.snapshot(0)["matched"] == 1.0
    assert answer(unit, with_crc(b"\0" + WRITE), 150) == []  # recorded only for the single unit
    assert unit.snapshot(0)["matched"] == 2.0
    unknown = with_crc(b"\0" + WRITE[:-1] + b"\4")
    assert answer(unit, unknown, 200) == []  # no exception response, but an event
    assert len(unit.take_events()) == 1


def test_unrecorded_request_is_refused_as_device_failure(unit):
    """MODBUS Application Protocol V1.1b3, section 7: function code and 80h, exception 04h."""
    refused = with_crc(bytes.fromhex("018604"))
    assert answer(unit, with_crc(b"\1" + WRITE[:-1] + b"\4")) == [refused]
    assert unit.snapshot(0)["mismatches"] == 1.0


def flexible_node(data_bit_ns, frames):
    """Return node 6 of a 500 kbit/s recording with known senders."""
    logs = CanopenExchanges("can0", 0, {6: "left"})
    for at_ns, sent in frames:
        logs.take(at_ns, sent, Direction.UNKNOWN, "left")
    made = RecordedNode(logs.logs()[6], CanopenDecoder(), 6, 2_000, "", data_bit_ns)
    made.start(0)
    return made


def test_can_fd_frame_starts_earlier_by_both_rates():
    """123h with 8 bytes: 26 nominal bits to its end, 99 at the data rate (test_can_bus_fd)."""
    data = bytes.fromhex("0011223344556677")
    frames = [
        (1 * MS, classic(0x706, b"\0")),
        (20 * MS, flexible(0x123, BRS, data)),
        (30 * MS, flexible(0x123, 0, data)),
    ]
    one = flexible_node(500, frames)
    due = []
    while (at_ns := one.next_deadline_ns()) is not None:
        one.expire(at_ns)
        due += [(at_ns, sent) for sent in one.take_output()]
    assert [sent for _, sent in due] == [sent for _, sent in frames]
    assert due[1][0] == 20 * MS - (26 * 2_000 + 99 * 500)
    assert due[2][0] == 30 * MS - (26 + 99) * 2_000
    assert one.take_events() == []


def test_classical_node_omits_can_fd_frames_with_warning():
    frames = [(1 * MS, classic(0x706, b"\0")), (20 * MS, flexible(0x123, 0, bytes(64)))]
    one = flexible_node(0, frames)
    one.expire(50 * MS)
    assert one.take_output() == [frames[0][1]]
    assert one.take_events() == [
        ("warning", "1 CAN FD frames of node 6 are left out: it is classical")
    ]
    assert len(flexible_node(500, frames).player.log.steps[0].reactions) == 2


def test_two_controllers_of_one_file_report_alike():
    heard = []
    for _ in range(2):
        context = ControllerContext("left", GOLDEN, 1)
        one = build({"recording": "cia402.mcap", "node_id": 1}, context)
        one.start(0)
        one.receive(classic(0x201, b"\x02\0"), 0)  # of which the mapping is known
        one.receive(classic(0x000, b"\x81\0"), 0)  # a reset, which forgets it
        one.receive(classic(0x201, b"\x02\0"), 0)
        heard.append(one.take_events())
    assert "6040h controlword" in heard[0][0][1]
    assert heard[0] == heard[1]
