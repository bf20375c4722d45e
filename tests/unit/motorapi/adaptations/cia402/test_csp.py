"""Set-points in csp: one per SYNC, none lost, none doubled."""

from collections.abc import Callable
from itertools import pairwise
from types import SimpleNamespace
from typing import Any

import pytest

from motorhil.harness.rig.rig import Rig
from motorhil.motorapi.adaptations.cia402.csp import CspStream
from motorhil.motorapi.adaptations.cia402.hardware import Cia402HwMotor
from motorhil.motorapi.adaptations.cia402.motion import times_of_stream
from motorhil.motorapi.errors import UsageError
from tests.support.motors.drive_rigs import drive
from tests.unit.motorapi.adaptations.cia402.test_controlword import written_to_left

OpenRig = Callable[..., Rig]
CYCLES = 500


@pytest.fixture
def rig(open_rig: OpenRig) -> Rig:
    return open_rig(drive("left", 1), drive("right", 2))


def enabled(rig: Rig, node_id: int) -> Cia402HwMotor:
    hw = Cia402HwMotor(rig.bus("can0"), node_id)
    hw.enable()
    return hw


def test_each_set_point_is_sent_once_before_its_sync(rig: Rig):
    left, right = enabled(rig, 1), enabled(rig, 2)
    order: list[tuple[int, int]] = []

    def on_frame(bus: str, time_ns: int, sender: str, data: bytes) -> None:
        can_id = int.from_bytes(data[:4], "little")
        if can_id in (0x080, 0x301, 0x302):
            order.append((can_id, int.from_bytes(data[10:14], "little", signed=True)))

    rig.world.tap_frames(on_frame)
    streams = [
        hw.stream_positions(0.001, lambda cycle: 20 * cycle if cycle <= CYCLES else None)
        for hw in (left, right)
    ]
    assert rig.runtime.wait_until(lambda: all(stream.ended for stream in streams), 5.0)
    rig.runtime.run_for(0.05)
    assert [(stream.sent, stream.late) for stream in streams] == [(CYCLES, 0)] * 2
    for can_id, name in ((0x301, "left"), (0x302, "right")):
        targets = [target for found, target in order if found == can_id]
        assert targets[-CYCLES - 1 :] == [20 * cycle for cycle in range(CYCLES + 1)]
        assert rig.controllers[name].snapshot()["demand_inc"] == 20 * CYCLES
    # while both stream, each of them gets exactly one between two SYNCs
    syncs = [place for place, (can_id, _) in enumerate(order) if can_id == 0x080]
    cycles = [sorted(can_id for can_id, _ in order[a + 1 : b]) for a, b in pairwise(syncs)]
    both = [place for place, cycle in enumerate(cycles) if 0x302 in cycle and 0x301 in cycle]
    assert len(both) >= CYCLES - 30  # the second one begins while the first one streams
    assert cycles[both[0] : both[-1] + 1] == [[0x301, 0x302]] * len(both)
    left.close()
    right.close()


def test_csp_begins_at_the_drives_position(rig: Rig):
    hw = enabled(rig, 1)
    hw.write("target_position", 50_000)  # an old target
    at = rig.controllers["left"].snapshot()["position_inc"]
    written = written_to_left(rig)
    stream = hw.stream_positions(0.01, lambda cycle: None)
    assert [entry for entry in written if entry[0] in ("607A", "6060")] == [
        ("607A", at),
        ("6060", 8),
    ]
    rig.runtime.run_for(0.3)
    assert stream.ended
    assert abs(rig.controllers["left"].snapshot()["position_inc"] - at) <= 1
    hw.close()


def test_running_sync_does_not_fire_an_old_target(rig: Rig):
    left, right = enabled(rig, 1), enabled(rig, 2)
    left.stream_positions(0.001, lambda cycle: 0)
    right.write("target_position", 50_000)  # an old target
    right.stream_positions(0.001, lambda cycle: None)
    rig.runtime.run_for(0.3)
    assert abs(rig.controllers["right"].snapshot()["position_inc"]) <= 1
    left.close()
    right.close()


def test_application_error_ends_the_stream_and_is_kept(rig: Rig):
    hw = enabled(rig, 1)

    def broken(cycle: int) -> int | None:
        raise ZeroDivisionError("as an example")

    stream = hw.stream_positions(0.002, broken)
    rig.runtime.run_for(0.1)
    assert stream.ended
    assert isinstance(stream.error, ZeroDivisionError)
    assert hw.node.bus.sync.period_ns is None
    hw.close()


@pytest.mark.parametrize("period_s", [0.0005, 0.0015, 0.3])
def test_period_outside_60c2h_is_refused(rig: Rig, period_s: float):
    hw = enabled(rig, 1)
    with pytest.raises(UsageError, match="integer milliseconds, 1 to 255"):
        CspStream(hw.control, period_s, lambda cycle: 0)
    hw.close()


@pytest.mark.parametrize(
    ("late", "missed", "words"),
    [
        (0, 0, ""),
        (2, 0, "; 2 of 9 set-points were late"),
        (0, 1, "; the host missed 1 periods"),
        (2, 1, "; 2 of 9 set-points were late; the host missed 1 periods"),
    ],
)
def test_source_of_times_tells_late_and_missed_periods(late: int, missed: int, words: str):
    watch: Any = SimpleNamespace(started_ns=1, ended_ns=2)
    plain = times_of_stream(watch, None).source
    stream: Any = SimpleNamespace(late=late, sent=9, missed=missed)
    assert times_of_stream(watch, stream).source == plain + words
