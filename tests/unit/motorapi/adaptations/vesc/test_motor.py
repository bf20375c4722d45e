"""A motor behind a VESC: its frames, and what the conformance kit does not ask.

Golden frames: vedderb/bldc b9d287b3 (firmware 7.01), documentation/comm_can.md.
"""

import tracemalloc
from math import tau
from pathlib import Path

import can
import pytest

from motorhil.emulators.can.fault_rules import FaultKind, FaultRule
from motorhil.emulators.can.frame import EFF_FLAG
from motorhil.harness.rig.config.rig_file import parse_rig
from motorhil.harness.rig.config.toml import RigError, Source
from motorhil.harness.rig.reading import installed_plugins
from motorhil.harness.rig.rig import Rig
from motorhil.motorapi import ControlMode, ControlVariable, MotorState
from motorhil.motorapi.adaptations.vesc.motor import Mode, VescMotor
from motorhil.motorapi.errors import (
    DeviceFault,
    LinkError,
    MotionInterrupted,
    PeerError,
    UsageError,
)
from motorhil.motorapi.model import MotorModel

MODEL = """\
velocity_max_rad_s = {}
acceleration_max_rad_s2 = 4.0
gear_ratio = {}
position_tolerance_rad = {}
"""
WIDE = "position_turns = 8.0\nerpm_min = 10.0"
GAINS = """\
status_1 = 25
position_divider = 8.0
position_kp = 0.2
position_kd = 0.0028
erpm_min = 10.0
erpm_ramp_s = 100_000.0"""


def opened(drive=GAINS, motor=WIDE, node=23, velocity=2.0, gear=66.0, within=0.01, seed=0):
    """Return a rig of one VESC."""
    text = (
        "bus.can0.bitrate_bit_s = 500_000\n"
        f'[controller.left]\nkind = "vesc"\nbus = "can0"\nnode_id = {node}\n{drive}\n'
        'plant = { preset = "wheel_60w" }\n'
        f'[motor.left]\nadaptation = "vesc"\ncontroller = "left"\n{motor}\n'
        f"[motor.left.model]\n{MODEL.format(velocity, gear, within)}"
    )
    return Rig(parse_rig(Source(Path("vesc.toml"), text), installed_plugins()), seed=seed)


def go_to(motor, target, variable=ControlVariable.POSITION):
    motor.set_control_mode(ControlMode.SETPOINT, variable)
    motor.set_setpoint(target)
    motor.start()


def true(rig, what="position_rad"):
    return rig.controllers["left"].snapshot()[what]


class Ear:
    """All frames to and from the drive, with its own bus object."""

    def __init__(self, rig):
        self.bus = can.Bus(interface="emulated", channel="can0")
        self.rig = rig

    def __enter__(self):
        return self

    def __exit__(self, *_):
        self.bus.shutdown()

    def heard(self):
        frames = []
        while (message := self.bus.recv(0)) is not None:
            assert message.is_extended_id
            frames.append((message.arbitration_id, bytes(message.data).hex().upper()))
        return frames

    def say(self, can_id, data):
        message = can.Message(arbitration_id=can_id, data=bytes.fromhex(data), is_extended_id=True)
        self.bus.send(message)
        self.rig.runtime.wait_until(lambda: False, 0.01)


@pytest.mark.parametrize(
    ("mode", "value", "frame"),
    [
        (Mode.CURRENT, 51.0, (0x117, "0000C738")),
        (Mode.BRAKE, 5.0, (0x217, "00001388")),
        (Mode.SPEED, 3000 / 60 / 7, (0x317, "00000BB8")),
        (Mode.POSITION, 0.25, (0x417, "055D4A80")),
        (Mode.POSITION, -0.75, (0x417, "055D4A80")),  # the same angle, a turn before
    ],
)
def test_command_is_the_frame_of_the_firmware(mode, value, frame):
    with opened("status_1 = 25", "") as rig, Ear(rig) as ear:
        hardware = rig.motors["left"].hardware
        rig.motors["left"].position()  # connects
        ear.heard()
        hardware.drive.confirm(hardware.tell(mode, value))
        assert frame in ear.heard()


