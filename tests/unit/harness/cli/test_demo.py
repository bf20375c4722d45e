"""Tests of `motorhil demo`: the whole tool on the paper's manoeuvre."""

import re
from functools import reduce

import pytest

from motorhil.harness.cli.demo import POINT_M
from motorhil.harness.cli.main import main
from motorhil.harness.examples.rover import MANOEUVRE, Rover, manoeuvre
from motorhil.harness.examples.rover_kinematics import Pose, look_at
from motorhil.harness.rig.config.rig_file import parse_rig
from motorhil.harness.rig.config.scaffold import EXAMPLES
from motorhil.harness.rig.config.toml import Source
from motorhil.harness.rig.reading import installed_plugins
from motorhil.harness.rig.rig import Rig
from motorhil.traces.mcap.reader import read_trace


def demo(capsys, *words):
    status = main(["demo", *map(str, words)])
    told = capsys.readouterr()
    return status, told.out, told.err


def rows_after(out, head):
    """Return the rows of the table that begins with this word, as lists of words."""
    lines = out.splitlines()
    first = next(n for n, line in enumerate(lines) if line.startswith(head + " "))
    rows = []
    for line in lines[first + 1 :]:
        if not line.strip():
            break
        rows.append(line.split())
    return rows


def test_fourteen_motors_arrive_together_in_one_record(capsys, tmp_path):
    record = tmp_path / "out" / "demo.mcap"
    status, out, err = demo(capsys, "-o", record)
    assert status == 0
    assert [re.search(r"s  (\w+)", line)[1] for line in err.splitlines()] == [
        *("switched", "arc", "crab", "turn")
    ]
    motors = rows_after(out, "motor")
    assert len(motors) == 14
    for _, target, reached, error_mrad, moved_s, peak_inc in motors:
        assert float(target) == pytest.approx(float(reached), abs=1e-4)  # printed with 4 decimals
        assert abs(float(error_mrad)) < 0.1  # an increment is 0.05 mrad
        assert float(moved_s) > 0.0
        assert float(peak_inc) < 200
    for _, frames, load, peak, *_ in rows_after(out, "bus"):
        assert int(frames) > 1000
        assert 0.0 < float(load.rstrip("%")) < float(peak.rstrip("%")) < 100.0
    for _, moves, level, bound, start, _, end in rows_after(out, "group"):
        assert int(moves) >= 3
        assert level == "TRIGGERED"
        assert float(start) <= float(bound)  # within the promised bound
        assert float(end) < 25.0  # statuswords arrive every 20 ms, or on change
    # tests/properties/determinism/test_demo.py compares two runs in two processes.
    assert re.search(r"digest [0-9a-f]{64} \(seed 7\)", out)
    with read_trace(record) as trace:
        topics = {channel.topic for channel, _, _ in trace.messages()}
    assert {"/can/can0", "/can/can1", "/motor/pan/state", "/controller/drive_fl/truth"} <= topics


# Largest error at the end [mrad], and while following [increments]. For drives: position window and
# fast loops. For the host's servo: ten increments of 0.05 mrad, and poles at 50 rad/s.
KINDS = {"rocky8": (0.1, 200, "TRIGGERED"), "fido": (0.5, 100, "CYCLIC")}


@pytest.mark.parametrize("name", KINDS)
def test_the_same_application_drives_a_distributed_and_a_central_rover(capsys, tmp_path, name):
    error_max_mrad, peak_max_inc, level = KINDS[name]
    record = tmp_path / "demo.mcap"
    status, out, err = demo(capsys, "--rig", name, "-o", record)
    assert status == 0, err
    motors = {row[0]: row for row in rows_after(out, "motor")}
    assert list(motors) == list(MOTORS)
    for motor, (_, target, _, error_mrad, _, peak_inc) in motors.items():
        assert float(target) == pytest.approx(MOTORS[motor], abs=2e-3)  # from its true position
        assert abs(float(error_mrad)) < error_max_mrad
        assert 0 < float(peak_inc) < peak_max_inc
    for _, _, how, bound, start, *_ in rows_after(out, "group"):
        assert how == level
        assert float(start) <= float(bound)


@pytest.mark.nightly  # golden recordings require the same of each kind of hardware
@pytest.mark.parametrize("words", [("--rig", "rocky8"), ("--rig", "fido"), ("--mast", "modbus")])
def test_repeated_manoeuvre_has_the_same_digest(capsys, tmp_path, words):
    told = [demo(capsys, *words, "-o", tmp_path / f"{n}.mcap")[1] for n in range(2)]
    first, again = (re.search(r"digest ([0-9a-f]{64})", out)[1] for out in told)
    assert again == first


