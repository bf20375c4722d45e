"""Exchange logs contain each frame of a node exactly once, after its cause."""

import struct
from collections import Counter

import pytest

from motorhil.harness.cli.main import main
from motorhil.traces.can_frame import EFF, ERR, RTR, classic
from motorhil.traces.exchange.canopen import CanopenExchanges
from motorhil.traces.exchange.modbus import LineAdu, modbus_logs
from motorhil.traces.exchange.recording import exchanges_of
from motorhil.traces.exchange.steps import START, Role
from motorhil.traces.formats.frames import Findings, Frame
from motorhil.traces.formats.modbus import Adu
from motorhil.traces.formats.registry import open_source
from motorhil.traces.mcap.reader import read_trace
from motorhil.traces.schema import Direction

MS = 1_000_000
REAL = (
    "canopenlens_sample_amr_2wheel.log",
    "canopen_machine_pcan1.trc",
    "canopen_machine_pcanrouter_pcan3.trc",
    "ros2canopen_issue298_fault_recovery.candump.txt",
    "roboteq_mbl1660_node12_candump.txt",
)


def frame(time_ms, can_id, data=b"", sender="", direction=Direction.UNKNOWN):
    return Frame(time_ms * MS, "can0", classic(can_id, data), direction, sender)


def canopen_logs(bus, frames, begin_ns, names=None):
    """Return the exchange logs of the nodes in these frames of one bus, by node-ID."""
    exchanges = CanopenExchanges(bus, begin_ns, names)
    for time_ns, _, frame, direction, sender in frames:
        exchanges.take(time_ns, frame, direction, sender)
    return exchanges.logs()


def cut(*frames, names=None):
    return canopen_logs("can0", frames, 0, names)


def sent(log):
    """Yield all frames that the node sent, as (time, frame)."""
    for step in log.steps:
        for one in (*step.answers, *step.reactions):
            yield step.time_ns + one.delay_ns, one.data
        for turn in step.turns:
            for one in turn.answers:
                yield None, one.data


@pytest.mark.parametrize("name", REAL)
def test_real_machine_frame_is_in_log_once(name, shared):
    """Counted here by identifier alone: 580h, 700h, and TPDOs of the pre-defined set."""
    findings = Findings()
    path = shared / "data" / "traffic" / name
    frames = list(open_source(path).frames(findings))
    logs = canopen_logs(frames[0].bus, frames, frames[0].time_ns)
    assert logs
    ours = Counter(data for log in logs.values() for _, data in sent(log))
    plain = [one for one in frames if len(one.frame) == 16]
    told = Counter()
    asked = set()
    for one in plain:
        (can_id,) = struct.unpack_from("<I", one.frame)
        if can_id & (EFF | ERR | RTR):
            continue
        if can_id >> 7 == 12:
            asked.add(can_id & 0x7F)
        if (can_id >> 7 == 11 and can_id & 0x7F in asked) or can_id >> 7 == 14:
            told[one.frame] += 1
    wrong = {data.hex(): (count, ours[data]) for data, count in told.items() if ours[data] != count}
    assert wrong == {}
    assert sum(told.values()) > 5


@pytest.mark.parametrize("name", REAL)
def test_times_in_log_are_those_of_recording(name, shared):
    path = shared / "data" / "traffic" / name
    frames = list(open_source(path).frames(Findings()))
    logs = canopen_logs(frames[0].bus, frames, frames[0].time_ns)
    there = {(one.time_ns, one.frame) for one in frames}
    for log in logs.values():
        for time_ns, data in sent(log):
            assert time_ns is None or (time_ns, data) in there


def test_write_and_its_reactions():
    logs = cut(
        frame(0, 0x701, b"\0"),
        frame(5, 0x601, bytes.fromhex("2b40600006000000")),
        frame(6, 0x581, bytes.fromhex("6040600000000000")),
        frame(9, 0x181, b"\x31\x02"),
        frame(20, 0x601, bytes.fromhex("4041600000000000")),
        frame(21, 0x581, bytes.fromhex("4b41600031020000")),
        frame(29, 0x181, b"\x31\x02"),
    )
    first, write, read = logs[1].steps
    assert (first.key, first.role) == (START, Role.COMMAND)
    assert [(one.delay_ns, one.data[8:9]) for one in first.reactions] == [(0, b"\0")]
    assert (write.role, read.role) == (Role.COMMAND, Role.POLL)
    assert [one.delay_ns for one in write.reactions] == [4 * MS, 24 * MS]  # both after the write
    assert [one.delay_ns for one in read.turns[0].answers] == [1 * MS]
    assert "6041h statusword = 0231h" in read.answer_text


