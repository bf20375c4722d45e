"""Logical motors that take turns with one motor: who commanded when, by the record alone."""

from itertools import pairwise

import pytest

from harness.ownership_record import Ended, read_ownership
from harness.rig import Rig, installed_plugins
from harness.rig_file import parse_rig
from harness.scaffold import EXAMPLES
from harness.settings import Source
from motorapi import ControlMode, MotorBusyError
from traces.digest import digest
from traces.reader import read_trace
from traces.schema import LockAction

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
    """Two programs have each had the left wheel twice, for two motions; when the middle was."""
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


def test_the_record_alone_tells_who_commanded_when(tmp_path):
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


def test_all_that_commands_the_drive_lies_within_somebodys_tenure(tmp_path):
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


def test_one_seed_is_one_record_and_no_process_is_in_it(tmp_path):
    take_turns(tmp_path / "1.mcap")
    take_turns(tmp_path / "2.mcap")
    assert digest(tmp_path / "1.mcap") == digest(tmp_path / "2.mcap")
    for event in read_ownership(tmp_path / "1.mcap").events:
        assert (event.pid, event.program) == (0, "")


def test_a_lease_that_ends_is_a_takeover_and_the_loser_notices_later(tmp_path):
    path = EXAMPLES / "two_wheels.toml"
    rig_file = parse_rig(Source(path, path.read_text() + MAST), installed_plugins())
    with Rig(rig_file, record=tmp_path / "run.mcap") as rig:
        drive, mast = rig.motors["left"], rig.motors["mast"]

        def rescue():
            with mast.reserve("rescue", timeout_s=5.0):
                rig.runtime.wait_until(lambda: False, 2.0)

        with drive.reserve("slow", lease_s=0.5):
            party = rig.runtime.spawn("mast", rescue)
            rig.runtime.run_for(1.0)  # and does nothing with it
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


def test_a_motor_on_no_bus_tells_it_too(tmp_path):
    path = EXAMPLES / "ideal_wheels.toml"
    with Rig.open(path, record=tmp_path / "run.mcap") as rig, rig.motors["left"].reserve("survey"):
        rig.runtime.run_for(1.5)
    record = read_ownership(tmp_path / "run.mcap")
    assert [event.action for event in record.events] == [LockAction.TAKEN, LockAction.RELEASED]
    (tenure,) = record.tenures["left"]
    assert (tenure.purpose, tenure.from_ns, tenure.to_ns) == ("survey", 0, 1_500_000_000)
