"""Recorded drives on a serial line: what they answer, and what a live host says otherwise.

Packets are examples of the maker's manual of Protocol 2.0.
"""

from dataclasses import replace

import pytest

from motorhil.emulators.controller import ControllerContext, SettingError
from motorhil.harness.replay.device_node import build
from motorhil.harness.replay.host import DrivenRig, bench_of, compared, drive
from motorhil.harness.replay.rig import with_recorded
from motorhil.harness.replay.verdict import never_came, unanswered
from motorhil.harness.rig.rig import Rig
from motorhil.motorapi import (
    ControlMode,
    Motor,
    MotorGroup,
    PeerError,
    TrapezoidalTrajectory,
)
from motorhil.traces.mcap.writer import TraceWriter
from motorhil.traces.protobuf import encode
from motorhil.traces.schema import SERIAL_DATA, Direction, Schema
from motorhil.traces.semantics.diff import Tolerance
from tests.support.golden import described, golden

RIG = """\
bus.line = {kind = "serial", baud_bit_s = 1_000_000}
controller.left = {kind = "dynamixel", bus = "line", unit = 1}
"""
PING = bytes.fromhex("FFFFFD0001030001194E")
PONG = bytes.fromhex("FFFFFD000107005500060426655D")
READ = bytes.fromhex("FFFFFD0001070002840004001D15")
TOLD = bytes.fromhex("FFFFFD000108005580A60000008F7C")
WRITE = bytes.fromhex("FFFFFD0001090003740000020000CA89")
REFUSED = bytes.fromhex("FFFFFD000104005504BA8C")  # error 4
RESULT_FAIL = bytes.fromhex("FFFFFD000104005501A48C")
SYNC_READ = bytes.fromhex("FFFFFD00FE090082840004000102CEFA")
BROKEN = bytes.fromhex("FFFFFD00010300082F4F")  # a reboot with a wrong CRC
CHARACTER_NS = 10_000
MS = 1_000_000
_ANSWER_NS = 400_000


def recording(path, *exchanges, rig=RIG):
    """Record (sender, data) on a line, 1 ms apart; an answer begins 0.4 ms after its request."""
    with TraceWriter(path, {"run": {}}) as writer:
        writer.attach("rig.toml", rig.encode(), "application/toml")
        channel = writer.channel("/serial/line", Schema.of(SERIAL_DATA))
        now_ns = 0
        for sender, data in exchanges:
            is_host = sender == "host"
            now_ns = now_ns + (MS if is_host else _ANSWER_NS)
            values = {
                "direction": Direction.TRANSMITTED if is_host else Direction.RECEIVED,
                "sender": sender,
                "start_ns": now_ns,
                "end_ns": now_ns + len(data) * CHARACTER_NS,
                "data": data,
            }
            now_ns += len(data) * CHARACTER_NS
            writer.write(channel, now_ns, encode(SERIAL_DATA, values))
    return path