def test_host_asks_and_keeps_alive_with_short_packets():
    with opened() as rig, Ear(rig) as ear:
        rig.motors["left"].enable()
        rig.runtime.run_for(0.2)
        frames = ear.heard()
    assert frames.count((0x817, "970000")) == 1  # FW_VERSION, asked by 128 + 23
    assert (0x817, "97003200008000") in frames  # GET_VALUES_SELECTIVE: the fault alone
    assert 3 <= frames.count((0x817, "97021E")) <= 5  # ALIVE, every 50 ms
    assert (0x897, "1701320000800000") in frames


@pytest.mark.parametrize(("target", "gear"), [(20 * tau, 1.0), (-3 * tau, -10.0)])
def test_motor_goes_on_over_turns_of_its_encoder(target, gear):
    with opened("status_1 = 25", "", velocity=10.0 / abs(gear), gear=gear, within=0.03) as rig:
        motor = rig.motors["left"]
        go_to(motor, target)
        motor.wait_until_done(timeout_s=120)
        turns = true(rig) * 66.0 / tau  # of the plant's motor
        assert turns == pytest.approx(target * gear / tau, abs=0.005)  # friction, no integrator
        assert motor.position() == pytest.approx(target, abs=0.06)


def test_position_is_that_of_another_program_afterwards():
    with opened() as rig:
        go_to(rig.motors["left"], 3.0)
        rig.motors["left"].wait_until_done(timeout_s=10)
        rig.motors["left"].hardware._restart()  # what a new program knows
        assert rig.motors["left"].position() == pytest.approx(3.0, abs=0.005)


# --- errors


def test_status_frames_that_are_off_are_told_with_a_remedy():
    with opened(drive="") as rig, pytest.raises(PeerError) as error:
        rig.motors["left"].enable()
    assert str(error.value) == (
        "can0 node 23: it answers, but sends no STATUS, STATUS_4 and STATUS_5 within 3 s; expected"
        " bits 0, 3 and 4 of its CAN status messages, which are off by default; set them (VESC"
        " Tool: App Settings, General, CAN Status Messages)"
    )


def test_silent_drive_is_a_lost_link():
    with opened() as rig:
        rig.controllers["left"].stimulate("power", 0)
        with pytest.raises(LinkError, match="no STATUS, STATUS_4 and STATUS_5 within 3 s"):
            rig.motors["left"].enable()


@pytest.mark.parametrize("major", [5, 8])
def test_foreign_firmware_is_refused(major):
    drive = f"status_1 = 25\nfirmware_major = {major}\nfirmware_minor = 3"
    with opened(drive) as rig, pytest.raises(PeerError) as error:
        rig.motors["left"].enable()
    assert f"firmware {major}.03 is not supported; expected 6.x and 7.x" in str(error.value)


def test_frames_of_wrong_length_are_ignored():
    with opened() as rig, Ear(rig) as ear:
        motor = rig.motors["left"]
        motor.enable()
        before = motor.hardware.estimate
        rig.controllers["left"].stimulate("power", 0)
        rig.runtime.run_for(0.01)
        for command in (0x9, 0x10, 0x1B, 0x39, 0x8):
            ear.say(command << 8 | 23, "0000")
        for command in (0x5, 0x7, 0x8):
            ear.say(command << 8 | 128 + 23, "17")
            ear.say(command << 8 | 128 + 23, "")
        assert motor.hardware.estimate.position == before.position


