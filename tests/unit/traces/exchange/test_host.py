"""The host's part of a recording, and the reports that the host can have waited for."""

import struct

import pytest

from motorhil.traces.can_frame import ERR, classic
from motorhil.traces.exchange.host import ANSWER, HostCutter, HostSurvey, Listener, answer_size
from motorhil.traces.formats.modbus import Adu
from motorhil.traces.schema import Direction

MS = 1_000_000
LENGTH = 100_000
HOST, NODE, NOBODY = Direction.TRANSMITTED, Direction.RECEIVED, Direction.UNKNOWN
WRITE = (HOST, 0x605, "2b40600006000000")
TAKEN = (NODE, 0x585, "6040600000000000")


def cut(*told):
    """Return the host's steps in (time [ms], (direction, identifier, data)) on one bus."""
    cutter = HostCutter(Listener({}), lambda bus, frame: LENGTH)
    for time_ms, (direction, identifier, data) in told:
        frame = classic(identifier, bytes.fromhex(data))
        cutter.take_frame(time_ms * MS, "can0", frame, direction)
    return cutter.steps()


def mapped(entry):
    """Return the SDO traffic that maps one object to TPDO 1 of node 5 (1A00h)."""
    told = []
    for number, head in enumerate(("2f001a0000000000", f"23001a01{entry}", "2f001a0001000000")):
        told.append((2 * number, (HOST, 0x605, head)))
        told.append((2 * number + 1, (NODE, 0x585, "60" + head[2:8] + "00000000")))
    return told


