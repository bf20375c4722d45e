"""Host programs against recorded devices: matches, mismatches, and reports."""

from contextlib import suppress
from itertools import pairwise

import pytest
from hypothesis import event, given
from hypothesis import strategies as st

from motorhil.harness.replay.rig import with_recorded
from motorhil.harness.replay.verdict import never_came, players, unanswered
from motorhil.harness.rig.rig import Rig
from motorhil.motorapi import ControlMode, MotorError
from motorhil.traces.can_frame import EFF, classic
from motorhil.traces.exchange.drive_kinds import readers_of
from motorhil.traces.exchange.drives import drive_key
from motorhil.traces.mcap.reader import read_trace
from tests.support.golden import GOLDEN, described, golden, overload, record
from tests.support.recordings.altered import copied, traffic
from tests.unit.harness.replay.test_golden import DESCRIBED


def one_move(rig, target=1.0, pauses=(0.0, 0.0, 0.0), after_enable=None):
    """Run the first half of `algorithms` with the given pauses."""
    left = rig.motors["left"]
    left.set_control_mode(ControlMode.SETPOINT)
    rig.runtime.run_for(pauses[0])
    if after_enable is not None:
        left.enable()
        after_enable(left)
    left.set_setpoint(target)
    rig.runtime.run_for(pauses[1])
    left.start()
    left.wait_until_done(timeout_s=5)
    rig.runtime.run_for(pauses[2])
    return left.position()


@given(st.tuples(*[st.sampled_from((0.0, 0.001, 0.037, 0.4, 3.0))] * 3))
def test_slower_host_is_answered_completely(pauses):
    with golden("cia402") as path, Rig(with_recorded(described("cia402"), path)) as rig:
        position = one_move(rig, pauses=pauses)
        event(f"slower by {sum(pauses):g} s")
        assert unanswered(rig) == []
        assert position == pytest.approx(1.0, abs=0.001)  # reached by the recorded drive


def test_idle_drive_keeps_its_heartbeat_period():
    with golden("cia402") as path, Rig(with_recorded(described("cia402"), path)) as rig:
        one_move(rig)
        heard = []
        rig.runtime.listen(rig.bus("can0"), lambda *one: heard.append(one))
        rig.runtime.run_for(5.0)
        beats = [time_ns for frame, time_ns, _ in heard if frame[:2] == b"\x01\x07"]
        assert 49 <= len(beats) <= 51
        steps = {b - a for a, b in pairwise(beats[1:])}
        assert max(steps) - min(steps) < 1_000_000


def test_other_target_is_reported_with_the_expected_one():
    with golden("cia402") as path, Rig(with_recorded(described("cia402"), path)) as rig:
        with pytest.raises(MotorError):
            one_move(rig, target=1.1)
        first = unanswered(rig)[0]
    assert first.controller == "left"
    told = str(first)
    # The model: 66 * 2000 increments per 2 pi.
    assert "write 607Ah target position = 23109" in told
    assert "expected, as at" in told
    assert "write 607Ah target position = 21008" in told


@pytest.mark.parametrize("set_points", ["exact", "any"])
def test_other_streamed_values_pass_only_with_any_set_point(set_points):
    """The target is half a milliradian further, within the recorded position window."""
    with golden("software") as path:
        description = with_recorded(described("software"), path, set_points)
        with Rig(description) as rig:
            if set_points == "any":
                one_move(rig, target=1.0005)
            else:
                with suppress(MotorError):
                    one_move(rig, target=1.0005)
            assert bool(unanswered(rig)) == (set_points == "exact")


def sdo_answers(path):
    """Return (message number, payload) of node 1's SDO answers."""
    found = []
    with read_trace(path) as trace:
        for number, (channel, _, payload) in enumerate(trace.messages()):
            if channel.topic == "/can/can0" and payload[1:5] == b"\x81\x05\0\0":
                found.append((number, payload))
    return found


# Answers that affect the host: (object, byte of its value to alter).
ACTED_ON = {
    "1000h": (b"\x43\x00\x10\x00", 0),
    "6061h": (b"\x4f\x61\x60\x00", 0),
    "1400h:2": (b"\x4f\x00\x14\x02", 0),
    "607Dh": (b"\x43\x7d\x60\x02", 0),
    "6062h": (b"\x43\x62\x60\x00", 1),
}


