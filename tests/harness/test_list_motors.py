"""`motorhil list motors` without other processes; tests/wall has those."""

import pytest

from harness.cli import main as motorhil
from motorapi.lock_directory import VARIABLE
from motorapi.process_lock import ProcessLock
from motorapi.wall_runtime import WallRuntime


@pytest.fixture
def runtime():
    wall = WallRuntime()
    yield wall
    wall.close()


def test_motors_of_a_hub_that_is_gone_are_left_out_unless_somebody_has_one(
    runtime, tmp_path, monkeypatch, capsys
):
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
