import errno
import os
import stat

import pytest

from motorhil.motorapi.errors import UsageError
from motorhil.motorapi.locking import directory as lock_directory
from motorhil.motorapi.locking.directory import VARIABLE, LockDirectory
from tests.unit.motorapi.locking.test_process_lock import open_here

ROOT = os.geteuid() == 0
SOMEBODY = 54321


def mode_of(path):
    return stat.S_IMODE(path.stat().st_mode)


@pytest.fixture
def default(tmp_path, monkeypatch):
    """Return the default directory of locks."""
    monkeypatch.delenv(VARIABLE, raising=False)
    monkeypatch.setattr(lock_directory, "_DEFAULT", str(tmp_path / "motorhil-{}"))
    return tmp_path / f"motorhil-{os.geteuid()}"


@pytest.fixture
def group(tmp_path):
    """Return a directory shared by a group."""
    folder = tmp_path / "robot"
    folder.mkdir()
    folder.chmod(0o2770)
    return folder


def test_default_directory_is_private_and_created(default):
    os.close(LockDirectory().open("pan"))
    assert mode_of(default) == 0o700
    assert mode_of(default / "pan") == 0o600
    os.close(LockDirectory().open("pan"))
    assert LockDirectory().names() == ["pan"]


def test_default_directory_does_not_depend_on_the_session(default, tmp_path, monkeypatch):
    for name in ("XDG_RUNTIME_DIR", "TMPDIR", "HOME"):
        monkeypatch.setenv(name, str(tmp_path))
    assert LockDirectory().path == default


def test_reading_creates_nothing(default):
    assert LockDirectory().open("pan", to_read=True) is None
    assert LockDirectory().names() == []
    assert not default.exists()


def test_environment_variable_names_another_directory(default, group, monkeypatch):
    monkeypatch.setenv(VARIABLE, str(group))
    assert LockDirectory().path == group
    monkeypatch.setenv(VARIABLE, "here")
    with pytest.raises(UsageError, match=f"{VARIABLE}=here: must be an absolute path"):
        LockDirectory()


def test_group_directory_gives_the_group_access_to_all_files(group):
    before = os.umask(0o077)
    try:
        os.close(LockDirectory(group).open("pan"))
    finally:
        os.umask(before)
    assert mode_of(group / "pan") == 0o660
    assert (group / "pan").stat().st_gid == group.stat().st_gid


def test_named_directory_is_not_created(tmp_path):
    with pytest.raises(UsageError, match="the directory does not exist"):
        LockDirectory(tmp_path / "none").open("pan")


@pytest.mark.parametrize("mode", [0o770, 0o777, 0o1777, 0o2777, 0o2775, 0o755, 0o2750])
def test_directory_with_excessive_access_raises(tmp_path, mode):
    folder = tmp_path / "locks"
    folder.mkdir()
    folder.chmod(mode)
    with pytest.raises(UsageError, match=f"{folder}: mode {mode:04o}.*{VARIABLE}"):
        LockDirectory(folder).open("pan")


def test_default_directory_is_not_accessible_to_others(default):
    default.mkdir()
    default.chmod(0o2770)
    with pytest.raises(UsageError, match="mode 2770 gives access to others; it must be 0700"):
        LockDirectory().open("pan")


@pytest.mark.skipif(not ROOT, reason="only root can give a directory away")
def test_default_directory_of_another_user_raises(default):
    default.mkdir(mode=0o700)
    os.chown(default, SOMEBODY, -1)
    with pytest.raises(UsageError, match=f"belongs to user {SOMEBODY}"):
        LockDirectory().open("pan")
    with pytest.raises(UsageError, match=f"belongs to user {SOMEBODY}"):
        LockDirectory().names()


@pytest.mark.skipif(not ROOT, reason="only root can give a directory away")
def test_named_private_directory_of_another_user_raises(tmp_path):
    folder = tmp_path / "theirs"
    folder.mkdir(mode=0o700)
    os.chown(folder, SOMEBODY, -1)
    with pytest.raises(
        UsageError, match=f"mode 0700, of user {SOMEBODY}; it must be 2770, or 0700 and your own"
    ):
        LockDirectory(folder).open("pan")


