"""The adaptation to MIT frames and RobStride's, on emulated drives of each firmware.

Frames that it sends are read by the functions of mini-cheetah-motor-driver-socketcan 0.4.3.
"""

from functools import partial
from pathlib import Path

import can
import pytest
from motor_driver.canmotorlib import AK80_6_V2_PARAMS, uint_to_float

from motorhil.emulators.can.fault_rules import FaultKind, FaultRule
from motorhil.emulators.mit.settings import MODELS as EMULATED_MODELS
from motorhil.harness.rig.config.rig_file import parse_rig
from motorhil.harness.rig.config.toml import RigError, Source
from motorhil.harness.rig.reading import installed_plugins
from motorhil.harness.rig.rig import Rig
from motorhil.motorapi import (
    ControlMode,
    ControlVariable,
    DeadlineExceeded,
    DeviceFault,
    LimitError,
    LinkError,
    MotionInterrupted,
    MotorBusyError,
    MotorState,
    PeerError,
    TrapezoidalTrajectory,
    UnsupportedError,
)
from motorhil.motorapi.adaptations.mit.frames import MODELS, Command, Frames, Maker, Ranges
from motorhil.motorapi.adaptations.mit.hardware import LIMP
from motorhil.motorapi.motion import Motion
from tests.support.kit_benches import RIGS

EMULATED = {name: tuple(ranges) for name, (_, ranges) in EMULATED_MODELS.items()}
FIRMWARE = ["ak80_6_v2", "mini_cheetah", "dm4310", "rs01"]
PLANT = (
    'preset = "wheel_60w", gear_ratio = 10.0, load_inertia_kg_m2 = 0.01,'
    " encoder_increments_rev = 65536"
)
MODEL = "velocity_max_rad_s = 4.0\nacceleration_max_rad_s2 = 8.0\ntorque_max_n_m = 2.0\n"
OPTIONS = "kp_n_m_rad = 200.0\nkd_n_m_s_rad = 2.5\ninertia_kg_m2 = 0.0103\nfriction_n_m = 0.04\n"


def opened(drive="ak80_6_v2", *, told=None, emulated="", motor="", model=MODEL, node=1, asked=None):
    where = 'controller = "left"' if asked is None else f'bus = "can0"\nnode_id = {asked}'
    kind = "robstride" if drive == "rs01" else "mit"
    return Rig(
        parse_rig(
            Source(
                Path("inline.toml"),
                "[bus.can0]\nbitrate_bit_s = 1_000_000\n"
                f'[controller.left]\nkind = "{kind}"\nbus = "can0"\nnode_id = {node}\n'
                f'model = "{drive}"\nplant = {{ {PLANT} }}\n{emulated}\n'
                f'[motor.left]\nadaptation = "{kind}"\n{where}\n'
                f'drive = "{told or drive}"\n{OPTIONS}{motor}\n[motor.left.model]\n{model}',
            ),
            installed_plugins(),
        )
    )


def true(rig, what="position_rad"):
    return rig.controllers["left"].snapshot()[what]


def go_to(motor, target, mode=ControlMode.TRAJECTORY):
    motor.set_control_mode(mode)
    if mode is ControlMode.TRAJECTORY:
        motor.set_trajectory(TrapezoidalTrajectory(target, initial=motor.position()))
    else:
        motor.set_setpoint(target)
    motor.start()


def frames(rig, seconds, *, sent=None):
    """Return the frames on the bus for so long; `sent`: a frame to send first."""
    found = []
    with can.Bus(interface="emulated", channel="can0") as bus:
        if sent is not None:
            bus.send(can.Message(arbitration_id=1, data=sent, is_extended_id=False))
        end_ns = rig.runtime.now_ns() + round(seconds * 1e9)
        while rig.runtime.now_ns() < end_ns:
            one = bus.recv(0.001)
            if one is not None:
                found.append(one)
    return found


