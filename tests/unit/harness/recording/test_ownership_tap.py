"""Ownership announcements of programs, in the record of a rig."""

import errno
import os

import pytest

from motorhil.emulators.simulation.ownership_notice import OwnershipNotice
from motorhil.harness.rig.config.scaffold import EXAMPLES
from motorhil.harness.rig.rig import Rig
from motorhil.traces.errors import TraceError
from motorhil.traces.mcap.writer import TraceWriter
from motorhil.traces.schema import LockAction
from motorhil.traces.semantics.ownership import Ended, LockEvent, read_ownership
from tests.support.plugin_rigs import GOOD, WHEEL

SECOND = 1_000_000_000
TAKEN, RELEASED = LockAction.TAKEN.value, LockAction.RELEASED.value


@pytest.fixture
def rig(bench):
    (bench / "rig.toml").write_text(
        GOOD + '[controller.spare]\nkind = "echo"\nbus = "can0"\nnode_id = 9\n'
    )
    (bench / "wheel.toml").write_text(WHEEL)
    return bench / "rig.toml"


def test_announcement_is_recorded_under_the_motors_name(rig, tmp_path):
    notice = OwnershipNotice(
        *(2, TAKEN, 7, "reserve() of wheel", "", "survey", "mast.py", 4711, 250_000_000, 0)
    )
    given_back = OwnershipNotice(2, RELEASED, 7, "reserve() of wheel", pid=4711, held_ns=SECOND)
    with Rig.open(rig, record=tmp_path / "run.mcap") as opened:
        opened.runtime.run_for(0.5)
        opened.world.tell_ownership("can0", "mast.py[4711]", notice)
        opened.runtime.run_for(1.0)
        opened.world.tell_ownership("can0", "mast.py[4711]", given_back)
    record = read_ownership(tmp_path / "run.mcap")
    assert record.events[0] == LockEvent(
        *("right", SECOND // 2, LockAction.TAKEN, "reserve() of wheel", "", "survey"),
        *(7, 4711, "mast.py", "mast.py[4711]"),
        waited_s=0.25,
    )
    assert record.events[1].held_s == 1.0
    (tenure,) = record.tenures["right"]
    assert (tenure.from_ns, tenure.to_ns) == (SECOND // 2, 3 * SECOND // 2)
    assert tenure.ended is Ended.RELEASED


@pytest.mark.parametrize(
    ("resource", "name"),
    [
        (3, "can0-node3"),
        (9, "spare"),
        (0x101, "left"),
        (0x201, "left-channel2"),
        (0x103, "can0-node3-channel1"),
    ],
)
def test_announcement_without_a_motor_is_recorded_by_place(rig, tmp_path, resource, name):
    with Rig.open(rig, record=tmp_path / "run.mcap") as opened:
        opened.world.tell_ownership("can0", "x", OwnershipNotice(resource, TAKEN, 1))
    assert list(read_ownership(tmp_path / "run.mcap").tenures) == [name]


def test_motor_is_recorded_by_its_name_not_its_controllers(rig, tmp_path):
    rig.write_text(GOOD.replace("motor.right", "motor.pan"))
    with Rig.open(rig, record=tmp_path / "run.mcap") as opened:
        opened.world.tell_ownership("can0", "x", OwnershipNotice(2, TAKEN, 1))
    assert list(read_ownership(tmp_path / "run.mcap").tenures) == ["pan"]


def test_channels_of_one_node_are_separate_motors(tmp_path):
    with Rig.open(EXAMPLES / "fido.toml", record=tmp_path / "run.mcap") as opened:
        motors = [
            motor
            for motor in opened.description.motors.values()
            if (motor.bus, motor.node_id) == ("can0", 1)
        ]
        for motor in motors:
            resource = 1 + 256 * motor.settings["channel"]
            opened.world.tell_ownership("can0", "x", OwnershipNotice(resource, TAKEN, 1))
    names = [event.motor for event in read_ownership(tmp_path / "run.mcap").events]
    assert names == [motor.name for motor in motors]
    assert len(set(names)) > 1


def test_program_in_the_rigs_process_has_no_recorded_pid(rig, tmp_path):
    notice = OwnershipNotice(1, TAKEN, 1, "start() of left", program="x", pid=os.getpid())
    with Rig.open(rig, record=tmp_path / "run.mcap") as opened:
        opened.world.tell_ownership("can0", "host", notice)
    (event,) = read_ownership(tmp_path / "run.mcap").events
    assert (event.pid, event.program, event.owner) == (0, "", "start() of left")


def test_full_disk_is_raised_by_the_run_not_in_the_program(rig, tmp_path, monkeypatch):
    def full(writer, entries):
        raise TraceError(str(tmp_path), os.strerror(errno.ENOSPC))

    went_on = []

    def until_it_is_told():
        with Rig.open(rig, record=tmp_path / "run.mcap") as opened:
            monkeypatch.setattr(TraceWriter, "extend", full)
            opened.world.tell_ownership("can0", "x", OwnershipNotice(1, TAKEN, 1))
            went_on.append(str(opened.recording.error))
            try:
                opened.runtime.run_for(0.5)
            finally:
                monkeypatch.undo()

    with pytest.raises(TraceError, match="No space left"):
        until_it_is_told()
    assert "No space left" in went_on[0]
