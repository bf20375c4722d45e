"""The cause of each frame, in cases where it is not obvious."""

import pytest

from motorhil.traces.can_frame import EFF, classic, remote
from motorhil.traces.exchange.canopen import CanopenExchanges, remote_key
from motorhil.traces.exchange.modbus import modbus_logs
from motorhil.traces.exchange.steps import Role, period_ns
from motorhil.traces.formats.frames import Frame
from motorhil.traces.schema import Direction
from tests.unit.traces.exchange.test_exchange_logs import MS, adu, cut, frame

BOOT = frame(0, 0x706, b"\0")


def set_points(*frames):
    """Return the set-points sent to node 6 in PDOs."""
    return [step.key[2][1] for step in cut(BOOT, *frames)[6].steps if step.key[0] == "pdo"]


@pytest.mark.parametrize(
    ("between", "forgets"),
    [
        (frame(20, 0x000, b"\x81\x06"), True),  # NMT reset node, to it
        (frame(20, 0x000, b"\x82\x00"), True),  # reset communication, to all
        (frame(20, 0x000, b"\x81\x05"), False),  # to another
        (frame(20, 0x000, b"\x01\x06"), False),  # start
        (frame(20, 0x706, b"\x00"), True),  # boot-up
        (frame(20, 0x706, b"\x05"), False),  # heartbeat
    ],
)
def test_set_point_after_reset_counts_again(between, forgets):
    told = set_points(frame(10, 0x206, b"\x0f"), between, frame(30, 0x206, b"\x0f"))
    assert told == ([0x0F, 0x0F] if forgets else [0x0F])


def test_extended_identifiers_are_not_canopen():
    assert cut(frame(0, EFF | 0x701, b"\0"), frame(1, EFF | 0x581, bytes(8))) == {}


def test_node_without_frames_has_no_log():
    assert cut(frame(0, 0x607, bytes.fromhex("4041600000000000")), frame(1, 0x207, b"\1")) == {}


def test_host_frame_with_node_identifier_is_not_nodes():
    assert cut(frame(0, 0x185, b"\1", direction=Direction.TRANSMITTED)) == {}
    assert cut(frame(0, 0x705, b"\5", direction=Direction.TRANSMITTED)) == {}
    assert list(cut(frame(0, 0x185, b"\1", direction=Direction.RECEIVED))) == [5]


def test_sync_producer_sends_sync_others_receive_it():
    logs = cut(
        frame(0, 0x705, b"\0", "left"),
        frame(0, 0x706, b"\0", "right"),
        frame(10, 0x080, b"", "left"),
        frame(11, 0x186, b"\1", "right"),
        names={5: "left", 6: "right"},
    )
    (first,) = logs[5].steps
    assert [(one.delay_ns, one.data) for one in first.reactions][1:] == [
        (10 * MS, classic(0x80, b""))
    ]
    assert all(step.key[0] != "sync" for step in logs[5].steps)


def test_reactions_are_in_order_of_arrival():
    """The relation of the TPDO to SYNC is unknown until the end."""
    (first,) = cut(BOOT, frame(5, 0x286, b"\1"), frame(10, 0x706, b"\5"))[6].steps
    assert [one.delay_ns for one in first.reactions] == [0, 5 * MS, 10 * MS]