@pytest.mark.parametrize("what", ACTED_ON)
def test_altered_answer_fails_and_is_named(what, tmp_path):
    head, byte = ACTED_ON[what]

    with golden("cia402") as path:
        number = next(n for n, payload in sdo_answers(path) if payload[-8:-4] == head)

        def change(here, topic, time_ns, payload):
            if here != number:
                return payload
            at = len(payload) - 4 + byte
            return payload[:at] + bytes([payload[at] ^ 0x01]) + payload[at + 1 :]

        altered = copied(path, tmp_path / "altered.mcap", change)
        told = ""
        with Rig.open(altered) as rig:
            try:
                one_move(rig)
                one_move(rig, target=2.0) if what == "6062h" else None
            except MotorError as error:
                told = str(error)
            for one in unanswered(rig):
                told += "\n".join([str(one), *one.mismatch.before])
    assert what in told


def test_unaltered_copy_passes(tmp_path):
    """The counterpart: the same copy without a change."""
    with golden("cia402") as path:
        same = copied(path, tmp_path / "same.mcap", lambda *args: args[-1])
        with Rig.open(same) as rig:
            one_move(rig)
            assert unanswered(rig) == []


def test_unrecorded_read_is_aborted_and_reported():
    with golden("cia402") as path, Rig(with_recorded(described("cia402"), path)) as rig:
        with pytest.raises(MotorError, match="2020h:00h aborted: no data available"):
            one_move(rig, after_enable=lambda motor: motor.hardware.read(0x2020, 0, "u16"))
        (one,) = unanswered(rig)
        assert "read 2020h" in str(one)


def test_constant_object_is_answered_for_every_read():
    def ask(motor):
        for _ in range(3):
            assert motor.hardware.read(0x1018, 2, "u32") == 0x402

    with golden("cia402") as path, Rig(with_recorded(described("cia402"), path)) as rig:
        one_move(rig, after_enable=ask)
        assert unanswered(rig) == []


def test_unrecorded_modbus_request_is_refused_and_reported():
    with golden("leadshine") as path, Rig(with_recorded(described("leadshine"), path)) as rig:
        with pytest.raises(MotorError, match="server device failure"):
            one_move(rig, target=1.1)
        first = unanswered(rig)[0]
        assert first.controller == "left"
        assert "write" in str(first)
        assert "expected, as at" in str(first)


def test_recorded_drive_refuses_stimulus():
    with (
        golden("cia402") as path,
        Rig(with_recorded(described("cia402"), path)) as rig,
        pytest.raises(ValueError, match="a recorded drive has no inputs"),
    ):
        rig.controllers["left"].stimulate("load_torque_n_m", 1.0)


def test_recording_of_a_replay_can_be_replayed(tmp_path):
    """Devices from a replay's recording behave identically."""
    first = tmp_path / "first.mcap"
    second = tmp_path / "second.mcap"
    record("overload", first)
    with Rig(with_recorded(described("overload"), first), record=second) as rig:
        overload(rig)
    with Rig.open(second) as rig:
        overload(rig)
        assert unanswered(rig) == []
        assert sum(one.matched for one in players(rig).values()) > 20
    assert traffic(first) == traffic(second)


# ---- drives with a protocol of their own


@pytest.mark.parametrize("pauses", [(0.0, 0.0371, 0.0), (0.4, 0.0, 0.0)])
@pytest.mark.parametrize("name", DESCRIBED)
def test_slower_host_of_another_kind_is_answered_completely(name, pauses):
    with golden(name) as path, Rig(with_recorded(described(name), path)) as rig:
        position = one_move(rig, pauses=pauses)
        assert unanswered(rig) == []
        assert position == pytest.approx(1.0, abs=0.002)  # reached by the recorded drive


@pytest.mark.parametrize("name", DESCRIBED)
def test_other_target_of_another_kind_is_reported_with_the_expected_command(name):
    with golden(name) as path, Rig(with_recorded(described(name), path)) as rig:
        with pytest.raises(MotorError):
            one_move(rig, target=1.1)
        first = unanswered(rig)[0]
    assert first.controller == "left"
    came, expected = str(first.mismatch).split("; expected, as at ")
    words = {"mit": "Command: p = ", "robstride": "Motion: p = ", "vesc": "SET_POS: position = "}
    words |= {
        "dynamixel": "Write: Profile_Acceleration = ",
        "rmd": "absolute position: ",
        "moteus": "Query: mode = position, position command = ",
    }
    assert words[name] in came
    assert words[name] in expected