def test_ranges_of_all_models_are_those_of_the_emulated_drives():
    """Each table was written by the data sheets."""
    assert {name: tuple(ranges) for name, (_, ranges) in MODELS.items()} == EMULATED


def test_golden_frames_of_rmd_in_motion_mode():
    """Compare with the maker's example of motion mode (400h, 500h), whose packing is the same."""
    frames = Frames(1, 0x501, Maker.MINI_CHEETAH, Ranges(12.5, 45.0, 24.0))
    answer = frames.answer(0x501, bytes.fromhex("01E66582EB550000"))
    # The manual divides the code of the position by 2 to the power of 16.
    assert answer[:3] == pytest.approx((9.99, 1.021, 10.004), abs=0.011)
    _, sent = frames.command(Command(9.99, 1.021, 10.012, 1.0, 10.004))
    golden = bytes.fromhex("E66682E052333B55")
    assert sent[2:] == golden[2:]  # the position is computed as above
    p, expected = (int.from_bytes(one[:2], "big") for one in (sent, golden))
    assert abs(p - expected) * 25 / 65535 <= 0.011


@pytest.mark.parametrize("drive", FIRMWARE)
def test_motor_moves_to_its_target_and_holds(drive):
    with opened(drive) as rig:
        motor = rig.motors["left"]
        assert motor.position() == pytest.approx(0.0, abs=0.001)
        assert motor.state() is MotorState.DISABLED
        motor.enable()
        go_to(motor, 1.0, ControlMode.SETPOINT)
        motor.wait_until_done(timeout_s=3)
        rig.runtime.run_for(1.0)
        assert true(rig) == pytest.approx(1.0, abs=0.002)
        assert motor.position() == pytest.approx(1.0, abs=0.002)
        assert motor.state() is MotorState.ENABLED
        motor.disable()
        assert motor.state() is MotorState.DISABLED
        assert true(rig, "is_on") == 0.0


def test_requests_are_those_of_another_client():
    with opened() as rig:
        motor = rig.motors["left"]
        motor.enable()
        go_to(motor, 1.0)
        commands = [one.data for one in frames(rig, 1.2) if one.arbitration_id == 1]
        table = AK80_6_V2_PARAMS
        bits = [int.from_bytes(data, "big") for data in commands]
        p = [uint_to_float(one >> 48, table["P_MIN"], table["P_MAX"], 16) for one in bits]
        v = [uint_to_float(one >> 36 & 0xFFF, table["V_MIN"], table["V_MAX"], 12) for one in bits]
        kp = {round(uint_to_float(one >> 24 & 0xFFF, 0, table["KP_MAX"], 12)) for one in bits}
        assert kp == {200}
        assert p == sorted(p)
        assert p[-1] == pytest.approx(1.0, abs=25 / 65535)
        assert max(v) == pytest.approx(8**0.5, abs=0.1)  # a triangle: 8 rad/s2 over 1 rad
        assert len(commands) >= 200  # every 5 ms
        t = [uint_to_float(one & 0xFFF, table["T_MIN"], table["T_MAX"], 12) for one in bits]
        assert max(t) == pytest.approx(0.0103 * 8 + 0.04, abs=24 / 4095)  # inertia and friction


def test_enable_causes_no_kick_after_an_old_command():
    """CubeMars drives execute the last command when they are enabled."""
    with opened() as rig:
        motor = rig.motors["left"]
        motor.enable()
        go_to(motor, 1.0)
        motor.wait_until_done(timeout_s=3)
        motor.disable()
        rig.controllers["left"].stimulate("load_torque_n_m", 0.2)
        rig.runtime.run_for(0.5)
        rig.controllers["left"].stimulate("load_torque_n_m", 0.0)
        rig.runtime.run_for(4.0)
        before = true(rig)
        assert abs(before - 1.0) > 0.2
        motor.enable()
        rig.runtime.run_for(0.5)
        assert true(rig) == pytest.approx(before, abs=0.002)


