"""Fencing of a process that lost its drive while paused.

The evidence is the bus: all frames that another program on the hub received after the takeover,
except those of the new owner and of the drive.
"""

import re
import signal
import struct
from collections import Counter
from contextlib import ExitStack
from pathlib import Path

import can
import pytest

from motorhil.emulators.cia402.drive import build
from motorhil.emulators.controller import ControllerContext
from motorhil.motorapi import ControlMode, MotorBusyError, WallRuntime
from motorhil.motorapi.adaptations.cia402.hardware import Cia402HwMotor
from motorhil.motorapi.adaptations.cia402.motor import Cia402Motor
from motorhil.motorapi.locking.directory import VARIABLE
from motorhil.motorapi.locking.lock_status import read_process
from tests.support.line_programs import LONG_S, Program
from tests.support.motors.streaming import quintic, set_function
from tests.support.programs.fenced_owner import MODEL, OPTIONS, open_bus
from tests.support.served_hub import Listener
from tests.system.wall.hub.test_hub import serving

pytestmark = pytest.mark.wall

SYNC, NMT, REQUEST = 0x080, 0x000, 0x601
SET_POINTS = 0x301
MARK = 0x7FF  # no node's identifier, and lowest priority
RPDOS = tuple(base + node for base in (0x200, 0x300, 0x400, 0x500) for node in (1, 2))


def is_commanding(can_id, data):
    """Return whether a frame may start or change a motion, or a setting: no upload, no abort."""
    if can_id == REQUEST:
        return data[0] >> 5 not in (2, 3, 4, 5)
    return can_id in RPDOS or can_id in (SYNC, NMT, MARK)


class Sent:
    """The commanding frames that the runtime has sent, once they were on the bus."""

    def __init__(self, bus, runtime):
        self.frames = []
        self._bus, self._runtime = bus, runtime
        self._marks = 0
        runtime.listen(bus, self._on_frame)

    def _on_frame(self, frame, time_ns, transmitted):
        can_id, data = int.from_bytes(frame[:4], "little"), frame[8 : 8 + frame[4]]
        if transmitted and is_commanding(can_id, data):
            self.frames.append((can_id, data))

    def mark(self, listener):
        """Wait until all frames sent so far are on the bus; return the two numbers of them.

        With several senders, the hub reads one after another: all frames read after the first mark
        are on the bus before the second.
        """
        for _ in range(2):
            self._marks += 1
            mark = (MARK, self._marks.to_bytes(2, "big"))
            self._runtime.send(self._bus, struct.pack("<IB3x8s", MARK, 2, mark[1]))
            both = (listener.frames, self.frames)
            known = self._runtime.wait_until(
                lambda mark=mark, both=both: all(mark in frames for frames in both), LONG_S
            )
            assert known
        return tuple(frames.index(mark) + 1 for frames in both)


def not_of_the_heir(listener, sent, since):
    """Return the frames on the bus since a mark, except the heir's; makes a new mark."""
    heard_to, sent_to = sent.mark(listener)
    heard_from, sent_from = since
    heard = Counter(listener.frames[heard_from:heard_to])
    return heard - Counter(sent.frames[sent_from:sent_to])


class Heir:
    """Another owner of the same drive, which records its own frames."""

    def __init__(self, path, runtime):
        self.bus = open_bus(path)
        self.hardware = Cia402HwMotor(self.bus, 1, runtime=runtime, options=OPTIONS)
        self.motor = Cia402Motor(self.hardware, MODEL, name="heir")
        self.sent = Sent(self.bus, runtime)

    def move(self):
        self.motor.set_control_mode(ControlMode.SETPOINT)
        self.motor.set_setpoint(0.2, relative=True)
        self.motor.start()
        self.motor.wait_until_done(LONG_S)

    def stream(self, distance, duration_s):
        set_function(self.motor, quintic(distance, duration_s))
        self.motor.start()

    def close(self):
        self.hardware.close()
        self.bus.shutdown()


