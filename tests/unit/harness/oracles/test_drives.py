"""Oracles of drives with a protocol of their own: golden recordings with one planted fault each.

That the golden recordings themselves are sound is in test_recordings.py.
"""

import random
from contextlib import suppress
from typing import NamedTuple

import pytest

from motorhil.harness.oracles.base import RecordingContext, Verdict
from motorhil.harness.oracles.drives.rules import DRIVE_ORACLES
from motorhil.harness.oracles.facts import Facts, subjects_in
from motorhil.harness.oracles.judge import Pass, judge
from motorhil.harness.oracles.seen import Incidents, Seen
from motorhil.harness.rig.config.rig_file import parse_rig
from motorhil.harness.rig.config.toml import Source
from motorhil.harness.rig.reading import installed_plugins
from motorhil.harness.rig.rig import Rig
from motorhil.motorapi import ControlMode, DeviceFault, MotorError
from motorhil.traces.decoding.attached_rig import facts_of, names_of, place_of
from motorhil.traces.exchange.drive_kinds import readers_of
from motorhil.traces.mcap.reader import read_trace
from motorhil.traces.protobuf import decode
from motorhil.traces.schema import SERIAL_DATA, FrameDecoder
from tests.support.golden import GOLDEN, described, golden

MS = 1_000_000
IDS = tuple(one.id for one in DRIVE_ORACLES)
EFF = 0x8000_0000


class Heard(NamedTuple):
    """A frame, or what one sender sent on a line without a pause."""

    time_ns: int
    bus: str
    data: bytes
    sender: str = ""

    @property
    def identifier(self):
        return int.from_bytes(self.data[:4], "little") & ~EFF

    def instead(self, at, *values):
        """Return it with other bytes from a place on."""
        data = self.data[:at] + bytes(values) + self.data[at + len(values) :]
        return self._replace(data=data)


def crc(data):
    """Return the CRC of Dynamixel's protocol 2.0, bit by bit."""
    register = 0
    for byte in data:
        for bit in range(7, -1, -1):
            is_set = (register >> 15) ^ (byte >> bit & 1)
            register = (register << 1 & 0xFFFF) ^ (0x8005 if is_set else 0)
    return register.to_bytes(2, "little")


def in_can(first, mask=0x7FF, at=8, value=None):
    """Return a test for frames of an identifier, and of a value at a place."""
    return lambda one: one.identifier & mask == first and (value is None or one.data[at] == value)


def with_error(one):
    """Return a status of the registers 64 to 143 without torque, with an overload."""
    told = bytearray(one.data)
    told[9], told[9 + 70 - 64] = 0, 0x20  # behind header, id, length, 55h, error
    return one._replace(data=bytes(told[:-2]) + crc(told[:-2]))


# An answer of drive 1, and what makes a fault of it.
KINDS = {
    "mit": (in_can(0x11), lambda one: one.instead(8, 0xB1)),
    "robstride": (in_can(0x02_00_01_00, 0x1F00_FF00), lambda one: one.instead(2, one.data[2] | 4)),
    "rmd": (in_can(0x241, value=0x9A), lambda one: one.instead(14, 4, 0)),
    "moteus": (in_can(0x0100, 0xFFFF), lambda one: one.instead(10, 1)),
    "vesc": (
        lambda one: one.identifier >> 8 == 8 and one.data[8] == 1 and one.data[10] == 50,
        lambda one: one.instead(15, 3),
    ),
    "dynamixel": (
        lambda one: one.data[4:5] == b"\1" and one.data[7:8] == b"\x55" and len(one.data) == 91,
        with_error,
    ),
}
ASKED = {"mit": "state", "robstride": "feedback", "rmd": "status 1", "moteus": "reply"} | {
    **{"vesc": "packet", "dynamixel": "status"},
}


def story(name):
    """Return the traffic of a golden recording, and its attachments."""
    frame_of, found = FrameDecoder().decode, []
    with golden(name) as path, read_trace(path) as trace:
        for channel, time_ns, payload in trace.messages():
            bus = channel.topic.rpartition("/")[2]
            if channel.topic.startswith("/can/"):
                frame, _, sender = frame_of(payload)
                found.append(Heard(time_ns, bus, frame, sender))
            elif channel.schema is not None and channel.schema.name == SERIAL_DATA.name:
                told = decode(SERIAL_DATA, payload)
                found.append(Heard(time_ns, channel.topic.strip("/").split("/")[1], told["data"]))
        return found, trace.attachments


def findings_of(heard, files, *, imported=False):
    """Return the findings by oracle, and what was seen."""
    tables = facts_of(files).settings.values()
    drives = {place_of(table): table for table in tables}
    context = RecordingContext(Facts(subjects_in(files)), names_of(files), None, None, drives)
    incidents = Incidents(context)
    pass_ = Pass(context, IDS, incidents)
    for one in heard:
        is_line = one.data[:3] == b"\xff\xff\xfd"
        take = pass_.take_bytes if is_line else pass_.take_frame
        take(one.time_ns, one.bus, one.data, one.sender)
    if imported:
        pass_.imported("candump")
    seen = Seen()
    pass_.saw(seen)
    return {one.oracle: one for one in pass_.findings(None, None, None)}, seen