@pytest.mark.parametrize(
    ("packet", "crc"),
    [("", "0000"), ("00", "0000"), ("0007", "70E7")],  # CRC-16/XMODEM
)
def test_version_packet_cut_short_is_ignored(packet, crc):
    with opened() as rig, Ear(rig) as ear:
        motor = rig.motors["left"]
        motor.enable()
        ear.say(0x5 << 8 | 128 + 23, "00" + packet)
        ear.say(0x7 << 8 | 128 + 23, f"1700000{len(packet) // 2}{crc}")
        go_to(motor, 0.1)
        motor.wait_until_done(timeout_s=5)


def test_parts_of_a_packet_without_end_take_no_memory():
    with opened() as rig, Ear(rig) as ear:
        rig.motors["left"].enable()
        tracemalloc.start()
        ear.say(0x5 << 8 | 128 + 23, "0000")
        for place in range(1, 6 * 2000, 6):  # its lowest byte is never 0, which begins anew
            ear.say(0x5 << 8 | 128 + 23, f"{place & 0xFF:02X}000000000000")
        ours = tracemalloc.Filter(True, "*/adaptations/vesc/motor.py")
        kept = tracemalloc.take_snapshot().filter_traces([ours]).statistics("filename")
        tracemalloc.stop()
        assert sum(one.size for one in kept) < 4_000  # the parts have 12,000 bytes


def test_late_angle_of_a_turning_motor_is_no_restart():
    """A late angle beside the first tachometer after a loss once set the position anew, wrongly."""
    with opened(velocity=6.0) as rig:
        motor = rig.motors["left"]
        go_to(motor, 4.0, ControlVariable.VELOCITY)
        rig.runtime.run_for(0.5)
        silence = FaultRule("silence", FaultKind.DROP, sender="left")
        late = FaultRule(
            "late", FaultKind.DELAY, EFF_FLAG | 16 << 8 | 23, sender="left", delay_ns=300_000_000
        )
        rig.faults.inject("can0", silence)
        assert rig.runtime.wait_until(lambda: motor.hardware.drive.is_lost, 1.0)
        rig.faults.lift("can0", "silence")
        rig.faults.inject("can0", late)
        told = 0
        for _ in range(100):
            rig.runtime.run_for(0.01)
            if motor.hardware.estimate is not None:
                told += 1
                assert motor.latest().position == pytest.approx(true(rig), abs=0.3 * 6.0 + 0.1)
        rig.faults.lift("can0", "late")
        motor.hardware.stop_anyway()
        rig.runtime.run_for(3.0)
        assert motor.position() == pytest.approx(true(rig), abs=0.005)


def test_motor_that_turns_after_a_restart_is_told_to_rest():
    with opened(velocity=6.0) as rig, Ear(rig) as ear:
        motor = rig.motors["left"]
        motor.enable()
        speed = bytes.fromhex("000044C0")  # 17,600 ERPM: 4 rad/s
        speed = can.Message(arbitration_id=0x317, data=speed, is_extended_id=True)
        turning = rig.runtime.every(0.05, lambda: ear.bus.send(speed))
        rig.runtime.run_for(1.0)
        motor.hardware._restart()
        with pytest.raises(PeerError, match=r"turns.*expected rest"):
            motor.position()
        turning.cancel()
        rig.runtime.run_for(4.0)
        span = 8.0 / 66.0 * tau
        assert (motor.position() - true(rig) + 0.1) % span == pytest.approx(0.1, abs=0.005)


def test_velocity_from_before_a_loss_is_forgotten():
    with opened() as rig:
        motor = rig.motors["left"]
        go_to(motor, 1.0, ControlVariable.VELOCITY)
        rig.runtime.run_for(1.0)
        now_ns = rig.runtime.now_ns()
        for name, can_id, s in (("all", None, 1.0), ("STATUS", EFF_FLAG | 9 << 8 | 23, 1.5)):
            until_ns = now_ns + round(s * 1e9)
            rule = FaultRule(name, FaultKind.DROP, can_id, sender="left", until_ns=until_ns)
            rig.faults.inject("can0", rule)
        rig.runtime.run_for(0.1)
        motor.hardware.stop_anyway()
        assert rig.runtime.wait_until(lambda: motor.latest() is None, 1.0)
        assert rig.runtime.wait_until(lambda: motor.latest() is not None, 2.0)
        assert abs(motor.latest().velocity) < 0.05