@pytest.mark.parametrize("set_points", ["exact", "any"])
@pytest.mark.parametrize("name", [name for name in DESCRIBED if name != "moteus"])
def test_other_set_points_of_another_kind_pass_only_with_any(name, set_points):
    """The target is a little further, within the recorded position window: a count of a servo."""
    target = 1.002 if name == "dynamixel" else 1.0005
    with golden(name) as path, Rig(with_recorded(described(name), path, set_points)) as rig:
        with suppress(MotorError):
            one_move(rig, target=target)
        assert bool(unanswered(rig)) == (set_points == "exact")


def test_idle_vesc_keeps_the_period_of_its_status():
    with golden("vesc") as path, Rig(with_recorded(described("vesc"), path)) as rig:
        one_move(rig)
        heard = []
        rig.runtime.listen(rig.bus("can0"), lambda *one: heard.append(one))
        rig.runtime.run_for(5.0)
        stati = [time_ns for frame, time_ns, _ in heard if frame[:4] == b"\x01\x09\0\x80"]
    assert 499 <= len(stati) <= 501


def test_request_that_is_not_in_the_recording_is_not_answered():
    with golden("rmd") as path, Rig(with_recorded(described("rmd"), path)) as rig:
        one_move(rig)
        heard, events = [], []
        rig.world.tap_events(lambda _, level, name, text: events.append((level, name, text)))
        rig.runtime.listen(rig.bus("can0"), lambda *one: heard.append(one))
        rig.runtime.send(rig.bus("can0"), classic(0x141, b"\xb1" + bytes(7)))
        rig.runtime.run_for(0.002)
        (first,) = unanswered(rig)
    assert "run time" in str(first)
    assert [(level, name, "run time" in text) for level, name, text in events] == [
        ("error", "left", True)
    ]
    assert not any(frame[8] == 0xB1 and not own for frame, _, own in heard)


def test_poll_between_other_commands_gets_the_nearest_answer():
    """The recorded host asked for the fault every 50 ms, between set-points every 5 ms."""
    with golden("vesc") as path, Rig(with_recorded(described("vesc"), path)) as rig:
        left = rig.motors["left"]
        left.set_control_mode(ControlMode.SETPOINT)
        left.set_setpoint(1.0)
        left.start()
        for _ in range(20):
            rig.runtime.run_for(0.0123)
            assert left.hardware.read_fault() == 0
        assert unanswered(rig) == []


@pytest.mark.parametrize("name", DESCRIBED)
def test_recording_of_a_replay_of_another_kind_can_be_replayed(name, tmp_path):
    second, run = tmp_path / "second.mcap", GOLDEN[name][2]
    with golden(name) as path:
        with Rig(with_recorded(described(name), path), record=second) as rig:
            run(rig)
        with Rig.open(second) as rig:
            run(rig)
            assert unanswered(rig) == []
            assert sum(one.matched for one in players(rig).values()) > 10


@pytest.mark.parametrize("name", ["moteus", "rmd", "robstride", "vesc"])
def test_polls_of_another_kind_that_never_came_are_not_missed(name):
    with golden(name) as path, Rig(with_recorded(described(name), path)) as rig:
        one_move(rig)
        missed = [step for _, step in never_came(rig)]
    assert len(missed) > 20
    reads = ("multi-turn", "status", "FW_VERSION", "GET_VALUES", "ALIVE", "Query: read", "Read")
    assert not any(word in step.text for step in missed for word in reads)


def test_any_set_point_ignores_the_torque_in_an_identifier_of_a_robstride():
    keys = set()
    for number in (0x01_8000_01, 0x01_9234_01, 0x01_9234_02):
        frame = (number | EFF).to_bytes(4, "little") + b"\x08\0\0\0" + bytes((0x80, 0)) * 4
        decode, read = readers_of("robstride", number & 0xFF, {"model": "rs01"})
        told = read(frame, decode(frame))
        keys.add(drive_key(frame, told, any_set_point=True))
        assert drive_key(frame, told, any_set_point=False)[2] == frame[8:]
    assert len(keys) == 2  # by motor