class Stage:
    """A hub with one drive; an owner in a separate process, an heir here, and a listener."""

    def __init__(self, path, runtime, world):
        self.path = path
        self.runtime = runtime
        self.events = []
        self.notices = []
        world.tap_events(lambda time_ns, level, name, text: self.events.append(text))
        world.tap_ownership(lambda bus, time_ns, sender, notice: self.notices.append(notice))
        self.heir = Heir(path, runtime)
        self.heir.hardware.connect()
        self.listener = Listener(open_bus(path), is_commanding)
        self.owner = None
        self.reserved = ExitStack()  # by the heir

    def begin(self, how, word="stream 0"):
        self.owner = Program("fenced_owner", self.path, how)
        assert self.owner.hear() == "ready"
        assert self.owner.ask(word) == "streaming"

    def wait_for(self, done):
        assert self.runtime.wait_until(done, LONG_S)

    def set_points(self):
        return sum(1 for can_id, _ in self.listener.frames if can_id == SET_POINTS)

    def pause(self):
        self.owner.signal(signal.SIGSTOP)
        self.wait_for(lambda: read_process(self.owner.pid)[0] in "Tt")

    def settle(self):
        """Wait until all frames sent so far are on the bus; return a mark for `others`."""
        return self.heir.sent.mark(self.listener)

    def take_over(self, **how):
        """Let the heir reserve the drive while the owner is paused, but not within a write."""
        while True:
            self.pause()
            self.settle()  # frames handed over earlier are carried by the hub, not refused
            try:
                self.reserved.enter_context(self.heir.motor.reserve("rescue", **how))
            except MotorBusyError as error:
                if "in the middle of a write" not in str(error):
                    raise
                self.owner.signal(signal.SIGCONT)
            else:
                return

    def others(self, since):
        """Return the commanding frames on the bus since then, except the heir's."""
        return not_of_the_heir(self.listener, self.heir.sent, since)

    def heard(self, since):
        """Return the frames of `others`, as far as they were received by now."""
        heard, sent = since
        return Counter(self.listener.frames[heard:]) - Counter(self.heir.sent.frames[sent:])

    def close(self):
        self.reserved.close()
        if self.owner is not None:
            self.owner.end()
        self.listener.close()
        self.heir.close()


@pytest.fixture
def stage(tmp_path, monkeypatch):
    locks = tmp_path / "locks"
    locks.mkdir(mode=0o700)
    monkeypatch.setenv(VARIABLE, str(locks))
    path = str(tmp_path / "hub")
    cores = [
        build({"node_id": node}, ControllerContext(name=f"drive{node}", folder=Path(), seed=node))
        for node in (1, 2)
    ]
    runtime = WallRuntime()
    with serving(path, *cores) as world:
        stage = Stage(path, runtime, world)
        try:
            yield stage
        finally:
            stage.close()
            runtime.close()


def lose(stage, how, word="stream 0", *, streams=False, **taking):
    """Take the drive over and move it; return the mark of the takeover for `others`."""
    stage.begin(how, word)
    stage.wait_for(lambda: stage.set_points() > 20 or word == "run")
    stage.take_over(**taking)
    since = stage.settle()
    if streams:
        stage.heir.stream(0.5, 2.0)
    else:
        stage.heir.move()
    stage.owner.signal(signal.SIGCONT)
    return since


def test_resumed_stream_sends_no_frame_on_the_bus(stage):
    since = lose(stage, "fenced", take_over=True)
    ended = r"owner: the motion was ended by pid \d+ \(.*, which took it over \(on demand\)"
    lost = r"hub node 1 was taken over \(on demand\) by pid \d+ .* for rescue"
    assert re.match(f"{ended}.*; the stream: .*{lost}", stage.owner.ask("told"))
    assert re.match(f"interrupted {ended}", stage.owner.ask("wait"))
    stage.heir.move()
    assert stage.others(since) == Counter()
    assert not any("refused" in event for event in stage.events)  # it did not even get so far
    assert stage.owner.ask("again").startswith("busy owner was taken over (on demand) by pid ")
    assert stage.owner.ask("write").startswith("busy ")
    assert stage.owner.ask("renew").startswith("busy ")
    assert stage.others(since) == Counter()
    assert stage.owner.ask("end") == "ended"
    write = stage.owner.ask("write")  # by the hardware object alone, which owns it for the frame
    assert " is held by pid " in write
    assert "for rescue" in write
    stage.reserved.close()
    stage.wait_for(lambda: not stage.heir.hardware.physical.ownership.is_here)
    assert stage.owner.ask("write") == "wrote"
    assert stage.owner.ask("again") == "started"  # it has taken the motor anew
    assert stage.owner.ask("wait") == "done"