def test_periodic_frames_are_marked():
    """Every 20 ms, and one more on a change; a pause; a boot-up is not a heartbeat."""
    times = [0, 20, 40, 42, 62, 82, 102, 500, 520, 540]
    beats = [frame(t, 0x701, b"\5") for t in range(100, 600, 100)]
    tpdos = [frame(t, 0x181, b"\1") for t in times]
    traffic = sorted([frame(0, 0x701, b"\0"), *tpdos, *beats], key=lambda one: one.time_ns)
    (first,) = cut(*traffic)[1].steps
    told = {
        can_id: [one.goes_on for one in first.reactions if one.data[:2] == can_id]
        for can_id in (b"\x81\1", b"\1\7")
    }
    assert told[b"\x81\1"] == [t != 102 for t in times]
    assert told[b"\1\7"] == [False, True, True, True, True, True]


def test_segmented_upload_is_one_step_with_turns():
    """CiA 301: initiate upload with the size 9, two segments."""
    logs = cut(
        frame(1, 0x602, bytes.fromhex("4008100000000000")),
        frame(2, 0x582, bytes.fromhex("4108100009000000")),
        frame(3, 0x602, bytes.fromhex("6000000000000000")),
        frame(4, 0x582, b"\x00motorhi"),
        frame(5, 0x602, bytes.fromhex("7000000000000000")),
        frame(6, 0x582, b"\x1bl!\0\0\0\0\0"),
        frame(9, 0x602, bytes.fromhex("4000100000000000")),
        frame(10, 0x582, bytes.fromhex("4300100092010200")),
    )
    _, name, kind = logs[2].steps
    assert [turn.asked[8] for turn in name.turns] == [0x40, 0x60, 0x70]
    assert [len(turn.answers) for turn in name.turns] == [1, 1, 1]
    assert len(kind.turns) == 1


def set_up_tpdo(node, transmission_type):
    """Return a write of 1800h:2 by SDO, and its confirmation."""
    request = bytes.fromhex("2f001802") + bytes([transmission_type, 0, 0, 0])
    return (
        frame(1, 0x600 + node, request),
        frame(2, 0x580 + node, bytes.fromhex("6000180200000000")),
    )


@pytest.mark.parametrize(("kind", "by_sync"), [(1, True), (240, True), (254, False), (255, False)])
def test_only_synchronous_pdo_answers_sync(kind, by_sync):
    """CiA 301: transmission types 0 to 240 are synchronous."""
    logs = cut(
        *set_up_tpdo(3, kind),
        frame(10, 0x80),
        frame(11, 0x183, b"\1"),
        frame(20, 0x80),
        frame(21, 0x183, b"\2"),
    )
    answers = [one.data[8:9] for step in logs[3].steps for one in step.answers]
    reactions = [one.data[8:9] for step in logs[3].steps for one in step.reactions]
    assert (answers, reactions) == (([b"\1", b"\2"], []) if by_sync else ([], [b"\1", b"\2"]))


def test_unknown_pdo_after_every_sync_is_synchronous():
    traffic = []
    for number in range(20):
        traffic += [frame(10 * number, 0x80), frame(10 * number + 1, 0x184, b"\1")]
        if number % 3 == 0:
            traffic.append(frame(10 * number + 5, 0x284, b"\2"))
    logs = cut(frame(0, 0x704, b"\0"), *traffic)
    assert {one.data[:2] for step in logs[4].steps for one in step.answers} == {b"\x84\x01"}
    assert {one.data[:2] for step in logs[4].steps for one in step.reactions} == {
        b"\x84\x02",
        b"\x04\x07",
    }


def test_sync_that_activates_set_point_is_command():
    logs = cut(
        frame(0, 0x705, b"\0"),
        frame(10, 0x205, b"\x3f\x00"),
        frame(12, 0x80),
        frame(14, 0x185, b"\x37\x12"),
        frame(22, 0x80),
        frame(24, 0x185, b"\x37\x16"),
    )
    kinds = [(step.role, step.key[0]) for step in logs[5].steps]
    command = Role.COMMAND
    assert kinds == [(command, "start"), (command, "pdo"), (command, "sync")]
    assert [one.delay_ns for one in logs[5].steps[-1].reactions] == [2 * MS, 12 * MS]


def test_repeated_set_point_is_not_a_command():
    logs = cut(
        frame(0, 0x706, b"\0"),
        *[frame(10 * n, 0x206, b"\x0f\0") for n in (1, 2, 3)],
        frame(40, 0x206, b"\x1f\0"),
    )
    assert [step.key[2][1:3] for step in logs[6].steps[1:]] == [b"\x0f\0", b"\x1f\0"]


