"""Four kinds of drives, each with a protocol of its own, as one group in one virtual time."""

from importlib.resources import files

import pytest

from motorhil import Rig
from motorhil.harness.cli.main import PASSED, main
from motorhil.harness.replay.rig import with_recorded
from motorhil.harness.replay.verdict import never_came, unanswered
from motorhil.harness.rig.reading import describe
from motorhil.motorapi import ControlMode, Motor, TrapezoidalTrajectory
from motorhil.traces.digest import digest
from tests.support.recordings.altered import traffic

RIG = files("motorhil.harness.examples") / "four_protocols.toml"
TARGET = 0.5
WINDOW = 0.006  # of MIT frames, the widest of the four
TOPICS = {"/can/can0", "/can/can1", "/can/fd0", "/serial/line"}


def moved(rig, group):
    """Move a group by 1 rad and back by half; return what was promised and what was measured."""
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
    truth = [rig.controllers[name].snapshot().get("position_rad") for name in names]
    motors.for_each(Motor.disable)
    return truth, found


def recorded(path, group="arm"):
    with Rig.open(RIG, record=path) as rig:
        return moved(rig, group)


@pytest.fixture(scope="module")
def recording(tmp_path_factory):
    path = tmp_path_factory.mktemp("four") / "arm.mcap"
    return path, recorded(path)


def test_group_of_four_protocols_arrives_together(recording):
    _, (truth, found) = recording
    assert truth == pytest.approx([TARGET] * 4, abs=WINDOW)
    for promised, measured in found:
        assert 0.0 < measured.command_skew_s <= promised.command_skew_s < 0.2
        assert measured.start_skew_s < 0.001
        assert len({one for one, times in measured.times if times.started_ns}) == 4


def test_command_skew_of_three_protocols_is_bounded(tmp_path):
    truth, found = recorded(tmp_path / "on_can.mcap", "on_can")
    assert truth == pytest.approx([TARGET] * 3, abs=WINDOW)
    for promised, measured in found:
        assert 0.0 < measured.command_skew_s <= promised.command_skew_s < 0.002


def test_same_seed_gives_the_same_recording_of_four(recording, tmp_path):
    path, _ = recording
    recorded(tmp_path / "again.mcap")
    assert digest(tmp_path / "again.mcap") == digest(path)


def test_recording_of_four_is_sound_and_replays(recording, tmp_path, capsys):
    path, _ = recording
    live = tmp_path / "live.mcap"
    assert main(["judge", str(path)]) == PASSED
    words = ["replay", str(path), "--as", "host", "--rig", str(RIG), "-o", str(live)]
    assert main(words) == PASSED
    told = capsys.readouterr().out
    assert "0 differences, 0 times waited in vain" in told
    assert "line, node 1 (wrist), Status Present_Position [count]" in told
    assert {topic: len(all_) for topic, all_ in traffic(live).items()}.keys() == TOPICS


def test_recording_of_four_stands_in_for_its_drives(recording, tmp_path):
    """The host is live again: all buses and lines carry the same, to the nanosecond."""
    path, (_, found) = recording
    again = tmp_path / "again.mcap"
    with Rig(with_recorded(describe(RIG), path), record=again) as rig:
        assert moved(rig, "arm")[1] == found
        assert unanswered(rig) == []
        assert never_came(rig) == []
    assert traffic(again).keys() == TOPICS
    assert traffic(again) == traffic(path)