def test_velocity_below_erpm_min_is_refused():
    with opened("status_1 = 25", "") as rig, pytest.raises(UsageError) as error:
        go_to(rig.motors["left"], 0.15, ControlVariable.VELOCITY)
    assert "is 662 ERPM; expected 0, or at least 900 ERPM" in str(error.value)


def test_velocity_beyond_32_bits_is_refused():
    with opened(velocity=1e8) as rig, pytest.raises(UsageError) as error:
        go_to(rig.motors["left"], 1e8, ControlVariable.VELOCITY)
    assert "ERPM; expected at most 2147483647 ERPM, 32 bits" in str(error.value)


def test_position_too_fast_for_the_shorter_way_is_refused():
    with opened("status_1 = 25", "") as rig, pytest.raises(UsageError) as error:
        go_to(rig.motors["left"], 1.0)
    assert "expected at most 1.771 with position_turns = 1" in str(error.value)


@pytest.mark.parametrize(("node", "motor"), [(127, ""), (5, "host_id = 5")])
def test_host_id_that_is_not_free_is_refused(node, motor):
    message = "not usable; expected a free id of 0 to 254"
    with opened(node=node, motor=motor) as rig, pytest.raises(RigError, match=message):
        rig.motors["left"].position()


def test_controller_0_is_a_controller():
    with opened(node=0) as rig:
        rig.motors["left"].position()  # connects
        assert rig.motors["left"].state() is MotorState.DISABLED


def test_motor_without_poles_is_refused():
    message = "pole_pairs: 0 is out of range; allowed: 1 to 1000"
    with opened(motor="pole_pairs = 0") as rig, pytest.raises(RigError, match=message):
        rig.motors["left"].position()


def test_model_without_gear_ratio_is_refused():
    model = MotorModel(name="wheel", velocity_max=1.0, acceleration_max=1.0)
    with opened() as rig:
        hardware = rig.motors["left"].hardware
        with pytest.raises(UsageError, match=r"gear_ratio = 1\.0 if there is no gear"):
            VescMotor(hardware, model)


# --- faults


def test_fault_is_kept_after_the_drive_has_cleared_it():
    with opened() as rig:
        motor = rig.motors["left"]
        go_to(motor, 2.0)
        rig.runtime.run_for(0.3)
        rig.controllers["left"].stimulate("fault", 5)
        with pytest.raises(DeviceFault, match="over temperature of the MOSFETs"):
            motor.wait_until_done(timeout_s=5)
        rig.runtime.run_for(2.0)
        assert true(rig, "fault") == 0
        assert motor.state() is MotorState.FAULT
        assert motor.fault().code == 5
        with pytest.raises(DeviceFault):
            motor.start()
        motor.reset_fault()
        assert motor.state() is MotorState.DISABLED
        go_to(motor, 1.0)
        motor.wait_until_done(timeout_s=5)
        assert true(rig) == pytest.approx(1.0, abs=0.003)


def test_fault_is_reset_once_its_cause_has_gone():
    with opened() as rig:
        motor = rig.motors["left"]
        motor.enable()
        rig.controllers["left"].stimulate("fault", 3)
        rig.runtime.run_for(0.1)
        began_ns = rig.runtime.now_ns()
        motor.reset_fault()
        assert 0.3 < (rig.runtime.now_ns() - began_ns) / 1e9 < 0.5  # 0.5 s after the fault


def test_motor_that_cannot_arrive_is_a_following_error():
    with opened() as rig:
        motor = rig.motors["left"]
        rig.controllers["left"].stimulate("load_torque_n_m", 25.0)
        go_to(motor, 0.1)
        with pytest.raises(DeviceFault) as error:
            motor.wait_until_done(timeout_s=10)
        assert error.value.code == 0x8611


