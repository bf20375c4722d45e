"""Motors on emulated dryve drives: telegrams of a motion, homing, refusals."""

from contextlib import contextmanager
from pathlib import Path

import pytest

from motorhil.harness.rig.config.rig_file import parse_rig
from motorhil.harness.rig.config.toml import RigError, Source
from motorhil.harness.rig.reading import installed_plugins
from motorhil.harness.rig.rig import Rig
from motorhil.motorapi import (
    ControlMode,
    ControlVariable,
    LimitError,
    MotorState,
    PeerError,
    StateError,
    UnsupportedError,
)
from motorhil.motorapi.motion import Motion
from tests.support.kit_benches import RIGS

TEXT = (RIGS / "dryve.toml").read_text()
ROTARY = "objects = { 60A8 = 0xFE41_0000 }"


@contextmanager
def opened(text=TEXT):
    with Rig(parse_rig(Source(Path("rig.toml"), text), installed_plugins()), seed=1) as rig:
        yield rig


@pytest.fixture
def rig():
    with opened() as one:
        yield one


def writes(rig):
    """Return the list that gets the objects that the host writes, with their data."""
    found: list[str] = []

    def on_adu(where, now_ns, start_ns, end_ns, sender, adu, spoiled):
        if sender.startswith("host") and adu[9] == 1:
            found.append(f"{adu[12:14].hex().upper()} {adu[19:].hex().upper()}")

    rig.world.tap_lines(on_adu)
    return found


def velocity(motor, value):
    motor.set_control_mode(ControlMode.SETPOINT, ControlVariable.VELOCITY)
    motor.set_setpoint(value)
    motor.start()


def move(motor, value):
    motor.set_control_mode(ControlMode.SETPOINT)
    motor.set_setpoint(value)
    motor.start()


def test_move_writes_profile_then_starts_by_one_telegram(rig):
    motor = rig.motors["left"]
    motor.enable()
    told = writes(rig)
    move(motor, 0.5)
    motor.wait_until_done(timeout_s=5)
    assert motor.position() == pytest.approx(0.5, abs=0.003)
    assert [one[:4] for one in told[:-1]] == ["6083", "6084", "607A", "6081"]
    assert told[2] == "607A 310B0000"  # 28.65 degrees
    assert told[-1] == "6040 3F00"
    told.clear()
    move(motor, 0.25)  # clears bit 4 first; what is the same is not told again
    motor.wait_until_done(timeout_s=5)
    assert told == ["6040 0F00", "607A 98050000", "6040 3F00"]


def test_halted_move_is_not_continued_by_the_next(rig):
    motor = rig.motors["left"]
    motor.enable()
    move(motor, 2.0)
    rig.runtime.wait_until(lambda: False, 0.5)
    motor.stop()
    motor.wait_until_done(timeout_s=2)
    at = motor.position()
    assert at < 1.9
    told = writes(rig)
    move(motor, 0.0)
    rig.runtime.wait_until(lambda: False, 0.3)
    assert motor.position() < at
    assert "6040 0F00" not in told  # nothing releases the halt before the new target
    motor.wait_until_done(timeout_s=5)


def test_velocity_and_position_take_turns_after_stops(rig):
    motor = rig.motors["left"]
    motor.enable()
    velocity(motor, 0.5)
    motor.wait_until_done(timeout_s=3)
    assert motor.velocity() == pytest.approx(0.5, abs=0.02)
    motor.stop()
    motor.wait_until_done(timeout_s=3)
    move(motor, 0.0)
    motor.wait_until_done(timeout_s=5)
    assert motor.position() == pytest.approx(0.0, abs=0.003)
    velocity(motor, -0.5)
    motor.stop()
    motor.wait_until_done(timeout_s=3)
    velocity(motor, 0.3)
    motor.wait_until_done(timeout_s=3)
    assert motor.velocity() == pytest.approx(0.3, abs=0.02)


def test_velocity_unit_of_both_sides_must_agree():
    text = TEXT.replace('kind = "dryve"', 'kind = "dryve"\nvelocity_unit = "rpm"')
    with opened(
        text.replace('adaptation = "dryve"', 'adaptation = "dryve"\nvelocity_unit = "rpm"')
    ) as rig:
        motor = rig.motors["left"]
        motor.enable()
        told = writes(rig)
        velocity(motor, 0.5)
        motor.wait_until_done(timeout_s=3)
        assert motor.velocity() == pytest.approx(0.5, abs=0.02)
        assert "60FF 187B0000" in told  # 315.12 rpm of the motor


def test_linear_axis_counts_by_the_feed_constant():
    text = TEXT.replace(ROTARY, "").replace("gear_ratio = 66.0", "motor_turns_per_m = 1222.2222222")
    text = text.replace("_rad", "_m").replace("torque_max_n_m = 5.0", "force_max_n = 500.0")
    text = text.replace("_m_s = 1.745", "_m_s = 1.745").replace("preset", "preset")
    text = text.replace("velocity_max_m_s = 2.0", "velocity_max_m_s = 0.05\nkind = 'linear'")
    with opened(text.replace("acceleration_max_m_s2 = 4.0", "acceleration_max_m_s2 = 0.1")) as rig:
        motor = rig.motors["left"]
        motor.enable()
        move(motor, 0.027)
        motor.wait_until_done(timeout_s=5)
        assert rig.controllers["left"].snapshot()["position_rad"] == pytest.approx(3.1416, abs=0.01)


