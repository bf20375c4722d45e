import can
import pytest

from motorhil.harness.rig.config.scaffold import EXAMPLES
from motorhil.harness.rig.config.toml import RigError
from motorhil.harness.rig.rig import Rig
from motorhil.motorapi import ControlMode, Motor, TrapezoidalTrajectory
from motorhil.traces.digest import digest
from motorhil.traces.mcap.reader import read_trace
from motorhil.traces.protobuf import decode
from motorhil.traces.schema import GROUP_SYNC
from tests.support.plugin_rigs import FAULT, GOOD, WHEEL

LOSSY = (
    GOOD.replace("node_id = 2", 'node_id = 2\neds = "drive.eds"') + FAULT + "probability = 0.5\n"
)


@pytest.fixture
def rig(bench):
    (bench / "rig.toml").write_text(LOSSY)
    (bench / "wheel.toml").write_text(WHEEL)
    (bench / "drive.eds").write_text("[FileInfo]\n")
    return bench / "rig.toml"


def recorded(rig, target, seed=None):
    with Rig.open(rig, seed=seed, record=target) as opened:
        bus = opened.bus("can0")
        for number in range(20):
            bus.send(can.Message(arbitration_id=0x101, data=[number], is_extended_id=False))
            opened.runtime.run_for(0.1)
        opened.controllers["left"].stimulate("load_torque_n_m", 0.5)
        opened.runtime.run_for(0.1)
    return target


def test_record_holds_frames_truth_and_events_with_times(rig, tmp_path):
    with read_trace(recorded(rig, tmp_path / "run.mcap")) as trace:
        messages = list(trace.messages())
    topics = [channel.topic for channel, _, _ in messages]
    # A boot-up of each controller, 20 requests and 20 answers: a frame that was received, or an
    # event that it was dropped.
    dropped = sum(b"drop" in data for c, _, data in messages if c.topic == "/events")
    assert topics.count("/can/can0") + dropped == 2 + 20 + 20
    assert 0 < dropped < 20
    assert topics.count("/controller/left/truth") == 3  # at the start, held, and after the stimulus
    assert topics.count("/controller/right/truth") == 1
    assert 2 < topics.count("/events") < 18
    assert b"drive.eds:3: mended" in next(data for c, _, data in messages if c.topic == "/events")
    times = [time_ns for _, time_ns, _ in messages]
    assert times[0] == 0
    assert max(times) == 2_000_000_000 + 20_000_000


def test_record_contains_seed_and_files_of_the_run(rig, tmp_path):
    with read_trace(recorded(rig, tmp_path / "run.mcap", seed=5)) as trace:
        assert trace.metadata["run"]["seed"] == "5"
        assert len(trace.metadata["run"]["rig_digest"]) == 64
        attached = {attachment.name: attachment.data for attachment in trace.attachments}
    assert list(attached) == ["rig.toml", "wheel.toml", "drive.eds"]
    assert attached["rig.toml"] == LOSSY.encode()


def test_one_seed_gives_one_record(rig, tmp_path):
    first = digest(recorded(rig, tmp_path / "1.mcap"))
    assert digest(recorded(rig, tmp_path / "2.mcap")) == first
    assert digest(recorded(rig, tmp_path / "3.mcap", seed=8)) != first


def test_used_motor_is_recorded_under_its_name(rig, tmp_path):
    with Rig.open(rig, record=tmp_path / "run.mcap") as opened:
        assert opened.motors["left"].name == "left"
        opened.runtime.run_for(0.1)
    with read_trace(tmp_path / "run.mcap") as trace:
        assert "/motor/left/state" in {channel.topic for channel in trace.channels.values()}


def test_record_is_complete_when_the_run_fails(rig, tmp_path):
    def fail_in_the_middle():
        with Rig.open(rig, record=tmp_path / "run.mcap") as opened:
            opened.runtime.run_for(0.5)
            raise ZeroDivisionError

    with pytest.raises(ZeroDivisionError):
        fail_in_the_middle()
    with read_trace(tmp_path / "run.mcap") as trace:
        assert trace.cut is None
        assert [channel.topic for channel, _, _ in trace.messages()].count("/can/can0") == 2


def test_unwritable_record_is_refused_and_nothing_stays_open(rig, tmp_path):
    target = tmp_path / "no" / "run.mcap"
    with pytest.raises(RigError) as caught, Rig.open(rig, record=target):
        pass
    assert str(caught.value).startswith(f"{target}: ")
    with Rig.open(rig):
        pass


def test_skew_of_a_group_is_recorded_as_reported(tmp_path):
    record = tmp_path / "run.mcap"
    with Rig.open(EXAMPLES / "two_wheels.toml", record=record) as rig:
        both = rig.groups["both"]
        both.for_each(Motor.set_control_mode, ControlMode.TRAJECTORY)
        both.set_trajectory(TrapezoidalTrajectory(0.5), TrapezoidalTrajectory(1.0))
        both.start()
        both.wait_until_done(5.0)
        quality = both.sync_quality()
    with read_trace(record) as trace:
        start, end = (
            decode(GROUP_SYNC, data)
            for c, _, data in trace.messages()
            if c.topic == "/group/both/sync"
        )
    assert (start["phase"], end["phase"]) == (1, 2)
    assert start["motor"] == end["motor"] == ["left", "right"]
    assert start.get("skew_s", 0.0) == quality.start_skew_s
    assert end["skew_s"] == quality.end_skew_s == max(end["offset_s"])
    assert end.get("predicted_skew_s", 0.0) == quality.predicted_end_skew_s
