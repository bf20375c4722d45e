import os
import pty
import socket

import pytest

from motorhil.motorapi.errors import MotorBusyError
from motorhil.motorapi.locking.directory import LockDirectory, serial_name, socketcan_name
from motorhil.motorapi.locking.lock_file import LockFile
from motorhil.motorapi.locking.process_lock import ProcessLock
from motorhil.motorapi.locking.unused_files import UNUSED_S, is_bus_gone, remove_unused
from motorhil.motorapi.runtime.wall import WallRuntime

HUB = "hub-5-123-can0-node1"
NAMESPACE = os.stat("/proc/self/ns/net").st_ino
NO_INTERFACE = f"can-if2147483647-net{NAMESPACE}"


@pytest.fixture
def directory(tmp_path):
    return LockDirectory(tmp_path)


@pytest.fixture
def runtime():
    wall = WallRuntime()
    yield wall
    wall.close()


@pytest.fixture
def used(directory, runtime, tmp_path):
    """Make lock files: released, abandoned or held, and used that long ago."""

    def make(name, age_s, how="released"):
        lock = ProcessLock(name, name, directory)
        hold = lock.acquire(runtime, "use")
        if how == "released":
            hold.release()
        elif how == "abandoned":
            hold._file.close()
        lock.close()
        then_s = (tmp_path / name).stat().st_mtime - age_s
        os.utime(tmp_path / name, (then_s, then_s))
        return hold

    return make


@pytest.mark.parametrize(
    ("name", "age_s", "how", "stays"),
    [
        ("tcp-10.0.0.7-502", UNUSED_S - 60, "released", True),
        ("tcp-10.0.0.7-502", UNUSED_S + 60, "released", False),
        ("tcp-10.0.0.7-502", 100 * UNUSED_S, "held", True),
        ("tcp-10.0.0.7-502", 100 * UNUSED_S, "abandoned", True),
        (HUB, UNUSED_S + 60, "abandoned", False),
        (HUB, UNUSED_S - 60, "abandoned", True),
        (NO_INTERFACE, 0, "released", False),
        (NO_INTERFACE, 0, "held", True),
        (NO_INTERFACE, 0, "abandoned", True),
        (NO_INTERFACE + "-node1", UNUSED_S + 60, "abandoned", False),
    ],
)
def test_only_unused_files_are_removed(used, directory, name, age_s, how, stays):
    hold = used(name, age_s, how)
    remove_unused(directory)
    assert directory.names() == ([name] if stays else [])
    hold.release()


def test_new_lock_removes_unused_files(used, directory, runtime, tmp_path):
    for number in range(40):
        used(f"hub-5-{number}-can0", 0)
    for name in directory.names():
        os.utime(tmp_path / name, (0, 0))
    lock = ProcessLock("pan", "the pan", directory)
    lock.acquire(runtime, "x").release()
    assert len(directory.names()) == 9  # 32 fewer
    lock.acquire(runtime, "x").release()
    assert len(directory.names()) == 9  # no new file


def test_awaited_lock_is_not_removed(used, directory):
    hold = used("pan", 2 * UNUSED_S, "held")
    waiter = LockFile(directory, "pan")
    waiter.queue_up()
    hold.release()
    os.utime(directory.path / "pan", (0, 0))
    remove_unused(directory)
    assert directory.names() == ["pan"]
    waiter.close()


def test_program_with_a_swept_file_uses_the_new_one(used, directory, runtime):
    lock = ProcessLock("pan", "the pan", directory)
    with lock.acquire(runtime, "x") as hold:
        token = hold.token
    os.utime(directory.path / "pan", (0, 0))
    remove_unused(directory)
    assert directory.names() == []
    other = ProcessLock("pan", "the pan", directory)
    with other.acquire(runtime, "y") as hold:
        assert hold.token > token
        with pytest.raises(MotorBusyError, match="for y since"):
            lock.acquire(runtime, "x")


def test_foreign_files_are_left_alone(directory, tmp_path):
    (tmp_path / "notes").write_text("keep")
    (tmp_path / "notes").chmod(0o600)
    (tmp_path / "link").symlink_to(tmp_path / "notes")
    (tmp_path / "folder").mkdir()
    for name in ("notes", "folder"):
        os.utime(tmp_path / name, (0, 0))
    remove_unused(directory)
    assert directory.names() == ["folder", "link", "notes"]


def test_missing_directory_has_no_unused_files(tmp_path):
    remove_unused(LockDirectory(tmp_path / "none"))


def test_bus_is_gone_only_if_this_host_can_tell():
    ours, theirs = pty.openpty()
    line = serial_name(os.ttyname(theirs))
    assert not is_bus_gone(line)
    assert not is_bus_gone(f"{line}-unit1")
    os.close(ours)
    os.close(theirs)
    assert is_bus_gone(line)
    assert is_bus_gone(f"slcan-{line}-node1")
    assert not is_bus_gone("serial-1-3")  # /dev/null
    loopback = socket.if_nameindex()[0][1]
    assert not is_bus_gone(socketcan_name(loopback))
    assert is_bus_gone(NO_INTERFACE)
    assert not is_bus_gone("can-if2147483647-net1")  # of another namespace
    assert not is_bus_gone("tcp-10.0.0.7-502")
