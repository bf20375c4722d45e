"""A drive that speaks CAN FD only: the kit, a recording, and the recorded host."""

from pathlib import Path

import pytest

from motorhil.harness.cli.main import main
from motorhil.harness.rig.rig import Rig
from motorhil.motorapi import ControlMode
from tests.support.checkout import CHECKOUT

RIG = CHECKOUT / "tests" / "support" / "can" / "fd_drive.toml"
CLAUSES = ("UNIT-01", "MEAS-01", "SET-01", "TRAJ-01", "STOP-01", "SHARE-11", "LOST-11", "BUS-04")


def test_kit_accepts_an_fd_drive_of_six_hooks(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    words = [word for clause in CLAUSES for word in ("--clause", clause)]
    status = main(["conform", "--rig", str(RIG), "--benches", "own", *words])
    assert status == 0, capsys.readouterr().out
    assert f"{len(CLAUSES)} clauses: {len(CLAUSES)} passed" in capsys.readouterr().out


@pytest.fixture
def recording(tmp_path) -> Path:
    path = tmp_path / "fd.mcap"
    with Rig.open(RIG, record=path) as rig:
        motor = rig.motors["left"]
        motor.set_control_mode(ControlMode.SETPOINT)
        motor.set_setpoint(0.5)
        motor.start()
        motor.wait_until_done(timeout_s=5)
        assert motor.position() == pytest.approx(0.5, abs=0.002)  # the window of the rig
    return path


def test_recorded_host_moves_an_fd_drive_again(recording, capsys):
    assert main(["replay", str(recording), "--as", "host", "--rig", str(RIG)]) == 0
    told = capsys.readouterr().out
    assert "id 181h CAN FD" in told
    assert "2 frames of the host sent" in told
    assert "0 differences" in told


def test_frames_of_an_fd_drive_are_shown(recording, capsys):
    assert main(["show", str(recording)]) == 0
    assert "id 201h CAN FD BRS, 20 bytes: 02 02 00 00 " in capsys.readouterr().out
