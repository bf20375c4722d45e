"""Rigs of motors that need no bus, and mixed rigs."""

import json

import pytest

from motorhil.harness.rig.config.scaffold import EXAMPLES
from motorhil.harness.rig.config.toml import RigError
from motorhil.harness.rig.rig import Rig
from motorhil.motorapi import ControlMode, TrapezoidalTrajectory
from motorhil.traces.digest import digest
from motorhil.traces.mcap.reader import read_trace

MODEL = "velocity_max_rad_s = 2.0\nacceleration_max_rad_s2 = 4.0\n"
IDEAL = f"""\
[rig]
name = "ideal"
[motor.left]
adaptation = "ideal"
axis = "shaft"
position_rad = 0.25
[motor.left.model]
{MODEL}
[motor.also_left]
adaptation = "ideal"
axis = "shaft"
[motor.also_left.model]
{MODEL}
"""
MIXED = (
    IDEAL
    + """\
[bus.can0]
bitrate_bit_s = 1_000_000
[controller.right]
kind = "cia402"
bus = "can0"
node_id = 1
plant = { preset = "wheel_60w" }
[motor.right]
adaptation = "cia402"
controller = "right"
[motor.right.model]
velocity_max_rad_s = 2.0
acceleration_max_rad_s2 = 4.0
increments_per_rad = 21008.452488130184
velocity_unit_rad_s = 4.7599888690754445e-05
acceleration_unit_rad_s2 = 4.7599888690754445e-05
[group.both]
motors = ["left", "right"]
"""
)


@pytest.fixture
def folder(tmp_path):
    (tmp_path / "ideal.toml").write_text(IDEAL)
    (tmp_path / "mixed.toml").write_text(MIXED)
    return tmp_path


def move(rig):
    motor = rig.motors["left"]
    motor.set_control_mode(ControlMode.TRAJECTORY)
    motor.set_trajectory(TrapezoidalTrajectory(1.0))
    motor.start()
    motor.wait_until_done()


def test_rig_without_a_bus_moves_its_motors_in_virtual_time(folder):
    with Rig.open(folder / "ideal.toml") as rig:
        move(rig)
        assert rig.runtime.now_ns() == 1_000_000_000  # 1 rad, accelerating and braking at 4 rad/s^2
        assert rig.motors["left"].position() == rig.motors["also_left"].position() == 1.25
        assert rig.motors["left"].hardware is rig.motors["also_left"].hardware


def test_record_of_a_rig_without_a_bus_has_one_digest(folder):
    digests = []
    for name in ("a.mcap", "b.mcap"):
        with Rig.open(folder / "ideal.toml", record=folder / name) as rig:
            rig.motors["left"].enable()
            rig.runtime.run_for(1.0)  # at rest
            move(rig)
        digests.append(digest(folder / name))
    assert digests[0] == digests[1]
    with read_trace(folder / "a.mcap") as trace:
        topics = [channel.topic for channel, _, _ in trace.messages()]
    assert topics.count("/motor/left/state") >= 50  # 1 s of motion every 20 ms


def test_ideal_motors_and_drives_share_a_rig_and_a_group(folder):
    with Rig.open(folder / "mixed.toml") as rig:
        group = rig.groups["both"]
        for motor in group:
            motor.set_control_mode(ControlMode.TRAJECTORY)
        group.set_trajectory(TrapezoidalTrajectory(1.0), TrapezoidalTrajectory(2.0))
        group.start()
        group.wait_until_done(10)
        assert rig.motors["left"].position() == 1.25
        assert abs(rig.motors["right"].position() - 2.0) < 0.01
        assert group.sync_quality().predicted_end_skew_s < 1e-3


@pytest.mark.parametrize(
    ("old", "new", "told"),
    [
        (
            "position_rad = 0.25",
            "position_m = 0.25",
            "6: motor.left.position_m: unknown key (known: name, axis, position_rad,",
        ),
        ("position_rad = 0.25", 'bus = "can0"', "6: motor.left.bus: a motor of adaptation"),
        (
            "position_rad = 0.25",
            "axes = 1",
            "6: motor.left.axes: unknown key (known: name, axis, position_rad,",
        ),
    ],
)
def test_wrong_ideal_motor_setting_is_reported_with_its_line(folder, old, new, told):
    (folder / "ideal.toml").write_text(IDEAL.replace(old, new, 1))
    with pytest.raises(RigError) as caught, Rig.open(folder / "ideal.toml") as rig:
        rig.build_motors()
    assert str(caught.value).startswith(f"{folder / 'ideal.toml'}:{told}")


def test_conflicting_motors_of_one_axis_are_reported_at_second(folder):
    first, axis, second = IDEAL.rpartition('axis = "shaft"\n')
    (folder / "ideal.toml").write_text(f"{first}{axis}position_rad = 1.0\n{second}")
    with pytest.raises(RigError) as caught, Rig.open(folder / "ideal.toml") as rig:
        rig.build_motors()
    told = "13: motor.also_left.axis: axis shaft is used with other settings already"
    assert str(caught.value).startswith(f"{folder / 'ideal.toml'}:{told}")


def test_check_and_list_support_rigs_without_a_bus(folder, say):
    status, out, err = say("check", str(folder / "ideal.toml"))
    assert (status, err) == (0, "")
    assert out.endswith("ideal.toml: ideal: 2 motors\n")
    names = [entry["name"] for entry in json.loads(say("list", "adaptations", "--json")[1])]
    assert "ideal" in names
    examples = json.loads(say("list", "examples", "--json")[1])
    assert "ideal_wheels" in [entry["name"] for entry in examples]


def test_adaptation_that_cannot_be_loaded_is_reported(rig, say):
    points = rig.parent / "site" / "bench-1.0.dist-info" / "entry_points.txt"
    with points.open("a") as file:
        file.write("gone = tests.unit.harness.no_such_module:adaptation\n")
    (rig / "ideal.toml").write_text(IDEAL.replace('"ideal"', '"gone"'))
    status, _, err = say("check", "ideal.toml")
    assert status == 2
    assert err.startswith('ideal.toml:4: motor.left.adaptation: plugin "gone" cannot be loaded')


def test_same_program_moves_examples_with_and_without_drives():
    ends = []
    for name in ("two_wheels", "ideal_wheels"):
        with Rig.open(EXAMPLES / f"{name}.toml") as rig:
            move(rig)
            ends.append(rig.motors["left"].position())
    assert ends == pytest.approx([1.0, 1.0], abs=1e-3)  # a drive's position window


def test_can_bus_in_a_rig_without_a_bus_is_refused(folder, say, monkeypatch):
    monkeypatch.chdir(folder)
    (folder / "script.py").write_text("print(1)\nimport can\ncan.Bus()\n")
    status, out, err = say("run", "ideal.toml", "script.py")
    assert (status, out) == (1, "1\n")
    assert "channel 'none': neither a bus of a rig open in this process (open: none)" in err


def test_serve_of_a_rig_without_a_bus_is_refused(folder, say):
    status, out, err = say("serve", str(folder / "ideal.toml"))
    assert (status, out) == (2, "")
    assert "ideal.toml: the rig has no bus, so there is nothing to serve; motorhil run" in err
    assert err.count("\n") == 1
