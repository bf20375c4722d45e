"""The lock between processes, seen from one process; tests/system/wall uses several."""

import gc
import os
import threading
from contextlib import suppress

import pytest

from motorhil.emulators.simulation.event_queue import EventQueue
from motorhil.harness.virtual_time.runtime import VirtualRuntime
from motorhil.motorapi.errors import MotorBusyError, UsageError
from motorhil.motorapi.locking.directory import LockDirectory
from motorhil.motorapi.locking.lock_file import LockFile
from motorhil.motorapi.locking.lock_status import list_locks
from motorhil.motorapi.locking.process_lock import ProcessLock
from motorhil.motorapi.runtime import wall as wall_runtime
from motorhil.motorapi.runtime.wall import WallRuntime

LONG_S = 20.0


@pytest.fixture
def directory(tmp_path):
    return LockDirectory(tmp_path)


@pytest.fixture
def runtime():
    wall = WallRuntime()
    yield wall
    wall.close()


@pytest.fixture
def lock(directory):
    return ProcessLock("pan", "the pan", directory)


@pytest.fixture
def other(directory):
    """Return the lock object of another program."""
    return ProcessLock("pan", "the pan", directory)


def purposes(view):
    return [one.record and one.record.purpose for _, one in view.waiters]


def test_ownership_has_a_greater_token_and_knows_a_change(lock, other, runtime):
    told = []
    for one in (lock, lock, other, other, lock):
        with one.acquire(runtime, "x") as hold:
            told.append((hold.token, hold.changed_hands))
    first = told[0][0]
    assert [(token - first, changed) for token, changed in told] == [
        (0, True),
        (1, False),
        (2, True),
        (3, False),
        (4, True),
    ]


def test_token_survives_all_processes(directory, lock, runtime):
    with lock.acquire(runtime, "x") as hold:
        token = hold.token
    lock.close()
    del lock, hold
    gc.collect()
    hold = ProcessLock("pan", "the pan", directory).acquire(runtime, "x")
    assert (hold.token, hold.changed_hands) == (token + 1, True)


def test_owner_acquires_repeatedly_and_releases_as_often(lock, other, runtime):
    hold = lock.acquire(runtime, "x")
    assert lock.acquire(runtime, "y") is hold
    hold.release()
    with pytest.raises(MotorBusyError, match=r"held by pid .*for x since"):
        other.acquire(runtime, "z")
    hold.release()
    assert not hold.is_held
    again = other.acquire(runtime, "z")
    hold.release()  # once too often: without effect
    assert again.is_held
    with pytest.raises(MotorBusyError):
        lock.acquire(runtime, "x")


def test_owner_is_the_thread_unless_named(lock, runtime):
    me, you = object(), object()
    hold = lock.acquire(runtime, "x", owner=me)
    assert lock.acquire(runtime, "x", owner=me) is hold
    for owner in (you, None):
        with pytest.raises(MotorBusyError):
            lock.acquire(runtime, "y", owner=owner)


def test_threads_acquire_in_the_order_of_requests(lock, runtime):
    order = []
    hold = lock.acquire(runtime, "x")

    def take(name):
        with lock.acquire(runtime, name, LONG_S):
            order.append(name)

    parties = []
    for number, name in enumerate("abc"):
        parties.append(runtime.spawn(name, lambda name=name: take(name)))
        assert runtime.wait_until(
            lambda n=number: purposes(lock.look()) == [*"abc"[: n + 1]], LONG_S
        )
    hold.release()
    for party in parties:
        assert party.join(LONG_S)
        assert party.error is None
    assert order == ["a", "b", "c"]


def test_wait_ends_at_its_timeout_without_its_place(lock, other, runtime):
    hold = lock.acquire(runtime, "x")
    begun_ns = runtime.now_ns()
    for timeout_s in (0.0, 0.03):
        with pytest.raises(MotorBusyError, match=r"the pan is held by pid .*for x since"):
            other.acquire(runtime, "y", timeout_s)
    assert runtime.now_ns() - begun_ns >= 30_000_000
    assert lock.look().waiters == ()
    hold.release()
    other.acquire(runtime, "y").release()


