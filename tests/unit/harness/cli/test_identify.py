"""The verb `identify`: results, files and errors."""

import json

import pytest

from motorhil.harness.cli.main import main
from motorhil.harness.rig.config.scaffold import EXAMPLES
from motorhil.harness.rig.rig import Rig
from motorhil.motorapi import ControlMode, TrapezoidalTrajectory

TURNS = (0.4, -1.0, 2.5, -4.0, 3.0, -0.6)


def turn(wheel):
    wheel.enable()
    wheel.set_control_mode(ControlMode.TRAJECTORY)
    for distance in TURNS:
        wheel.set_trajectory(TrapezoidalTrajectory(distance))
        wheel.start()
        wheel.wait_until_done(timeout_s=20.0)


@pytest.fixture(scope="module")
def swing(tmp_path_factory):
    """Return a recording in which one of two wheels turns there and back."""
    file = tmp_path_factory.mktemp("swing") / "swing.mcap"
    with Rig.open(EXAMPLES / "two_wheels.toml", record=file) as rig:
        turn(rig.motors["left"])
    return str(file)


def test_inertia_and_friction_of_an_emulated_wheel_are_found(swing, capsys):
    words = ["identify", swing, "--motor", "left", "--truth", "--gear", "66", "--json"]
    assert main(words) == 0
    found = json.loads(capsys.readouterr().out)["parameters"]
    inertia = 0.05 + 66.0**2 * 3.37e-6  # load and rotor of the rig file
    assert found["inertia"]["value"] == pytest.approx(inertia, rel=0.03)
    assert found["coulomb"]["value"] == pytest.approx(66.0 * 4.0e-3, rel=0.05)


def test_the_table_is_that_of_a_plant(swing, tmp_path, capsys):
    out = tmp_path / "plant.toml"
    assert main(["identify", swing, "--motor", "left", "--truth", "-o", str(out)]) == 0
    assert "[plant]\ngear_ratio = 1.0\nrotor_inertia_kg_m2 = 0.06" in out.read_text()
    assert "effort not explained" in capsys.readouterr().out


def test_a_check_judges_another_recording(swing, capsys):
    words = ["identify", swing, "--motor", "left", "--truth", "--check", swing, "--json"]
    assert main(words) == 0
    found = json.loads(capsys.readouterr().out)
    assert found["effort_error_of_check"] == pytest.approx(found["effort_error"])


@pytest.mark.parametrize(
    ("words", "expected"),
    [
        (["--motor", "left"], "holds no torque or force of left in SI units; give --rated"),
        (["--motor", "lift", "--truth"], "has no motor 'lift' (known: left, right)"),
        (["--truth"], "has 2 motors; add --motor, one of: left, right"),
        (["--motor", "right", "--truth"], "has 2 samples of right; at least 200 are needed"),
        (["--motor", "left", "--truth", "--gear", "0"], "--gear: 0.0 is not above 0"),
        (["--motor", "left", "--rated", "-1"], "--rated: -1.0 is not above 0"),
        (["--motor", "left", "--truth", "-o", "/nowhere/plant.toml"], "cannot be written"),
    ],
)
def test_what_cannot_be_identified_is_told_in_a_line(swing, capsys, words, expected):
    assert main(["identify", swing, *words]) == 2
    told = capsys.readouterr().err
    assert expected in told
    assert told.count("\n") == 1


def test_a_missing_recording_is_told(capsys):
    assert main(["identify", "/nowhere.mcap"]) == 2
    assert "/nowhere.mcap" in capsys.readouterr().err


def test_the_picture_has_table_and_curves_and_no_script(swing, tmp_path, capsys):
    page = tmp_path / "left.html"
    words = ["identify", swing, "--motor", "left", "--truth", "--picture", str(page)]
    assert main(words) == 0
    text = page.read_text()
    assert text.count("<svg") == 2
    assert text.count('<g class="recorded">') == text.count('<g class="emulated">') == 2
    assert "<td>inertia</td>" in text
    assert "<script" not in text
    assert "http" not in text.replace("http-equiv", "")


def test_the_inverse_model_alone_has_no_delay(swing, capsys):
    words = ["identify", swing, "--motor", "left", "--truth", "--json"]
    assert main([*words, "--inverse"]) == 0
    assert "delay" not in json.loads(capsys.readouterr().out)["parameters"]
    assert main(words) == 0
    assert "delay" in json.loads(capsys.readouterr().out)["parameters"]


def test_the_identified_plant_in_a_rig_moves_like_the_first_one(swing, tmp_path, capsys):
    """The torque of the emulated plant is nearer to the recorded one than that of another."""
    rig = (EXAMPLES / "two_wheels.toml").read_text()
    begin, end = rig.index("[controller.left.plant]"), rig.index("[controller.right]")
    plant = '[controller.left.plant]\npreset = "wheel_60w"\nfile = "plant.toml"\n\n'
    (tmp_path / "rig.toml").write_text(rig[:begin] + plant + rig[end:])
    (tmp_path / "wheel_model.toml").write_text((EXAMPLES / "wheel_model.toml").read_text())
    words = ["identify", swing, "--motor", "left", "--truth", "--gear", "66"]
    assert main([*words, "-o", str(tmp_path / "plant.toml")]) == 0
    shares = []
    for factor in (1.0, 1.5):
        text = (tmp_path / "plant.toml").read_text()
        key = "rotor_inertia_kg_m2 = "
        number = float(text.partition(key)[2].partition("\n")[0])
        (tmp_path / "plant.toml").write_text(
            text.replace(f"{key}{number:.6g}", f"{key}{factor * number:.6g}")
        )
        file = tmp_path / f"{factor}.mcap"
        with Rig.open(tmp_path / "rig.toml", record=file) as opened:
            turn(opened.motors["left"])
        capsys.readouterr()
        assert main(["diff", "--motions", swing, str(file), "--json"]) == 0
        (left, *_) = json.loads(capsys.readouterr().out)["motors"]
        shares.append({one["quantity"]: one["share"] for one in left["distances"]})
    assert shares[0]["torque"] < 0.1
    assert shares[1]["torque"] > 0.2
    assert shares[1]["position"] < 0.01  # it proves nothing


def test_motions_without_a_common_motor_are_not_judged(swing, capsys):
    assert main(["diff", "--motions", swing, str(EXAMPLES / "none.mcap")]) == 2
    assert "none.mcap" in capsys.readouterr().err