def test_present_position_is_commanded_before_enabling():
    with opened(emulated="initial_position_rad = 1.0") as rig:
        motor = rig.motors["left"]
        motor.position()
        with can.Bus(interface="emulated", channel="can0") as bus:
            motor.enable()
            heard = [bus.recv(0.0) for _ in range(40)]
        sent = [bytes(one.data) for one in heard if one and one.arbitration_id == 1]
        before = sent[: sent.index(b"\xff" * 7 + b"\xfc")][-1]
        assert before[:2] == bytes.fromhex("8A3C")
        assert int.from_bytes(before[3:5], "big") & 0xFFF == 1638  # kp 200 of 500


def test_motor_at_rest_reads_zero_which_has_no_code():
    with opened() as rig:
        motor = rig.motors["left"]
        assert motor.position() == 0.0
        assert motor.velocity() == 0.0
        assert motor.torque() == 0.0


def test_stop_ends_where_the_deceleration_leads():
    with opened() as rig:
        motor = rig.motors["left"]
        motor.enable()
        go_to(motor, 6.0)
        rig.runtime.run_for(0.8)  # 4 rad/s since 0.5 s
        at = true(rig)
        motor.stop()
        motor.wait_until_done(timeout_s=3)
        assert true(rig) - at == pytest.approx(4.0**2 / (2 * 8.0), abs=0.03)


def test_limp_motor_that_is_on_counts_as_disabled():
    """Another host has switched the drive on, and is silent now."""
    with opened("rs01") as rig:
        motor = rig.motors["left"]
        motor.position()
        with can.Bus(interface="emulated", channel="can0") as bus:
            bus.send(can.Message(arbitration_id=0x0300FD01, data=bytes(8)))
            rig.runtime.run_for(0.2)
        assert true(rig, "is_on") == 1.0
        assert motor.state() is MotorState.DISABLED


def test_velocity_and_torque_are_commands_without_stiffness():
    with opened() as rig:
        motor = rig.motors["left"]
        motor.set_control_mode(ControlMode.SETPOINT, ControlVariable.VELOCITY)
        motor.set_setpoint(2.0)
        motor.start()
        motor.wait_until_done(timeout_s=3)
        assert true(rig, "velocity_rad_s") == pytest.approx(2.0, abs=0.08)
        assert true(rig, "command_kp_n_m_rad") == 0.0
        motor.stop()
        motor.wait_until_done(timeout_s=3)
        motor.set_control_mode(ControlMode.SETPOINT, ControlVariable.TORQUE)
        motor.set_setpoint(0.3)
        motor.start()
        rig.runtime.run_for(0.05)
        assert true(rig, "torque_n_m") == pytest.approx(0.3, abs=24 / 4095)
        assert true(rig, "command_kd_n_m_s_rad") == 0.0


def test_ranges_that_a_damiao_drive_tells_must_be_those_of_the_model():
    with opened("dm4310", told="dm4340") as rig:
        with pytest.raises(PeerError, match=r"12.5, 30, 10 .*expected 12.5, 8, 28"):
            rig.motors["left"].position()
        with pytest.raises(PeerError):  # again, as long as it is wrong
            rig.motors["left"].enable()


def test_ranges_can_be_given_one_by_one():
    keys = "p_max_rad = 12.5\nv_max_rad_s = 8.0\nt_max_n_m = 28.0"
    with opened("dm4310", told="dm4340", emulated=keys) as rig:
        rig.motors["left"].enable()


def test_wrong_range_of_velocity_is_noticed_in_motion():
    """Two libraries have different ranges for an AK80-9: 25.64 and 50 rad/s."""
    with opened("ak80_9_v2", emulated="v_max_rad_s = 50.0") as rig:
        motor = rig.motors["left"]
        motor.enable()
        go_to(motor, 2.0)
        with pytest.raises(PeerError, match=r"velocities tell .*v_max_rad_s"):
            motor.wait_until_done(timeout_s=3)