# End of the manoeuvre by the rover's geometry alone [rad]: rolled distance and final steering of
# each wheel, and the mast's view of the point, which needs no hardware.
_KINEMATICS = {
    name: [leg.wheel(name) for leg in MANOEUVRE] for name in ("fl", "fr", "ml", "mr", "rl", "rr")
}
_POSE = reduce(lambda pose, leg: leg.pose_after(pose, 1.0), MANOEUVRE, Pose())
MOTORS = {
    **{f"drive_{n}": sum(roll for _, roll in legs) for n, legs in _KINEMATICS.items()},
    **{f"steer_{n}": legs[-1][0] for n, legs in _KINEMATICS.items()},
    **dict(zip(("pan", "tilt"), look_at(_POSE, POINT_M), strict=True)),
}


def test_ideal_motors_end_exactly_where_geometry_says():
    models = {"drive": "rover_wheel", "steer": "rover_steering", "pan": "rover_mast"}
    text = "".join(
        f'[motor.{name}]\nadaptation = "ideal"\n'
        f'model = "{models.get(name.split("_")[0], "rover_mast")}.toml"\n'
        for name in MOTORS
    )
    groups = (EXAMPLES / "rover.toml").read_text().partition("[group.wheels]")
    source = Source(EXAMPLES / "ideal_rover.toml", text + groups[1] + groups[2])
    with Rig(parse_rig(source, installed_plugins())) as rig:
        rover = Rover(rig.groups["wheels"], rig.groups["steering"], rig.groups["mast"])
        manoeuvre(rover, rig.runtime, POINT_M, lambda text: None)
        for name, motor in rig.motors.items():
            assert motor.position() == pytest.approx(MOTORS[name], abs=1e-12), name
        for move in rover.moves:
            assert move.quality.start_skew_s in (0.0, None)  # None: no motor had to move
            assert move.quality.end_skew_s in (0.0, None)


def test_eds_option_for_a_rig_without_drives_is_refused(capsys, tmp_path):
    words = ("--rig", "fido", "--eds", EXAMPLES / "fido.toml", "-o", tmp_path / "x.mcap")
    status, out, err = demo(capsys, *words)
    assert (status, out) == (2, "")
    assert "fido.toml: has no drives; use --eds with another --rig" in err


def test_repeat_command_names_the_rig(capsys, tmp_path, monkeypatch):
    monkeypatch.setattr("motorhil.harness.cli.demo.ERROR_MAX_RAD", 0.0)
    status, _, err = demo(capsys, "--rig", "rocky8", "-o", tmp_path / "x.mcap")
    assert status == 1
    assert err.splitlines()[-1].endswith("--rig rocky8")


@pytest.mark.data
def test_two_vendors_drives_do_the_same_manoeuvre(capsys, tmp_path, shared):
    files = [
        shared / "data/eds" / name for name in ("nanotec_C5-E-2-09.eds", "maxon_epos2_50_5.eds")
    ]
    status, out, _ = demo(
        capsys, "--eds", files[0], "--eds", files[1], "-o", tmp_path / "vendors.mcap"
    )
    assert status == 0
    for _, target, reached, *_ in rows_after(out, "motor"):
        assert float(target) == pytest.approx(float(reached), abs=2e-3)


@pytest.mark.parametrize(
    ("words", "reason"),
    [
        (("--eds", "no-such.eds"), "no-such.eds: no such EDS file"),
        (("--eds", str(EXAMPLES / "rover.toml")), "rover.toml"),
        (("-o", "/proc/no/such/folder/demo.mcap"), "/proc/no/such/folder"),
    ],
)
def test_unusable_option_is_reported_in_one_line(capsys, tmp_path, words, reason):
    output = () if "-o" in words else ("-o", tmp_path / "x.mcap")
    status, out, err = demo(capsys, *words, *output)
    assert (status, out) == (2, "")
    assert reason in err
    assert err.count("\n") == 1


def test_invalid_seed_is_wrong_usage(capsys):
    status, out, err = demo(capsys, "--seed", "-1")
    assert (status, out) == (2, "")
    assert "argument --seed: invalid seed (0 to 4294967295) value: '-1'" in err


def test_position_error_fails_the_demo_with_repeat_command(capsys, tmp_path, monkeypatch):
    monkeypatch.setattr("motorhil.harness.cli.demo.ERROR_MAX_RAD", 0.0)
    record = tmp_path / "a b.mcap"
    status, _, err = demo(capsys, "-o", record, "--seed", "3")
    assert status == 1
    assert err.splitlines()[-1] == f"again: motorhil demo --seed 3 -o '{record}'"
