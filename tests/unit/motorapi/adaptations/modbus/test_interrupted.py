"""A Modbus drive that rests short of its target has not arrived."""

import pytest

from motorhil.emulators.media.serial_faults import SerialFaultKind, SerialFaultRule
from motorhil.motorapi import ControlMode, ControlVariable
from motorhil.motorapi.adaptations.leadshine.hardware import LeadshineHwMotor
from motorhil.motorapi.errors import MotionInterrupted, UsageError
from tests.support.modbus.bench import with_crc
from tests.support.modbus.rigs import opened, run_s, text, truth

SWITCHES = "switches = { home_rad = 0.3 }"


def begun(rig, variable=ControlVariable.POSITION):
    mast = rig.motors["mast"]
    mast.enable()
    mast.set_control_mode(ControlMode.SETPOINT, variable)
    mast.set_setpoint(1.0)
    mast.start()
    return mast


def say(rig, pdu):
    """Send a request as a second client, while ours is silent."""
    rig.line("line").send(with_crc(b"\x01" + bytes.fromhex(pdu)))
    run_s(rig, 0.05)


def test_limit_switch_ends_a_motion_short_of_its_target():
    with opened(text().replace(SWITCHES, "switches = { limit_forward_rad = 0.2 }")) as rig:
        mast = begun(rig)
        with pytest.raises(MotionInterrupted, match=r"it rests at 0\.2"):
            mast.wait_until_done(5)
        assert truth(rig)["position_rad"] == pytest.approx(0.2, abs=0.05)


def test_velocity_blocked_by_a_limit_switch_is_not_reached():
    switches = "switches = { limit_forward_rad = 0.02 }"
    with opened(text().replace(SWITCHES, switches)) as rig:
        mast = begun(rig, ControlVariable.VELOCITY)
        with pytest.raises(MotionInterrupted):
            mast.wait_until_done(5)


def test_emergency_stop_input_ends_a_motion():
    with opened() as rig:
        mast = begun(rig)
        run_s(rig, 0.3)
        rig.controllers["mast"].stimulate("emergency_stop", 1)
        with pytest.raises(MotionInterrupted):
            mast.wait_until_done(5)


@pytest.mark.parametrize(
    ("adaptation", "pdu"),
    [
        pytest.param("leadshine", "06 6002 0040", id="leadshine, stop"),
        pytest.param("leadshine", "06 000F 0000", id="leadshine, no current"),
        pytest.param("oriental_az", "10 007C 0002 04 0000 0020", id="az, STOP"),
        pytest.param("oriental_az", "10 007C 0002 04 0000 0040", id="az, FREE"),
    ],
)
def test_end_by_another_client_is_reported(adaptation, pdu):
    with opened(text(adaptation)) as rig:
        mast = begun(rig)
        run_s(rig, 0.3)
        say(rig, pdu)
        with pytest.raises(MotionInterrupted, match="another program"):
            mast.wait_until_done(5)


@pytest.mark.parametrize("adaptation", ["leadshine", "oriental_az"])
def test_arrival_on_a_slow_line_is_not_an_interruption(adaptation):
    with opened(text(adaptation)) as rig:
        late = SerialFaultRule("late", SerialFaultKind.DELAY, sender="mast", delay_ns=60_000_000)
        mast = begun(rig)
        rig.faults.inject("line", late)
        mast.wait_until_done(8)
        assert truth(rig)["position_rad"] == pytest.approx(1.0, abs=0.002)


@pytest.mark.parametrize("adaptation", ["leadshine", "oriental_az"])
def test_velocity_0_is_reached_at_rest(adaptation):
    with opened(text(adaptation)) as rig:
        mast = begun(rig, ControlVariable.VELOCITY)
        mast.wait_until_done(5)
        mast.set_setpoint(0.0)
        mast.start()
        mast.wait_until_done(5)
        assert truth(rig)["velocity_rad_s"] == pytest.approx(0.0, abs=0.02)


def test_line_of_another_runtime_is_refused_and_motor_is_free():
    with opened() as rig, opened() as other:
        line = rig.line("line")
        with pytest.raises(UsageError, match="another runtime"):
            LeadshineHwMotor(line, 2, runtime=other.runtime)
        LeadshineHwMotor(line, 2, runtime=rig.runtime).close()


@pytest.mark.parametrize(("line", "highest"), [("rtu", 247), ("tcp", 255)])
def test_server_address_range_is_checked(line, highest):
    with opened(text(line=line)) as rig:
        LeadshineHwMotor(rig.line("line"), highest, runtime=rig.runtime).close()
        with pytest.raises(UsageError, match=f"1 to {highest}"):
            LeadshineHwMotor(rig.line("line"), highest + 1, runtime=rig.runtime)
