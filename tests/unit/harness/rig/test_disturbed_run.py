"""A disturbed run (noise, errors, CAN FD, bus-off), read by every verb.

The run is made twice, by processes with different hash seeds.
"""

import re
from dataclasses import dataclass
from pathlib import Path

import pytest

from motorhil.harness.recording.conversion import convert
from motorhil.harness.rig.config.scaffold import write_new_rig
from motorhil.traces import can_frame
from motorhil.traces.digest import digest
from motorhil.traces.formats.frames import Findings
from motorhil.traces.formats.registry import Feature, open_source
from motorhil.traces.schema import Direction
from tests.support.parallel_runs import outputs, start
from tests.support.recordings.formats import WRITTEN, in_order_of

FAULTS = """
[bus.can0.node.left]
frames = "fd_tolerant"
[bus.can0.node.right]
frames = "fd_tolerant"
[bus.can0.node.ear]
silent = true
frames = "fd"

[[fault]]
bus = "can0"
kind = "noise"
bit_error_rate = 1e-4

[[fault]]
bus = "can0"
kind = "error"
error = "crc"
probability = 0.05

[[fault]]
bus = "can0"
kind = "error"
error = "bit"
sender = "right"
from_s = 1.0
limit = 32
"""
SCRIPT = """
import time
from contextlib import closing

import can

from motorhil.motorapi import (
    ControlMode, LinkError, Motor, MotorGroup, MotorModel, TrapezoidalTrajectory
)
from motorhil.motorapi.adaptations.cia402.motor import Cia402HwMotor, Cia402Motor

MODEL = MotorModel.load("wheels/wheel_model.toml")
with (
    can.Bus() as bus,
    can.Bus(fd=True) as fd,
    closing(Cia402HwMotor(bus, node_id=1)) as one,
    closing(Cia402HwMotor(bus, node_id=2)) as two,
):
    sized = can.Message(
        arbitration_id=0x321, is_extended_id=False, is_fd=True, bitrate_switch=True, data=bytes(64)
    )
    task = fd.send_periodic(sized, 0.05)
    left, right = Cia402Motor(one, MODEL, name="left"), Cia402Motor(two, MODEL, name="right")
    both = MotorGroup(left, right)
    for attempt in (1, 2):
        both.for_each(Motor.set_control_mode, ControlMode.TRAJECTORY)
        both.set_trajectory(TrapezoidalTrajectory(5.0), TrapezoidalTrajectory(4.0))
        both.start()
        try:
            both.wait_until_done(timeout_s=10)
        except LinkError as error:
            print(error)
            time.sleep(1.0)
            right.reset_fault()
    print(f"attempt {attempt}:", [f"EMCY {one.code:04X}h" for one in two.emergencies][:3])
    both.for_each(Motor.disable)
    task.stop()
"""
RUN = ("run", "wheels/rig.toml", "drive.py", "-o", "run.mcap")


@dataclass(frozen=True)
class Runs:
    folder: Path
    other: Path
    said: list[str]


@pytest.fixture(scope="module")
def runs(tmp_path_factory):
    """Run the rig twice; return both folders and the outputs."""
    folders = [tmp_path_factory.mktemp("disturbed") / name for name in ("run", "again")]
    started = []
    for number, folder in enumerate(folders):
        write_new_rig(folder / "wheels")
        rig = folder / "wheels/rig.toml"
        rate = "bitrate_bit_s = 1_000_000\n"
        text = rig.read_text().replace(rate, rate + "data_bitrate_bit_s = 4_000_000\n", 1)
        rig.write_text(text + FAULTS)
        (folder / "drive.py").write_text(SCRIPT)
        started.append(start(folder, number, *RUN))
    return Runs(folders[0], folders[1], outputs(started))


@pytest.fixture(autouse=True)
def here(runs, monkeypatch):
    monkeypatch.chdir(runs.folder)


def frames_of(path):
    return list(open_source(path).frames(Findings()))


def kinds_of(frames):
    """Return the numbers of error messages, CAN FD frames, and all frames."""
    errors = sum(bool(one.frame[3] & 0x20) for one in frames)
    return errors, sum(len(one.frame) == 72 for one in frames), len(frames)


def test_one_seed_with_many_errors_gives_one_digest(runs):
    errors, sized, count = kinds_of(frames_of("run.mcap"))
    assert errors > 300
    assert sized > 50
    assert count > 1000
    assert digest("run.mcap") == digest(runs.other / "run.mcap")
    assert runs.said[0] == runs.said[1]


