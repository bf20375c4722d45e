"""Exclusion of processes whose lock file was removed or moved under a holder."""

import contextlib
import os
import shutil
import signal
import tempfile
from pathlib import Path

import pytest

from motorhil.motorapi.errors import MotorBusyError
from motorhil.motorapi.locking import witness
from motorhil.motorapi.locking.directory import LockDirectory
from motorhil.motorapi.locking.process_lock import ProcessLock
from tests.support.line_programs import Program
from tests.system.wall.sharing.test_process_lock import LONG_S, lock, programs, wall

__all__ = ["lock", "programs", "wall"]

pytestmark = pytest.mark.wall

SOMEBODY = 54321


@pytest.fixture
def folder(tmp_path):
    """Return a directory of locks that tests may remove as a whole."""
    made = tmp_path / "locks"
    made.mkdir(mode=0o700)
    return made


@pytest.fixture
def base():
    return 0


@pytest.fixture
def lock(folder):  # noqa: F811  (of that folder)
    return ProcessLock("pan", "the pan", LockDirectory(folder))


@pytest.fixture
def holder(folder):
    """Return a program that holds the lock."""
    program = Program("lock_holder", folder, "pan")
    assert program.ask("take driving").startswith("has ")
    yield program
    program.end()


def remove(folder):
    (folder / "pan").unlink()


def remove_all(folder):
    shutil.rmtree(folder)
    folder.mkdir(mode=0o700)


def move(folder):
    folder.rename(folder.with_name("before"))
    folder.mkdir(mode=0o700)


@pytest.mark.parametrize("change", [remove, remove_all, move])
def test_new_file_of_a_held_lock_gives_no_second_holder(holder, lock, wall, folder, change):
    change(folder)
    words = (
        rf"the pan is held by pid {holder.pid} \(lock_holder.py\), whose lock file was removed or"
        rf" moved, for driving since 2.* ago\); .*end the program \(kill {holder.pid}\)"
    )
    for take_over in (False, True):
        with pytest.raises(MotorBusyError, match=words) as refused:
            lock.acquire(wall, "mine", timeout_s=0.02, take_over=take_over)
    assert (refused.value.pid, refused.value.purpose) == (holder.pid, "driving")
    assert lock.look().holder is None  # the attempts left nothing behind
    assert holder.ask("write").startswith("wrote ")
    assert holder.ask("held") == "held True"
    assert holder.ask("release") == "released"
    assert not lock.acquire(wall, "mine").was_abandoned


def test_waiter_with_a_new_file_gets_the_lock_at_release(holder, lock, wall, folder):
    remove_all(folder)
    waits = Program("lock_holder", folder, "pan")
    try:
        waits.say(f"take waiting {LONG_S}")
        assert wall.wait_until(lambda: lock.look().holder is not None, LONG_S)
        assert holder.ask("write").startswith("wrote ")
        assert holder.ask("release") == "released"
        assert waits.hear().startswith("has ")
        assert holder.ask("take again").startswith(f"busy the pan is held by pid {waits.pid} ")
    finally:
        waits.end()


@pytest.mark.parametrize("how", ["", "fork", "child"])
def test_killed_holder_of_a_removed_file_frees_it_at_once(holder, lock, wall, folder, how):
    child = int(holder.ask(how).split()[1]) if how else 0
    remove_all(folder)
    try:
        with pytest.raises(MotorBusyError, match=f"held by pid {holder.pid} "):
            lock.acquire(wall, "mine")
        holder.kill()
        lock.acquire(wall, "mine").release()
    finally:
        if child:
            with contextlib.suppress(ProcessLookupError):
                os.kill(child, signal.SIGKILL)


def test_paused_loser_does_not_exclude_the_next_holder(holder, lock, wall, folder):
    holder.signal(signal.SIGSTOP)
    assert wall.wait_until(lambda: lock.look().holder.is_paused, LONG_S)
    for _ in range(2):
        lock.acquire(wall, "rescue", take_over=True).release()
    remove_all(folder)
    lock.acquire(wall, "with a new file").release()
    holder.signal(signal.SIGCONT)


def test_other_locks_of_a_removed_directory_stay_free(holder, folder, wall):
    remove_all(folder)
    ProcessLock("tilt", "the tilt", LockDirectory(folder)).acquire(wall, "mine").release()


def test_holder_without_a_witness_is_told_of_the_next(holder, lock, wall, folder, monkeypatch):
    monkeypatch.setattr(witness, "PLACE", "/nonexistent")  # as in another network namespace
    remove_all(folder)
    assert holder.ask("write").startswith("wrote ")  # no other process has it
    with lock.acquire(wall, "mine"):
        told = holder.ask("write")
        assert told.startswith("busy the pan was taken over (its lock file had been removed) by")
    assert holder.ask("release") == "released"


@pytest.fixture
def robot():
    """Return a folder that other users can reach: those of pytest are private."""
    with tempfile.TemporaryDirectory() as name:
        yield Path(name)


@pytest.mark.skipif(os.geteuid() != 0, reason="only root can become another user")
def test_holder_of_another_user_is_told_as_such(robot, wall):
    folder = robot
    os.chown(folder, -1, SOMEBODY)
    folder.chmod(0o2770)
    lock = ProcessLock("pan", "the pan", LockDirectory(folder))
    hold = lock.acquire(wall, "driving")
    (folder / "pan").unlink()
    ours, theirs = os.pipe()
    child = os.fork()
    if child == 0:
        os.setgroups([])
        os.setgid(SOMEBODY)
        os.setuid(SOMEBODY)
        try:
            told = f"has {lock.acquire(wall, 'mine').token}"
        except BaseException as error:
            told = str(error)
        os.write(theirs, told.encode())
        os._exit(0)
    os.close(theirs)
    told = os.read(ours, 1000).decode()
    os.close(ours)
    os.waitpid(child, 0)
    hold.release()
    assert told.startswith(
        "the pan is held by a process of another user or container, whose lock file was removed or"
    )
    assert "; as root, find it (grep -l " in told
