"""Modbus controllers in a world, on a line and behind a gateway.

The expected times are computed here from the standard's numbers (MODBUS over Serial Line V1.02).
"""

import gc
from collections.abc import Mapping
from fractions import Fraction

import pytest

from motorhil.emulators.controller import Controller
from motorhil.emulators.media.byte_pipe import BytePipe
from motorhil.emulators.media.serial_faults import SerialFaultKind, SerialFaultPlan, SerialFaultRule
from motorhil.emulators.media.serial_line import SerialLine
from motorhil.emulators.modbus.registers import Register, RegisterBank
from motorhil.emulators.modbus.rtu import RtuUnit, with_crc
from motorhil.emulators.modbus.server import Diagnostics, ModbusServer
from motorhil.emulators.modbus.tcp import adu
from motorhil.emulators.simulation.event_queue import EventQueue
from motorhil.emulators.simulation.world import World

MS = 1_000_000
T35_NS = 1_750_000


class Registers(Controller):
    """A unit with a few registers without behaviour."""

    def __init__(self, unit: int, reply_ns: int = 2 * MS) -> None:
        bank = RegisterBank([Register(n, f"r{n}", default=100 * unit + n) for n in range(8)])
        self.unit = unit
        self.rtu = RtuUnit(unit, ModbusServer(bank, diagnostics=Diagnostics()), reply_ns)

    def start(self, now_ns: int) -> None: ...

    def receive(self, data: bytes, now_ns: int) -> None:
        if data:
            self.rtu.receive(data, now_ns)
        else:
            self.rtu.spoiled()

    def sent(self, data: bytes, now_ns: int) -> bool | None: ...

    def wants_sent(self) -> bool:
        return False

    def next_deadline_ns(self) -> int | None:
        return self.rtu.next_deadline_ns()

    def expire(self, now_ns: int) -> None:
        self.rtu.expire(now_ns)

    def take_output(self) -> list[bytes]:
        return self.rtu.take_output()

    def take_events(self) -> list[tuple[str, str]]:
        return []

    def stimulate(self, name: str, value: float, now_ns: int) -> None: ...

    def snapshot(self, now_ns: int) -> Mapping[str, float]:
        return {}

    def identifiers(self) -> None:
        return None

    def identifiers_revision(self) -> int:
        return 0


Heard = list[tuple[int, bytes, bool]]


def a_world(*rules: SerialFaultRule, tcp: bool = False) -> tuple[World, SerialFaultPlan]:
    world = World(EventQueue())
    plan = SerialFaultPlan(rules, lambda: 0.5)
    if tcp:
        world.add_tcp(BytePipe("line", 50_000, plan), plan)
    else:
        world.add_serial_line(SerialLine("line", 115_200, "N", 1, plan), plan)
    for unit in (1, 2):
        world.add_controller(f"unit{unit}", Registers(unit), "line")
    return world, plan


def listener(heard: Heard):
    return lambda data, now_ns, transmitted: heard.append((now_ns, data, transmitted))


def characters_ns(count: int) -> Fraction:
    return Fraction(count * 10 * 10**9, 115_200)


def test_cycle_takes_time_of_characters_and_silences():
    world, _ = a_world()
    heard: Heard = []
    host = world.add_line_host("line", "host", listener(heard))
    host.send(with_crc(bytes.fromhex("020300010002")))
    world.queue.run_until(1000 * MS)
    assert heard[0][1:] == (b"", True)
    assert abs(heard[0][0] - characters_ns(8)) < 1
    assert heard[1][1:] == (with_crc(bytes.fromhex("02030400C900CA")), False)
    expected_ns = characters_ns(8) + T35_NS + 2 * MS + characters_ns(9)
    assert abs(heard[1][0] - expected_ns) < 1000  # to the microsecond
    assert len(heard) == 2


def test_other_units_ignore_and_count_foreign_frames():
    world, _ = a_world()
    host = world.add_line_host("line", "host", lambda *_: None)
    host.send(with_crc(bytes.fromhex("020300010002")))
    world.queue.run_until(1000 * MS)
    other = world.controller("unit1")
    assert isinstance(other, Registers)
    assert other.rtu.server.diagnostics is not None
    assert other.rtu.server.diagnostics.bus_messages == 2  # request and response
    assert other.rtu.server.diagnostics.server_messages == 0


