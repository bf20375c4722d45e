"""Cases that resemble violations, and recordings that prove nothing."""

import pytest

from motorhil.harness.cli.main import main
from motorhil.harness.oracles.base import Verdict
from motorhil.harness.oracles.facts import Facts
from motorhil.harness.oracles.judge import judge
from motorhil.harness.oracles.state_machine import Command, command_in
from tests.support.recordings.story import record, sdo, story, written
from tests.unit.harness.oracles.test_broken import (
    LAGS,
    LOCKS,
    broken_in,
    findings_of,
    instead,
    status,
    torque,
    with_more,
    without,
)

SYNC = 0x080
CREEPS = (status(1100, 0x0637, 530), status(1200, 0x0637, 560))


def by_time(*frames):
    return sorted(frames, key=lambda frame: frame[0])


def slow_drive():
    """Delay the statusword of 405 ms behind the controlwords of 401 and 403 ms."""
    words = ((401, 0x201, b"\x06\0"), (403, 0x201, b"\x07\0"), status(405, 0x0250, 0))
    return by_time(*without((0x201, 410, 430)), *words)


def lowered():
    """Lower 6072h to 200 at 600 ms; the old limit may still apply for a while."""
    late = [torque(ms, 100, 0) for ms in range(1055, 1400, 50)]
    return by_time(*instead(*late), *written(600, 0x6072, 2, 200))


FINE = {
    "a distance is not a position": by_time(
        *instead((510, 0x201, b"\x5f\0")), *written(500, 0x607A, 4, 1500)
    ),
    "a motion of torque passes 607Dh": by_time(
        *instead(status(700, 0x0237, 1200)), *sdo(494, 0x6061, 0, 1, 4)
    ),
    "a limit that was lowered": lowered(),
    "a new set-point ends the rest": by_time(*instead(*CREEPS), (1050, 0x201, b"\x1f\0")),
    "SYNC that was stopped": without((SYNC, 800, 890)),
    "SYNC that began again": by_time(
        *without((SYNC, 800, 9999)), *((ms, SYNC, b"") for ms in range(814, 1700, 10))
    ),
    "a drive that is slow": slow_drive(),
    "one who is not named": with_more((600, 0x201, b"\x1f\0", "")),
}


def test_programs_of_one_host_may_share_a_heartbeat_and_end(tmp_path):
    """No device has node-ID 127: two programs send 77Fh until 900 ms, and end."""
    beats = [(ms, 0x77F, b"\x05", f"program[{ms // 50 % 2}]") for ms in range(50, 900, 50)]
    findings = findings_of(record(tmp_path / "one.mcap", with_more(*beats), locks=LOCKS))
    assert {one.oracle: str(one.first) for one in findings.values() if one.first} == {}


def test_device_may_not_share_its_heartbeat(tmp_path):
    """A node that has answered or booted is a device, and its sender is its own."""
    frames = with_more((650, 0x701, b"\x05", "ghost"))
    assert findings_of(record(tmp_path / "one.mcap", frames))["one-sender"].first is not None


@pytest.mark.parametrize("name", FINE)
def test_allowed_behaviour_is_not_broken(tmp_path, name):
    findings = findings_of(record(tmp_path / "one.mcap", FINE[name], locks=LOCKS))
    assert {one.oracle: str(one.first) for one in findings.values() if one.first} == {}


def test_disabled_following_window_is_not_judged(tmp_path):
    frames = by_time(*instead(*LAGS), *written(494, 0x6065, 4, 0xFFFF_FFFF))
    finding = findings_of(record(tmp_path / "one.mcap", frames))["following-bounded"]
    assert (finding.verdict, finding.looked) == (Verdict.NOT_JUDGED, 0)


