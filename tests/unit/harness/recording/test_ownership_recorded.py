"""Logical motors sharing one motor, according to the record alone."""

from itertools import pairwise

import pytest

from motorhil.harness.rig.config.rig_file import parse_rig
from motorhil.harness.rig.config.scaffold import EXAMPLES
from motorhil.harness.rig.config.toml import Source
from motorhil.harness.rig.reading import installed_plugins
from motorhil.harness.rig.rig import Rig
from motorhil.motorapi import ControlMode, MotorBusyError
from motorhil.traces.digest import digest
from motorhil.traces.mcap.reader import read_trace
from motorhil.traces.schema import LockAction
from motorhil.traces.semantics.ownership import Ended, read_ownership

MAST = """[motor.mast]
adaptation = "cia402"
controller = "left"
model = "wheel_model.toml"
servo_period_ms = 1.0
oscillator_ppm = 100.0
"""
TURNS = ["drive 1", "mast 1", "drive 2", "mast 2"]


def move(motor, way):
    motor.set_control_mode(ControlMode.SETPOINT)
    motor.set_setpoint(way, relative=True)
    motor.start()
    motor.wait_until_done(10.0)


def take_turns(target, rig_file="two_wheels", more=MAST):
    """Let two programs use the left wheel twice each, in turns; return the middle times [ns]."""
    path = EXAMPLES / f"{rig_file}.toml"
    known = installed_plugins()
    middle_ns = []
    with Rig(parse_rig(Source(path, path.read_text() + more), known), record=target) as rig:

        def program(name, motor):
            for number in (1, 2):
                with motor.reserve(f"{name} {number}", timeout_s=60.0):
                    move(motor, 0.25)
                    middle_ns.append(rig.runtime.now_ns())
                    move(motor, -0.25)

        drive = rig.motors["left"]
        parties = [
            rig.runtime.spawn("drive", lambda: program("drive", drive)),
            rig.runtime.spawn("mast", lambda: program("mast", rig.motors["mast"])),
        ]
        for party in parties:
            assert party.join(timeout_s=100.0)
            assert party.error is None
    return middle_ns


def test_record_alone_shows_who_commanded_when(tmp_path):
    middle_ns = take_turns(tmp_path / "run.mcap")
    record = read_ownership(tmp_path / "run.mcap")
    assert record.contradictions == ()
    tenures = record.tenures["left"]
    assert [one.purpose for one in tenures] == TURNS
    assert [one.owner for one in tenures] == ["reserve() of left", "reserve() of mast"] * 2
    assert {one.ended for one in tenures} == {Ended.RELEASED}
    for before, after in pairwise(tenures):
        assert before.token < after.token
        assert before.to_ns <= after.from_ns
    for time_ns, purpose in zip(middle_ns, TURNS, strict=True):
        assert record.owner_at("left", time_ns).purpose == purpose


def test_every_command_of_the_drive_is_within_a_tenure(tmp_path):
    take_turns(tmp_path / "run.mcap")
    record = read_ownership(tmp_path / "run.mcap")
    first_ns = record.tenures["left"][0].from_ns
    with read_trace(tmp_path / "run.mcap") as trace:
        frames = [
            (time_ns, int.from_bytes(data[1:5], "little"))
            for _, time_ns, data in trace.messages(["/can/can0"])
        ]
    targets_ns = [time_ns for time_ns, can_id in frames if can_id == 0x201 and time_ns > first_ns]
    assert len(targets_ns) >= 8  # RPDO 1 of node 1: each motion begins with at least one
    assert all(record.owner_at("left", time_ns) for time_ns in targets_ns)


def test_one_seed_gives_one_record_without_process_ids(tmp_path):
    take_turns(tmp_path / "1.mcap")
    take_turns(tmp_path / "2.mcap")
    assert digest(tmp_path / "1.mcap") == digest(tmp_path / "2.mcap")
    for event in read_ownership(tmp_path / "1.mcap").events:
        assert (event.pid, event.program) == (0, "")


def test_expired_lease_is_a_takeover_noticed_later(tmp_path):
    path = EXAMPLES / "two_wheels.toml"
    rig_file = parse_rig(Source(path, path.read_text() + MAST), installed_plugins())
    with Rig(rig_file, record=tmp_path / "run.mcap") as rig:
        drive, mast = rig.motors["left"], rig.motors["mast"]

        def rescue():
            with mast.reserve("rescue", timeout_s=5.0):
                rig.runtime.wait_until(lambda: False, 2.0)

        with drive.reserve("slow", lease_s=0.5):
            party = rig.runtime.spawn("mast", rescue)
            rig.runtime.run_for(1.0)  # without using it
            with pytest.raises(MotorBusyError):
                drive.enable()
        assert party.join(timeout_s=10.0)
        assert party.error is None
    record = read_ownership(tmp_path / "run.mcap")
    slow, rescued = record.tenures["left"]
    assert (slow.purpose, slow.ended) == ("slow", Ended.TAKEN_OVER)
    assert slow.to_ns == rescued.from_ns == 500_000_000
    assert slow.noticed_ns >= slow.to_ns
    assert (rescued.purpose, rescued.ended) == ("rescue", Ended.RELEASED)
    assert record.contradictions == ()


def test_motor_without_a_bus_records_its_ownership(tmp_path):
    path = EXAMPLES / "ideal_wheels.toml"
    with Rig.open(path, record=tmp_path / "run.mcap") as rig, rig.motors["left"].reserve("survey"):
        rig.runtime.run_for(1.5)
    record = read_ownership(tmp_path / "run.mcap")
    assert [event.action for event in record.events] == [LockAction.TAKEN, LockAction.RELEASED]
    (tenure,) = record.tenures["left"]
    assert (tenure.purpose, tenure.from_ns, tenure.to_ns) == ("survey", 0, 1_500_000_000)
