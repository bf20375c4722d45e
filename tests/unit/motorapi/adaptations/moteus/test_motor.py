"""The adaptation on emulated drives; mjbots' own library is another program on the bus."""

from math import isnan, nan, tau
from pathlib import Path
from struct import pack, unpack

import can
import moteus
import pytest

from motorhil.harness.rig.config.rig_file import parse_rig
from motorhil.harness.rig.config.toml import RigError, Source
from motorhil.harness.rig.reading import installed_plugins
from motorhil.harness.rig.rig import Rig
from motorhil.motorapi import (
    ControlMode,
    ControlVariable,
    DerivativeLimits,
    DeviceFault,
    LinkError,
    MotionInterrupted,
    MotorState,
    PeerError,
    TrapezoidalTrajectory,
    UsageError,
)
from motorhil.motorapi.adaptations.moteus.motor import MoteusHwMotor

FD_LENGTHS = (*range(9), 12, 16, 20, 24, 32, 48, 64)
GEAR = 66.0
REV = GEAR / tau  # turns of the motor per rad
MODEL = "velocity_max_rad_s = 2.0\nacceleration_max_rad_s2 = 4.0\ngear_ratio = 66.0\n"
FREE = 'position_min_rev = "none"\nposition_max_rev = "none"\n'


def opened(drive=FREE, motor="", model=MODEL, node=1):
    return Rig(
        parse_rig(
            Source(
                Path("inline.toml"),
                "[bus.can0]\nbitrate_bit_s = 1_000_000\ndata_bitrate_bit_s = 5_000_000\n"
                'node.left.frames = "fd"\n'
                f'[controller.left]\nkind = "moteus"\nbus = "can0"\nnode_id = {node}\n'
                f'plant = {{ preset = "wheel_60w" }}\n{drive}\n'
                f'[motor.left]\nadaptation = "moteus"\ncontroller = "left"\n{motor}\n'
                f"[motor.left.model]\n{model}",
            ),
            installed_plugins(),
        )
    )


@pytest.fixture
def rig():
    with opened() as rig:
        yield rig


def another():
    """Return the bus of another program."""
    return can.Bus(interface="emulated", channel="can0", fd=True)


def true(rig, what="position_rad"):
    return rig.controllers["left"].snapshot()[what]


def go_to(motor, value):
    motor.set_control_mode(ControlMode.SETPOINT)
    motor.set_setpoint(value)
    motor.start()


def test_broadcast_is_no_node(rig):
    with another() as bus, pytest.raises(UsageError, match="node_id of a moteus = 127"):
        MoteusHwMotor(bus, 127)


def heard_commands(rig, seconds):
    """Return the commands on the bus, as the library reads them."""
    found = []
    end_ns = rig.runtime.now_ns() + round(seconds * 1e9)
    with another() as ear:
        while rig.runtime.now_ns() < end_ns:
            message = ear.recv(0.001)
            if message is not None and message.arbitration_id & 0x7F == 1:
                assert message.is_fd
                assert message.bitrate_switch
                registers = moteus.parse_registers(bytes(message.data))
                assert not registers.errors
                if registers.command:
                    found.append(registers.command)
    return found


def test_motor_moves_to_its_target(rig):
    motor = rig.motors["left"]
    motor.enable()
    go_to(motor, 1.0)
    motor.wait_until_done(timeout_s=3)
    assert true(rig) == pytest.approx(1.0, abs=0.002)
    assert motor.following_error() == pytest.approx(1.0 - motor.position(), abs=1e-6)
    rig.runtime.run_for(1.0)  # without a watchdog now
    assert motor.state() is MotorState.ENABLED
    assert true(rig) == pytest.approx(1.0, abs=0.002)


