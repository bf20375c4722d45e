"""Host programs against recorded devices: matches, mismatches, and reports."""

from contextlib import suppress
from itertools import pairwise

import pytest
from hypothesis import event, given
from hypothesis import strategies as st

from motorhil.harness.replay.rig import with_recorded
from motorhil.harness.replay.verdict import players, unanswered
from motorhil.harness.rig.rig import Rig
from motorhil.motorapi import ControlMode, MotorError
from motorhil.traces.mcap.reader import read_trace
from tests.support.golden import described, golden, overload, record
from tests.support.recordings.altered import copied, traffic


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
