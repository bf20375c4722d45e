"""Oracles hold on a sound story, with counted cases, and break on altered ones."""

import struct

import pytest

from motorhil.harness.oracles.base import Verdict
from motorhil.harness.oracles.facts import Facts
from motorhil.harness.oracles.judge import IDS, is_sound, judge
from tests.support.recordings.story import (
    MS,
    RELEASED,
    TAKEN,
    error,
    record,
    story,
    written,
)

LOCKS = ((305, TAKEN, "host"), (1699, RELEASED, "host"))


def without(*chosen):
    """Return the story without frames of (identifier, first ms, last ms)."""
    return [
        frame
        for frame in story()
        if not any(frame[1] == one and low <= frame[0] <= high for one, low, high in chosen)
    ]


def with_more(*frames):
    return sorted([*story(), *frames], key=lambda frame: frame[0])


def instead(*frames):
    """Return the story with these frames instead of those with equal time and identifier."""
    times = {frame[:2] for frame in frames}
    return sorted([*frames, *(one for one in story() if one[:2] not in times)])


def status(ms, word, position):
    return ms, 0x181, struct.pack("<Hi", word, position)


def torque(ms, permille, velocity=0):
    return ms, 0x281, struct.pack("<hi", permille, velocity)


def gave_up():
    frames = [frame for frame in without((0x581, 470, 471)) if frame[0] > 0]
    return sorted([*frames, (770, 0x601, bytes.fromhex("8083600000000405"))])


