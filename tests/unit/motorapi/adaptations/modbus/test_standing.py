"""Knowledge of a Modbus drive expires with its owner or its power."""

import pytest

from motorhil.emulators.media.serial_faults import SerialFaultKind, SerialFaultRule
from motorhil.motorapi import ControlMode, MotorState
from motorhil.motorapi.errors import PeerError
from tests.support.modbus.rigs import ADAPTATIONS, opened, run_s, text, truth

RESOLUTION = 0.004  # rad: two steps of the coarser drive, which counts half as many here
# Registers of the steps per turn, and their values for half as many steps.
COARSER = {"leadshine": (0x0001, (5000,)), "oriental_az": (0x0380, (0, 2))}
QUICK_RAMP = 0x6017
ONE_IS_LOST = SerialFaultRule("lost", SerialFaultKind.LOSE, sender="mast", limit=1)

LINE_IS_LOST = SerialFaultRule("lost", SerialFaultKind.LOSE, sender="mast")


@pytest.fixture(params=list(ADAPTATIONS))
def adaptation(request):
    return request.param


@pytest.fixture
def rig(adaptation):
    with opened(text(adaptation)) as rig:
        yield rig


def go_to(motor, position):
    motor.set_control_mode(ControlMode.SETPOINT)
    motor.set_setpoint(position)
    motor.start()
    motor.wait_until_done(5)


def cut_power(rig):
    """Remove the supply for a while, and send a request meanwhile."""
    drive = rig.controllers["mast"]
    drive.stimulate("power", 0)
    assert rig.motors["mast"].state() is MotorState.OFFLINE
    drive.stimulate("power", 1)
    run_s(rig, 2.0)


def test_steps_per_turn_are_read_again_after_another_owner(rig, adaptation):
    mast = rig.motors["mast"]
    go_to(mast, 0.1)
    with mast.low_level() as hardware:
        address, values = COARSER[adaptation]
        hardware.registers.write(address, *values)
    go_to(mast, 0.5)
    assert truth(rig)["position_rad"] == pytest.approx(0.5, abs=RESOLUTION)
    assert mast.position() == pytest.approx(0.5, abs=RESOLUTION)


@pytest.mark.parametrize(
    ("adaptation", "flip", "problem"),
    [
        ("leadshine", b"\x27\x10", "0 pulses per revolution"),
        ("oriental_az", b"\0\0\0\x01", r"A = 0 \(0380h\), B = 0 \(0382h\)"),
    ],
)
def test_scale_of_0_is_reported_before_anything_moves(adaptation, flip, problem):
    with opened(text(adaptation, "tcp")) as rig:
        rule = SerialFaultRule(
            "zero", SerialFaultKind.CORRUPT, sender="mast", function=3, flip=b"\0" * 9 + flip
        )
        rig.faults.inject("line", rule)
        mast = rig.motors["mast"]
        with pytest.raises(PeerError, match=problem):
            mast.enable()
        with pytest.raises(PeerError, match=problem):
            mast.position()
        rig.faults.lift("line", rule.name)
        go_to(mast, 0.2)
        assert truth(rig)["position_rad"] == pytest.approx(0.2, abs=RESOLUTION)


def test_steps_per_turn_are_the_saved_ones_after_power_loss(rig, adaptation):
    mast = rig.motors["mast"]
    mast.enable()
    with mast.low_level() as hardware:
        address, values = COARSER[adaptation]
        hardware.registers.write(address, *values)
    go_to(mast, 0.2)
    cut_power(rig)
    before = truth(rig)["position_rad"]
    here = mast.position()
    go_to(mast, here + 0.2)
    assert truth(rig)["position_rad"] - before == pytest.approx(0.2, abs=RESOLUTION)