def test_right_ranges_are_not_accused():
    with opened("ak80_9_v2") as rig:
        motor = rig.motors["left"]
        motor.enable()
        for target in (2.0, -2.0, 0.3, -8.0):
            go_to(motor, target)
            motor.wait_until_done(timeout_s=9)
        assert motor.hardware.mismatch == ""


def test_repeated_answer_about_a_parameter_is_no_position():
    twice = FaultRule("twice", FaultKind.DUPLICATE, sender="left")
    with opened("dm4310") as rig:
        rig.faults.inject("can0", twice)
        motor = rig.motors["left"]
        told = []
        motor.hardware.drive.news.listeners.append(lambda: told.append(motor.hardware.answer))
        assert motor.position() == pytest.approx(0.0, abs=0.01)
        rig.runtime.run_for(0.1)
        assert rig.faults.fired()["twice"] > 3
        assert all(abs(one.p) < 0.01 for one in told if one is not None)


@pytest.mark.parametrize("probability", [0.1, 0.3, 0.6])
def test_late_answers_accuse_no_range(probability):
    late = FaultRule(
        *("late", FaultKind.DELAY), sender="left", probability=probability, delay_ns=300_000_000
    )
    with opened("ak80_9_v2") as rig:
        motor = rig.motors["left"]
        motor.enable()
        rig.faults.inject("can0", late)
        go_to(motor, 2.0)
        rig.runtime.run_for(3.0)
        assert motor.hardware.mismatch == ""


def test_target_beyond_the_range_of_frames_is_refused():
    with opened() as rig:
        motor = rig.motors["left"]
        motor.enable()
        with pytest.raises(LimitError, match=r"12\.5"):
            go_to(motor, 12.6)
        assert true(rig) == pytest.approx(0.0, abs=1e-3)


@pytest.mark.parametrize(
    ("variable", "value", "text"),
    [
        (ControlVariable.VELOCITY, -77.0, "velocity -77 rad/s, allowed is -76 to 76 rad/s"),
        (ControlVariable.TORQUE, 12.5, "torque 12.5 N·m, allowed is -12 to 12 N·m"),
    ],
)
def test_set_point_beyond_the_range_of_frames_is_refused(variable, value, text):
    model = "velocity_max_rad_s = 100.0\nacceleration_max_rad_s2 = 8.0\ntorque_max_n_m = 20.0\n"
    with opened(model=model) as rig:
        motor = rig.motors["left"]
        motor.enable()
        motor.set_control_mode(ControlMode.SETPOINT, variable)
        motor.set_setpoint(value)
        with pytest.raises(LimitError, match=text):
            motor.start()


@pytest.mark.parametrize("drive", FIRMWARE)
def test_homing_makes_this_place_zero(drive):
    with opened(drive, emulated="initial_position_rad = 1.5") as rig:
        motor = rig.motors["left"]
        assert motor.position() == pytest.approx(1.5, abs=0.001)
        assert not motor.is_referenced()
        motor.home(35)
        motor.wait_until_done(timeout_s=5)
        assert motor.is_referenced()
        assert motor.position() == pytest.approx(0.0, abs=0.001)
        assert true(rig) == pytest.approx(1.5, abs=0.002)
        assert motor.state() is MotorState.ENABLED
        with pytest.raises(UnsupportedError, match="35, 37"):
            motor.home(17)


@pytest.mark.parametrize(("drive", "code"), [("ak80_6_v2", 2), ("dm4310", 0xA), ("rs01", 2)])
def test_fault_of_the_drive_is_told_and_reset(drive, code):
    with opened(drive) as rig:
        motor = rig.motors["left"]
        motor.enable()
        go_to(motor, 2.0)
        rig.runtime.run_for(0.2)
        rig.controllers["left"].stimulate("fault", code)
        with pytest.raises(DeviceFault, match="over current"):
            motor.wait_until_done(timeout_s=3)
        assert motor.state() is MotorState.FAULT
        motor.reset_fault()
        assert motor.state() is MotorState.DISABLED
        go_to(motor, 0.5)
        motor.wait_until_done(timeout_s=3)