class WokenRuntime:
    """A runtime that checks only when woken: waiters do not poll."""

    def __init__(self):
        self._woken = threading.Semaphore(0)

    def now_ns(self):
        return 0

    def wake(self):
        self._woken.release()

    def wait_until(self, done, timeout_s=None):
        while not done():
            if not self._woken.acquire(timeout=timeout_s):
                return False
        return True


def test_waiter_is_woken_without_polling(lock, other, runtime):
    order = []

    def take(name):
        with other.acquire(WokenRuntime(), name, LONG_S):
            order.append(name)

    for attempt in range(3):
        hold = lock.acquire(runtime, "x")
        party = runtime.spawn("waits", lambda name=attempt: take(str(name)))
        assert runtime.wait_until(lambda: purposes(lock.look()), LONG_S)
        hold.release()
        assert party.join(LONG_S / 2)
        assert party.error is None
    assert order == ["0", "1", "2"]


def test_abandoned_wait_blocks_no_other_waiter(lock, other, runtime, directory):
    hold = lock.acquire(runtime, "x")
    with pytest.raises(MotorBusyError):
        other.acquire(runtime, "gives up", 0.01)
    order = []

    def take(name):
        with other.acquire(WokenRuntime(), name, LONG_S):
            order.append(name)

    party = runtime.spawn("waits", lambda: take("late"))
    assert runtime.wait_until(lambda: purposes(lock.look()) == ["late"], LONG_S)
    hold.release()
    assert party.join(LONG_S)
    assert (party.error, order) == (None, ["late"])


def test_queue_is_free_after_a_wait(lock, other, runtime, tmp_path):
    hold = lock.acquire(runtime, "x")
    party = runtime.spawn("waits", lambda: other.acquire(runtime, "y", LONG_S).release())
    assert runtime.wait_until(lambda: purposes(lock.look()) == ["y"], LONG_S)
    hold.release()
    assert party.join(LONG_S)
    again = LockFile(LockDirectory(tmp_path), "pan")  # the watcher may just be letting go of it
    assert runtime.wait_until(again.take_at_once, LONG_S)


def test_wall_runtime_checks_at_once_when_woken(runtime, monkeypatch):
    monkeypatch.setattr(wall_runtime, "_LOOK_AGAIN_S", LONG_S)
    looked = []
    party = runtime.spawn(
        "waits", lambda: runtime.wait_until(lambda: looked.append(1) or len(looked) > 1, LONG_S)
    )
    while not looked:
        pass
    runtime.wake()
    assert party.thread is not None
    party.thread.join(LONG_S / 2)
    assert party.finished


def test_reused_pid_does_not_count_as_the_holder(lock, other, runtime, monkeypatch):
    lock.acquire(runtime, "x")
    monkeypatch.setattr("motorhil.motorapi.locking.lock_status.read_process", lambda pid: ("S", 1))
    assert lock.look().holder.record is None


def test_acquisition_in_a_callback_does_not_wait(lock, other, runtime):
    lock.acquire(runtime, "x")
    told = []

    def meddle():
        try:
            other.acquire(runtime, "y", 1.0)
        except UsageError as error:
            told.append(str(error))

    timer = runtime.every(0.005, meddle)
    assert runtime.wait_until(lambda: bool(told), LONG_S)
    timer.cancel()
    assert told[0].startswith("waiting inside a callback")
    assert lock.look().waiters == ()


def test_closed_runtime_ends_the_wait_and_its_place(lock, other):
    runtime = WallRuntime()
    lock.acquire(runtime, "x")
    party = runtime.spawn("waits", lambda: other.acquire(runtime, "y", LONG_S))
    assert runtime.wait_until(lambda: purposes(lock.look()) == ["y"], LONG_S)
    runtime.close()
    assert party.finished
    assert lock.look().waiters == ()


def test_parties_in_virtual_time_wait_for_each_other(lock):
    virtual = VirtualRuntime(EventQueue())
    order = []

    def take(name):
        with lock.acquire(virtual, name, 10.0):
            order.append((name, virtual.now_ns()))
            virtual.run_for(0.1)

    parties = [virtual.spawn(name, lambda name=name: take(name)) for name in "abc"]
    for party in parties:
        assert party.join(10.0)
        assert party.error is None
    assert order == [("a", 0), ("b", 100_000_000), ("c", 200_000_000)]