@pytest.mark.parametrize("has_moved", [True, False])
def test_drive_after_power_loss_is_not_enabled(rig, has_moved):
    mast = rig.motors["mast"]
    mast.enable()
    if has_moved:
        go_to(mast, 0.1)
    assert mast.state() is MotorState.ENABLED
    cut_power(rig)
    assert mast.state() is MotorState.DISABLED
    mast.enable()
    assert mast.state() is MotorState.ENABLED


@pytest.mark.parametrize("has_moved", [True, False])
def test_power_loss_without_a_request_is_noticed(rig, adaptation, has_moved):
    mast = rig.motors["mast"]
    mast.enable()
    with mast.low_level() as hardware:
        address, values = COARSER[adaptation]
        hardware.registers.write(address, *values)
    if has_moved:
        go_to(mast, 0.1)
    drive = rig.controllers["mast"]
    drive.stimulate("power", 0)
    drive.stimulate("power", 1)
    run_s(rig, 2.0)
    assert mast.state() is MotorState.DISABLED
    before, here = truth(rig)["position_rad"], mast.position()
    go_to(mast, here + 0.2)
    assert truth(rig)["position_rad"] - before == pytest.approx(0.2, abs=RESOLUTION)


def test_drive_after_a_lost_answer_is_still_enabled(rig):
    mast = rig.motors["mast"]
    go_to(mast, 0.1)
    rig.faults.inject("line", ONE_IS_LOST)
    assert mast.position() == pytest.approx(0.1, abs=RESOLUTION)
    assert mast.state() is MotorState.ENABLED
    go_to(mast, 0.2)
    assert truth(rig)["position_rad"] == pytest.approx(0.2, abs=RESOLUTION)


@pytest.mark.parametrize("has_moved", [True, False])
def test_drive_after_a_lost_line_is_still_enabled(rig, has_moved):
    mast = rig.motors["mast"]
    mast.enable()
    if has_moved:
        go_to(mast, 0.1)
    rig.faults.inject("line", LINE_IS_LOST)
    assert mast.state() is MotorState.OFFLINE
    rig.faults.lift("line", LINE_IS_LOST.name)
    assert mast.state() is MotorState.ENABLED


@pytest.mark.parametrize("adaptation", ["leadshine"])
@pytest.mark.parametrize("has_request", [True, False])
def test_stop_ramp_is_written_again_after_power_loss(rig, has_request):
    mast = rig.motors["mast"]
    go_to(mast, 0.1)
    told = mast.hardware.registers.read(QUICK_RAMP)
    if has_request:
        cut_power(rig)
    else:
        for power in (0, 1):
            rig.controllers["mast"].stimulate("power", power)
        run_s(rig, 2.0)
    assert mast.hardware.registers.read(QUICK_RAMP) != told
    go_to(mast, 0.2)
    assert mast.hardware.registers.read(QUICK_RAMP) == told


@pytest.mark.parametrize("stops_first", [False, True])
@pytest.mark.parametrize("clears", ["true", "false"])
def test_az_drive_that_keeps_its_trigger_starts_and_stops(clears, stops_first):
    kind = 'kind = "oriental_az"\n'
    rig_text = text("oriental_az").replace(kind, f"{kind}trigger_auto_clear = {clears}\n")
    assert "trigger_auto_clear" in rig_text
    with opened(rig_text) as rig:
        mast = rig.motors["mast"]
        mast.enable()
        if stops_first:
            mast.stop()
            mast.wait_until_done(1)
        for target in (0.1, 0.2, 0.3):
            go_to(mast, target)
            assert truth(rig)["position_rad"] == pytest.approx(target, abs=RESOLUTION)
        for target in (2.0, 5.0):  # the second replaces the first in motion
            mast.set_setpoint(target)
            mast.start()
            run_s(rig, 0.3)
        before = truth(rig)["position_rad"]
        mast.stop()
        mast.wait_until_done(2)
        assert truth(rig)["position_rad"] - before < 0.6  # 2 rad/s, ended by 4 rad/s^2: 0.5 rad
        go_to(mast, 0.0)
