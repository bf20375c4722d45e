"""Four kinds of drives, each with a protocol of its own, as one group in one virtual time."""

from importlib.resources import files

import pytest

from motorhil import Rig
from motorhil.harness.cli.main import PASSED, main
from motorhil.motorapi import ControlMode, Motor, TrapezoidalTrajectory
from motorhil.traces.digest import digest

RIG = files("motorhil.harness.examples") / "four_protocols.toml"
TARGET = 0.5
WINDOW = 0.006  # of MIT frames, the widest of the four


def moved(path, group):
    """Move a group by 1 rad and back by half; return what was promised and what was measured."""
    with Rig.open(RIG, record=path) as rig:
        motors = rig.groups[group]
        names = rig.description.groups[group].motors
        motors.for_each(Motor.enable)
        motors.for_each(Motor.set_control_mode, ControlMode.TRAJECTORY)
        found = []
        for distance in (1.0, TARGET - 1.0):
            motors.set_trajectory(*[TrapezoidalTrajectory(distance)] * len(names))
            promised = motors.sync_capability()
            motors.start()
            motors.wait_until_done(10)
            found.append((promised, motors.sync_quality()))
        truth = [rig.controllers[name].snapshot()["position_rad"] for name in names]
        motors.for_each(Motor.disable)
    return truth, found


@pytest.fixture(scope="module")
def recording(tmp_path_factory):
    path = tmp_path_factory.mktemp("four") / "arm.mcap"
    return path, moved(path, "arm")


def test_group_of_four_protocols_arrives_together(recording):
    _, (truth, found) = recording
    assert truth == pytest.approx([TARGET] * 4, abs=WINDOW)
    for promised, measured in found:
        assert 0.0 < measured.command_skew_s <= promised.command_skew_s < 0.2
        assert measured.start_skew_s < 0.001
        assert len({one for one, times in measured.times if times.started_ns}) == 4


def test_command_skew_of_three_protocols_is_bounded(tmp_path):
    truth, found = moved(tmp_path / "on_can.mcap", "on_can")
    assert truth == pytest.approx([TARGET] * 3, abs=WINDOW)
    for promised, measured in found:
        assert 0.0 < measured.command_skew_s <= promised.command_skew_s < 0.002


def test_same_seed_gives_the_same_recording_of_four(recording, tmp_path):
    path, _ = recording
    moved(tmp_path / "again.mcap", "arm")
    assert digest(tmp_path / "again.mcap") == digest(path)


def test_recording_of_four_is_sound_and_replays(recording, capsys):
    path, _ = recording
    assert main(["judge", str(path)]) == PASSED
    assert main(["replay", str(path), "--as", "host", "--rig", str(RIG)]) == PASSED
    assert "0 differences, 0 times waited in vain" in capsys.readouterr().out