def test_following_error_switches_the_motor_off():
    with opened() as rig:
        motor = rig.motors["left"]
        motor.enable()
        rig.controllers["left"].stimulate("load_torque_n_m", 5.0)
        assert rig.runtime.wait_until(lambda: motor.fault() is not None, 1.0)
        assert "following error" in repr(motor.fault())
        rig.runtime.run_for(0.01)
        assert true(rig, "is_on") == 0.0


def test_power_loss_is_told_and_the_motor_is_off_afterwards():
    with opened() as rig:
        motor = rig.motors["left"]
        motor.enable()
        go_to(motor, 2.0)
        rig.runtime.run_for(0.2)
        rig.controllers["left"].stimulate("power", 0)
        with pytest.raises(LinkError, match="no answer for 100 ms"):
            motor.wait_until_done(timeout_s=3)
        rig.controllers["left"].stimulate("power", 1)
        rig.runtime.run_for(0.5)
        assert motor.state() is MotorState.DISABLED


def test_command_of_another_program_interrupts():
    with opened() as rig:
        motor = rig.motors["left"]
        motor.enable()
        go_to(motor, 2.0)
        rig.runtime.run_for(0.2)
        frames(rig, 0.0, sent=b"\xff" * 7 + b"\xfd")
        with pytest.raises(MotionInterrupted, match="another program"):
            motor.wait_until_done(timeout_s=3)
        assert motor.state() is MotorState.DISABLED
        rig.runtime.run_for(0.2)
        assert true(rig, "command_kp_n_m_rad") == 0.0  # nothing goes on


def test_motion_that_is_refused_is_not_kept():
    with opened() as rig:
        motor = rig.motors["left"]
        motor.enable()
        hardware = motor.hardware
        hardware.release()
        hardware.drive.close(at_rest=True)
        with pytest.raises(LinkError, match="closed"):
            hardware.motions.hold((2.0, 0.0), partial(hardware.send, ControlVariable.POSITION))
        assert hardware.present() == LIMP


def motion_to(target):
    """Return a motion in units of the drive."""
    limits = {"velocity": 2.0, "acceleration": 8.0, "deceleration": 8.0}
    place = {"start": 0.0, "target": target}
    return Motion(ControlMode.SETPOINT, ControlVariable.POSITION, **place, **limits)


def test_motor_is_held_and_heard_after_an_error_of_its_stream():
    """The error is told until the next motion; the motor holds where the stream has ended."""
    with opened() as rig:
        motor = rig.motors["left"]
        motor.home(37)
        hardware, end_ns = motor.hardware, rig.runtime.now_ns() + 500_000_000

        def send(value, fence):
            if rig.runtime.now_ns() > end_ns:
                raise LinkError(link="can0", reason="it takes no frame")
            return hardware.send(ControlVariable.POSITION, value, fence)

        hardware.motions.start(motion_to(3.0), 1.0, hardware.measured(), send)
        rig.runtime.run_for(0.6)
        stopped_at = hardware.motions.demand()[0]
        assert 0.5 < stopped_at < 1.5
        rig.runtime.run_for(1.0)
        assert "it takes no frame" in str(hardware.motions.error)
        assert motor.state() is MotorState.ENABLED
        assert motor.is_referenced()
        assert motor.position() == pytest.approx(stopped_at, abs=0.01)
        assert true(rig) == pytest.approx(stopped_at, abs=0.01)
        go_to(motor, 2.0)
        assert hardware.motions.error is None
        motor.wait_until_done(timeout_s=3)
        assert true(rig) == pytest.approx(2.0, abs=0.01)