def test_pause_or_collision_is_bus_error_for_all():
    pause = SerialFaultRule("pause", SerialFaultKind.PAUSE, after=2, delay_ns=1 * MS)
    world, _ = a_world(pause)
    host = world.add_line_host("line", "host", lambda *_: None)
    host.send(with_crc(bytes.fromhex("020300010002")))
    world.queue.run_until(1000 * MS)
    for name in ("unit1", "unit2"):
        unit = world.controller(name)
        assert isinstance(unit, Registers)
        assert unit.rtu.server.diagnostics is not None
        assert unit.rtu.server.diagnostics.bus_errors == 1


def test_taps_hear_every_adu_with_times_and_sender():
    world, _ = a_world()
    told: list[tuple[str, int, int, int, str, bytes, bool]] = []
    world.tap_lines(lambda *facts: told.append(facts))
    host = world.add_line_host("line", "host", lambda *_: None)
    host.send(with_crc(bytes.fromhex("020300010001")))
    world.queue.run_until(1000 * MS)
    assert [(line, sender, spoiled) for line, _, _, _, sender, _, spoiled in told] == [
        ("line", "host", False),
        ("line", "unit2", False),
    ]
    _, now_ns, start_ns, end_ns, _, _, _ = told[0]
    assert start_ns == 0
    assert abs(end_ns - characters_ns(8)) < 1
    assert now_ns == end_ns + T35_NS


def test_faults_are_reported_by_name():
    lose = SerialFaultRule("lose", SerialFaultKind.LOSE, sender="unit1")
    world, plan = a_world(lose)
    events: list[tuple[int, str, str, str]] = []
    world.tap_events(lambda *event: events.append(event))
    heard: Heard = []
    host = world.add_line_host("line", "host", listener(heard))
    host.send(with_crc(bytes.fromhex("010300010001")))
    world.queue.run_until(1000 * MS)
    lost = with_crc(bytes.fromhex("0103020065"))
    assert plan.fired() == {"lose": 1}
    assert [(level, name, text) for _, level, name, text in events] == [
        ("warning", "line", "lose: lose " + lost.hex(" ").upper())
    ]
    assert [transmitted for _, _, transmitted in heard] == [True]


def test_units_behind_gateway_answer_pipelined_requests():
    world, _ = a_world(tcp=True)
    heard: Heard = []
    host = world.add_line_host("line", "host", listener(heard))
    asked = [(7, 1, "03 0001 0001"), (3, 2, "03 0002 0001"), (9, 1, "03 0000 0001")]
    host.send(b"".join(adu(n, unit, bytes.fromhex(pdu)) for n, unit, pdu in asked))
    world.queue.run_until(1000 * MS)
    answers = {(7, 1): "03 02 0065", (3, 2): "03 02 00CA", (9, 1): "03 02 0064"}
    expected = {adu(*key, bytes.fromhex(pdu)) for key, pdu in answers.items()}
    assert {data for _, data, _ in heard} == expected
    assert [now_ns for now_ns, _, _ in heard] == [2_100_000, 2_100_000, 4_100_000]


def test_gateway_reports_missing_unit_at_once():
    world, _ = a_world(tcp=True)
    heard: Heard = []
    host = world.add_line_host("line", "host", listener(heard))
    host.send(adu(1, 5, bytes.fromhex("03 0000 0001")))
    world.queue.run_until(1000 * MS)
    assert heard == [(100_000, adu(1, 5, b"\x83\x0b"), False)]


def test_requests_beyond_queue_limit_are_refused():
    world, _ = a_world(tcp=True)
    heard: Heard = []
    host = world.add_line_host("line", "host", listener(heard))
    host.send(b"".join(adu(n, 1, bytes.fromhex("03 0000 0001")) for n in range(68)))
    world.queue.run_until(1000 * MS)
    refused = {data[1] for _, data, _ in heard if data[7:] == b"\x83\x0a"}
    answered = {data[1] for _, data, _ in heard if data[7:] == b"\x03\x02\x00\x64"}
    assert (answered, refused) == ({*range(64)}, {64, 65, 66, 67})