# --- other programs


@pytest.mark.parametrize("frame", [(0x117, "00000000"), (0x817, "FE02060000000000"[:16])])
def test_command_of_another_program_interrupts(frame):
    with opened() as rig, Ear(rig) as ear:
        motor = rig.motors["left"]
        go_to(motor, 2.0)
        rig.runtime.run_for(0.3)
        ear.say(*frame)
        with pytest.raises(MotionInterrupted, match="another program"):
            motor.wait_until_done(timeout_s=5)
        assert motor.state() is MotorState.DISABLED


@pytest.mark.parametrize("data", ["FE0004", "FE021E", "FE003200008000"])
def test_reading_of_another_program_does_not_interrupt(data):
    with opened() as rig, Ear(rig) as ear:
        motor = rig.motors["left"]
        go_to(motor, 1.0)
        ear.say(0x817, data)
        motor.wait_until_done(timeout_s=5)


def test_restarted_drive_is_noticed_and_moves_again():
    with opened() as rig:
        motor = rig.motors["left"]
        go_to(motor, 1.0)
        motor.wait_until_done(timeout_s=5)
        for power in (0, 1):
            rig.controllers["left"].stimulate("power", power)  # shorter than the timeout of STATUS
        rig.runtime.run_for(1.0)
        assert motor.state() is not MotorState.ENABLED
        motor.enable()
        here = motor.position()
        go_to(motor, here + 0.5)
        motor.wait_until_done(timeout_s=5)
        assert true(rig) == pytest.approx(1.5, abs=0.005)


def test_restart_in_a_motion_ends_it_before_the_boot_notice():
    """The notice comes half a second after a start; within 0.7 s of the first frames it is old."""
    with opened(f"{GAINS}\nencoder_turns = 8", within=0.002) as rig:  # its angle stays the same
        motor = rig.motors["left"]
        motor.enable()
        go_to(motor, 0.5)
        assert rig.runtime.wait_until(lambda: true(rig) * 66 / tau > 1.3, 1.0)
        rig.controllers["left"].stimulate("power", 0)
        rig.runtime.run_for(0.05)
        rig.controllers["left"].stimulate("power", 1)
        rig.runtime.run_for(0.05)
        assert motor.hardware.motions.variable is None
        with pytest.raises(MotionInterrupted, match="the drive"):
            motor.wait_until_done(timeout_s=3)
        assert motor.state() is not MotorState.ENABLED


def test_restart_at_the_place_of_power_on_is_told_by_the_boot_notice():
    with opened() as rig:
        motor = rig.motors["left"]
        rig.runtime.run_for(1.0)
        motor.enable()
        rig.runtime.run_for(1.5)
        for power in (0, 1):
            rig.controllers["left"].stimulate("power", power)
        rig.runtime.run_for(0.6)
        assert motor.state() is not MotorState.ENABLED


def test_restart_at_the_place_of_power_on_is_told_by_the_ways_before():
    """After a way and back the tachometer is 0, with or without a restart; all ways are not."""
    with opened() as rig:
        motor = rig.motors["left"]
        for target in (0.3, 0.0):
            go_to(motor, target)
            motor.wait_until_done(timeout_s=5)
        rig.faults.inject("can0", FaultRule("gap", FaultKind.DROP, sender="left", limit=12))
        rig.runtime.run_for(0.3)
        assert motor.state() is MotorState.ENABLED  # a gap alone is no restart
        rig.controllers["left"].stimulate("power", 0)
        rig.runtime.run_for(0.05)
        rig.controllers["left"].stimulate("power", 1)
        rig.runtime.run_for(0.05)
        assert motor.hardware.motions.variable is None
        rig.runtime.run_for(1.0)
        go_to(motor, 0.2)  # the notice of that start ends nothing
        motor.wait_until_done(timeout_s=5)
        assert true(rig) == pytest.approx(0.2, abs=0.01)