LAGS = [(ms, 0x381, struct.pack("<i", 80)) for ms in range(605, 860, 50)]
BY_PRESENCE = [  # oracle, frames, time of the violation [ms], words of the violation
    ("limit-position", instead(status(700, 0x0237, 1200)), 700, "6064h beyond 607Dh: 1200 inc"),
    ("limit-position", with_more(*written(500, 0x607A, 4, 1500)), 510, "607Ah: 1.5 rad, limit 1"),
    (  # the display counts, not the written mode: it is still in pp
        "limit-position",
        sorted([*instead(status(700, 0x0237, 1200)), *written(494, 0x6060, 1, 4)]),
        *(700, "6064h beyond 607Dh: 1200 inc"),
    ),
    ("limit-velocity", instead(torque(605, 300, 1900)), 605, "beyond 607Fh: 1900"),
    ("limit-velocity", with_more(*written(500, 0x6081, 4, 2002)), 501, "2.002 rad/s, limit 2"),
    ("limit-acceleration", with_more(*written(500, 0x6083, 4, 4002)), 501, "6083h: 4.002 rad/s2"),
    ("limit-torque", instead(torque(605, 1080, 1000)), 605, "6077h: 1080 permille, limit 1000"),
    ("pds-legal", instead(status(700, 0x026F, 250)), 700, "none of the eight"),
    (
        "rest-when-told",
        instead(status(1100, 0x0637, 530), status(1200, 0x0637, 560)),
        *(1200, "moves while it reports arrival, since 0.900000 s: 30 inc, limit 10"),
    ),
    ("following-bounded", instead(*LAGS), 755, "since 0.605000 s"),
    ("torque-off", instead(torque(1555, -120)), 1555, "since 1.420000 s: 120 permille"),
    ("sdo-answered", gave_up(), 770, "SDO of 6083h, asked at 0.470000 s: the client gave up"),
    (
        "error-states",
        instead(error(1670, 0x204, "0020000000007800")),
        *(1670, "CAN controller of left: error passive by sending (TEC 120, REC 0): the g"),
    ),
    ("error-states", with_more((1685, 0x701, b"\5")), 1685, "left: sends 701h while it is bus-off"),
    ("one-sender", with_more((*status(610, 0x0237, 99), "ghost")), 700, "by ghost and by left"),
]
BY_ABSENCE = [  # missing frames
    ("pds-legal", without((0x201, 450, 450)), 460, "switched on, then operation enabled"),
    ("pds-legal", instead(status(1700, 0x0231, 500)), 1700, "after enable operation, fault reset"),
    (
        "pds-legal",
        without((0x201, 410, 410)),
        420,
        "ready to switch on (statusword 0231h), after no",
    ),
    ("pds-legal", without((0x201, 1610, 1610)), 1620, "fault, then switch on disabled"),
    ("pds-legal", with_more(status(610, 0x0200, 99)), 610, "then not ready to switch on"),
    ("fault-told", without((0x081, 0, 9999)), 1402, "without an EMCY within 1 s"),
    ("sync-period", without((0x080, 800, 800)), 810, "1 SYNC missing: 20 ms, limit 10 ms"),
    (
        "sync-period",
        [*without((0x080, 800, 800)), (804, 0x080, b"")],
        804,
        "out of its time: 14 ms",
    ),
    ("heartbeat-kept", without((0x701, 700, 900)), 950, "0.300 s: 300 ms, limit 170 ms"),
    ("heartbeat-kept", without((0x701, 700, 9999)), 1700, "until the recording ends"),
    ("sdo-answered", without((0x581, 470, 471)), 470, "SDO of 6083h, asked at 0.470000 s: no ans"),
    (
        "error-states",
        without((0x2000_0204, 1670, 1670)),
        1680,
        "left: bus-off (TEC 255, REC 0), but was error warning",
    ),
    (
        "error-states",
        instead(error(1690, 0x204, "0008000000006000")),
        1690,
        "left: error warning (TEC 96, REC 0), but was bus-off",
    ),
    ("no-reboot", with_more((1000, 0x701, b"\0")), 1000, "booted again without an NMT reset"),
]
REACH = {  # of the sound story, counted by hand
    "limit-position": 7,  # one target, six positions while enabled in pp
    "limit-velocity": 19,  # 6081h, and 606Ch from 505 to 1355 ms
    "limit-acceleration": 1,
    "limit-torque": 28,  # 6077h from 305 to 1655 ms
    "pds-legal": 6,
    "rest-when-told": 1,
    "following-bounded": 18,
    "torque-off": 3,  # at 405, 1555 and 1605 ms
    "fault-told": 1,
    "commands-obeyed": 0,  # all controlwords come by RPDO
    "mode-signs": 5,  # enabled in pp, after the first controlword with bit 4 = 0
    "arrival-true": 3,
    "sync-period": 139,
    "heartbeat-kept": 25,
    "sdo-answered": 24,  # 21 read, 3 written
    "one-sender": 6,
    "no-reboot": 27,
    "nmt-obeyed": 0,  # no node is reset, stopped or set back
    "sdo-refusals": 0,
    "errors-listed": 1,
    "tpdo-times": 0,  # no transmission type is known
    "error-states": 4,  # warning, passive, bus-off, restarted
    "drive-answered": 0,  # these three: no drive has a protocol of its own
    "one-drive": 0,
    "fault-heeded": 0,
    "owner-commands": 7,  # 0Fh, 1Fh, 0Fh, 80h, and three objects written
}


def findings_of(path, **options):
    return {finding.oracle: finding for finding in judge(path, **options)}


def broken_in(findings):
    return [name for name, one in findings.items() if one.verdict is Verdict.BROKEN]


def test_sound_story_is_held_by_every_oracle(tmp_path):
    findings = findings_of(record(tmp_path / "one.mcap", story(), locks=LOCKS))
    assert [one.first for one in findings.values()] == [None] * len(IDS)
    assert {name: one.looked for name, one in findings.items()} == REACH
    assert is_sound(findings.values())
    assert tuple(findings) == IDS
    for name in IDS:  # each oracle works alone
        assert judge(tmp_path / "one.mcap", only=[name]) == [findings[name]]


@pytest.mark.parametrize(("oracle", "frames", "ms", "words"), BY_PRESENCE)
def test_present_violation_breaks_one_oracle_in_any_recording(tmp_path, oracle, frames, ms, words):
    for metadata in ({"run": {}}, {}):
        findings = findings_of(record(tmp_path / "one.mcap", frames, metadata=metadata))
        assert broken_in(findings) == [oracle]
        first = findings[oracle].first
        assert first.time_ns == ms * MS
        assert words in str(first)
        assert (first.bus, first.node) == ("can0", 1)
        assert judge(tmp_path / "one.mcap", only=[oracle]) == [findings[oracle]]