def test_homing_attained_makes_motor_referenced(rig):
    motor = rig.motors["left"]
    motor.enable()
    assert not motor.is_referenced()
    motor.home(37)
    assert motor.is_referenced()
    move(motor, 0.2)  # bit 12 has another meaning now
    motor.wait_until_done(timeout_s=3)
    assert motor.is_referenced()


def test_failed_homing_is_an_error():
    text = TEXT.replace(ROTARY, "objects = { 60A8 = 0xFE41_0000, '6099:1' = 0, '6099:2' = 0 }")
    with opened(text) as rig:
        motor = rig.motors["left"]
        motor.enable()
        with pytest.raises(PeerError, match=r"homing failed \(statusword bit 13\)"):
            motor.home(17)
        motor.stop()  # which ends what has failed
        motor.wait_until_done(timeout_s=1)


def test_homing_method_that_the_drive_lacks_is_unsupported(rig):
    motor = rig.motors["left"]
    motor.enable()
    with pytest.raises(UnsupportedError, match="homing by method 77"):
        motor.home(77)


def test_enable_without_di7_says_what_to_do(rig):
    rig.controllers["left"].stimulate("di7", 0)
    with pytest.raises(StateError, match=r"DI7 \(enable\) is low \(statusword 0440h\).*24 V"):
        rig.motors["left"].enable()


def test_loss_of_di7_ends_a_motion(rig):
    motor = rig.motors["left"]
    motor.enable()
    move(motor, 2.0)
    rig.controllers["left"].stimulate("di7", 0)
    with pytest.raises(Exception, match="disabled"):
        motor.wait_until_done(timeout_s=3)
    assert motor.state() is MotorState.DISABLED


def test_target_outside_607b_is_refused_before_the_start():
    text = TEXT.replace(ROTARY, "objects = { 60A8 = 0xFE41_0000, '607B:2' = 5730 }")
    with opened(text) as rig:
        motor = rig.motors["left"]
        motor.enable()
        told = writes(rig)
        with pytest.raises(LimitError, match="607Bh"):
            move(motor, 1.1)
        assert not told
        move(motor, 1.0)
        motor.wait_until_done(timeout_s=5)
        move(motor, 0.0)  # the lower end
        motor.wait_until_done(timeout_s=5)


def test_fault_has_code_and_text_and_is_reset(rig):
    motor = rig.motors["left"]
    motor.enable()
    rig.controllers["left"].stimulate("fault", 0x2310)
    fault = motor.fault()
    assert (fault.code, fault.text) == (0x2310, "over-current")
    motor.reset_fault()
    assert motor.state() is MotorState.DISABLED


@pytest.mark.parametrize(
    ("objects", "text"),
    [
        ("{ 60A8 = 0x0002_0000 }", "60A8h = 00020000h is not known; expected 01h"),
        ("{ '6092:1' = 0 }", "feed constant 0"),
    ],
)
def test_drive_without_known_scale_is_refused(objects, text):
    rig_text = TEXT.replace(ROTARY, f"objects = {objects}")
    with opened(rig_text) as rig, pytest.raises(PeerError, match=text):
        rig.motors["left"].enable()


def test_velocity_that_is_rounded_twice_loses_no_step():
    """Steps of a millionth of a degree: beyond 4 million steps a double has few digits left."""
    with opened(f"{TEXT.replace(ROTARY, 'objects = { 60A8 = 0xFA41_0000 }')}") as rig:
        motor = rig.motors["left"]
        motor.position()  # connects
        hardware, model = motor.hardware, motor.model
        limits = {"velocity": 1.0, "acceleration": 1.0, "deceleration": 1.0}
        changed = []
        for number in range(200):
            place = {"start": 0.0, "target": 0.5 + number / 173.0}
            motion = Motion(ControlMode.SETPOINT, ControlVariable.VELOCITY, **place, **limits)
            once = hardware.quantised(motion, model)
            if hardware.quantised(once, model) != once:
                changed.append(once.target)
    assert changed == []


def test_velocity_beyond_32_bits_is_refused():
    text = TEXT.replace("velocity_max_rad_s = 2.0", "velocity_max_rad_s = 1e9")
    with opened(text) as rig:
        motor = rig.motors["left"]
        motor.enable()
        motor.set_control_mode(ControlMode.SETPOINT, ControlVariable.VELOCITY)
        motor.set_setpoint(1e9)
        with pytest.raises(
            LimitError, match=r"1e\+09 rad/s, allowed is -374807 to 374807 rad/s.*60FFh"
        ):
            motor.start()


@pytest.mark.parametrize(
    ("line", "text"),
    [
        ('velocity_unit = "mm"', "velocity_unit"),
        ("speed = 1", "speed"),
        ("timeout_s = 0", "timeout_s"),
    ],
)
def test_wrong_setting_of_motor_is_refused(line, text):
    rig_text = TEXT.replace('adaptation = "dryve"', f'adaptation = "dryve"\n{line}')
    with opened(rig_text) as rig, pytest.raises(RigError, match=text):
        assert rig.motors["left"]


def test_velocity_ramp_to_almost_0_is_done(rig):
    motor = rig.motors["left"]
    motor.enable()
    velocity(motor, 0.2)
    motor.wait_until_done(timeout_s=3)
    velocity(motor, -1e-16)  # the drive can only be told 0
    rig.runtime.wait_until(lambda: False, 0.5)
    motor.wait_until_done(timeout_s=3)