def test_other_program_ends_the_holding_after_an_error():
    with opened() as rig:
        motor = rig.motors["left"]
        motor.enable()
        hardware = motor.hardware

        def send(value, fence):
            if hardware.motions.is_going:
                raise MotorBusyError(motor="left", holder="another program", since_ns=0)
            return hardware.send(ControlVariable.POSITION, value, fence)

        hardware.motions.start(motion_to(3.0), 1.0, hardware.measured(), send)
        rig.runtime.run_for(0.2)
        assert isinstance(hardware.motions.error, MotorBusyError)
        assert true(rig, "command_kp_n_m_rad") > 0.0
        frames(rig, 0.0, sent=b"\xff" * 7 + b"\xfd")
        rig.runtime.run_for(0.2)
        assert hardware.present() == LIMP
        assert motor.state() is MotorState.DISABLED


def test_reader_does_not_disturb_another_program():
    """Check that a reader stays silent while it hears answers to others."""
    with opened() as rig:
        motor = rig.motors["left"]
        motor.position()
        with can.Bus(interface="emulated", channel="can0") as bus:
            for data in [b"\xff" * 7 + b"\xfc"] + 100 * [bytes.fromhex("8A3C7FF0513337FF")]:
                bus.send(can.Message(arbitration_id=1, data=data, is_extended_id=False))
                rig.runtime.run_for(0.01)
            heard = [bus.recv(0.0) for _ in range(300)]
        foreign = [one for one in heard if one and one.arbitration_id == 1 and one.timestamp > 0.15]
        assert foreign == []
        assert motor.state() is MotorState.ENABLED
        assert true(rig) == pytest.approx(1.0, abs=0.05)


def test_wrong_identifier_of_answers_is_told():
    message = "no answer of motor 1 on identifier 0h within 2 s"
    with opened(emulated="master_id = 5") as rig, pytest.raises(LinkError, match=message):
        rig.motors["left"].position()


def test_drive_that_knows_no_host_is_heard_by_any():
    """Its commands do not name the host: it answers FDh before a request, and after power-on."""
    with opened("rs01", motor="host_id = 0xAA\n") as rig:
        motor = rig.motors["left"]
        assert motor.position() == pytest.approx(0.0, abs=0.001)
        motor.enable()
        rig.controllers["left"].stimulate("power", 0.0)
        rig.runtime.run_for(0.3)
        rig.controllers["left"].stimulate("power", 1.0)
        rig.runtime.run_for(0.3)
        assert motor.state() is MotorState.DISABLED


THIRD_HOST = {  # 11h writes 7017h, the speed limit of position mode: 2.0
    "arbitration_id": 0x12001101,
    "data": bytes.fromhex("1770000000000040"),
}


def test_drive_that_answers_a_third_host_is_found_and_heard():
    """Commands do not name their host: they are answered to that of the last request."""
    with opened("rs01") as rig, can.Bus(interface="emulated", channel="can0") as bus:
        motor = rig.motors["left"]
        rig.runtime.run_for(0.2)  # it boots
        bus.send(can.Message(**THIRD_HOST))
        rig.runtime.run_for(0.2)
        assert motor.position() == pytest.approx(0.0, abs=0.001)
        rig.controllers["left"].stimulate("fault", 2)  # told to that host, too
        rig.runtime.run_for(0.05)
        assert "over current" in repr(motor.fault())


def test_drive_that_answers_a_third_host_goes_on_in_a_motion():
    with opened("rs01") as rig, can.Bus(interface="emulated", channel="can0") as bus:
        motor = rig.motors["left"]
        motor.enable()
        go_to(motor, 2.0)
        rig.runtime.run_for(0.2)
        bus.send(can.Message(**THIRD_HOST))
        motor.wait_until_done(timeout_s=3)
        assert true(rig) == pytest.approx(2.0, abs=0.01)