def test_library_reads_the_commands(rig):
    motor = rig.motors["left"]
    motor.enable()
    limits = DerivativeLimits(first=1.0, second=(-2.0, 3.0))
    motor.set_control_mode(ControlMode.TRAJECTORY)
    motor.set_trajectory(TrapezoidalTrajectory(0.5, limits=limits))
    motor.start()
    commands = heard_commands(rig, 1.2)
    register = moteus.Register
    first, last = commands[0], commands[-1]
    assert first[register.MODE] == moteus.Mode.POSITION
    assert first[register.COMMAND_POSITION] == pytest.approx(0.5 * REV)
    assert first[register.COMMAND_VELOCITY] == 0.0
    assert first[register.COMMAND_VELOCITY_LIMIT] == pytest.approx(REV)
    assert first[register.COMMAND_ACCEL_LIMIT] == pytest.approx(2.0 * REV)  # the lesser of both
    assert first[register.COMMAND_TIMEOUT] == pytest.approx(0.1)
    assert all(
        one[register.COMMAND_POSITION] == first[register.COMMAND_POSITION] for one in commands
    )
    assert isnan(last[register.COMMAND_TIMEOUT])
    assert len(commands) > 50  # every 10 ms, until it is there


def test_single_precision_of_registers_does_not_accumulate(rig):
    """Check that a motor leaves its limit, and comes back to the same bits after relative motions.

    5.31 rad are 55.7776 turns of the motor, which single precision rounds up by 1.5e-7 rad.
    """
    motor = rig.motors["left"]
    motor.enable()
    limits = DerivativeLimits(value=(-0.1, 5.31))
    motor.set_control_mode(ControlMode.SETPOINT)
    motor.set_setpoint(5.31, limits=limits)
    motor.start()
    motor.wait_until_done(timeout_s=6)
    motor.set_control_mode(ControlMode.TRAJECTORY)
    for way in [-0.1] * 3 + [0.1] * 3:
        motor.set_trajectory(TrapezoidalTrajectory(way, limits=limits))
        motor.start()
        last = heard_commands(rig, 0.6)[-1]
        assert motor.is_done()
    assert last[moteus.Register.COMMAND_POSITION] == unpack("<f", pack("<f", 5.31 * REV))[0]


def test_stop_slows_down_and_holds(rig):
    motor = rig.motors["left"]
    motor.enable()
    go_to(motor, 5.0)
    rig.runtime.run_for(0.6)
    before, velocity = true(rig), true(rig, "velocity_rad_s")
    motor.stop()
    motor.wait_until_done(timeout_s=2)
    assert true(rig) - before == pytest.approx(velocity**2 / (2 * 4.0), abs=0.01)
    here = true(rig)
    rig.runtime.run_for(1.0)
    assert true(rig) == pytest.approx(here, abs=0.001)
    assert motor.state() is MotorState.ENABLED


def test_velocity_is_kept_until_the_stop(rig):
    motor = rig.motors["left"]
    motor.enable()
    motor.set_control_mode(ControlMode.SETPOINT, ControlVariable.VELOCITY)
    motor.set_setpoint(1.0)
    motor.start()
    motor.wait_until_done(timeout_s=2)
    rig.runtime.run_for(0.5)  # longer than the watchdog
    assert true(rig, "velocity_rad_s") == pytest.approx(1.0, abs=0.05)
    motor.stop()
    motor.wait_until_done(timeout_s=2)
    rig.runtime.run_for(0.5)
    assert true(rig, "velocity_rad_s") == 0.0
    assert motor.state() is MotorState.ENABLED


@pytest.mark.parametrize("offset_ms", [0, 0.1, 4.9, 5.1, 9.9])
def test_stop_is_over_at_rest_only(rig, offset_ms):
    """A reply to a query from before the stop says that the velocity was reached."""
    motor = rig.motors["left"]
    motor.enable()
    motor.set_control_mode(ControlMode.SETPOINT, ControlVariable.VELOCITY)
    motor.set_setpoint(1.0)
    motor.start()
    motor.wait_until_done(timeout_s=2)
    now_ns = rig.runtime.now_ns()
    rig.runtime.run_for((10_000_000 - now_ns % 10_000_000) / 1e9 + offset_ms / 1e3)
    motor.stop()
    motor.wait_until_done(timeout_s=2)
    assert true(rig, "velocity_rad_s") == pytest.approx(0.0, abs=0.01)


def test_home_makes_the_place_zero():
    with opened(drive=f"{FREE}initial_position_rad = 0.02") as rig:
        motor = rig.motors["left"]
        motor.enable()
        assert not motor.is_referenced()
        motor.home(35)
        motor.wait_until_done(timeout_s=1)
        assert motor.is_referenced()
        assert motor.position() == pytest.approx(0.0, abs=1e-4)
        assert true(rig) == pytest.approx(0.02, abs=1e-4)


