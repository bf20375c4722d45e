"""Effects of bus errors on drive, application, record and user messages."""

import re

import pytest

from motorhil.harness.rig.rig import Rig
from motorhil.motorapi import ControlMode, DeadlineExceeded, LinkError, MotorState
from motorhil.traces.mcap.reader import read_trace

RIG = """
[rig]
name = "disturbed"
seed = 3
[bus.can0]
bitrate_bit_s = 500_000
{bus}
[controller.left]
kind = "cia402"
bus = "can0"
node_id = 1
plant = {{ preset = "wheel_60w" }}
{controller}
[motor.left]
adaptation = "cia402"
controller = "left"
[motor.left.model]
velocity_max_rad_s = 2.0
acceleration_max_rad_s2 = 4.0
increments_per_rad = 21008.45
velocity_unit_rad_s = 4.76e-05
acceleration_unit_rad_s2 = 4.76e-05
[[fault]]
bus = "can0"
{fault}
"""
STRUCK = 'kind = "error"\nerror = "bit"\nsender = "{sender}"\nlimit = {limit}\nfrom_s = 1.0'


def opened(tmp_path, fault, bus="", controller="", **options):
    path = tmp_path / "rig.toml"
    path.write_text(RIG.format(fault=fault, bus=bus, controller=controller))
    return Rig.open(path, **options)


def start(rig, target=3.0):
    motor = rig.motors["left"]
    motor.set_control_mode(ControlMode.SETPOINT)
    motor.set_setpoint(target)
    motor.start()
    return motor


def test_host_off_the_bus_by_command_reports_until_restart(tmp_path):
    chip = '[bus.can0.node.host]\nrecovery_s = "command"'
    with opened(tmp_path, STRUCK.format(sender="host", limit=32), chip) as rig:
        motor = start(rig)
        with pytest.raises(
            LinkError, match=r"can0: bus-off: nothing is sent or received since 1\."
        ):
            motor.wait_until_done(timeout_s=5)
        at_ns = rig.runtime.now_ns()
        assert at_ns < 1_200_000_000
        rig.runtime.run_for(0.05)  # shorter than the drive's heartbeat timeout
        assert motor.state() is MotorState.OFFLINE
        rig.faults.restart("can0", "host")
        rig.runtime.run_for(0.05)
        assert motor.state() is MotorState.ENABLED
        start(rig, 0.5).wait_until_done(timeout_s=5)
        assert motor.position() == pytest.approx(0.5, abs=0.001)


def test_drive_reports_recovery_from_bus_off(tmp_path):
    record = tmp_path / "run.mcap"
    with opened(tmp_path, STRUCK.format(sender="left", limit=32), record=record) as rig:
        motor = start(rig)
        with pytest.raises(LinkError) as lost:  # 1029h is 0
            motor.wait_until_done(timeout_s=5)
        assert "its NMT state is 7Fh (PRE-OPERATIONAL), not OPERATIONAL" in str(lost.value)
        assert "after EMCY 8140h at 1." in str(lost.value)
        assert lost.value.remedy == "start() brings it up again"
        assert [one.code for one in motor.hardware.emergencies][:2] == [0x8140, 0x0000]
        rig.runtime.run_for(2.0)
        motor.reset_fault()
        start(rig, 0.5).wait_until_done(timeout_s=5)
    with read_trace(record) as trace:
        told = [data for _, _, data in trace.messages({"/events"})]
    for text in (b"\x1a\x07bus-off", b"\x1a\x16recovered from bus-off"):  # a field of a message
        assert sum(text in one for one in told) == 1


def test_error_passive_drive_reports_it_and_continues(tmp_path):
    with opened(tmp_path, STRUCK.format(sender="left", limit=24)) as rig:
        motor = start(rig)
        motor.wait_until_done(timeout_s=5)
        rig.runtime.run_for(10.0)
        assert [one.code for one in motor.hardware.emergencies] == [0x8120, 0x0000]
        assert motor.fault() is None


@pytest.mark.parametrize(
    ("fault", "told"),
    [
        (
            'kind = "short"\nlevel = "dominant"',
            r"can0 is error passive since 1\.\d+ s \(TEC 0, REC",
        ),
        ('kind = "split"\nnodes = ["host"]', r"can0: no ACK since t = 1\.\d+ s"),
    ],
)
def test_lost_drive_error_names_the_bus_problem(tmp_path, fault, told):
    """The host's cable is faulty, not the drive's."""
    with opened(tmp_path, fault + "\nfrom_s = 1.0") as rig:
        motor = start(rig)
        lost = rf"no heartbeat for 300 ms since 1\.\d+ s; check the bus first: {told}"
        with pytest.raises(LinkError, match=lost):
            motor.wait_until_done(timeout_s=5)


def test_silent_drive_error_names_the_bus_problem(tmp_path):
    told = "last heard: nothing; can0: no ACK"
    alone = 'kind = "split"\nnodes = ["host"]'
    with opened(tmp_path, alone) as rig, pytest.raises(DeadlineExceeded, match=told):
        start(rig)


def test_unknown_bus_or_node_is_refused_with_known_names(tmp_path):
    with opened(tmp_path, STRUCK.format(sender="host", limit=1)) as rig:
        with pytest.raises(ValueError, match=r"this rig has no CAN bus 'can1' \(known: can0\)"):
            rig.faults.restart("can1", "host")
        with pytest.raises(ValueError, match=r"node lef not found \(known: left, host\)"):
            rig.faults.restart("can0", "lef")
        with pytest.raises(ValueError, match=r"host is not bus-off \(TEC 0, REC 0\)"):
            rig.faults.restart("can0", "host")
        with pytest.raises(ValueError, match="has no CAN bus 'can1'"):
            rig.faults.lift("can1", "fault 1")


def test_host_alone_on_its_bus_is_reported(tmp_path):
    fault = 'kind = "cut"\nnodes = ["left"]\nfrom_s = 1.0'
    with opened(tmp_path, fault) as rig:
        motor = start(rig, 0.1)
        motor.wait_until_done(timeout_s=5)
        rig.runtime.run_for(1.2 - rig.runtime.now_ns() / 1e9)
        with pytest.raises(DeadlineExceeded, match=r"can0: no ACK since t = 1\.\d+ s"):
            motor.hardware.read(0x6064)


SCRIPT = """
import can
from motorhil.motorapi.adaptations.cia402.motor import Cia402HwMotor
drive = Cia402HwMotor(can.Bus(), node_id=1)
drive.connect()
while True:
    drive.read("position_actual_value")
"""


def test_script_error_names_start_and_remedy_of_bus_off(tmp_path, say):
    opened(tmp_path, STRUCK.format(sender="host", limit=32)).close()
    (tmp_path / "script.py").write_text(SCRIPT)
    status, out, err = say("run", str(tmp_path / "rig.toml"), str(tmp_path / "script.py"))
    assert (status, out) == (1, "")
    assert re.search(r"LinkError: can0: bus-off: .* since 1\.\d+ s; .*rig\.faults\.restart", err)