def test_reference_that_a_third_host_writes_interrupts():
    with opened("rs01") as rig, can.Bus(interface="emulated", channel="can0") as bus:
        motor = rig.motors["left"]
        motor.enable()
        go_to(motor, 2.0)
        rig.runtime.run_for(0.2)
        speed = bytes.fromhex("0A7000000000803F")  # 700Ah: 1.0 rad/s
        bus.send(can.Message(arbitration_id=0x12001101, data=speed))
        with pytest.raises(MotionInterrupted, match="another program"):
            motor.wait_until_done(timeout_s=3)


def test_answers_of_another_motor_are_named():
    other = can.Message(arbitration_id=2, data=b"\xff" * 8, is_extended_id=False)
    with (
        opened(node=2, asked=1) as rig,
        can.Bus(interface="emulated", channel="can0") as bus,
    ):
        rig.runtime.every(0.01, lambda: bus.send(other))
        with pytest.raises(LinkError, match="heard there: motor 2; check node_id"):
            rig.motors["left"].position()


def test_short_answers_of_another_firmware_are_named():
    with (
        opened("ak80_6_v2", told="dm4310", emulated="answer_bytes = 6") as rig,
        pytest.raises(LinkError, match="an answer of 6 bytes"),
    ):
        rig.motors["left"].position()


@pytest.mark.parametrize("told", ["ak80_6_v2", "mini_cheetah"])
def test_drive_of_another_maker_is_told_by_a_fault_that_it_cannot_have(told):
    """A Damiao drive has its temperature in that byte; the motor was accused of four faults."""
    message = "heard there: fault 19h, which such a drive does not have; check .* drive"
    with opened("dm4310", told=told) as rig, pytest.raises(LinkError, match=message):
        rig.motors["left"].enable()


def test_drive_without_parameters_is_told_to_be_no_damiao():
    with (
        opened("ak80_6_v2", told="dm4310") as rig,
        pytest.raises(DeadlineExceeded, match="parameter 21, which a Damiao drive tells; check"),
    ):
        rig.motors["left"].enable()


@pytest.mark.parametrize(("kind", "drive"), [("mit", "dm4310"), ("robstride", "rs01")])
def test_drive_has_no_default(kind, drive):
    text = (RIGS / f"{kind}.toml").read_text().replace(f'drive = "{drive}"\n', "")
    description = parse_rig(Source(Path("rig.toml"), text), installed_plugins())
    with pytest.raises(RigError, match="drive"), Rig(description) as rig:
        assert rig.motors["left"]


def test_answers_of_six_bytes_are_enough():
    with opened(emulated="answer_bytes = 6") as rig:
        motor = rig.motors["left"]
        go_to(motor, 0.5)
        motor.wait_until_done(timeout_s=3)


def test_model_with_negative_gear_turns_the_signs():
    with opened(model=MODEL + "gear_ratio = -10.0\n") as rig:
        motor = rig.motors["left"]
        go_to(motor, 0.5)
        motor.wait_until_done(timeout_s=3)
        assert motor.position() == pytest.approx(0.5, abs=0.002)
        assert true(rig) == pytest.approx(-0.5, abs=0.002)


@pytest.mark.parametrize(
    ("motor", "message"),
    [
        ("damping = 1", "unknown key"),
        ("period_ms = 0.0", "period_ms"),
        ("master_id = 0x800", "master_id"),
    ],
)
def test_wrong_setting_is_refused(motor, message):
    with pytest.raises(RigError, match=message), opened(motor=motor) as rig:
        assert rig.motors["left"]


def test_linear_model_is_refused():
    model = 'kind = "linear"\nvelocity_max_m_s = 1.0\nacceleration_max_m_s2 = 1.0\n'
    with pytest.raises(RigError, match="linear"), opened(model=model) as rig:
        assert rig.motors["left"]