def waits(step):
    return [told.time_ns // MS for told in step.waits]


def test_step_waits_for_reports_since_previous_step():
    first, second, third = cut((10, WRITE), (12, TAKEN), (20, WRITE), (22, TAKEN), (30, WRITE))
    assert [waits(one) for one in (first, second, third)] == [[], [12], [22]]
    assert second.waits[0].subject == ("can0", 5, ANSWER)
    assert (first.start_ns, first.end_ns) == (10 * MS - LENGTH, 10 * MS)


def test_report_during_a_frame_of_another_bus_belongs_to_next_step():
    cutter = HostCutter(Listener({}), lambda bus, frame: LENGTH)
    for time_ms, bus, (direction, identifier, data) in (
        (10, "can1", TAKEN),
        (10, "can0", WRITE),
        (20, "can0", WRITE),
    ):
        cutter.take_frame(time_ms * MS, bus, classic(identifier, bytes.fromhex(data)), direction)
    first, second = cutter.steps()
    assert [waits(first), waits(second)] == [[], [10]]


def test_order_of_equal_stamps_is_that_of_the_recording():
    # A log of one stamp: four controlwords, the shortest frame last.
    cutter = HostCutter(Listener({}), lambda bus, frame: LENGTH - frame[8])
    words = ("8f00", "0e00", "0700", "0f00")
    for word in words:
        cutter.take_frame(0, "can0", classic(0x205, bytes.fromhex(word)), HOST)
    assert [step.frame[8:10].hex() for step in cutter.steps()] == list(words)


def test_repeated_part_keeps_its_own_times():
    """Frames at 20 and 30 ms stand in the file twice; all of the second copy is earlier."""
    part = [(20, WRITE), (22, TAKEN), (30, WRITE), (32, TAKEN)]
    steps = cut((10, WRITE), (12, TAKEN), *part, *part, (40, WRITE))
    assert [one.start_ns for one in steps] == [
        stamp * MS - LENGTH for stamp in (10, 20, 20, 30, 30, 40)
    ]
    assert [waits(one) for one in steps] == [[], [12], [], [22, 22], [], [32, 32]]


def test_answer_of_the_same_stamp_is_awaited_by_the_next_step():
    first, second = cut((10, WRITE), (10, TAKEN), (10, WRITE))
    assert [waits(first), waits(second)] == [[], [10]]


@pytest.mark.parametrize(
    ("identifier", "data", "is_hosts"),
    [
        (0x000, "0105", True),  # NMT
        (0x080, "", True),  # SYNC
        (0x100, "000000000000", True),  # TIME
        (0x205, "0f00", True),  # RPDO
        (0x605, "4041600000000000", True),  # SDO request
        (0x185, "3702", False),  # TPDO
        (0x585, "4b41600037020000", False),  # SDO response
        (0x085, "1086210000000000", False),  # EMCY
        (0x705, "05", False),  # heartbeat
        (0x705, "00", False),  # boot-up
    ],
)
def test_unknown_direction_is_decided_by_purpose(identifier, data, is_hosts):
    """CiA 301, pre-defined connection set."""
    assert len(cut((1, (NOBODY, identifier, data)))) == is_hosts
    assert len(cut((1, (HOST, identifier, data)))) == 1
    assert cut((1, (NODE, identifier, data))) == []


def test_error_frame_belongs_to_neither_side():
    assert cut((1, (HOST, ERR | 0x04, "0000000000000000"))) == []


def test_host_heartbeat_is_free_and_takes_no_waits():
    beat = (HOST, 0x77F, "05")
    steps = cut((10, WRITE), (12, TAKEN), (15, beat), (20, WRITE))
    assert [one.is_free for one in steps] == [False, True, False]
    assert [waits(one) for one in steps] == [[], [], [12]]


def test_states_are_reported_on_change_events_each_time():
    told = [
        *[(ms, (NODE, 0x705, "05")) for ms in (1, 2, 3)],
        (4, (NODE, 0x705, "7f")),
        *[(ms, (NODE, 0x705, "00")) for ms in (5, 6)],
        *[(ms, (NODE, 0x085, "1086210000000000")) for ms in (7, 8)],
    ]
    (step,) = cut(*told, (20, WRITE))
    assert sorted(set(waits(step))) == [1, 4, 5, 6, 7, 8]


# CiA 402, statusword: 0 ready to switch on, 1 switched on, 2 operation enabled, 3 fault, 5 quick
# stop, 6 switch on disabled, 10 target reached, 12 and 13 mode-specific. A host does not wait for
# the others: 4 voltage enabled, 7 warning, 8 and 14, 15 manufacturer-specific, 9 remote, 11
# internal limit active.
@pytest.mark.parametrize("bit", range(16))
def test_statusword_bits_relevant_to_host_count(bit):
    word = 1 << bit
    steps = cut(
        *mapped("10004160"),
        (10, (NODE, 0x185, "0000")),
        (11, (NODE, 0x185, struct.pack("<H", word).hex())),
        (20, WRITE),
    )
    assert waits(steps[-1])[1:] == ([10, 11] if bit in (0, 1, 2, 3, 5, 6, 10, 12, 13) else [10])


def test_measured_quantities_are_not_waited_for():
    """6064h, position actual value."""
    steps = cut(
        *mapped("20006460"),
        (10, (NODE, 0x185, "01000000")),
        (20, WRITE),
    )
    assert waits(steps[-1]) == [5]  # the answer to the last write


def test_modbus_request_is_hosts_and_answer_is_awaited():
    cutter = HostCutter(Listener({}), lambda bus, frame: LENGTH)
    for time_ms, to_server in ((5, True), (9, False), (20, True)):
        adu = Adu(time_ms * MS, None, to_server, 0, 7, bytes.fromhex("0600010003"))
        cutter.take_adu((time_ms - 2) * MS, "rs485", b"all of it", adu, "text")
    first, second = cutter.steps()
    assert (first.start_ns, first.end_ns, first.frame) == (3 * MS, 5 * MS, b"all of it")
    assert [(one.time_ns, one.subject) for one in second.waits] == [(9 * MS, ("rs485", 7, ANSWER))]


# The examples of MODBUS Application Protocol V1.1b3, section 6, each after its unit.
RESPONSES = {
    "01": "0103CD6B05",
    "02": "0203ACDB35",
    "03": "0306022B00000064",
    "04": "0402000A",
    "05": "0500ACFF00",
    "06": "0600010003",
    "07": "076D",
    "08": "080000A537",
    "0B": "0BFFFF0108",
    "0C": "0C080000010801212000",
    "0F": "0F0013000A",
    "10": "1000010002",
    "14": "140C05060DFE0020050633CD0040",
    "15": "150D0600040007000306AF04BE100D",
    "16": "16000400F20025",
    "17": "170C00FE0ACD00010003000D00FF",
    "83": "8302",
}


@pytest.mark.parametrize("function", RESPONSES)
def test_answer_size_follows_from_its_beginning(function):
    """On a serial line with two bytes of check sum; on TCP from the header."""
    pdu = bytes.fromhex(RESPONSES[function])
    assert pdu[0] == int(function, 16)
    on_line = b"\x05" + pdu + b"\xc5\xc5"
    assert answer_size(on_line, False) == len(on_line)
    assert answer_size(on_line[:3], False) == len(on_line)
    assert answer_size(on_line[:2], False) is None
    on_tcp = struct.pack(">HHHB", 1, 0, 1 + len(pdu), 5) + pdu
    assert answer_size(on_tcp, True) == len(on_tcp)
    assert answer_size(on_tcp[:6], True) == len(on_tcp)
    assert answer_size(on_tcp[:5], True) is None


def test_answer_size_of_unknown_function_is_none():
    assert answer_size(bytes.fromhex("052b0e0101"), False) is None


def surveyed(*told):
    survey = HostSurvey()
    for direction, identifier, data in told:
        survey.take("can0", classic(identifier, bytes.fromhex(data)), direction)
    return survey


@pytest.mark.parametrize(
    ("directions", "is_known"),
    [
        ((HOST, NODE), True),
        ((NODE, NODE), False),  # a monitor receives all
        ((HOST, HOST), False),  # both programs run beside the recorder
        ((NOBODY, NOBODY), False),
    ],
)
def test_directions_separate_host_only_if_both_occur(directions, is_known):
    ask, answer = directions
    survey = surveyed((ask, 0x605, "4000100000000000"), (answer, 0x585, "4300100092010200"))
    assert survey.by_direction() is is_known


BEAT = (NOBODY, 0x701, "05")


@pytest.mark.parametrize(
    ("told", "present", "own"),
    [
        ([BEAT], [], [1]),
        ([BEAT], [("can0", 1)], []),  # a device has it
        ([BEAT], None, []),  # the devices are unknown
        ([BEAT, (NOBODY, 0x081, "1081010000000000")], [], []),  # an emergency
        ([BEAT, (NOBODY, 0x601, "4000100000000000")], [], []),  # it is asked
        ([BEAT, (NOBODY, 0x000, "0101")], [], []),
        ([(HOST, 0x701, "05"), (NODE, 0x705, "05")], None, [1]),
    ],
)
def test_hosts_own_node_only_sends_heartbeats(told, present, own):
    assert surveyed(*told).hosts_own(present) == [("can0", node) for node in own]


@pytest.mark.parametrize(
    ("told", "running", "operational"),
    [
        ([(NODE, 0x705, "00"), (NODE, 0x705, "05")], False, True),
        ([(NODE, 0x705, "7f")], True, False),
        ([(NODE, 0x185, "3102")], True, True),
        ([(HOST, 0x000, "0105"), (NODE, 0x185, "3102")], True, False),  # started by the host
        ([(HOST, 0x000, "8100"), (NODE, 0x705, "00")], True, False),  # booted by the host
        ([(HOST, 0x605, "4000100000000000")], True, False),  # silent
    ],
)
def test_survey_tells_what_ran_before_the_recording(told, running, operational):
    survey = surveyed(*told)
    assert (survey.running() != [], survey.operational() != []) == (running, operational)


def test_answer_with_the_stamp_of_its_request_is_not_awaited_by_it():
    """Stamps of whole seconds; the earlier frame occupies the bus until the stamp."""
    first, second, third = cut((10, WRITE), (10, TAKEN), (10, WRITE), (10, TAKEN), (10, WRITE))
    assert [len(one.waits) for one in (first, second, third)] == [0, 1, 1]
