"""Two independent clients on one serial line, at times drawn by Hypothesis.

Whatever collides, nothing hangs, only sent values are written, and only once. The line works when
it is quiet again.
"""

from hypothesis import event, example, given
from hypothesis import strategies as st

from motorhil.emulators.media.serial_faults import SerialFaultKind, SerialFaultRule
from motorhil.emulators.modbus.rtu import with_crc
from tests.unit.emulators.simulation.test_lines import MS, Heard, Registers, a_world, listener

US = 1_000
QUIET_NS = 1000 * MS
# A frame takes 0.7 ms, t3.5 is 1.75 ms, the response comes 2 ms later: gaps of that size hit all.
GAPS_US = st.sampled_from([0, 1, 80, 690, 700, 1700, 2400, 2500, 4400, 5300]) | st.integers(0, 9000)
SAID = st.sampled_from(["write 1", "write 2", "write 0", "read 1", "read 2", "rubbish"])
SPEECHES = st.lists(st.tuples(GAPS_US, st.integers(0, 1), SAID), min_size=2, max_size=12)
K = SerialFaultKind
FAULTS = [  # changes of a rule that fires once
    {"kind": K.LOSE},
    {"kind": K.CORRUPT},
    {"kind": K.DELAY, "delay_ns": 3 * MS},
    {"kind": K.NOISE, "noise": b"\x00"},
    *({"kind": K.TRUNCATE, "after": after} for after in range(1, 8)),
    *({"kind": K.PAUSE, "after": after, "delay_ns": 3 * MS} for after in range(1, 8)),
]
RULES = st.none() | st.builds(
    lambda fault, sender: SerialFaultRule(name="drawn", sender=sender, limit=1, **fault),
    st.sampled_from(FAULTS),
    st.sampled_from(["host", "host-2", "unit1", "unit2"]),
)


class Line:
    """The world, two clients, and the values written to register 0 of each unit."""

    def __init__(self, *rules: SerialFaultRule) -> None:
        self.world, _ = a_world(*rules)
        self.heard: tuple[Heard, Heard] = ([], [])
        self.clients = [self.world.add_line_host("line", "host", listener(h)) for h in self.heard]
        self.written: dict[int, list[int]] = {1: [], 2: []}
        for unit, log in self.written.items():
            controller = self.world.controller(f"unit{unit}")
            assert isinstance(controller, Registers)
            assert controller.rtu.server.holding is not None
            controller.rtu.server.holding.on_write("r0", self._logger(log))
        self.sent: dict[int, list[int]] = {1: [], 2: []}

    def _logger(self, log: list[int]):
        def note(value: int) -> int:
            log.append(value)
            return 0

        return note

    def say(self, client: int, what: str, number: int) -> None:
        """Let the client send now, whatever else is sent."""
        verb, _, unit = what.partition(" ")
        if verb == "write":
            for one in [int(unit)] if int(unit) else [1, 2]:
                self.sent[one].append(number)
            data = with_crc(bytes((int(unit), 6, 0, 0)) + number.to_bytes(2, "big"))
        elif verb == "read":
            data = with_crc(bytes((int(unit), 3, 0, 1, 0, 1)))
        else:
            data = bytes((number & 0xFF,)) * (1 + number % 11)
        self.clients[client].send(data)

    def until_quiet(self) -> None:
        """Run until the line is quiet."""
        queue = self.world.queue
        end_ns = queue.now_ns + QUIET_NS
        while (due_ns := queue.next_time_ns()) is not None:
            assert due_ns <= end_ns, "it goes on and on"
            queue.run_next()

    def answered(self, client: int, unit: int) -> bool:
        """Let the client make a request on a quiet line."""
        self.until_quiet()
        self.world.queue.run_until(self.world.queue.now_ns + 10 * MS)
        self.heard[client].clear()
        self.say(client, f"read {unit}", 0)
        self.until_quiet()
        expected = with_crc(bytes((unit, 3, 2)) + (100 * unit + 1).to_bytes(2, "big"))
        return [data for _, data, sent in self.heard[client] if not sent] == [expected]


@given(SPEECHES, RULES)
@example([(0, 0, "write 1"), (0, 1, "write 1")], None)
@example([(0, 0, "read 1"), (4400, 1, "read 1")], None)  # into the response
@example([(0, 0, "write 0"), (1700, 1, "write 0")], None)  # within its t3.5
@example(  # server input without a check of the CRC
    [(0, 0, "write 1"), (9000, 1, "read 1")],
    SerialFaultRule("drawn", K.CORRUPT, sender="host", limit=1, flip=b"\0\0\0\0\0\x01"),
)
def test_line_works_after_collisions(speeches, rule):
    line = Line(*([] if rule is None else [rule]))
    line.world.queue.run_until(10 * MS)
    for number, (gap_us, client, what) in enumerate(speeches):
        line.world.queue.run_until(line.world.queue.now_ns + gap_us * US)
        line.say(client, what, 1000 + number)
    line.until_quiet()
    collisions = line.world.line("line").line.collisions
    event(f"collisions: {min(collisions, 3)}")
    event(f"written: {min(sum(map(len, line.written.values())), 3)}")
    for unit in (1, 2):
        assert len(set(line.written[unit])) == len(line.written[unit])
        assert set(line.written[unit]) <= set(line.sent[unit])
    for client in (0, 1):
        for unit in (1, 2):  # the drawn fault may still spoil one exchange
            assert line.answered(client, unit) or line.answered(client, unit)


def test_simultaneous_requests_collide_and_later_ones_work():
    line = Line()
    line.say(0, "write 1", 4711)
    line.say(1, "write 2", 4712)
    line.until_quiet()
    assert line.written == {1: [], 2: []}
    assert line.world.line("line").line.collisions == 1
    line.say(0, "write 1", 4711)
    line.until_quiet()
    line.say(1, "write 2", 4712)
    line.until_quiet()
    assert line.written == {1: [4711], 2: [4712]}


def test_request_during_response_spoils_both():
    line = Line()
    line.say(0, "write 1", 4711)
    line.world.queue.run_until(4_900 * US)  # the response began at 4.44 ms
    line.say(1, "write 2", 4712)
    line.until_quiet()
    assert line.written == {1: [4711], 2: []}
    assert line.world.line("line").line.collisions == 1
