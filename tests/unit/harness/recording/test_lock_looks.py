"""Ownership of motors on SocketCAN, polled from lock files."""

import os
import subprocess
import sys
from contextlib import contextmanager

import pytest

from motorhil.emulators.simulation.event_queue import EventQueue
from motorhil.emulators.simulation.world import World
from motorhil.harness.recording.ownership import PERIOD_NS, LockLooks, LockWriter
from motorhil.harness.rig.config.rig_file import read_rig
from motorhil.harness.rig.config.scaffold import EXAMPLES
from motorhil.harness.rig.reading import installed_plugins
from motorhil.motorapi.locking.directory import VARIABLE, socketcan_name
from motorhil.motorapi.locking.process_lock import ProcessLock
from motorhil.motorapi.runtime.wall import WallRuntime
from motorhil.traces.schema import LockAction
from motorhil.traces.semantics.ownership import Ended, LockEvent, ownership_of

NODE_2 = f"{socketcan_name('lo')}-node2"  # a network interface that every host has


class Recorder:
    """A recorder that keeps lock events."""

    def __init__(self):
        self.events = []

    def message(self, time_ns, topic, message, values):
        action = LockAction(values["action"])
        rest = {key: value for key, value in values.items() if key != "action"}
        self.events.append(LockEvent(topic.split("/")[2], time_ns, action, **rest))


@pytest.fixture
def bench(tmp_path, monkeypatch):
    """Return a poller for the locks of two wheels, in simulated wall time."""
    folder = tmp_path / "locks"
    folder.mkdir(mode=0o700)
    monkeypatch.setenv(VARIABLE, str(folder))
    return Bench(folder)


class Bench:
    def __init__(self, folder, rig="two_wheels"):
        self.folder = folder
        self.queue = EventQueue()
        self.world = World(self.queue)
        self.told = []
        self.world.tap_events(lambda *event: self.told.append(event))
        self.recorder = Recorder()
        description = read_rig(EXAMPLES / f"{rig}.toml", installed_plugins())
        writer = LockWriter(self.recorder, self.world)
        self.looks = LockLooks(writer, self.world, description, {"can0": "lo"})
        self.look()

    def look(self):
        """Run the next poll; return the events that it recorded."""
        before = len(self.recorder.events)
        self.queue.run_until(self.queue.now_ns + PERIOD_NS)
        return self.recorder.events[before:]


@pytest.fixture
def runtime():
    runtime = WallRuntime()
    yield runtime
    runtime.close()


def test_taking_and_releasing_are_recorded_with_owner(bench, runtime):
    lock = ProcessLock(NODE_2, "lo node 2")
    hold = lock.acquire(runtime, "survey (reserve() of mast)")
    (taken,) = bench.look()
    assert (taken.motor, taken.action, taken.owner) == (
        *("right", LockAction.TAKEN),
        "survey (reserve() of mast)",
    )
    assert (taken.token, taken.pid, taken.looked) == (hold.token, os.getpid(), True)
    assert 0.0 < taken.held_s < 60.0
    assert bench.look() == []
    hold.release()
    (released,) = bench.look()
    assert (released.action, released.token, released.pid) == (
        *(LockAction.RELEASED, hold.token),
        os.getpid(),
    )
    assert bench.look() == []
    lock.close()


def test_release_after_the_last_poll_is_seen_at_the_end(bench, runtime):
    lock = ProcessLock(NODE_2, "lo node 2")
    hold = lock.acquire(runtime, "survey")
    bench.look()
    hold.release()
    bench.looks.look()
    lock.close()
    (tenure,) = ownership_of(bench.recorder.events).tenures["right"]
    assert (tenure.owner, tenure.ended) == ("survey", Ended.RELEASED)