def broken_in(findings):
    return [name for name, one in findings.items() if one.verdict is Verdict.BROKEN]


def chosen(heard, is_chosen):
    """Return the place of an answer in the middle of a recording."""
    places = [at for at, one in enumerate(heard) if is_chosen(one)]
    assert len(places) > 20
    return places[len(places) // 2]


@pytest.mark.parametrize("name", KINDS)
def test_answer_that_is_missing_is_found(name):
    heard, files = story(name)
    at = chosen(heard, KINDS[name][0])
    findings, _ = findings_of([*heard[:at], *heard[at + 1 :]], files)
    assert broken_in(findings) == ["drive-answered"]
    first = findings["drive-answered"].first
    assert (first.node, first.motor, findings["drive-answered"].further) == (1, "left", 0)
    assert first.text == f"no {ASKED[name]} within 0.2 s of the request"
    assert 0 < heard[at].time_ns - first.time_ns < 20 * MS  # it is the time of the request


@pytest.mark.parametrize("name", ["mit", "dynamixel"])
def test_answer_that_is_missing_at_the_end_is_found(name):
    heard, files = story(name)
    at = chosen(heard, KINDS[name][0])
    later = Heard(heard[at].time_ns + 300 * MS, "elsewhere", bytes(16))
    findings, _ = findings_of([*heard[:at], later], files)
    assert broken_in(findings) == ["drive-answered"]


@pytest.mark.parametrize("name", KINDS)
def test_missing_answer_of_an_imported_recording_is_a_doubt(name):
    heard, files = story(name)
    at = chosen(heard, KINDS[name][0])
    findings, _ = findings_of([*heard[:at], *heard[at + 1 :]], files, imported=True)
    assert broken_in(findings) == []
    assert findings["drive-answered"].verdict is Verdict.NOT_JUDGED
    assert findings["drive-answered"].first is not None


@pytest.mark.parametrize("name", [name for name in KINDS if name != "rmd"])
def test_second_answer_is_found(name):
    heard, files = story(name)
    at = chosen(heard, KINDS[name][0])
    again = heard[at]._replace(time_ns=heard[at].time_ns + 1)
    findings, _ = findings_of([*heard[: at + 1], again, *heard[at + 1 :]], files)
    assert broken_in(findings) == ["one-drive"]
    first = findings["one-drive"].first
    assert first.time_ns == again.time_ns
    assert first.text == f"one more {ASKED[name]} than was asked for"


def test_second_answer_to_a_motion_of_an_rmd_is_found():
    """The drive sends status 1 by itself when an error occurs: this one is no surplus."""
    heard, files = story("rmd")
    for command, expected in ((0xA4, ["one-drive"]), (0x9A, [])):
        at = chosen(heard, in_can(0x241, value=command))
        findings, _ = findings_of([*heard[: at + 1], *heard[at:]], files)
        assert broken_in(findings) == expected


@pytest.mark.parametrize("name", KINDS)
def test_second_sender_of_answers_is_found(name):
    heard, files = story(name)
    is_answer = KINDS[name][0]
    heard = [one._replace(sender="left" if is_answer(one) else "") for one in heard]
    assert broken_in(findings_of(heard, files)[0]) == []
    at = chosen(heard, is_answer)
    heard[at] = heard[at]._replace(sender="ghost")
    findings, _ = findings_of(heard, files)
    assert broken_in(findings) == ["one-drive"]
    assert findings["one-drive"].first.text == "answers are sent by left and by ghost"


@pytest.mark.parametrize("name", KINDS)
def test_motion_during_a_fault_is_found(name):
    heard, files = story(name)
    is_answer, fail = KINDS[name]
    begin_ns = heard[0].time_ns + 600 * MS
    end_ns = begin_ns + (800 if name in ("dynamixel", "rmd") else 300) * MS
    altered = [
        fail(one) if begin_ns <= one.time_ns < end_ns and is_answer(one) else one for one in heard
    ]
    findings, seen = findings_of(altered, files)
    assert broken_in(findings) == ["fault-heeded"]
    first = findings["fault-heeded"].first
    assert first.node == 1
    assert begin_ns + 100 * MS < first.time_ns < end_ns + 500 * MS
    assert [one.place for one in seen.incidents] == [f"{heard[0].bus} node 1 (left)"]
    assert first.text.split(", since")[0].endswith(seen.incidents[0].text.removeprefix("fault: "))


def begin(rig):
    """Start a motion of both motors."""
    for motor in rig.motors.values():
        motor.set_control_mode(ControlMode.SETPOINT)
        motor.set_setpoint(1.0)
        motor.start()
    rig.runtime.run_for(0.2)


@pytest.mark.parametrize("name", KINDS)
def test_host_that_heeds_and_resets_a_fault_is_not_accused(name, tmp_path):
    path, description = tmp_path / "fault.mcap", described(name)
    with Rig(description, record=path) as rig:
        left, facts = rig.motors["left"], description.conformance
        begin(rig)
        rig.controllers["left"].stimulate(facts.fault_stimulus, facts.fault_code)
        with pytest.raises(DeviceFault):
            left.wait_until_done(timeout_s=3)
        rig.runtime.run_for(1.0)
        left.reset_fault()
        left.set_setpoint(0.5)
        left.start()
        left.wait_until_done(timeout_s=3)
    seen = Seen()
    findings = judge(path, only=IDS, seen=seen)
    assert [one.verdict for one in findings] == [Verdict.HELD] * 3
    assert any(one.text.startswith("fault: ") for one in seen.incidents)


@pytest.mark.parametrize("name", KINDS)
def test_drive_that_loses_its_power_is_found(name, tmp_path):
    path = tmp_path / "power.mcap"
    with Rig(described(name), record=path) as rig:
        begin(rig)
        rig.controllers["left"].stimulate("power", 0.0)
        off_ns = rig.runtime.now_ns()
        rig.runtime.run_for(1.0)
    findings = {one.oracle: one for one in judge(path, only=IDS)}
    assert broken_in(findings) == ["drive-answered"]
    first = findings["drive-answered"].first
    assert (first.motor, first.node) == ("left", 1)
    assert 0 <= first.time_ns - off_ns < 100 * MS


@pytest.mark.parametrize("is_reset", [False, True])
def test_motion_directly_behind_a_reset_is_not_accused(is_reset):
    heard, files = story("mit")
    is_answer, fail = KINDS["mit"]
    answer = next(one for one in heard if is_answer(one))
    motion = next(one for one in heard if one.identifier == 1 and one.data[11:14] != bytes(3))
    reset = motion.instead(8, *b"\xff" * 7, 0xFB)
    told = [(0, answer), (1, fail(answer)), (300, reset), (301, motion)]
    frames = [one._replace(time_ns=ms * MS) for ms, one in told if one is not reset or is_reset]
    findings, _ = findings_of(frames, files)
    assert findings["fault-heeded"].looked == (0 if is_reset else 1)
    assert broken_in(findings) == ([] if is_reset else ["fault-heeded"])


@pytest.mark.parametrize("name", KINDS)
def test_altered_frames_are_judged_without_an_error(name):
    """Any byte may be wrong, the length of a frame included."""
    heard, files = story(name)
    draw = random.Random(name)
    first = 0 if name == "dynamixel" else 4  # an identifier stays one of a frame
    altered = [
        one.instead(draw.randrange(first, len(one.data)), draw.randrange(256)) for one in heard
    ]
    findings, _ = findings_of(altered, files)
    assert findings["one-drive"].looked or findings["drive-answered"].looked


@pytest.mark.parametrize("node", [-1, 256, 1 << 40])
@pytest.mark.parametrize("kind", [*KINDS, "strange"])
def test_drive_with_an_impossible_number_or_kind_is_not_judged(kind, node):
    assert readers_of(kind, node, {}) is None
    heard, _ = story("rmd")
    context = RecordingContext(Facts(), names_of(()), drives={("can0", node): {"kind": kind}})
    pass_ = Pass(context, IDS)
    for one in heard[:50]:
        pass_.take_frame(one.time_ns, one.bus, one.data, "")
    assert [one.looked for one in pass_.findings(None, None, None)] == [0, 0, 0]


STARVED = "watchdog: no commands in time"


@pytest.mark.parametrize(("name", "from_s"), [("rmd", 2.0), ("moteus", 0.6)])
def test_drive_without_commands_in_time_is_seen(name, from_s, tmp_path):
    """In motion, the host's frames are lost for longer than the drive's own watchdog."""
    lost = '[[fault]]\nbus = "can0"\nkind = "drop"\nsender = "host"\n'
    lost += f"from_s = {from_s}\nuntil_s = {from_s + 0.5}\n"
    path, source = tmp_path / "starved.mcap", Source(tmp_path / "rig.toml", GOLDEN[name][1] + lost)
    with Rig(parse_rig(source, installed_plugins()), record=path) as rig:
        rig.runtime.run_for(0.3)
        begin(rig)
        with suppress(MotorError):
            rig.motors["left"].wait_until_done(timeout_s=1.0)
        rig.runtime.run_for(0.5)
    seen = Seen()
    findings = judge(path, only=IDS, seen=seen)
    assert STARVED in [one.text for one in seen.incidents]
    assert "fault-heeded" not in broken_in({one.oracle: one for one in findings})


def test_expired_bus_watchdog_of_a_servo_is_seen():
    heard, files = story("dynamixel")
    assert findings_of(heard, files)[1].incidents == []
    is_status, _ = KINDS["dynamixel"]
    at = chosen(heard, is_status)
    for _ in range(2):  # it is told again, until it is reset
        told = bytearray(heard[at].data)
        told[9 + 98 - 64] = 0xFF
        heard[at] = heard[at]._replace(data=bytes(told[:-2]) + crc(told[:-2]))
        at = next(n for n in range(at + 1, len(heard)) if is_status(heard[n]))
    (incident,) = findings_of(heard, files)[1].incidents
    assert (incident.text, incident.times) == (STARVED, 1)