def test_lost_and_spoiled_answers_on_tcp_are_recorded_as_heard():
    lose = SerialFaultRule("lose", SerialFaultKind.LOSE, sender="unit1", limit=1)
    flip = SerialFaultRule(
        "flip", SerialFaultKind.CORRUPT, sender="unit1", flip=b"\0" * 9 + b"\x01", limit=1
    )
    world, _ = a_world(lose, flip, tcp=True)
    told: list[bytes] = []
    world.tap_lines(lambda *facts: told.append(facts[5]) if facts[4] == "unit1" else None)
    heard: Heard = []
    host = world.add_line_host("line", "host", listener(heard))
    for number in (1, 2, 3):
        host.send(adu(number, 1, bytes.fromhex("03 0001 0001")))
        world.queue.run_until(number * 100 * MS)
    expected = [adu(2, 1, bytes.fromhex("03 02 0165")), adu(3, 1, bytes.fromhex("03 02 0065"))]
    assert [data for _, data, _ in heard] == expected
    assert told == expected


def test_two_connections_get_their_own_responses():
    world, _ = a_world(tcp=True)
    first: Heard = []
    second: Heard = []
    one = world.add_line_host("line", "host", listener(first))
    two = world.add_line_host("line", "host", listener(second))
    assert (one.name, two.name) == ("host", "host-2")
    one.send(adu(1, 1, bytes.fromhex("03 0000 0001")))
    two.send(adu(1, 1, bytes.fromhex("03 0001 0001")))
    world.queue.run_until(1000 * MS)
    assert [data for _, data, _ in first] == [adu(1, 1, bytes.fromhex("03020064"))]
    assert [data for _, data, _ in second] == [adu(1, 1, bytes.fromhex("03020065"))]


@pytest.mark.parametrize("pieces", [1, 2, 12])
def test_request_before_a_close_arrives_as_in_tcp(pieces):
    """RFC 9293, 3.6: all data before a CLOSE are delivered; nobody is there for the answer."""
    world, _ = a_world(tcp=True)
    heard: Heard = []
    host = world.add_line_host("line", "host", listener(heard))
    request = adu(7, 1, bytes.fromhex("06 0003 04D2"))
    size = len(request) // pieces
    for number in range(pieces):
        world.queue.run_until(number * 1_000)
        host.send(request[number * size : (number + 1) * size])
    host.close()
    host.send(request[:4])
    other = world.add_line_host("line", "other", listener(heard))
    world.queue.run_until(100 * MS)
    assert heard == []
    assert [one.name for one in world.line("line").endpoints] == ["unit1", "unit2", "other"]
    other.send(adu(8, 1, bytes.fromhex("03 0003 0001")))
    world.queue.run_until(1_000 * MS)
    assert [data for _, data, _ in heard] == [adu(8, 1, bytes.fromhex("03 02 04D2"))]


def test_foreign_bytes_before_a_close_end_the_connection_once():
    world, _ = a_world(tcp=True)
    notes = []
    world.tap_events(lambda *note: notes.append(note))
    host = world.add_line_host("line", "host", listener([]))
    host.send(b"GET / HTTP/1.1\r\n\r\n")
    host.close()
    world.queue.run_until(100 * MS)
    assert notes == []
    assert [one.name for one in world.line("line").endpoints] == ["unit1", "unit2"]


def objects() -> int:
    """Return the number of objects, without garbage."""
    gc.collect()
    return len(gc.get_objects())


def test_connections_may_come_and_go_without_end():
    world, _ = a_world(tcp=True)
    heard: Heard = []
    before = 0
    for number in range(300):
        host = world.add_line_host("line", "host", listener(heard))
        assert host.name == "host"
        host.send(adu(number, 1, bytes.fromhex("03 0001 0001")))
        host.close()
        host.close()
        host.send(b"too late")
        world.queue.run_until(number * MS)
        before = before or objects()
    last = world.add_line_host("line", "host", listener(heard))
    last.send(adu(7, 1, bytes.fromhex("03 0001 0001")))
    world.queue.run_until(1_000 * MS)
    assert [data for _, data, _ in heard] == [adu(7, 1, bytes.fromhex("03 02 0065"))]
    assert objects() < before + 100