def test_show_prints_each_step_into_and_out_of_bus_off(say):
    status, out, _ = say("show", "run.mcap")
    assert status == 0
    at = 0
    for step in (
        r"error frame of right \(2\): error warning by sending \(TEC \d+, REC 0\)",
        r"error frame of right \(2\): error passive by sending \(TEC 1\d\d, REC 0\)",
        r"error frame of right \(2\): bus-off$",
        r"right: recovered from bus-off",
        r"right \(2\) emergency 8140h recovered from bus-off",
        r"right \(2\) is pre-operational",
        r"right \(2\) is operational",
    ):
        found = re.compile(step, re.MULTILINE).search(out, at)
        assert found is not None, step
        at = found.end()
    for error in ("stuff error", "form error", "bus error while sending, in the ACK slot"):
        assert out.count(error) > 5
    assert out.count("CAN FD BRS, 64 bytes") == kinds_of(frames_of("run.mcap"))[1]


def test_host_learns_why_its_motion_ended_and_continues(runs):
    reason, attempts = runs.said[0].splitlines()
    assert re.fullmatch(
        r"can0 node 2: its NMT state is 7Fh \(PRE-OPERATIONAL\), not OPERATIONAL any more, after "
        r"EMCY 8140h at 1\.\d+ s: recovered from bus-off; start\(\) brings it up again",
        reason,
    )
    assert attempts == "attempt 2: ['EMCY 8140h', 'EMCY 0000h']"


def test_judge_checks_every_error_state_change(say):
    status, out, _ = say("judge", "run.mcap")
    assert status == 0
    assert re.search(r"^error-states +held +[4-9]$", out, re.MULTILINE)


def test_report_and_analyse_mention_the_errors(say):
    assert say("report", "run.mcap", "-o", "run.html")[0] == 0
    assert "bus-off" in Path("run.html").read_text()
    errors = kinds_of(frames_of("run.mcap"))[0]
    assert f"{errors} error messages were recorded" in say("analyse", "run.mcap")[1]


def test_recorded_drives_answer_the_program_as_before(runs, say):
    status, out, err = say("run", "run.mcap", "drive.py")
    assert (status, out.splitlines()[1]) == (0, runs.said[0].splitlines()[1])
    assert "all answered as recorded" in err


def test_recorded_host_drives_its_rig_into_bus_off_again(say):
    status, out, _ = say("replay", "run.mcap", "--as", "host")
    assert status == 0
    assert re.search(r"node 2 \(right\), emergency +2 +2 +100\.0 %", out)
    assert "0 differences, 0 times waited in vain" in out


def test_traffic_replay_needs_a_can_fd_bus(say):
    errors, sized, count = kinds_of(frames_of("run.mcap"))
    words = ("replay", "run.mcap", "--as", "traffic", "--speed", "max", "--rig")
    status, out, err = say(*words, "wheels/rig.toml")
    assert status == 0
    assert out.startswith(f"{count - errors} frames of can0 to can0")
    assert f"{errors} error frames of can0 cannot be sent" in err
    rig = Path("wheels/rig.toml").read_text().replace("data_bitrate_bit_s = 4_000_000\n", "", 1)
    Path("wheels/classical.toml").write_text(rig)
    status, out, err = say(*words, "wheels/classical.toml")
    assert (status, out) == (2, "")
    assert f"{sized} frames of can0 are CAN FD, which this bus does not carry" in err


NO_WORDS = can_frame.classic(can_frame.ERR | 0x80, bytes(8))  # a bus error without details


def without(feature, form, one):
    """Return the frame as kept by a format without this feature, or None if it is lost."""
    if feature is Feature.NANOSECONDS:
        return one._replace(time_ns=one.time_ns // 1000 * 1000)
    if feature is Feature.SENDER:
        return one._replace(sender="")
    if feature is Feature.DIRECTION:
        return one._replace(direction=Direction.UNKNOWN)
    if feature is Feature.ERROR_FRAMES and one.frame[3] & 0x20:
        told = one._replace(frame=NO_WORDS, direction=Direction.UNKNOWN)
        return told if form.name == "asc" else None
    return one


@pytest.mark.parametrize("form", WRITTEN)
def test_conversion_keeps_or_reports_every_feature(form):
    there = convert("run.mcap", f"run{form.ending}", form.name)
    back = f"{form.name}.mcap"
    convert(f"run{form.ending}", back, "mcap")
    frames = frames_of("run.mcap")
    errors, _, count = kinds_of(frames)
    finer = sum(one.time_ns % 1000 > 0 for one in frames)
    counts = {Feature.NANOSECONDS: finer, Feature.SENDER: count, Feature.ERROR_FRAMES: errors}
    counts[Feature.DIRECTION] = sum(one.direction is not Direction.UNKNOWN for one in frames)
    lost = {one: number for one, number in counts.items() if one not in form.holds}
    order = there.lost.pop(Feature.ORDER, 0)
    assert order == 0 or Feature.ORDER not in form.holds
    assert there.lost == lost
    for feature in lost:
        frames = [one for one in (without(feature, form, one) for one in frames) if one]
    assert frames_of(back) == in_order_of(form.holds, frames)
