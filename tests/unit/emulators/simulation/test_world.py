import struct

import pytest

from motorhil.emulators.can.bus.bus import CanBus
from motorhil.emulators.can.bus.fault_plan import FaultPlan
from motorhil.emulators.can.fault_rules import FaultKind, FaultRule
from motorhil.emulators.controller import StuckControllerError
from motorhil.emulators.simulation.event_queue import EventQueue
from motorhil.emulators.simulation.world import World

MS = 1_000_000


def frame(can_id, data=b""):
    return struct.pack("<IB3x8s", can_id, len(data), data)


class Echo:
    """A simple controller: it answers each 100h frame with its own, a fixed delay later."""

    def __init__(self, answer_id, delay_ns=MS):
        self.answer_id = answer_id
        self.delay_ns = delay_ns
        self.listens_to = [0x100]
        self.revision = 0
        self.due = []
        self.out = []
        self.heard = []
        self.sent_at = []
        self.level = 0.0
        self.snapshots = 0

    def start(self, now_ns):
        self.started_ns = now_ns

    def receive(self, data, now_ns):
        self.heard.append((now_ns, data))
        self.due.append((now_ns + self.delay_ns, data[8:9]))

    def sent(self, data, now_ns):
        self.sent_at.append((now_ns, data))

    def wants_sent(self):
        return True

    def next_deadline_ns(self):
        return self.due[0][0] if self.due else None

    def expire(self, now_ns):
        while self.due and self.due[0][0] <= now_ns:
            self.out.append(frame(self.answer_id, self.due.pop(0)[1]))

    def take_output(self):
        out, self.out = self.out, []
        return out

    def take_events(self):
        return ()

    def stimulate(self, name, value, now_ns):
        self.level = value
        self.listens_to = [0x200]
        self.revision += 1

    def snapshot(self, now_ns):
        self.snapshots += 1
        return {"level": self.level, "answers": float(len(self.sent_at))}

    def identifiers(self):
        return self.listens_to

    def identifiers_revision(self):
        return self.revision


def world_with(*controllers):
    queue = EventQueue()
    world = World(queue)
    world.add_bus(CanBus("can0", 1_000_000))
    for number, controller in enumerate(controllers):
        world.add_controller(f"c{number}", controller, "can0")
    return queue, world


def test_frame_is_delivered_complete_and_answered_after_delay():
    echo = Echo(0x180)
    queue, world = world_with(echo)
    heard = []
    host = world.add_host("can0", "host", lambda *what: heard.append(what))
    host.send(frame(0x100, b"\x05"))
    queue.run_until(10 * MS)
    # The media tests check lengths against an independent construction (can-physics.md). Here the
    # request's confirmation, the receiver's time and the response must agree.
    (request, t1, own), (answer, t2, foreign) = heard
    assert (request, own) == (frame(0x100, b"\x05"), True)
    assert echo.heard == [(t1, request)]
    assert (answer, foreign) == (frame(0x180, b"\x05"), False)
    assert echo.sent_at == [(t2, answer)]
    assert 0 < t2 - t1 - MS < 65_000  # one frame of 1 data byte: at most 65 bits of 1 us


def test_controller_hears_only_its_current_identifiers():
    echo = Echo(0x180)
    queue, world = world_with(echo)
    host = world.add_host("can0", "host", lambda *what: None)
    for can_id in (0x101, 0x200):
        host.send(frame(can_id))
    queue.run_until(MS)
    assert echo.heard == []
    world.stimulate("c0", "level", 1.0)
    for can_id in (0x100, 0x200):
        host.send(frame(can_id))
    queue.run_until(2 * MS)
    assert [data for _, data in echo.heard] == [frame(0x200)]


def test_simultaneous_answers_are_sent_by_identifier():
    queue, world = world_with(Echo(0x190), Echo(0x180))
    heard = []
    host = world.add_host("can0", "host", lambda data, t, own: own or heard.append(data[0]))
    host.send(frame(0x100, b"\x01"))
    queue.run_until(10 * MS)
    assert heard == [0x80, 0x90]


def test_tap_hears_every_frame_with_sender():
    queue, world = world_with(Echo(0x180))
    taken = []
    world.tap_frames(lambda bus, t, sender, data: taken.append((bus, sender, data)))
    world.add_host("can0", "host", lambda *what: None).send(frame(0x100, b"\x07"))
    world.add_host("can0", "host", lambda *what: None).send(frame(0x101))
    queue.run_until(10 * MS)
    assert taken == [
        ("can0", "host", frame(0x100, b"\x07")),
        ("can0", "host-2", frame(0x101)),
        ("can0", "c0", frame(0x180, b"\x07")),
    ]