def test_next_owner_streams_undisturbed_with_its_own_sync(stage):
    since = lose(stage, "fenced", take_over=True, streams=True)
    assert stage.owner.ask("wait").startswith("interrupted ")
    stage.heir.motor.wait_until_done(LONG_S)
    assert stage.heir.hardware.stream.error is None
    assert stage.others(since) == Counter()
    assert Counter(stage.heir.sent.frames)[SYNC, b""] >= 200


def test_expired_lease_fences_like_a_takeover(stage):
    since = lose(stage, "fenced", "stream 0.3", timeout_s=LONG_S)
    assert stage.owner.ask("wait").startswith("interrupted ")
    assert stage.others(since) == Counter()


def test_orphaned_motion_is_stopped_and_then_left_alone(stage):
    since = lose(stage, "fenced", "run", take_over=True)
    assert stage.owner.ask("write").startswith("busy ")
    assert stage.owner.ask("wait").startswith("interrupted ")
    assert stage.others(since) == Counter()


def test_failing_resumed_stream_does_not_halt_next_owner(stage):
    stage.begin("fenced")
    assert stage.owner.ask("spoil") == "spoilt"
    stage.take_over(take_over=True)
    since = stage.settle()
    stage.owner.signal(signal.SIGCONT)
    assert stage.owner.ask("wait").startswith("interrupted ")
    for _ in range(3):
        stage.heir.move()
    assert stage.others(since) == Counter()


def test_repeated_stop_does_not_stop_the_next_owner(stage):
    stage.begin("fenced", "run")
    assert stage.owner.ask("wait") == "done"  # its velocity is reached
    assert stage.owner.ask("stop") == "stopped"  # and repeated until standstill
    stage.take_over(take_over=True)
    since = stage.settle()
    stage.owner.signal(signal.SIGCONT)
    for _ in range(5):
        stage.heir.move()
    assert stage.others(since) == Counter()
    assert stage.owner.ask("write").startswith("busy ")


def test_sync_after_takeover_starts_no_armed_target(stage):
    stage.owner = Program("fenced_owner", stage.path, "fenced")
    assert stage.owner.hear() == "ready"
    stage.owner.say("group")
    assert stage.owner.hear() == "armed"
    stage.take_over(take_over=True)
    begin = stage.heir.motor.position()
    with open_bus(stage.path) as stranger:
        stranger.send(can.Message(arbitration_id=SYNC, is_extended_id=False))
        stage.settle()
    moved = stage.runtime.wait_until(lambda: abs(stage.heir.motor.position() - begin) > 0.01, 0.5)
    assert not moved
    since = stage.settle()
    stage.owner.signal(signal.SIGCONT)
    assert stage.owner.hear().startswith("busy ")
    sent = stage.others(since)
    assert not [can_id for can_id, _ in sent if can_id & 0x7F == 1]  # nothing to node 1
    assert stage.heir.motor.position() == pytest.approx(begin, abs=1e-3)


def test_hub_refuses_frames_of_a_careless_program(stage):
    since = lose(stage, "careless", take_over=True)
    stage.wait_for(lambda: any("are refused: token" in event for event in stage.events))
    sent = stage.others(since)
    assert not [can_id for can_id, _ in sent if can_id in RPDOS or can_id == REQUEST]


def test_unfenced_set_points_do_reach_the_bus(stage):
    since = lose(stage, "unfenced", take_over=True)
    # No wait for the motor there: a waiting program might be notified first, and end the stream.
    stage.wait_for(lambda: any(SET_POINTS in frame for frame in stage.heard(since)))


def test_hub_is_notified_of_the_owner(stage):
    lose(stage, "fenced", take_over=True)
    stage.owner.ask("wait")
    stage.settle()
    told = [(notice.action, notice.purpose) for notice in stage.notices]
    assert (1, "survey") in told
    assert (6, "rescue") in told
    assert 7 in [action for action, _ in told]  # the owner has noticed
    tokens = [notice.token for notice in stage.notices if notice.action in (1, 5, 6)]
    assert tokens == sorted(set(tokens))
