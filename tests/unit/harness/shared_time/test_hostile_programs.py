"""Programs that do not keep to the protocol are told by name, and end nothing else."""

import select
import socket
import threading
from random import Random

import pytest

from motorhil.harness.shared_time import records
from motorhil.harness.shared_time import shared_clock as shared_clock_module
from motorhil.harness.shared_time.shared_clock import JoinError
from tests.support.programs.clock_sharers import begin, guest, new_world, shared_clock

CASES = 150
POLL = select.poll
RECEIVE = shared_clock_module.SharedClock.receive
KINDS = [*range(records.JOIN, records.LEAVE + 1), 0, 1, 33, 255]


def joined(path, name):
    connection = socket.socket(socket.AF_UNIX, socket.SOCK_SEQPACKET)
    connection.connect(str(path))
    connection.send(records.numbered(records.JOIN, records.VERSION, name))
    assert connection.recv(records.RECORD_MAX)[0] == records.WELCOME
    return connection


def first_turn(connection):
    connection.send(records.numbered(records.PARTY, 0, "main"))
    connection.send(records.WAITING.pack(records.WAIT, 1, 0, 0, records.NO_DEADLINE))
    connection.send(records.COUNTED.pack(records.IDLE, 1))
    assert connection.recv(records.RECORD_MAX)[0] == records.GRANT


def run_with(path, body):
    """Run `body` beside a well-behaved program; return what was told."""
    world, runtime, frames = new_world()
    told, log = [], []
    clock = shared_clock(world, runtime, path, told, {"good": 60.0, "bad": 0.2})
    good = [("wait", 1e-3, 0), ("send", 0.0, 1), ("wait", 1e-3, 0), ("send", 0.0, 2)]
    threads = [
        threading.Thread(
            target=guest, args=(path, "good", lambda r, w: begin(r, w, "good", good, log))
        ),
        threading.Thread(target=body, args=(path,)),
    ]
    try:
        for thread in threads:
            thread.start()
        clock.await_programs(["good", "bad"], lambda name: True)
        runtime.wait_for_parties(clock.are_gone)
        for thread in threads:
            thread.join()
    finally:
        clock.close()
        runtime.close()
    assert [kind for *_, kind in log] == ["wait", "send", "wait", "send"]
    assert len(frames) >= 2
    return clock.left, told


def test_random_records_end_their_program_alone(tmp_path):
    reasons = set()
    for seed in range(CASES):
        random = Random(seed)

        def bad(path, random=random):
            with joined(path, "bad") as connection:
                if random.random() < 0.8:
                    first_turn(connection)
                try:
                    for _ in range(random.randint(1, 6)):
                        kind = random.choice(KINDS)
                        connection.send(bytes([kind]) + random.randbytes(random.randint(0, 24)))
                except OSError:
                    pass

        left, told = run_with(tmp_path / f"{seed}", bad)
        assert left["good"] == ""
        assert len(told) <= 1
        reasons.add(left["bad"].partition("record")[0] + left["bad"].rpartition(" ")[2])
    assert len(reasons) > 3, reasons


def test_silent_program_is_told_and_its_connection_closed(tmp_path):
    def bad(path):
        with joined(path, "bad") as connection:
            first_turn(connection)
            assert connection.recv(1) == b""

    left, told = run_with(tmp_path / "clock", bad)
    assert left["bad"] == "its connection has ended"
    assert [(name, level) for name, level, _ in told] == [("bad", "error"), ("bad", "warning")]
    assert "has kept the turn for 0.2 s" in told[0][2]
    assert told[0][2].endswith("; waiting: good until 0.001 s")


def test_ctrl_c_tells_who_has_the_turn_and_who_waits(tmp_path):
    world, runtime, _ = new_world()
    told = []
    clock = shared_clock(world, runtime, tmp_path / "clock", told, {"busy": 60.0, "calm": 60.0})
    is_told = threading.Event()

    def calm():
        with joined(tmp_path / "clock", "calm") as connection:
            first_turn(connection)
            connection.send(records.WAITING.pack(records.WAIT, 2, 0, 0, 5 * 10**9))
            connection.send(records.COUNTED.pack(records.IDLE, 0))
            is_told.wait(60.0)

    def busy():
        with joined(tmp_path / "clock", "busy") as connection:
            first_turn(connection)
            assert runtime.interrupt()
            while not told:  # it computes
                pass
        is_told.set()

    threads = [threading.Thread(target=one) for one in (calm, busy)]
    for thread in threads:
        thread.start()
    clock.await_programs(["calm", "busy"], lambda name: True)
    with pytest.raises(KeyboardInterrupt):
        runtime.wait_for_parties(clock.are_gone)
    for thread in threads:
        thread.join()
    clock.close()
    runtime.close()
    name, level, text = told[0]
    assert (name, level) == ("busy", "warning")
    assert "Ctrl-C takes effect at its next wait" in text
    assert text.endswith("; waiting: calm until 5 s")