@pytest.mark.parametrize(
    ("delay_ms", "every", "by_sync"), [(2, 1, True), (3, 1, False), (1, 2, False)]
)
def test_pdo_within_2_ms_of_most_syncs_is_synchronous(delay_ms, every, by_sync):
    traffic = [BOOT]
    for number in range(1, 21):
        traffic.append(frame(10 * number, 0x080))
        if number % every == 0:
            traffic.append(frame(10 * number + delay_ms, 0x286, b"\1"))
    steps = cut(*traffic)[6].steps
    assert bool(sum(len(step.answers) for step in steps)) == by_sync
    assert len(steps[0].reactions) == (1 if by_sync else 1 + 20 // every)


def test_remote_frame_is_poll_answered_by_next_frame():
    asked = Frame(10 * MS, "can0", remote(0x186, 1))
    logs = cut(BOOT, asked, frame(12, 0x186, b"\1"), frame(20, 0x186, b"\2"))
    poll = logs[6].steps[1]
    assert (poll.role, poll.key) == (Role.POLL, remote_key(0x186))
    assert [(one.delay_ns, one.data[8]) for one in poll.answers] == [(2 * MS, 1)]
    assert [one.data[8] for one in logs[6].steps[0].reactions] == [0, 2]


def test_set_point_bits_of_pdo_can_be_masked():
    """RPDO 1 of node 6: controlword (16 bits), modes of operation (8), target position (32)."""
    logs = CanopenExchanges("can0", 0, any_set_point=True)
    written = ("2f001600 00", "23001601 10004060", "23001602 08006060", "23001603 20007a60")
    frames = [BOOT]
    for number, request in enumerate((*written, "2f001600 03")):
        data = bytes.fromhex(request).ljust(8, b"\0")
        taken = b"\x60" + data[1:4] + bytes(4)
        frames += [frame(10 + 2 * number, 0x606, data), frame(11 + 2 * number, 0x586, taken)]
    frames += [
        frame(30, 0x206, bytes.fromhex("0f000801000000")),
        frame(40, 0x206, bytes.fromhex("0f0008ffffffff")),
        frame(50, 0x206, bytes.fromhex("1f000802000000")),
        frame(60, 0x206, bytes.fromhex("1f000602000000")),
    ]
    for one in frames:
        logs.take(one.time_ns, one.frame, one.direction, one.sender)
    log = logs.logs()[6]
    (((_, mask),),) = log.masks.values()
    assert mask == bytes.fromhex("ffffff00000000ff")
    told = [step.time_ns // MS for step in log.steps if step.key[0] == "pdo"]
    assert told == [30, 50, 60]


def test_period_needs_five_frames_and_similar_intervals():
    assert period_ns([0, 100, 200, 300, 400]) == 100
    assert period_ns([0, 100, 200, 300]) is None
    assert period_ns([0, 90, 180, 280, 390, 500]) == 100  # 90, 90, 100, 110, 110
    assert period_ns([0, 89, 178, 278, 389, 500]) is None


# MODBUS Application Protocol V1.1b3, section 6: functions that write, 15h to 17h included.
@pytest.mark.parametrize("function", range(1, 0x2C))
def test_requests_that_write_are_commands(function):
    pdu = bytes([function, 0, 1, 0, 3])
    told = [adu(1, pdu), adu(4, pdu, to_server=False)]
    is_write = function in (0x05, 0x06, 0x0F, 0x10, 0x15, 0x16, 0x17)
    assert modbus_logs("rs485", told, 0)[1].steps[1].role is (
        Role.COMMAND if is_write else Role.POLL
    )


READ = bytes.fromhex("03006B0001")
ANSWER = bytes.fromhex("0302022B")


def answers(adus):
    """Return (delay [ns], last byte) of each answer of unit 1; None if there is none."""
    found = []
    for step in modbus_logs("line", adus, 0)[1].steps[1:]:
        told = step.turns[0].answers
        found.append((told[0].delay_ns, told[0].data[-1]) if told else None)
    return found


def test_serial_request_unanswered_before_next_stays_so():
    told = [adu(1, READ), adu(500, READ), adu(503, ANSWER, to_server=False)]
    assert answers(told) == [None, (3 * MS - MS // 4, 0x2B)]


def test_tcp_answer_is_matched_by_transaction():
    """Two requests in flight, answered in reverse order."""
    told = [
        adu(1, READ, transaction=1),
        adu(2, READ, transaction=2),
        adu(5, ANSWER[:-1] + b"\2", to_server=False, transaction=2),
        adu(6, ANSWER[:-1] + b"\1", to_server=False, transaction=1),
    ]
    assert [one and one[1] for one in answers(told)] == [1, 2]


def test_unit_after_gateway_exception_has_usual_delay():
    """The gateway delays the request, so the unit's own response time is not in the recording."""
    told = [
        adu(0, READ, transaction=1),
        adu(5, ANSWER, to_server=False, transaction=1),
        adu(10, READ, transaction=2),
        adu(1010, b"\x83\x0b", to_server=False, transaction=2),
        adu(1020, READ, transaction=3),
        adu(1100, ANSWER, to_server=False, transaction=3),
        adu(1110, READ, transaction=4),
        adu(1117, ANSWER, to_server=False, transaction=4),
    ]
    usual, longer = 5 * MS - MS // 4, 7 * MS - MS // 4
    told_again = answers(told)
    assert told_again[1] is None
    assert [one[0] for one in (told_again[0], told_again[3])] == [usual, longer]
    assert told_again[2][0] in (usual, longer)  # the median of the two known ones
