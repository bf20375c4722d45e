"""Golden recordings: up to date, and replayable in all three ways."""

import shutil

import pytest

from motorhil.harness.cli.main import main
from motorhil.harness.replay.host import DrivenRig, bench_of, compared, drive
from motorhil.harness.replay.rig import with_recorded
from motorhil.harness.replay.verdict import never_came, summary, unanswered
from motorhil.harness.rig.config.rig_file import parse_rig
from motorhil.harness.rig.config.toml import Source
from motorhil.harness.rig.reading import installed_plugins
from motorhil.harness.rig.rig import Rig
from motorhil.traces.digest import digest
from motorhil.traces.schema import decode_can_frame
from motorhil.traces.semantics.diff import Tolerance
from tests.support.golden import GOLDEN, INDEX, described, golden, record, rows
from tests.support.recordings.altered import traffic

DESCRIBED = ("dynamixel", "mit", "moteus", "rmd", "robstride", "vesc")
"""Recordings without CANopen or Modbus."""


@pytest.fixture(params=GOLDEN)
def name(request):
    return request.param


@pytest.fixture(params=[name for name in GOLDEN if name not in DESCRIBED])
def known(request):
    return request.param


def test_golden_recording_equals_a_new_run(name, tmp_path):
    with golden(name) as path:
        record(name, tmp_path / "now.mcap")
        assert digest(tmp_path / "now.mcap") == digest(path), "if that is right: make golden"


def test_index_equals_generated_rows():
    assert INDEX.read_text() == "\n".join(rows()) + "\n", "make golden"


def test_as_device_traffic_equals_the_recording(name, tmp_path):
    """The drives are recorded and the host is live; times agree to the nanosecond."""
    with golden(name) as path:
        again = tmp_path / "again.mcap"
        with Rig(with_recorded(described(name), path), record=again) as rig:
            GOLDEN[name][2](rig)
            assert unanswered(rig) == []
            assert never_came(rig) == []
            (line,) = summary(rig)
            assert "all answered as recorded" in line
        assert traffic(again) == traffic(path)


def test_recording_opened_as_rig_answers_completely(name, tmp_path):
    with golden(name) as path:
        moved = shutil.copy(path, tmp_path / "bench.mcap")
        with Rig.open(moved) as rig:
            GOLDEN[name][2](rig)
            assert unanswered(rig) == []


def test_as_host_objects_agree_with_the_recording(known, tmp_path):
    with golden(known) as path:
        live = tmp_path / "live.mcap"
        with Rig(described(known), record=live) as rig:
            player = drive(DrivenRig(rig), path).player
        objects, differing = compared(path, live, player.pairs, Tolerance())
        if known == "overload":  # the frames do not show the missing load
            assert any("emergency" in one.label for one in differing)
            assert any("6041h" in one.awaited.subject[2] for one in player.missed)
            return
        assert player.missed == []
        assert differing == []
        assert objects
        assert {one.label: one.share for one in objects if one.share < 1.0} == {}


def replayed(name, path, live, more=""):
    """Replay the host on the recording's rig with more text; return objects and differences."""
    text = GOLDEN[name][1] + more
    rig_file = Source(path.parent / "rig.toml", text)
    with Rig(parse_rig(rig_file, installed_plugins()), record=live) as rig:
        bench = bench_of(rig.description)
        done = drive(DrivenRig(rig), path, bench=bench)
    assert done.notes == []
    return compared(path, live, done.player.pairs, Tolerance(), done.reading)


@pytest.mark.parametrize("name", DESCRIBED)
def test_as_host_messages_of_other_kinds_agree_with_the_recording(name, tmp_path):
    with golden(name) as path:
        objects, differing = replayed(name, path, tmp_path / "live.mcap")
    assert differing == []
    assert {one.label: one.share for one in objects if one.share < 1.0} == {}
    labels = [one.label for one in objects if one.is_compared and one.worst is not None]
    assert sum("left" in label for label in labels) >= 1  # its position
    assert sum("right" in label for label in labels) >= 1
    assert sum(one.of for one in objects) > 400


@pytest.mark.parametrize("name", DESCRIBED)
def test_as_host_load_on_a_drive_of_another_kind_is_a_difference(name, tmp_path):
    """The left motor is turned away by a load of which the recording has nothing."""
    load = '[[stimulus]]\ncontroller = "left"\nname = "load_torque_n_m"\nvalue = 40.0\nat_s = 0.8\n'
    with golden(name) as path:
        _, differing = replayed(name, path, tmp_path / "live.mcap", load)
    units = ("[rad]", "[deg]", "[rev]", "[count]")
    assert any(unit in one.label for one in differing for unit in units)
    assert all("node 1 (left)" in one.label for one in differing)
    assert all(one.time_ns > 790_000_000 for one in differing)


def test_as_traffic_frames_keep_order_and_times(name, tmp_path, capsys):
    """A frame is sent at its recorded end, and a longer frame may delay it."""
    bench, live = tmp_path / "bench.toml", tmp_path / "live.mcap"
    bench.write_text(
        "[bus.bench]\nbitrate_bit_s = 1_000_000\ndata_bitrate_bit_s = 5_000_000\n"
        'node.ear = { silent = true, frames = "fd" }\n'
    )
    with golden(name) as path:
        words = ["replay", str(path), "--as", "traffic", "--on", "can0=bench"]
        status = main([*words, "--rig", str(bench), "-o", str(live)])
        recorded = traffic(path)
        if "/can/can0" not in recorded:
            assert status == 2
            assert "holds no CAN frame to send" in capsys.readouterr().err
            return
        assert status == 0
        sent = recorded["/can/can0"]
    heard = traffic(live)["/can/bench"]
    before, after = ([decode_can_frame(data).frame for _, data in all_] for all_ in (sent, heard))
    assert before == after
    began_ns = heard[0][0] - sent[0][0]
    late = [there - here - began_ns for (here, _), (there, _) in zip(sent, heard, strict=True)]
    assert -135_000 < min(late) <= max(late) < 2 * 135_000  # the longest frame, at 1 Mbit/s