def test_ports_of_serial_line_are_used_again_once_silent():
    world, _ = a_world()
    heard: Heard = []
    senders: list[str] = []
    world.tap_lines(lambda _, now, start, end, sender, data, spoiled: senders.append(sender))
    request = with_crc(bytes.fromhex("020300010001"))
    before = 0
    for number in range(1, 300):
        host = world.add_line_host("line", "host", listener(heard))
        assert host.name == "host"
        host.send(request)
        host.close()
        host.send(request)
        other = world.add_line_host("line", "other", listener([]))
        assert other.port != host.port
        other.close()
        world.queue.run_until(number * 20 * MS)
        before = before or objects()
    assert senders == ["host", "unit2"] * 299
    assert heard == []
    assert objects() < before + 100


def test_foreign_protocol_is_disconnected_with_reason():
    world, _ = a_world(tcp=True)
    events: list[tuple[int, str, str, str]] = []
    world.tap_events(lambda *event: events.append(event))
    heard: Heard = []
    host = world.add_line_host("line", "host", listener(heard))
    host.send(b"GET / HTTP/1.1\r\n\r\n")
    world.queue.run_until(1000 * MS)
    assert heard == [(50_000, b"", False)]
    assert "host is disconnected: no Modbus: protocol 21536" in events[0][3]


@pytest.mark.parametrize(
    ("conditions", "answered"),
    [
        ({"function": 6}, [2]),
        ({"unit": 2}, [1]),
        ({"unit": 1, "function": 6, "sender": "unit1"}, [2]),
        ({"sender": "unit2"}, [1]),
        ({"function": 3, "sender": "host-2"}, [1]),
        ({"sender": "line"}, [1, 2]),
    ],
)
def test_tcp_faults_match_units_functions_and_senders(conditions, answered):
    late = SerialFaultRule("late", SerialFaultKind.DELAY, delay_ns=900 * MS, **conditions)
    world, _ = a_world(late, tcp=True)
    first: Heard = []
    second: Heard = []
    # transaction identifiers that look like units and functions
    world.add_line_host("line", "host", listener(first)).send(
        adu(0x0203, 1, bytes.fromhex("06 0000 0001"))
    )
    world.add_line_host("line", "host", listener(second)).send(
        adu(0x0106, 2, bytes.fromhex("03 0000 0001"))
    )
    world.queue.run_until(500 * MS)
    assert [number for number, heard in ((1, first), (2, second)) if heard] == answered


@pytest.mark.parametrize("after", range(1, 12))
def test_request_may_be_split_anywhere(after):
    split = SerialFaultRule("split", SerialFaultKind.PAUSE, after=after, delay_ns=5 * MS)
    world, plan = a_world(split, tcp=True)
    heard: Heard = []
    host = world.add_line_host("line", "host", listener(heard))
    host.send(adu(1, 1, bytes.fromhex("03 0000 0001")))
    world.queue.run_until(1000 * MS)
    assert b"".join(data for _, data, _ in heard) == adu(1, 1, bytes.fromhex("03020064"))
    assert plan.fired() == {"split": 2}


def test_truncated_data_end_their_direction():
    rule = SerialFaultRule("broken", SerialFaultKind.TRUNCATE, sender="host", limit=1, after=3)
    world, _ = a_world(rule, tcp=True)
    heard: Heard = []
    host = world.add_line_host("line", "host", listener(heard))
    for _ in range(2):
        host.send(adu(1, 1, bytes.fromhex("03 0000 0001")))
    world.queue.run_until(1000 * MS)
    assert heard == []
    again = world.add_line_host("line", "host", listener(heard))
    again.send(adu(2, 1, bytes.fromhex("03 0000 0001")))
    world.queue.run_until(2000 * MS)
    assert [data for _, data, _ in heard] == [adu(2, 1, bytes.fromhex("03020064"))]


def test_controller_without_unit_is_refused_on_line():
    world, _ = a_world()

    class Nobody(Registers):
        def __init__(self) -> None:
            super().__init__(3)
            del self.unit

    with pytest.raises(ValueError, match="no unit"):
        world.add_controller("nobody", Nobody(), "line")