def test_fault_is_told_in_words_and_reset(rig):
    motor = rig.motors["left"]
    motor.enable()
    go_to(motor, 1.0)
    rig.controllers["left"].stimulate("fault", 38)
    with pytest.raises(DeviceFault, match="over-temperature") as caught:
        motor.wait_until_done(timeout_s=2)
    assert caught.value.code == 38
    assert motor.state() is MotorState.FAULT
    motor.reset_fault()
    assert motor.state() is MotorState.DISABLED
    motor.enable()
    go_to(motor, 0.2)
    motor.wait_until_done(timeout_s=2)


def test_fresh_board_moves_within_its_bounds_only():
    with opened(drive="") as rig:
        motor = rig.motors["left"]
        motor.enable()
        rig.controllers["left"].stimulate("load_torque_n_m", 1.0)
        motor.disable()
        rig.runtime.run_for(0.5)
        assert true(rig) * REV < -0.01
        with pytest.raises(DeviceFault, match=r"servopos\.position_min") as caught:
            motor.enable()
        assert caught.value.code == 39


def test_watchdog_stops_the_motor_without_its_host(rig):
    motor = rig.motors["left"]
    motor.enable()
    go_to(motor, 5.0)
    rig.runtime.run_for(0.5)
    motor.close()
    rig.runtime.run_for(0.3)
    assert true(rig, "mode") == 11
    assert true(rig, "velocity_rad_s") == pytest.approx(0.0, abs=0.05)


def restart(rig):
    rig.controllers["left"].stimulate("power", 0.0)
    rig.runtime.run_for(0.05)  # shorter than the silence that is a loss
    rig.controllers["left"].stimulate("power", 1.0)
    rig.runtime.run_for(0.3)


@pytest.mark.parametrize("variable", [ControlVariable.POSITION, ControlVariable.VELOCITY])
def test_restart_interrupts_the_motion_and_leaves_the_drive_off(rig, variable):
    motor = rig.motors["left"]
    motor.enable()
    motor.set_control_mode(ControlMode.SETPOINT, variable)
    motor.set_setpoint(1.5)
    motor.start()
    rig.runtime.run_for(0.5)  # the velocity is reached
    restart(rig)
    assert true(rig, "mode") == 0
    assert motor.state() is MotorState.DISABLED
    motor.enable()
    with pytest.raises(MotionInterrupted, match="the drive, now stopped"):
        motor.wait_until_done(timeout_s=2)
    go_to(motor, 0.2)
    motor.wait_until_done(timeout_s=2)


@pytest.mark.parametrize("seconds", [0.05, 0.5])
def test_zero_set_by_a_host_is_not_known_after_a_restart(seconds):
    with opened(drive=FREE + "output_encoder = true\n") as rig:
        motor = rig.motors["left"]
        motor.enable()
        restart(rig)
        assert motor.is_referenced()  # to the zero of its encoder
        motor.enable()
        go_to(motor, 0.3)
        motor.wait_until_done(timeout_s=2)
        motor.home(35)
        assert motor.is_referenced()
        motor.disable()
        motor.enable()
        assert motor.is_referenced()
        rig.controllers["left"].stimulate("power", 0.0)
        rig.runtime.run_for(seconds)
        rig.controllers["left"].stimulate("power", 1.0)
        rig.runtime.run_for(0.3)
        assert not motor.is_referenced()
        motor.enable()
        motor.home(35)
        assert motor.is_referenced()


def test_timeout_is_told_and_left_by_enable(rig):
    motor = rig.motors["left"]
    motor.enable()
    with another() as other:
        library = moteus.Controller(id=1, transport=object())
        command = library.make_position(position=nan, watchdog_timeout=0.02)
        send(other, command)
        rig.runtime.run_for(0.1)
    assert motor.state() is MotorState.STOPPED
    motor.enable()
    assert motor.state() is MotorState.ENABLED
    go_to(motor, 0.2)
    motor.wait_until_done(timeout_s=2)


def send(bus, command):
    can_id = (0x8000 if command.reply_required else 0) | command.destination
    length = next(
        one for one in (*range(9), 12, 16, 20, 24, 32, 48, 64) if one >= len(command.data)
    )
    bus.send(
        can.Message(
            arbitration_id=can_id,
            is_extended_id=can_id > 0x7FF,
            is_fd=True,
            bitrate_switch=True,
            data=command.data.ljust(length, b"\x50"),
        )
    )


