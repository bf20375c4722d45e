"""The verb `list motors`, without other processes; for those see tests/system/wall."""

import json
import os

import pytest

from motorhil.harness.cli.main import main as motorhil
from motorhil.motorapi.locking.directory import VARIABLE
from motorhil.motorapi.locking.process_lock import ProcessLock
from motorhil.motorapi.runtime.wall import WallRuntime


@pytest.fixture
def runtime():
    wall = WallRuntime()
    yield wall
    wall.close()


@pytest.fixture
def locks(tmp_path, monkeypatch):
    """A function that creates locks as programs do; no other locks are listed."""
    folder = tmp_path / "locks"
    folder.mkdir(mode=0o700)
    monkeypatch.setenv(VARIABLE, str(folder))
    return ProcessLock


def test_leases_and_takeovers_are_listed(runtime, locks, capsys):
    def listed():
        assert motorhil(["list", "motors", "--json"]) == 0
        (entry,) = json.loads(capsys.readouterr().out)
        return entry["holder"]

    first = locks("can0-node3", "can0 node 3").acquire(runtime, "survey", lease_s=0.01)
    told = listed()
    assert told["lease_s"] == 0.01
    assert told["token"] == first.token
    assert "; lease of 0.01 s, " in told["text"]
    runtime.wait_until(lambda: False, 0.02)
    told = listed()
    assert told["lease_left_s"] < 0.0
    assert "; lease of 0.01 s, expired " in told["text"]
    assert "taken_over" not in told
    second = locks("can0-node3", "can0 node 3").acquire(runtime, "rescue")
    told = listed()
    assert "lease_s" not in told
    assert told["token"] == second.token
    pid = os.getpid()
    assert told["taken_over"]["from_pid"] == pid
    assert told["taken_over"]["reason"] == "its lease of 0.01 s was over"
    assert told["text"].endswith(
        f"; taken over from pid {pid} ({told['program']}): its lease of 0.01 s was over"
    )


def test_motors_of_gone_hub_are_listed_only_while_held(runtime, tmp_path, monkeypatch, capsys):
    locks = tmp_path / "locks"
    locks.mkdir(mode=0o700)
    monkeypatch.setenv(VARIABLE, str(locks))
    hub = tmp_path / "hub"
    hub.touch()
    shared = ProcessLock("hub-1", f"{hub} node 1")
    with shared.acquire(runtime, "survey"):
        pass
    with ProcessLock("can0-3", "can0 node 3").acquire(runtime, "survey"):
        pass

    def listed():
        assert motorhil(["list", "motors"]) == 0
        return capsys.readouterr().out.splitlines()

    assert [line.rpartition(" node ")[0] for line in listed()] == [str(hub), "can0"]
    hub.unlink()
    assert [line.rpartition(" node ")[0] for line in listed()] == ["can0"]
    with shared.acquire(runtime, "survey"):
        assert any("for survey" in line for line in listed())


def test_brief_locks_are_listed_only_while_held(runtime, locks, capsys):
    names = ["can0-node3-sdo", "can0-sync", "can0-sync-producer", "can0-armed-3-200"]
    for name in names:
        with locks(name, name).acquire(runtime, "x"):
            assert motorhil(["list", "motors"]) == 0
            assert capsys.readouterr().out.startswith(name)
        assert motorhil(["list", "motors"]) == 0
        assert capsys.readouterr().out == ""


def test_refused_lock_directory_is_reported(tmp_path, monkeypatch, capsys):
    def told():
        assert motorhil(["list", "motors"]) == 2
        output = capsys.readouterr()
        assert output.out == ""
        assert output.err.count("\n") == 1
        return output.err

    missing = tmp_path / "missing"
    monkeypatch.setenv(VARIABLE, str(missing))
    assert told().startswith(f"motorhil list: {missing}: the directory does not exist.")
    missing.mkdir(mode=0o755)
    assert told().startswith(f"motorhil list: {missing}: mode 0755 gives access to everybody;")
    monkeypatch.setenv(VARIABLE, "here")
    assert told() == f"motorhil list: {VARIABLE}=here: must be an absolute path\n"


def test_invalid_lock_file_does_not_hide_others(runtime, locks, tmp_path, capsys):
    file = tmp_path / "locks" / "can0-node4"
    with locks("can0-node3", "can0 node 3").acquire(runtime, "survey"):
        file.write_bytes(b"a letter")
        file.chmod(0o600)
        assert motorhil(["list", "motors"]) == 2
    output = capsys.readouterr()
    assert output.out.startswith("can0 node 3 ")
    assert output.err == f"motorhil list: {file}: not a lock file; remove it\n"


def test_control_characters_of_programs_are_escaped(runtime, locks, capsys):
    with locks("can0-node3", "can0 node 3").acquire(runtime, "a\nline \x1b[31mred"):
        assert motorhil(["list", "motors"]) == 0
    output = capsys.readouterr().out
    assert " for a?line ?[31mred, since " in output
    assert output.count("\n") == 1
