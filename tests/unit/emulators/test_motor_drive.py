"""The parts of every emulated drive with one motor: times, delayed frames, inputs, builder."""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import ClassVar

import pytest

from motorhil.emulators.api import (
    REQUIRED,
    ControllerContext,
    MotorDrive,
    MotorTable,
    SettingError,
    axis_of,
    drive_builder,
    whole,
)

MS = 1_000_000
CONTEXT = ControllerContext(name="drive", folder=Path(), seed=1)
PLANT = {"preset": "wheel_60w"}


@dataclass(frozen=True, kw_only=True)
class Table(MotorTable):
    """A drive."""

    node_id: int = whole(REQUIRED, 1, 9, "", "Its number.", example="1")


class Drive(MotorDrive):
    """A drive with a time of its own and an input."""

    INPUTS: ClassVar = {"board_c": (-40.0, 100.0)}

    def __init__(self, table: Table, context: ControllerContext) -> None:
        motor = table.motor(context.stream())
        super().__init__(axis_of(motor, motor.oscillator.rate()), range(1, 3))
        self.seen: list[object] = []

    def boot(self, now_ns: int) -> None:
        self.wake("status", 5 * MS)

    def set_input(self, name: str, value: float) -> None:
        self.seen.append((name, value, self.now_ns))

    def expire(self, now_ns: int) -> None:
        self.advance(now_ns)
        if self.is_due("status"):
            self.seen.append(now_ns)
            self.queue_at(b"late", now_ns + 2 * MS)
        self.queue_due()

    def receive(self, data: bytes, now_ns: int) -> None:
        self.advance(now_ns)

    def inject(self, fault: int) -> None:
        self.seen.append(fault)

    def go_dark(self) -> None:
        self.seen.append("dark")

    def identifiers(self) -> Sequence[int] | None:
        return None


@pytest.fixture
def drive():
    made = Drive(Table(node_id=1, plant=PLANT), CONTEXT)
    made.start(0)
    return made


def test_a_time_is_due_once_and_its_frame_comes_later(drive):
    assert drive.next_deadline_ns() == 5 * MS
    drive.expire(5 * MS - 1)
    assert drive.seen == []
    drive.expire(5 * MS)
    assert drive.seen == [5 * MS]
    assert drive.take_output() == []
    assert drive.next_deadline_ns() == 7 * MS
    drive.expire(7 * MS)
    assert drive.take_output() == [b"late"]
    assert drive.next_deadline_ns() is None


def test_a_wait_of_0_cancels_a_time(drive):
    drive.wake("status", 0)
    assert drive.next_deadline_ns() is None
    drive.expire(9 * MS)
    assert drive.seen == []


def test_loss_of_power_cancels_times_and_delayed_frames(drive):
    drive.queue_at(b"late", 6 * MS)
    drive.stimulate("power", 0, MS)
    assert drive.next_deadline_ns() is None
    drive.stimulate("power", 1, 10 * MS)
    assert drive.next_deadline_ns() == 15 * MS
    drive.expire(15 * MS)
    assert drive.seen == ["dark", 15 * MS]
    assert drive.take_output() == []


def test_own_input_has_a_range_and_is_listed(drive):
    drive.stimulate("board_c", 85.0, MS)
    assert drive.seen == [("board_c", 85.0, MS)]
    with pytest.raises(ValueError, match=r"board_c = 101.0: out of range; expected -40 to 100"):
        drive.stimulate("board_c", 101.0, MS)
    with pytest.raises(ValueError, match="known: load_torque_n_m, supply_v, power, fault, board_c"):
        drive.stimulate("board_f", 1.0, MS)
    with pytest.raises(ValueError, match=r"fault = 3\.0: out of range; expected 1 to 2"):
        drive.stimulate("fault", 3.0, MS)


def test_builder_reads_the_table_and_is_marked():
    build = drive_builder(Table, Drive, api=1, bus_kinds=("serial",))
    assert (build.api_version, build.bus_kinds) == (1, ("serial",))
    made = build({"node_id": 1, "plant": PLANT}, CONTEXT)
    made.start(0)
    assert made.next_deadline_ns() == 5 * MS
    with pytest.raises(SettingError, match="node_id: 10 is out of range"):
        build({"node_id": 10, "plant": PLANT}, CONTEXT)


def test_input_that_nobody_sets_is_a_defect_of_the_drive():
    class Deaf(Drive):
        set_input = MotorDrive.set_input

    drive = Deaf(Table(node_id=1, plant=PLANT), CONTEXT)
    drive.start(0)
    with pytest.raises(TypeError, match="Deaf: INPUTS has 'board_c'; expected a set_input of it"):
        drive.stimulate("board_c", 20.0, 0)
