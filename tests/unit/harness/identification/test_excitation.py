"""Excitation of a motor: its moves, and the application that makes them."""

import json

import pytest

from motorhil.harness.cli.main import main
from motorhil.harness.identification.excitation import middle_of, moves_of
from motorhil.motorapi.model import MotorModel

INERTIA = 0.05 + 66.0**2 * 3.37e-6  # load and rotor of the rig file
COULOMB = 66.0 * 4.0e-3
VISCOUS = 66.0**2 * 1.0e-6


@pytest.fixture
def wheels(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    assert main(["new", "wheels"]) == 0
    capsys.readouterr()
    return tmp_path / "wheels"


def test_moves_are_within_the_limits_of_the_model():
    model = MotorModel(velocity_max=6.0, acceleration_max=20.0, deceleration_max=15.0)
    moves = moves_of(model)
    assert max(one.velocity for one in moves) == pytest.approx(0.9 * 6.0)
    assert max(one.acceleration for one in moves) == pytest.approx(0.9 * 15.0)
    assert all(one.velocity / one.acceleration >= 0.1 - 1e-3 for one in moves)
    assert middle_of(model) is None


def test_moves_stay_in_a_limited_range_around_its_middle():
    model = MotorModel(velocity_max=6.0, acceleration_max=20.0, position_min=-0.2, position_max=0.6)
    assert middle_of(model) == pytest.approx(0.2)
    moves = moves_of(model)
    assert max(one.distance for one in moves) <= 0.4
    assert all(one.velocity**2 / one.acceleration <= one.distance for one in moves)


def test_the_recording_of_the_application_identifies_the_axis(wheels, capsys):
    """A CiA 402 drive tells 6064h and 6077h in PDOs, and its rated torque, 6076h."""
    assert main(["new", "wheels", "--excite", "left"]) == 0
    printed = capsys.readouterr()
    assert printed.out == "wheels/excite_left.py\n"
    command = "motorhil run wheels/rig.toml wheels/excite_left.py -o wheels/left.mcap"
    assert printed.err == f"next: {command}\n"
    assert main(command.split()[1:]) == 0
    identify = ["identify", "wheels/left.mcap", "--motor", "left", "--gear", "66", "--json"]
    capsys.readouterr()
    assert main(identify) == 0
    found = json.loads(capsys.readouterr().out)
    assert found["source"] == "6064h on the bus, 6077h on the bus"
    values = found["parameters"]
    assert values["inertia"]["value"] == pytest.approx(INERTIA, rel=0.01)
    assert values["coulomb"]["value"] == pytest.approx(COULOMB, rel=0.02)
    viscous = values["viscous"]
    assert abs(viscous["value"] - VISCOUS) < 2.0 * viscous["deviation"]
    constant = found["torque_constant"]
    assert constant["value"] == pytest.approx(0.0259, rel=0.02)  # of the rig file
    assert abs(constant["value"] - 0.0259) < 3.0 * constant["deviation"]
    assert found["plant"]["torque_constant_n_m_a"] == constant["value"]
    assert_a_log_of_the_bus_shows_the_same(values["inertia"]["value"], capsys)


def assert_a_log_of_the_bus_shows_the_same(inertia, capsys):
    """A log of another tool has no rig and no units; --rig gives both."""
    assert main(["convert", "wheels/left.mcap", "-o", "left.log"]) == 0
    words = ["identify", "left.log", "--motor", "left", "--gear", "66", "--inverse", "--json"]
    assert main(words) == 2
    capsys.readouterr()
    assert main([*words, "--rig", "wheels/rig.toml"]) == 0
    found = json.loads(capsys.readouterr().out)["parameters"]
    assert found["inertia"]["value"] == pytest.approx(inertia, rel=0.02)


@pytest.mark.parametrize(
    ("motor", "rig", "expected"),
    [
        ("lift", "", "has no motor 'lift' (left, right)"),
        ("left", 'adaptation = "ideal"\nmodel = "wheel_model.toml"', "driven by 'ideal'; expected"),
    ],
)
def test_motors_that_cannot_be_excited_are_refused(wheels, capsys, motor, rig, expected):
    if rig:
        (wheels / "rig.toml").write_text(f"[motor.left]\n{rig}\n")
    assert main(["new", "wheels", "--excite", motor]) == 2
    told = capsys.readouterr().err
    assert expected in told
    assert told.count("\n") == 1


def test_an_existing_application_is_kept(wheels, capsys):
    assert main(["new", "wheels", "--excite", "left"]) == 0
    (wheels / "excite_left.py").write_text("mine")
    assert main(["new", "wheels", "--excite", "left"]) == 2
    assert "already exists" in capsys.readouterr().err
    assert (wheels / "excite_left.py").read_text() == "mine"