def test_restart_soon_after_the_first_start_is_told_by_its_notice():
    """The first notice never comes; the second one is within 1 s of the first frames."""
    with opened() as rig:
        motor = rig.motors["left"]
        motor.enable()
        rig.runtime.run_for(0.3)
        rig.controllers["left"].stimulate("power", 0)
        rig.runtime.run_for(0.05)
        rig.controllers["left"].stimulate("power", 1)
        rig.runtime.run_for(0.48)
        assert motor.state() is MotorState.ENABLED  # nothing tells it yet
        rig.runtime.run_for(0.1)
        assert motor.state() is not MotorState.ENABLED


@pytest.mark.parametrize(("from_ms", "to_ms"), [(50, 100), (100, 250), (350, 495)])
def test_notice_of_the_first_start_after_a_pause_is_no_restart(from_ms, to_ms):
    with opened() as rig:
        motor = rig.motors["left"]
        times = {"from_ns": from_ms * 1_000_000, "until_ns": to_ms * 1_000_000}
        rig.faults.inject("can0", FaultRule("pause", FaultKind.DROP, sender="left", **times))
        motor.enable()
        rig.runtime.run_for(1.5)
        assert motor.state() is MotorState.ENABLED
        assert motor.hardware.motions.variable is not None


@pytest.mark.parametrize("seed", range(6))
def test_position_survives_lost_frames_in_motion(seed):
    """An angle of before the loss, beside a tachometer of after it, once told a span too much."""
    with opened(velocity=6.0, seed=seed) as rig:
        motor = rig.motors["left"]
        go_to(motor, 4.0, ControlVariable.VELOCITY)
        losses = 0
        for number in range(8):
            for name, probability in (("silence", 1.0), ("noise", 0.7)):
                rule = FaultRule(
                    f"{name}{number}", FaultKind.DROP, sender="left", probability=probability
                )
                rig.faults.inject("can0", rule)
                rig.runtime.run_for(0.25)
                losses += motor.hardware.drive.is_lost
                rig.faults.lift("can0", rule.name)
            if motor.hardware.estimate is not None:
                assert motor.position() == pytest.approx(true(rig), abs=0.3)
        assert losses >= 8
        rig.runtime.run_for(2.0)
        assert motor.position() == pytest.approx(true(rig), abs=0.005)


def test_positions_are_sent_ahead_by_the_lead():
    # With 4 rad/s², 100 ms are 0.02 rad: 0.21 turns of the motor, in parts of 8 turns.
    with opened(motor=f"{WIDE}\nlead_ms = 100.0") as rig, Ear(rig) as ear:
        motor = rig.motors["left"]
        motor.enable()
        ear.heard()
        go_to(motor, 1.0)
        first, *_ = (data for can_id, data in ear.heard() if can_id == 0x417)
        assert int(first, 16) / 1e6 == pytest.approx(360.0 * 0.02 / tau * 66.0 / 8.0, rel=1e-3)


def test_speeds_are_not_sent_ahead():
    with opened() as rig, Ear(rig) as ear:
        motor = rig.motors["left"]
        motor.enable()
        go_to(motor, 1.0, ControlVariable.VELOCITY)
        first, *_ = (data for can_id, data in ear.heard() if can_id == 0x317)
        assert first == "00000000"


def test_drive_without_its_host_releases_the_motor():
    with opened() as rig:
        motor = rig.motors["left"]
        go_to(motor, 1.0, ControlVariable.VELOCITY)
        motor.wait_until_done(timeout_s=5)
        motor.hardware._feeds = False  # a program that hangs
        rig.runtime.run_for(2.0)
        assert (true(rig, "mode"), true(rig, "timeout")) == (0, 1)
        assert true(rig, "velocity_rad_s") == 0.0