def test_ownership_between_two_polls_shows_only_as_skipped(bench, runtime):
    lock = ProcessLock(NODE_2, "lo node 2")
    first = lock.acquire(runtime, "first")
    bench.look()
    first.release()
    lock.acquire(runtime, "unseen").release()
    third = lock.acquire(runtime, "third")
    bench.look()
    third.release()
    bench.look()
    lock.close()
    tenures = ownership_of(bench.recorder.events).tenures["right"]
    assert [(one.owner, one.ended) for one in tenures] == [
        ("first", Ended.UNTOLD),
        ("third", Ended.RELEASED),
    ]
    assert [one.skipped for one in tenures] == [0, 1]


@contextmanager
def kill_one_who_has_it(bench, is_looked_at=True):
    """Yield the pid of a process that was seen with the lock, and then killed."""
    program = (
        "import os, sys; from motorhil.motorapi.locking.process_lock import ProcessLock;"
        "from motorhil.motorapi.runtime.wall import WallRuntime;"
        f"hold = ProcessLock({NODE_2!r}, 'x').acquire(WallRuntime(), 'panorama');"
        "print('held', flush=True); sys.stdin.read()"
    )
    with subprocess.Popen(
        [sys.executable, "-c", program], stdin=subprocess.PIPE, stdout=subprocess.PIPE
    ) as dies:
        assert dies.stdout.readline() == b"held\n"
        bench.look()
        dies.kill()
        dies.wait()
        if is_looked_at:
            assert bench.look() == []
        yield dies.pid


@pytest.mark.parametrize("seen_free", [True, False])
def test_owner_that_died_is_reported_if_it_was_seen(bench, runtime, seen_free):
    with kill_one_who_has_it(bench, seen_free) as dead:
        if seen_free:
            assert bench.told[-1][1:3] == ("warning", "can0")
            assert bench.told[-1][3] == f"pid {dead} (python -c) has died with right"
    lock = ProcessLock(NODE_2, "lo node 2")
    hold = lock.acquire(runtime, "rescue")
    (taken,) = bench.look()
    assert taken.action is (LockAction.BROKEN if seen_free else LockAction.TAKEN)
    dead, _ = ownership_of(bench.recorder.events).tenures["right"]
    assert dead.ended is (Ended.DIED if seen_free else Ended.UNTOLD)
    hold.release()
    lock.close()


def test_owner_in_between_is_not_reported_as_dead(bench, runtime):
    lock = ProcessLock(NODE_2, "lo node 2")
    lock.acquire(runtime, "unseen").release()
    bench.look()
    with kill_one_who_has_it(bench) as dead:
        assert f"pid {dead} (python -c) has died with right" in bench.told[-1][3]
        lock.acquire(runtime, "unseen").release()  # takes over from the dead owner
        hold = lock.acquire(runtime, "next")
        (taken,) = bench.look()
        assert taken.action is LockAction.TAKEN
        hold.release()
    lock.close()


def test_channel_of_a_node_is_a_separate_motor(bench, runtime):
    fido = Bench(bench.folder, "fido")
    lock = ProcessLock(f"{socketcan_name('lo')}-node1-channel2", "lo node 1 channel 2")
    hold = lock.acquire(runtime, "survey")
    (taken,) = fido.look()
    motors = read_rig(EXAMPLES / "fido.toml", installed_plugins()).motors.values()
    names = [m.name for m in motors if (m.bus, m.node_id) == ("can0", 1)]
    assert taken.motor == names[1]
    hold.release()
    lock.close()


def test_record_explains_polling_and_its_limits(bench):
    _, level, bus, text = bench.told[0]
    assert (level, bus) == ("info", "can0")
    assert text == (
        "who owns its motors nobody tells on lo: it is looked up every 100 ms in"
        f" {bench.folder}; what lies between two looks, and who uses other lock files, is not seen"
    )


def test_unsafe_lock_directory_ends_polling_with_one_warning(bench):
    bench.folder.chmod(0o777)
    bench.look()
    bench.look()
    warnings = [text for _, level, _, text in bench.told if level == "warning"]
    assert len(warnings) == 1
    assert warnings[0].startswith("no more lock events: ")