def said(path, *requests, **settings):
    """Return (delay [us], data) of what the recorded servo begins to send after each request."""
    core = build(
        {"recording": path.name, "unit": 1, **settings}, ControllerContext("left", path.parent, 1)
    )
    core.start(0)
    found = []
    for number, request in enumerate(requests, 1):
        now_ns = number * 10 * MS
        core.receive(request, now_ns)
        found += [(0, data) for data in core.take_output()]
        while (due_ns := core.next_deadline_ns()) is not None:
            core.expire(due_ns)
            found += [((due_ns - now_ns) // 1000, data) for data in core.take_output()]
    return core, found


ALL = (
    ("host", PING),
    ("left", PONG),
    ("host", READ),
    ("left", TOLD),
    ("host", WRITE),
    ("left", REFUSED),
)


def test_recorded_servo_answers_each_packet_at_its_delay(tmp_path):
    path = recording(tmp_path / "a.mcap", *ALL)
    core, found = said(path, PING, READ, READ, WRITE)
    assert found == [(400, PONG), (400, TOLD), (400, TOLD), (400, REFUSED)]
    assert core.player.mismatches == []
    assert core.player.never_came() == []


def test_packet_in_pieces_or_with_another_is_answered(tmp_path):
    path = recording(tmp_path / "a.mcap", *ALL)
    assert said(path, PING[:3], PING[3:])[1] == [(400, PONG)]
    assert said(path, PING[:8], READ)[1] == [(400, TOLD)]  # a new packet drops the beginning
    assert said(path, b"\0\xff" + PING)[1] == [(400, PONG)]


def test_packet_recorded_in_pieces_is_one_command(tmp_path):
    path = recording(
        tmp_path / "a.mcap", ("host", WRITE[:9]), ("host", WRITE[9:]), ("left", REFUSED)
    )
    core, found = said(path, WRITE)
    assert found == [(400, REFUSED)]
    assert core.player.never_came() == []


def test_unknown_packet_is_refused_and_told_with_expected_one(tmp_path):
    path = recording(tmp_path / "a.mcap", *ALL)
    other = bytes.fromhex("FFFFFD00010A00037400FFFFFDFDFF23E5")  # another goal
    core, found = said(path, PING, other)
    assert found == [(400, PONG), (0, RESULT_FAIL)]
    ((level, text),) = core.take_events()
    assert level == "error"
    assert "the recording cannot answer: Write: Goal_Position = -131073 count" in text
    assert "expected, as at 0.004490 s of it: Write: Goal_Position = 512 count" in text
    assert [str(step.text) for step in core.player.never_came()] == [
        "Write: Goal_Position = 512 count"
    ]


def test_other_goal_passes_with_any_set_point(tmp_path):
    path = recording(tmp_path / "a.mcap", *ALL)
    other = bytes.fromhex("FFFFFD00010A00037400FFFFFDFDFF23E5")
    core, found = said(path, other, set_points="any")
    assert found == [(400, REFUSED)]
    assert core.player.mismatches == []


def test_packets_to_others_and_broken_ones_change_nothing(tmp_path):
    path = recording(tmp_path / "a.mcap", ("host", BROKEN), *ALL)
    others = bytes.fromhex("FFFFFD000208005500 1F080000BABE")  # a status of servo 2
    core, found = said(path, others, BROKEN, TOLD)
    assert found == []
    assert core.player.mismatches == []
    assert all("Reboot" not in step.text for step in core.player.never_came())


def test_joint_read_is_answered_after_its_turn(tmp_path):
    path = recording(
        tmp_path / "a.mcap",
        *(("host", SYNC_READ), ("right", bytes.fromhex("FFFFFD0002080055001F080000BABE"))),
        ("left", TOLD),
    )
    assert said(path, SYNC_READ)[1] == [(400 + 150 + 400, TOLD)]


def test_another_unit_than_the_recorded_one_is_refused(tmp_path):
    path = recording(tmp_path / "a.mcap", *ALL)
    with pytest.raises(SettingError, match="the packets of a servo have its id"):
        said(path, unit=7, recorded_unit=1)


def test_program_with_another_target_fails_at_once():
    with golden("dynamixel") as path, Rig(with_recorded(described("dynamixel"), path)) as rig:
        left = rig.motors["left"]
        left.set_control_mode(ControlMode.SETPOINT)
        left.set_setpoint(1.1)
        with pytest.raises(PeerError, match="could not be done"):
            left.start()
        first = unanswered(rig)[0]
    assert first.controller == "left"
    told = str(first)
    assert "Goal_Position = 2765 count" in told  # 2048 + 1.1 rad
    assert "expected, as at" in told
    assert "Goal_Position = 2700 count" in told


def test_start_of_a_group_is_compared_for_the_recorded_servo_alone():
    """The right servo is emulated and goes the other way: one sync write has both goals."""
    with golden("dynamixel") as path:
        both = described("dynamixel")
        recorded = with_recorded(both, path).controllers["left"]
        mixed = replace(both, controllers={**both.controllers, "left": recorded})
        with Rig(mixed) as rig:
            left, right = rig.motors["left"], rig.motors["right"]
            left.set_control_mode(ControlMode.SETPOINT)
            left.set_setpoint(1.0)
            left.start()
            left.wait_until_done(timeout_s=5)
            group = MotorGroup(left, right)
            group.for_each(Motor.set_control_mode, ControlMode.TRAJECTORY)
            group.set_trajectory(TrapezoidalTrajectory(-0.5), TrapezoidalTrajectory(-1.0))
            group.start()
            group.wait_until_done(timeout_s=5)
            assert unanswered(rig) == []
            assert right.position() == pytest.approx(-1.0, abs=0.01)
            assert left.position() == pytest.approx(0.5, abs=0.01)


def test_commands_that_a_program_leaves_out_are_named():
    with golden("dynamixel") as path, Rig(with_recorded(described("dynamixel"), path)) as rig:
        rig.motors["left"].enable()
        missed = [(name, step.text) for name, step in never_came(rig)]
    assert any("Goal_Position" in text for name, text in missed if name == "left")
    assert not any(text.startswith(("Read", "Ping")) for _, text in missed)


def test_recorded_host_waits_for_the_live_servo_and_tells_its_silence(tmp_path):
    """Servo 2 is missing: its answers are awaited in vain, and count as differences."""
    live, both = tmp_path / "live.mcap", described("dynamixel")
    alone = replace(
        both,
        controllers={"left": both.controllers["left"]},
        motors={"left": both.motors["left"]},
        groups={},
    )
    with golden("dynamixel") as path:
        with Rig(alone, record=live) as rig:
            done = drive(DrivenRig(rig), path, bench=bench_of(rig.description))
        _, differing = compared(path, live, done.player.pairs, Tolerance(), done.reading)
    assert {one.awaited.subject for one in done.player.missed} == {("line", 2, "answer")}
    assert ("line", 2, "answer") in done.player.silent
    assert any(
        one.second is None and one.label.startswith("line, node 2 (right), Status")
        for one in differing
    )
