"""The parts of every emulated drive with one motor: times, delayed frames, inputs, builder."""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import ClassVar

import pytest

from motorhil.emulators.api import (
    EFF_FLAG,
    REQUIRED,
    RTR_FLAG,
    CanMotorDrive,
    ControllerContext,
    MotorDrive,
    MotorTable,
    SettingError,
    axis_of,
    drive_builder,
    flags,
    pack,
    truncated,
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


class CanDrive(CanMotorDrive):
    """A drive on CAN with methods that are due, and faults that its plant causes."""

    FLAG: ClassVar = EFF_FLAG

    def __init__(self, table: Table, context: ControllerContext) -> None:
        motor = table.motor(context.stream())
        super().__init__(motor, range(1, 3), {flags.OVER_VOLTAGE: 7, flags.UNDER_VOLTAGE: 9})
        self.axis.set_thresholds(over_voltage_v=30.0, under_voltage_v=20.0)
        self.seen: list[object] = []
        self.is_deaf = False

    def boot(self, now_ns: int) -> None:
        self.wake(self.second, 5 * MS)
        self.wake(self.first, 5 * MS)
        self.wake(self.never, 7 * MS)
        self.due_ns["a name"] = 6 * MS

    def second(self) -> None:
        self.seen.append("second")
        self.wake(self.never, 0)

    def first(self) -> None:
        self.seen.append("first")
        self.wake(self.first, 1 * MS)

    def never(self) -> None:
        self.seen.append("never")

    def hears(self, now_ns: int) -> bool:
        return not self.is_deaf

    def hear(self, can_id: int, data: bytes) -> None:
        self.seen.append((can_id, data, self.now_ns))
        self.send(0x1ABCD, b"answer", 2 * MS)

    def inject(self, fault: int) -> None: ...

    def go_dark(self) -> None: ...

    def identifiers(self) -> Sequence[int] | None:
        return None


@pytest.fixture
def on_can():
    link = {"source_resistance_ohm": 0.1, "dc_link_capacitance_f": 1e-3, "dc_link_bleed_ohm": 50.0}
    plant = {**PLANT, **link}
    made = CanDrive(Table(node_id=1, plant=plant), CONTEXT)
    made.start(0)
    return made


def test_methods_that_are_due_are_called_in_order_of_time(on_can):
    on_can.expire(5 * MS - 1)
    assert on_can.seen == []
    on_can.expire(5 * MS)
    assert on_can.seen == ["second", "first"]  # at one time: as they were set
    on_can.due_ns[on_can.second] = 8 * MS
    on_can.expire(9 * MS)  # late: `first` was due at 6 ms; a method that is cancelled is not called
    assert on_can.seen == ["second", "first", "first", "second"]
    assert on_can.is_due("a name")  # names are left to `is_due`


def test_due_method_that_one_before_it_cancels_is_not_called(on_can):
    on_can.expire(8 * MS)
    assert on_can.seen == ["second", "first"]


def test_method_is_not_called_without_power(on_can):
    on_can.stimulate("power", 0, MS)
    on_can.due_ns[on_can.first] = 5 * MS
    on_can.expire(5 * MS)
    assert on_can.seen == []


def test_frames_of_its_kind_are_heard_and_answered_later(on_can):
    on_can.receive(pack(0x123 | EFF_FLAG, b"data"), MS)
    assert on_can.seen == [(0x123, b"data", MS)]
    assert on_can.take_output() == []
    assert on_can.next_deadline_ns() == 3 * MS
    on_can.expire(3 * MS)
    assert on_can.take_output() == [pack(0x1ABCD | EFF_FLAG, b"answer")]


@pytest.mark.parametrize("can_id", [0x123, 0x123 | EFF_FLAG | RTR_FLAG])
def test_frames_of_another_kind_are_not_heard(on_can, can_id):
    on_can.receive(pack(can_id, b"data"), MS)
    assert on_can.seen == []


def test_deaf_drive_and_one_without_power_hear_nothing(on_can):
    on_can.is_deaf = True
    on_can.receive(pack(0x123 | EFF_FLAG, b"data"), MS)
    on_can.is_deaf = False
    on_can.stimulate("power", 0, MS)
    on_can.receive(pack(0x123 | EFF_FLAG, b"data"), MS)
    assert on_can.seen == []


def test_causes_are_the_codes_of_active_flags_in_order(on_can):
    assert on_can.causes() == []
    on_can.stimulate("supply_v", 15.0, MS)
    on_can.advance(500 * MS)
    assert on_can.causes() == [9]
    on_can.stimulate("supply_v", 35.0, 500 * MS)
    on_can.advance(1000 * MS)
    assert on_can.causes() == [7]


def test_supply_beyond_its_range_is_refused_with_it(on_can):
    with pytest.raises(ValueError, match=r"supply_v = 1000000000.5: .* 0.001 to 1e\+06"):
        on_can.stimulate("supply_v", 1e9 + 0.5, MS)


def test_clock_that_is_not_ideal_is_told():
    settings = {"node_id": 1, "plant": PLANT, "oscillator": {"ppm": 50.0}}
    ((level, text),) = drive_builder(Table, CanDrive, api=1)(settings, CONTEXT).take_events()
    assert level == "info"
    assert "50" in text


@pytest.mark.parametrize(
    ("value", "expected"),
    [(1.9, 1), (-1.9, -1), (127.9, 127), (128, 127), (-128.9, -128), (1e300, 127), (-1e300, -128)],
)
def test_truncated_number_fits_its_size(value, expected):
    assert truncated(value, 8) == expected


@pytest.mark.parametrize(("value", "expected"), [(-1, 0), (255.9, 255), (256, 255)])
def test_truncated_number_without_sign(value, expected):
    assert truncated(value, 8, signed=False) == expected