def test_look_takes_nothing_and_shows_holder_and_waiters(lock, other, runtime, directory):
    assert lock.look().holder is None
    assert list_locks(directory) == []  # reading creates no file
    hold = lock.acquire(runtime, "drive ü" + "!" * 200)
    party = runtime.spawn("waits", lambda: other.acquire(runtime, "b", LONG_S).release())
    assert runtime.wait_until(lambda: purposes(lock.look()) == ["b"], LONG_S)
    (view,) = list_locks(directory)
    assert (view.name, view.label) == ("pan", "the pan")
    assert view.holder.record.purpose == "drive ü" + "!" * 88  # 96 bytes
    assert (view.holder.record.pid, view.holder.is_paused) == (os.getpid(), False)
    assert view.holder.age_s >= 0.0
    assert purposes(view) == ["b"]
    hold.release()
    assert party.join(LONG_S)
    (view,) = list_locks(directory)
    assert (view.label, view.holder, view.waiters) == ("the pan", None, ())


def test_unpublished_holder_is_shown_as_unidentified(lock, other, runtime, monkeypatch):
    monkeypatch.setattr(
        "motorhil.motorapi.locking.lock_file.LockFile.tell_holder", lambda *told: None
    )
    lock.acquire(runtime, "x")
    with pytest.raises(MotorBusyError, match="is not yet identified since just now") as caught:
        other.acquire(runtime, "y")
    assert caught.value.pid is None


def test_restored_file_does_not_change_the_holder(lock, runtime, tmp_path):
    with lock.acquire(runtime, "long ago"):
        old = (tmp_path / "pan").read_bytes()
    hold = lock.acquire(runtime, "now")
    (tmp_path / "pan").write_bytes(old)
    holder = lock.look().holder
    assert holder is not None
    assert holder.record is None
    hold.release()


def test_acquisition_reports_an_abandoned_lock(lock, other, runtime):
    hold = lock.acquire(runtime, "x")
    hold.release()
    assert not lock.look().abandoned
    hold = other.acquire(runtime, "y")
    assert not hold.was_abandoned
    assert not lock.look().abandoned  # it is held
    hold._file.close()  # as the kernel does when a process dies
    assert lock.look().abandoned == hold.token
    assert lock.look().holder is None
    with lock.acquire(runtime, "x") as hold:
        assert hold.was_abandoned
    assert not lock.look().abandoned
    assert not lock.acquire(runtime, "x").was_abandoned


def test_removed_file_is_replaced_and_tokens_still_grow(lock, other, runtime, tmp_path):
    with lock.acquire(runtime, "x") as hold:
        token = hold.token
    (tmp_path / "pan").unlink()
    hold = other.acquire(runtime, "y")
    assert hold.token > token
    with pytest.raises(MotorBusyError, match="for y since"):
        lock.acquire(runtime, "x")


def test_file_that_is_not_a_lock_is_left_alone(lock, runtime, tmp_path):
    (tmp_path / "pan").touch(0o600)
    (tmp_path / "pan").write_text("my precious notes")
    with pytest.raises(UsageError, match=f"{tmp_path}/pan: not a lock file"):
        lock.acquire(runtime, "x")
    assert (tmp_path / "pan").read_text() == "my precious notes"


@pytest.mark.parametrize("name", ["", "a/b", ".hidden", "..", "x" * 201])
def test_invalid_lock_name_raises(name, directory):
    with pytest.raises(UsageError, match="lock '"):
        ProcessLock(name, "x", directory)


def open_here(folder):
    """Return the number of open descriptors of files in the folder."""
    count = 0
    for name in os.listdir("/proc/self/fd"):
        with suppress(FileNotFoundError):  # of the listing itself
            count += os.readlink(f"/proc/self/fd/{name}").startswith(str(folder))
    return count


def test_unused_lock_keeps_no_file_open(directory, runtime, tmp_path):
    lock = ProcessLock("pan", "the pan", directory)
    lock.acquire(runtime, "x").release()
    assert open_here(tmp_path) == 1  # kept for the next time
    lock.close()
    assert open_here(tmp_path) == 0
    lock.acquire(runtime, "x").release()
    assert open_here(tmp_path) == 1
    del lock
    gc.collect()
    assert open_here(tmp_path) == 0