def test_fault_reset_is_a_rising_edge():
    assert command_in(0x80, 0x00) is command_in(0x80, None) is Command.FAULT_RESET
    assert command_in(0x80, 0x80) is command_in(0x8F, 0x8F) is None
    assert [command_in(word, 0) for word in (0x06, 0x07, 0x0F, 0x00, 0x02)] == [
        *(Command.SHUTDOWN, Command.SWITCH_ON, Command.ENABLE_OPERATION, None, None)
    ]


SPOILT = without((0x201, 410, 410))  # breaks pds-legal if all frames are present


def reason(path):
    finding = findings_of(path, facts=Facts(is_complete=True))["pds-legal"]
    assert finding.first is not None
    assert finding.verdict is (Verdict.NOT_JUDGED if finding.reason else Verdict.BROKEN)
    return finding.reason


def test_answer_without_request_proves_missing_frames(tmp_path):
    frames = without((0x201, 410, 410), (0x601, 474, 474))
    path = record(tmp_path / "one.mcap", frames)
    assert reason(path) == "it has an SDO answer without a request"
    begun_in_the_middle = without((0x201, 410, 410), (0x601, 10, 10))
    assert reason(record(tmp_path / "two.mcap", begun_in_the_middle)) == ""


def test_recorded_losses_prevent_judgement(tmp_path):
    path = record(tmp_path / "one.mcap", SPOILT, said=["3 frames were lost here"])
    assert reason(path) == "frames were lost while it was recorded"
    assert reason(record(tmp_path / "two.mcap", SPOILT, said=["it is hot"])) == ""


def test_backward_times_prevent_judgement(tmp_path):
    rows = [f"({ms / 1e3:.6f}) can0 {can_id:03X}#{data.hex()}\n" for ms, can_id, data in SPOILT]
    log, mcap = tmp_path / "one.log", tmp_path / "one.mcap"
    log.write_text("".join(rows))
    assert reason(log) == ""
    rows.insert(110, rows.pop(100))
    log.write_text("".join(rows))
    assert reason(log) == "its times go backwards"
    assert main(["convert", str(log), "-o", str(mcap)]) == 0
    assert reason(mcap) == "its times go backwards"
    log.write_text("".join([*sorted(rows), "(2.0) can0 what is this\n"]))
    assert reason(log) == "1 of its lines could not be read"


def test_recording_without_times_is_judged_by_order(tmp_path):
    rows = [
        f"  can0  {can_id:03X}   [{len(data)}]  {data.hex(' ')}\n" for _, can_id, data in story()
    ]
    log = tmp_path / "plain.txt"
    log.write_text("".join(rows))
    findings = {one.oracle: one for one in judge(log)}
    assert broken_in(findings) == []
    assert findings["pds-legal"].verdict is Verdict.HELD
    assert findings["sync-period"].verdict is Verdict.NOT_JUDGED


def test_foreign_counters_are_doubted_but_not_broken(tmp_path):
    """M_CAN has 7 bits for REC, and an imported recording has no sender names."""
    rows = ["(1.000000) can0 20000204#0004000000000060\n"]  # receive warning, REC 96
    rows += ["(2.000000) can0 20000204#001000000000007F\n"]  # receive passive, REC 127
    path = tmp_path / "real.log"
    path.write_text("".join(rows))
    (finding,) = judge(path, only=["error-states"])
    assert (finding.verdict, finding.looked) == (Verdict.NOT_JUDGED, 2)
    assert finding.first.text == (
        "the CAN controller: error passive by receiving (TEC 0, REC 127): "
        "the greater counter should be 128 to 255"
    )


def test_skipped_frames_are_reported(tmp_path, capsys):
    path = tmp_path / "fd.log"
    path.write_text("(1.000000) can0 701##10500\n(2.000000) can1 123##1\n(3.0) can1 701#05\n")
    assert main(["judge", str(path)]) == 3
    assert capsys.readouterr().err.splitlines() == [
        f"motorhil judge: {path}: 1 CAN FD frames of can0 are not judged",
        f"motorhil judge: {path}: 1 CAN FD frames of can1 are not judged",
    ]