def test_program_that_only_sends_is_ended_before_its_frames_fill_the_memory(tmp_path, monkeypatch):
    monkeypatch.setattr("motorhil.harness.python_can.send_limit._WAITING_MAX", 1_000)

    def bad(path):
        with joined(path, "bad") as connection:
            first_turn(connection)
            connection.send(records.numbered(records.OPEN, 0, "can0"))
            opened = connection.recv(records.RECORD_MAX)
            head = records.NUMBERED.pack(records.SEND, records.NUMBERED.unpack_from(opened)[1])
            try:
                for _ in range(2_000):
                    connection.send(head + b"\x01" + bytes(15))
            except OSError:
                pass

    left, _ = run_with(tmp_path / "clock", bad)
    assert "can0: 1024 frames wait; expected at most 1000" in left["bad"]


def test_program_that_has_gone_costs_the_others_nothing(tmp_path, monkeypatch):
    """A connection that has ended is readable for ever: waits for others must not look at it."""
    asked, seen = [], []

    class Watched:
        def __init__(self):
            self.poll_of = POLL()
            self.register, self.unregister = self.poll_of.register, self.poll_of.unregister

        def poll(self, timeout_ms):
            ready = self.poll_of.poll(timeout_ms)
            seen.extend((fd, asked[-1]) for fd, _ in ready)
            return ready

    def receive(clock, participant, is_first):
        asked.append(participant.connection.fileno())
        return RECEIVE(clock, participant, is_first)

    def bad(path):
        joined(path, "bad").close()

    monkeypatch.setattr(shared_clock_module.select, "poll", Watched)
    monkeypatch.setattr(shared_clock_module._Turn, "is_late", lambda turn, stall_s: True)
    monkeypatch.setattr(shared_clock_module.SharedClock, "receive", receive)
    left, _ = run_with(tmp_path / "clock", bad)
    assert left["bad"] == "its connection has ended"
    assert len(seen) > 10
    assert [fd for fd, wanted in seen if fd != wanted] == []


@pytest.mark.parametrize(
    "wrong",
    [
        records.PERIOD.pack(records.EVERY, 1, 10**9),
        records.WAITING.pack(records.WAIT, 2, 0, 0, records.NO_DEADLINE),
        records.WAITING.pack(records.WAIT, 3, 0, 0, 2**62),
        records.numbered(records.PARTY, 1024, "many"),
    ],
    ids=["period", "wait", "deadline", "party"],
)
def test_number_in_use_or_out_of_range_ends_its_program(tmp_path, wrong):
    def bad(path):
        with joined(path, "bad") as connection:
            first_turn(connection)
            connection.send(records.PERIOD.pack(records.EVERY, 1, 10**9))
            connection.send(records.WAITING.pack(records.WAIT, 2, 0, 0, records.NO_DEADLINE))
            connection.send(wrong)
            assert connection.recv(1) == b""

    left, told = run_with(tmp_path / "clock", bad)
    assert left["bad"].startswith(f"its record {wrong.hex()} is wrong")
    assert [name for name, *_ in told] == ["bad"]


def test_program_that_ends_while_it_joins_is_named(tmp_path):
    world, runtime, _ = new_world()
    clock = shared_clock(world, runtime, tmp_path / "clock", [], {"bad": 1.0})
    with socket.socket(socket.AF_UNIX, socket.SOCK_SEQPACKET) as connection:
        connection.connect(str(tmp_path / "clock"))
        connection.send(records.numbered(records.JOIN, records.VERSION, "bad"))
    looks = iter((True, True))
    with pytest.raises(JoinError, match="program bad: ended before it joined"):
        clock.await_programs(["bad"], lambda name: next(looks, False))
    clock.close()
    runtime.close()


@pytest.mark.parametrize(
    ("record", "reason"),
    [
        (b"hello", "expected JOIN"),
        (records.numbered(records.JOIN, 9, "bad"), "protocol 9: unknown; expected 2"),
        (records.numbered(records.JOIN, 2, "other"), "program 'other': not awaited"),
    ],
)
def test_refused_program_hears_why(tmp_path, record, reason):
    heard = []

    def refused(path):
        with socket.socket(socket.AF_UNIX, socket.SOCK_SEQPACKET) as connection:
            connection.connect(str(path))
            connection.send(record)
            heard.append(connection.recv(records.RECORD_MAX))

    world, runtime, _ = new_world()
    clock = shared_clock(world, runtime, tmp_path / "clock", [], {"bad": 1.0})
    thread = threading.Thread(target=refused, args=(tmp_path / "clock",))
    thread.start()
    looks = iter((True, True, True, False))
    with pytest.raises(JoinError, match="program bad: ended before it joined"):
        clock.await_programs(["bad"], lambda name: next(looks, False))
    thread.join()
    clock.close()
    runtime.close()
    assert heard[0][0] == records.REFUSED
    assert reason in heard[0].decode()