@pytest.mark.parametrize(
    ("kind", "heard_ns"),
    [(FaultKind.DROP, []), (FaultKind.DELAY, [5]), (FaultKind.DUPLICATE, [0, 0])],
)
def test_tap_hears_faulty_frames_as_listener_does(kind, heard_ns):
    queue = EventQueue()
    world = World(queue)
    rule = FaultRule(name="rule", kind=kind, delay_ns=5 * MS if kind is FaultKind.DELAY else 0)
    world.add_bus(CanBus("can0", faults=FaultPlan([rule], lambda: 0.0)))
    taken, heard = [], []
    world.tap_frames(lambda bus, t, sender, data: taken.append((t, data)))
    world.add_host("can0", "listener", lambda data, t, own: heard.append((t, data)))
    world.add_host("can0", "host", lambda *what: None).send(frame(0x123))
    queue.run_until(100 * MS)
    assert taken == heard
    assert [t // MS for t, _ in taken] == heard_ns


def test_closed_host_hears_nothing():
    queue, world = world_with(Echo(0x180))
    heard = []
    first = world.add_host("can0", "first", lambda *what: heard.append(what))
    second = world.add_host("can0", "second", lambda *what: None)
    first.close()
    second.send(frame(0x100))
    queue.run_until(10 * MS)
    assert heard == []


def test_programs_may_come_and_go_without_end():
    queue, world = world_with(Echo(0x180))
    heard = []
    for number in range(5000):
        world.add_host("can0", f"program-{number}", lambda *what: None).close()
    last = world.add_host("can0", "last", lambda *what: heard.append(what))
    last.send(frame(0x100))
    queue.run_until(10 * MS)
    assert [one[0][:2] for one in heard] == [b"\x00\x01", b"\x80\x01"]
    assert world.bus("can0").port_names()[last.port] == last.name == "last"
    assert len(world.bus("can0").port_names()) <= 4


def test_port_waits_for_its_last_frame_before_its_next_user():
    queue, world = world_with(Echo(0x180))
    senders = []
    world.tap_frames(lambda bus, now_ns, sender, data: senders.append(sender))
    first = world.add_host("can0", "first", lambda *what: None)
    for _ in range(3):
        first.send(frame(0x200))
    first.close()
    second = world.add_host("can0", "second", lambda *what: None)
    assert second.port != first.port
    queue.run_until(10 * MS)
    assert senders == ["first"] * 3
    assert world.add_host("can0", "first", lambda *what: None).port == first.port


def test_rule_applies_to_the_name_and_not_to_the_port():
    queue = EventQueue()
    world = World(queue)
    rule = FaultRule("lose", FaultKind.DROP, sender="bad")
    world.add_bus(CanBus("can0", 1_000_000, FaultPlan([rule], lambda: 0.0)))
    heard = []
    world.add_host("can0", "witness", lambda *what: heard.append(what))
    for name, value in (("bad", 1), ("good", 2), ("bad", 3), ("good", 4)):
        host = world.add_host("can0", name, lambda *what: None)
        host.send(frame(0x100, bytes((value,))))
        queue.run_until(queue.now_ns + MS)
        host.close()
    assert [one[0][8] for one in heard] == [2, 4]


def test_samples_are_taken_only_while_truth_changes():
    echo = Echo(0x180)
    queue, world = world_with(echo)
    samples = []
    world.tap_samples(20 * MS, lambda t, name, truth: samples.append((t, truth["answers"])))
    queue.run_until(1000 * MS)
    assert samples == [(0, 0.0)]
    assert echo.snapshots == 2  # one report, and one check without a change
    assert queue.next_time_ns() is None
    host = world.add_host("can0", "host", lambda *what: None)
    host.send(frame(0x100))
    queue.run_until(2000 * MS)
    assert samples == [(0, 0.0), (1020 * MS, 1.0)]
    assert queue.next_time_ns() is None


class Stuck(Echo):
    """A controller that asks to be called in the past, whatever it is told."""

    def next_deadline_ns(self):
        return 5


def test_deadline_that_does_not_move_on_is_refused_by_name():
    queue, _ = world_with(Stuck(0x101, 0))
    with pytest.raises(StuckControllerError, match=r"controller c0: .* at 0\.000000005 s .*defect"):
        queue.run_until(10)