@pytest.mark.parametrize(("oracle", "frames", "ms", "words"), BY_ABSENCE)
def test_missing_frame_breaks_one_oracle_if_complete(tmp_path, oracle, frames, ms, words):
    whole = record(tmp_path / "whole.mcap", frames)
    findings = findings_of(whole)
    assert broken_in(findings) == [oracle]
    first = findings[oracle].first
    assert first.time_ns == ms * MS
    assert words in str(first)

    imported = record(tmp_path / "imported.mcap", frames, metadata={})
    findings = findings_of(imported)
    assert broken_in(findings) == []
    assert findings[oracle].verdict is Verdict.NOT_JUDGED
    assert findings[oracle].first == first
    assert "--complete" in findings[oracle].reason
    assert broken_in(findings_of(imported, facts=Facts(is_complete=True))) == [oracle]


def test_command_without_ownership_breaks_oracle(tmp_path):
    frames = with_more((600, 0x201, b"\x1f\0", "other"))
    findings = findings_of(record(tmp_path / "one.mcap", frames, locks=LOCKS))
    assert broken_in(findings) == ["owner-commands"]
    first = findings["owner-commands"].first
    assert (first.time_ns, first.motor) == (600 * MS, "wheel")
    assert first.text.startswith("other sends 201h 1f 00 while wheel: 0.305 s to 1.699 s: host")


def test_creeping_drive_is_detected_at_the_end(
    tmp_path,
):
    frames = instead(status(1100, 0x0637, 530), status(1200, 0x0637, 560))
    path = record(tmp_path / "one.mcap", [frame for frame in frames if frame[0] < 1350])
    assert broken_in(findings_of(path)) == ["rest-when-told"]


def test_time_limits_judgement_but_not_knowledge(tmp_path):
    path = record(tmp_path / "one.mcap", without((0x201, 410, 410), (0x201, 1610, 1610)))
    early = findings_of(path, to_ns=1000 * MS)["pds-legal"]
    assert (early.first.time_ns, early.further, early.looked) == (420 * MS, 0, 3)
    late = findings_of(path, from_ns=1500 * MS)["pds-legal"]
    assert (late.first.time_ns, late.further, late.looked) == (1620 * MS, 0, 1)
    both = findings_of(path)["pds-legal"]
    assert (both.first.time_ns, both.further) == (420 * MS, 1)
    assert [one.oracle for one in judge(path, only=["pds-legal"])] == ["pds-legal"]


def test_unmapped_rpdo_prevents_judgement(tmp_path):
    """Without known controlwords, a state change may be due to an undecoded RPDO."""
    frames = [frame for frame in without((0x201, 410, 410)) if frame[1] != 0x301]
    frames += [(ms, 0x301, b"\x06\0") for ms in (405, 1600)]
    path = record(tmp_path / "one.mcap", sorted(frames, key=lambda frame: frame[0]))
    finding = findings_of(path)["pds-legal"]
    assert finding.verdict is Verdict.NOT_JUDGED
    assert finding.reason == ("RPDO 301h may carry the controlword: its mapping is not known")


def test_bus_without_canopen_is_not_judged(tmp_path):
    """Cars also use identifiers 580h to 67Fh, 700h to 77Fh and 080h."""
    frames = [(10 * n, 0x701, b"\x05") for n in range(20)]  # like heartbeats, which end
    frames += [(10 * n, 0x601, b"\x40" + bytes(7)) for n in range(100)]
    path = record(tmp_path / "car.mcap", sorted(frames, key=lambda frame: frame[0]))
    findings = judge(path)
    assert {finding.verdict for finding in findings} == {Verdict.NOT_JUDGED}
    assert [finding.looked for finding in findings] == [0] * len(IDS)