def test_link_in_place_of_the_directory_raises(default, tmp_path):
    elsewhere = tmp_path / "elsewhere"
    elsewhere.mkdir(mode=0o700)
    default.symlink_to(elsewhere)
    with pytest.raises(UsageError, match="it is a link"):
        LockDirectory().open("pan")
    assert list(elsewhere.iterdir()) == []


@pytest.mark.parametrize("number", [errno.EMFILE, errno.ENOSPC, errno.EROFS])
def test_error_does_not_advise_removal_of_a_lock_in_use(group, monkeypatch, number):
    really = os.open

    def full(path, flags, mode=0o777, *, dir_fd=None):
        if dir_fd is not None:
            raise OSError(number, os.strerror(number))
        return really(path, flags, mode)

    monkeypatch.setattr(lock_directory.os, "open", full)
    with pytest.raises(UsageError) as refused:
        LockDirectory(group).open("pan")
    reason = f"{os.strerror(number)}: the lock between processes cannot be opened"
    assert str(refused.value) == f"{group}/pan: {reason}"


def test_link_in_place_of_a_file_raises_and_target_stays(group, tmp_path):
    precious = tmp_path / "precious"
    precious.write_text("keep")
    (group / "pan").symlink_to(precious)
    with pytest.raises(UsageError, match=f"{group}/pan: it is a link"):
        LockDirectory(group).open("pan")
    (group / "tilt").symlink_to(tmp_path / "to be made")
    with pytest.raises(UsageError):
        LockDirectory(group).open("tilt")
    assert precious.read_text() == "keep"
    assert not (tmp_path / "to be made").exists()


def test_file_with_a_hard_link_raises(group, tmp_path):
    precious = tmp_path / "precious"
    precious.write_text("keep")
    precious.chmod(0o660)
    (group / "pan").hardlink_to(precious)
    with pytest.raises(UsageError, match="hard link"):
        LockDirectory(group).open("pan")


def test_fifo_in_place_of_a_file_raises_at_once(group):
    os.mkfifo(group / "pan", 0o660)
    for to_read in (False, True):
        with pytest.raises(UsageError, match="it is not a file"):
            LockDirectory(group).open("pan", to_read=to_read)


def test_file_writable_by_others_raises(default, group):
    default.mkdir(mode=0o700)
    (default / "pan").touch(0o600)
    (default / "pan").chmod(0o620)
    with pytest.raises(UsageError, match="mode 0620; it must be your own, 0600"):
        LockDirectory().open("pan")
    (group / "pan").touch()
    (group / "pan").chmod(0o666)
    with pytest.raises(UsageError, match="mode 0666; it must be group"):
        LockDirectory(group).open("pan")


@pytest.mark.skipif(not ROOT, reason="only root can give a file away")
def test_file_of_another_user_in_private_directory_raises(default):
    default.mkdir(mode=0o700)
    (default / "pan").touch(0o600)
    os.chown(default / "pan", SOMEBODY, -1)
    with pytest.raises(UsageError, match=f"user {SOMEBODY}, mode 0600"):
        LockDirectory().open("pan")


@pytest.mark.skipif(not ROOT, reason="only root can give a file away")
def test_file_of_another_group_in_group_directory_raises(group):
    (group / "pan").touch()
    (group / "pan").chmod(0o660)
    os.chown(group / "pan", -1, SOMEBODY)
    with pytest.raises(UsageError, match=f"group {SOMEBODY}, mode 0660; it must be group"):
        LockDirectory(group).open("pan")


def test_errors_leave_no_descriptor_open(default, group, tmp_path):
    assert open_here(tmp_path) == 0
    default.mkdir(mode=0o755)
    (group / "pan").touch(0o666)
    os.mkfifo(group / "tilt", 0o660)
    for directory, name in ((None, "pan"), (group, "pan"), (group, "tilt"), (tmp_path / "x", "x")):
        with pytest.raises(UsageError):
            LockDirectory(directory).open(name)
    assert open_here(tmp_path) == 0