def test_sender_decides_owner_before_identifier():
    """An emergency under another node's identifier, as a real controller sends it."""
    frames = (
        frame(0, 0x70C, b"\0", "left", Direction.RECEIVED),
        frame(1, 0x081, bytes(8), "left", Direction.RECEIVED),
    )
    named = cut(*frames, names={12: "left"})
    assert list(named) == [12]
    assert len(list(sent(named[12]))) == 2
    assert sorted(cut(*frames)) == [1, 12]


def adu(time_ms, pdu, unit=1, to_server=True, transaction=0):
    time_ns = time_ms * MS
    return LineAdu(
        time_ns,
        time_ns - MS // 2,
        time_ns - MS // 4,
        Adu(time_ns, None, to_server, transaction, unit, pdu),
    )


def test_modbus_write_is_command_and_read_is_poll():
    """FC 06h and 03h, from the specification's own examples (sections 6.6 and 6.3)."""
    logs = modbus_logs(
        "rs485",
        [
            adu(1, bytes.fromhex("0600010003")),
            adu(4, bytes.fromhex("0600010003"), to_server=False),
            adu(10, bytes.fromhex("03006B0003")),
            adu(13, bytes.fromhex("0306022B00000064"), to_server=False),
        ],
        0,
    )
    _, write, read = logs[1].steps
    assert (write.role, read.role) == (Role.COMMAND, Role.POLL)
    (answer,) = read.turns[0].answers
    assert answer.data == bytes.fromhex("010306022B00000064")
    assert (answer.delay_ns, answer.duration_ns) == (3 * MS - MS // 4, MS // 4)


def test_broadcast_reaches_all_gateway_exception_none():
    """Exception 0Bh: gateway target device failed to respond."""
    logs = modbus_logs(
        "plant",
        [
            adu(1, bytes.fromhex("03006B0001"), unit=1, transaction=1),
            adu(2, bytes.fromhex("0302022B"), unit=1, to_server=False, transaction=1),
            adu(3, bytes.fromhex("03006B0001"), unit=2, transaction=2),
            adu(1003, bytes.fromhex("830B"), unit=2, to_server=False, transaction=2),
            adu(1010, bytes.fromhex("0600010003"), unit=0, transaction=3),
        ],
        0,
    )
    assert list(logs) == [1]
    assert [step.key[0] for step in logs[1].steps] == ["start", "modbus", "modbus"]
    assert logs[1].steps[-1].turns[0].asked == bytes.fromhex("000600010003")


def on_tcp(*told):
    """Return ADUs of unit 2 from (ms, PDU in hex, True for a request, transaction)."""
    return [
        adu(time_ms, bytes.fromhex(pdu), 2, to_server, transaction)._replace(is_tcp=True)
        for time_ms, pdu, to_server, transaction in told
    ]


def answered(log):
    return [
        (step.turns[0].asked[1:].hex(), [one.data[1:].hex() for one in step.turns[0].answers])
        for step in log.steps[1:]
    ]


def test_reused_transaction_leaves_request_unanswered():
    """As with the gateway whose client begins with transaction 0 on each connection."""
    logs = modbus_logs(
        "plant",
        on_tcp(
            *((1, "0400000001", True, 0), (2, "0400010001", True, 1), (9, "0402aaaa", False, 1)),
            *((2000, "0400050001", True, 0), (2001, "0400060002", True, 0)),
            *((2010, "04020055", False, 0), (2011, "040400660066", False, 0)),
        ),
        0,
    )
    assert answered(logs[2]) == [
        ("0400000001", []),
        ("0400010001", ["0402aaaa"]),
        ("0400050001", ["04020055"]),
        ("0400060002", ["040400660066"]),
    ]


def test_real_gateway_answers_match_requests(shared, tmp_path):
    """1592 of its answers have a request, none later than 5.1 s: traffic/INDEX.md."""
    source = shared / "data" / "traffic" / "modbus_gateway_units1237_pipelined.pcap"
    assert main(["convert", str(source), "-o", str(tmp_path / "plant.mcap")]) == 0
    with read_trace(tmp_path / "plant.mcap") as trace:
        logs = exchanges_of(trace).logs.values()
    turns = [step.turns[0] for log in logs for step in log.steps[1:]]
    assert sum(len(turn.answers) for turn in turns) == 1592
    assert max(one.delay_ns for turn in turns for one in turn.answers) < 5_100 * MS


def test_broadcast_counts_for_units_addressed_later():
    logs = modbus_logs(
        "rs485",
        [
            adu(1, bytes.fromhex("0600010003"), unit=0),
            adu(10, bytes.fromhex("03006B0001"), unit=4),
            adu(13, bytes.fromhex("0302022B"), unit=4, to_server=False),
        ],
        0,
    )
    assert [step.turns[0].asked[0] for step in logs[4].steps[1:]] == [0, 4]
