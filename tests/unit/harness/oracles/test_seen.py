"""Faults, limits and alarms of a sound recording, which `motorhil judge` reports."""

import json

import pytest

from motorhil.harness.oracles.judge import judge
from motorhil.harness.oracles.seen import Seen
from tests.support.recordings.story import record
from tests.unit.harness.oracles.test_broken import LOCKS, status, torque, with_more

FOLLOWING = bytes.fromhex("1186210000000000")  # CiA 301: 8611h, following error


def seen_in(path):
    seen = Seen()
    judge(path, seen=seen)
    return [str(one).partition(": ")[2] for one in seen.incidents]


def test_reported_fault_is_told_though_the_recording_is_sound(tmp_path):
    told = seen_in(record(tmp_path / "one.mcap", with_more(), locks=LOCKS))
    assert told == ["EMCY 8611h following error at 1.401000 s", "fault (6041h) at 1.402000 s"]


def test_faults_and_limits_are_counted_with_their_first_time(tmp_path):
    frames = with_more(
        status(600, 0x0A37, 99),  # bit 11: internal limit active
        status(601, 0x0A37, 99),
        status(602, 0x0237, 99),
        status(603, 0x0A37, 99),
        (650, 0x081, FOLLOWING),
        status(651, 0x020F, 99),  # fault reaction active
        status(652, 0x0208, 99),  # fault
    )
    assert seen_in(record(tmp_path / "one.mcap", frames)) == [
        "internal limit active (6041h bit 11), 2 times, first at 0.600000 s",
        "EMCY 8611h following error, 2 times, first at 0.650000 s",
        "fault (6041h), 2 times, first at 0.651000 s",
    ]


def test_torque_at_its_limit_is_told(tmp_path):
    frames = with_more(torque(700, 1000, 99), torque(701, 1000, 99))
    told, *_ = seen_in(record(tmp_path / "one.mcap", frames))
    assert told.startswith("torque limited: 6077h at 6072h = 1000 at ")


def test_verdict_counts_what_was_seen(tmp_path, say):
    path = str(record(tmp_path / "one.mcap", with_more((650, 0x081, FOLLOWING)), locks=LOCKS))
    out = say("judge", path)[1]
    assert "EMCY 8611h following error, 2 times, first at 0.650000 s" in out
    assert out.splitlines()[-1].endswith("; 3 incidents seen")
    told = json.loads(say("judge", path, "--json")[1])
    assert [one["times"] for one in told["seen"]] == [2, 1]


@pytest.mark.parametrize(
    ("table", "told"),
    [
        ("[motor.strange]\nvelocity_max_rad_s = 2.0\n", "no such motor"),
        (
            '[motor.left]\nbus = "can0"\nnode_id = 77\nincrements_per_rad = 10.0\n'
            "velocity_max_rad_s = 2.0\n",
            "nothing of can0 node 77",
        ),
    ],
)
def test_limit_of_a_motor_that_is_not_recorded_is_an_error(tmp_path, say, table, told):
    path = str(record(tmp_path / "one.mcap", with_more(), locks=LOCKS))
    (tmp_path / "limits.toml").write_text(table)
    status_, out, err = say("judge", path, "--limits", str(tmp_path / "limits.toml"))
    assert (status_, out) == (2, "")
    assert told in err