def test_command_of_another_program_interrupts_the_motion(rig):
    motor = rig.motors["left"]
    motor.enable()
    go_to(motor, 3.0)
    rig.runtime.run_for(0.3)
    with another() as other:
        send(other, moteus.Controller(id=1, transport=object()).make_stop())
        with pytest.raises(MotionInterrupted, match="mode 00h"):
            motor.wait_until_done(timeout_s=2)
        rig.runtime.run_for(0.1)
        assert motor.state() is MotorState.DISABLED


def test_query_of_another_program_disturbs_nothing(rig):
    motor = rig.motors["left"]
    motor.enable()
    go_to(motor, 0.5)
    with another() as other:
        library = moteus.Controller(id=1, transport=object())
        for _ in range(100):
            send(other, library.make_query())
            rig.runtime.run_for(0.01)
            if motor.is_done():
                break
    assert true(rig) == pytest.approx(0.5, abs=0.003)


def test_drive_with_a_high_id_is_heard():
    with opened(node=9) as rig:
        rig.motors["left"].enable()
        assert rig.motors["left"].state() is MotorState.ENABLED


def test_ratio_of_the_drive_changes_its_units_only():
    ratio = "rotor_to_output_ratio = 0.015151515151515152"
    with opened(drive=f"{FREE}{ratio}", motor=ratio) as rig:
        motor = rig.motors["left"]
        motor.enable()
        go_to(motor, 0.5)
        motor.wait_until_done(timeout_s=2)
        assert true(rig) == pytest.approx(0.5, abs=0.002)


def test_torque_is_that_of_the_output(rig):
    motor = rig.motors["left"]
    motor.enable()
    rig.controllers["left"].stimulate("load_torque_n_m", 1.0)
    rig.runtime.run_for(0.5)
    assert motor.torque() == pytest.approx(1.0, abs=0.004 * GEAR)  # less or plus its friction


@pytest.mark.parametrize("version", [4, 6])
def test_other_register_map_is_refused(version):
    with (
        opened(drive=f"{FREE}register_map_version = {version}") as rig,
        pytest.raises(PeerError, match=f"register map {version}; expected 5"),
    ):
        rig.motors["left"].enable()


@pytest.mark.parametrize(
    ("key", "message"),
    [
        ("watchdog_ms = 29.9", "too short for poll_ms = 10; at least 3 times poll_ms"),
        ("poll_ms = 0", "poll_ms"),
        ("rotor_to_output = 2", "did you mean rotor_to_output_ratio"),
    ],
)
def test_wrong_option_is_named(key, message):
    with opened(motor=key) as rig, pytest.raises(RigError, match=message):
        rig.motors["left"].enable()


def test_shortest_watchdog_is_fed():
    with opened(motor="watchdog_ms = 30") as rig:
        motor = rig.motors["left"]
        motor.enable()
        go_to(motor, 1.0)
        motor.wait_until_done(timeout_s=3)


def test_silent_drive_is_a_link_error(rig):
    motor = rig.motors["left"]
    motor.enable()
    rig.controllers["left"].stimulate("power", 0)
    rig.runtime.run_for(0.2)
    with pytest.raises(LinkError, match="no reply"):
        motor.position()
    assert motor.state() is MotorState.OFFLINE


def test_classical_bus_is_refused():
    text = (
        "[bus.can0]\nbitrate_bit_s = 1_000_000\n"
        '[controller.left]\nkind = "moteus"\nbus = "can0"\n'
        '[motor.left]\nadaptation = "moteus"\nbus = "can0"\nnode_id = 1\n'
        f"[motor.left.model]\n{MODEL}"
    )
    with (
        Rig(parse_rig(Source(Path("inline.toml"), text), installed_plugins())) as rig,
        pytest.raises(RigError, match="opened for classical CAN; open it with fd=True"),
    ):
        rig.motors["left"].enable()


def test_model_without_gear_ratio_is_refused():
    with (
        opened(model="velocity_max_rad_s = 2.0\nacceleration_max_rad_s2 = 4.0\n") as rig,
        pytest.raises(RigError, match="gear_ratio is missing"),
    ):
        rig.motors["left"].enable()
