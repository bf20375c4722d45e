"""Command `motorhil judge`: output, exit status, and errors."""

import json

import pytest

from motorhil.harness.oracles.judge import IDS
from tests.support.golden import golden
from tests.support.kit_benches import RIGS
from tests.support.recordings.story import RIG, record, story
from tests.unit.harness.oracles.test_broken import without


@pytest.fixture
def sound(tmp_path):
    return str(record(tmp_path / "sound.mcap", story()))


@pytest.fixture
def broken(tmp_path):
    frames = without((0x201, 410, 410), (0x201, 1610, 1610))
    return str(record(tmp_path / "broken.mcap", frames))


def test_sound_recording_passes_with_counts(say, sound):
    status, out, err = say("judge", sound)
    assert (status, err) == (0, "")
    lines = out.splitlines()
    assert lines[0] == "oracle              verdict          looked at"
    assert "pds-legal           held                     6" in lines
    verdict = "sound, as far as it could be judged: 18 held, 8 could not judge; 2 incidents seen"
    assert lines[-1] == f"{sound}: {verdict}"


def test_broken_recording_fails_with_first_violation(say, broken):
    status, out, _ = say("judge", broken, "--only", "pds-legal")
    assert status == 1
    assert out.splitlines()[2:] == [
        "pds-legal: 0.420000000 s can0 node 1 (wheel): switch on disabled, then ready to switch on"
        " (statusword 0231h), after no command that leads there; 1 more",
        "seen: can0 node 1 (wheel): EMCY 8611h following error at 1.401000 s",
        "seen: can0 node 1 (wheel): fault (6041h) at 1.402000 s",
        f"{broken}: broken: 1 broken; 2 incidents seen",
    ]
    assert say("judge", broken, "--to", "0.4", "--only", "pds-legal")[0] == 3
    assert say("judge", broken, "--from", "0.43", "--to", "1.5", "--only", "pds-legal")[0] == 0


def test_judging_nothing_does_not_pass(say):
    with golden("leadshine") as path:
        status, out, _ = say("judge", str(path), "--only", "pds-legal", "--only", "sync-period")
    assert status == 3
    assert out.splitlines()[-1] == f"{path}: not judged: 2 could not judge"


def test_json_output_has_the_same_findings(say, broken):
    status, out, _ = say("judge", "--json", broken)
    told = json.loads(out)
    assert (status, told["file"], told["verdict"]) == (1, broken, "broken")
    findings = {one["oracle"]: one for one in told["findings"]}
    assert tuple(findings) == IDS
    first = findings["pds-legal"]["first"]
    assert (first["time_ns"], first["bus"], first["node"]) == (420_000_000, "can0", 1)
    assert findings["pds-legal"]["verdict"] == "broken"
    assert findings["owner-commands"]["reason"].startswith("no motor ownership ")


def test_list_names_promise_and_source_of_each_oracle(say):
    status, out, _ = say("judge", "--list")
    assert status == 0
    lines = out.splitlines()
    assert [line for line in lines if not line.startswith(" ")] == list(IDS)
    assert len([line for line in lines if line.startswith("    source: ")]) == len(IDS)
    assert all(len(line) <= 104 for line in lines)


def test_complete_option_accepts_imported_recording(say, broken, tmp_path):
    log = str(tmp_path / "broken.log")
    assert say("convert", broken, "-o", log)[0] == 0
    status, out, _ = say("judge", log)
    assert status == 0
    assert "pds-legal: perhaps: 0.420000000 s can0 node 1: switch on disabled" in out
    assert (
        "nothing shows that this recording (candump) has every frame; --complete asserts it" in out
    )
    assert say("judge", log, "--complete")[0] == 1


def test_rig_option_names_motors_and_limits(say, broken, tmp_path):
    log, rig = str(tmp_path / "broken.log"), tmp_path / "one.toml"
    rig.write_bytes(RIG)
    assert say("convert", broken, "-o", log)[0] == 0
    _, out, _ = say("judge", log, "--complete", "--rig", str(rig))
    assert "can0 node 1 (wheel): switch on disabled" in out
    assert "limit-acceleration  held                     1" in out


def test_truncated_recording_is_judged_as_far_as_readable(say, sound, tmp_path):
    cut = tmp_path / "cut.mcap"
    with open(sound, "rb") as file:
        cut.write_bytes(file.read()[:-3_000])
    status, out, err = say("judge", str(cut))
    assert status == 0
    assert "pds-legal           held" in out
    assert err.startswith(f"motorhil judge: {cut}: cut at byte")


LIMITS = {  # contents of the file, message
    "[motor.left]\nvelocity_max = 1.0\n": ":2: motor.left.velocity_max: unknown key",
    "[moter.left]\nvelocity_max_rad_s = 1.0\n": ":1: moter: unknown key (known: motor)",
    "[motor.left]\nvelocity_max_rad_s = -1\n": ":2: motor.left.velocity_max_rad_s: -1 is out of",
    '[motor.left]\nvelocity_max_rad_s = "1"\n': "must be a number, but is a string",
    "[motor.left]\nbus = 'can0'\nvelocity_max_rad_s = 1\n": "motor.left.node_id: is missing",
    "[motor.left]\nposition_max_rad = 1\nvelocity_max_m_s = 1\n": "is in m, but other keys",
    "[motor.left]\nposition_max_rad = 1\nincrements_per_rad = 0\n": "0 is out of range",
    "[motor.left]\nbus = 'can0'\nnode_id = 1\n": "motor.left: has no limit",
    "": "motor: is missing",
    "motor = 3\n": "must be a table",
    "[motor\n": "not TOML",
}


@pytest.mark.parametrize(("text", "said"), LIMITS.items())
def test_wrong_limits_file_is_reported_with_line(say, sound, tmp_path, text, said):
    file = tmp_path / "limits.toml"
    file.write_text(text)
    status, out, err = say("judge", sound, "--limits", str(file))
    assert (status, out) == (2, "")
    assert err.startswith(f"{file}:")
    assert said in err
    assert err.count("\n") == 1


@pytest.mark.parametrize(
    ("content", "said"),
    [
        (None, "cannot be read: no such file or directory"),
        (b"", "is empty"),
        (b"Dear diary,\ntoday nothing moved.\n", "holds no CAN traffic in a format known here"),
        (b"\x89MCAP0\r\n", None),
        (b"\x89MCAP0\r\n" + bytes(range(256)), None),
    ],
)
def test_unreadable_file_gives_an_error_message(say, tmp_path, content, said):
    path = tmp_path / "what"
    if content is not None:
        path.write_bytes(content)
    status, out, err = say("judge", str(path))
    if said is None:  # a recording that ends at once
        assert status in (2, 3)
        return
    assert (status, out) == (2, "")
    assert said in err


def test_wrong_usage_is_reported(say, sound, tmp_path):
    assert say("judge")[0] == 2
    assert say("judge", sound, "--only", "luck")[0] == 2
    assert say("judge", sound, "--from", "soon")[0] == 2
    for option in ("--limits", "--rig"):
        status, _, err = say("judge", sound, option, str(tmp_path / "none.toml"))
        assert status == 2
        assert "no such file" in err
    empty = tmp_path / "empty.toml"
    empty.write_text("")
    status, _, err = say("judge", sound, "--rig", str(empty))
    assert status == 2
    assert "motor: is missing" in err


def test_rig_names_the_drives_of_an_imported_recording(say, tmp_path):
    log, rig = str(tmp_path / "rmd.log"), tmp_path / "rig.toml"
    only = [word for one in ("drive-answered", "one-drive") for word in ("--only", one)]
    rig.write_text((RIGS / "rmd.toml").read_text())
    with golden("rmd") as path:
        assert say("convert", str(path), "-o", log)[0] == 0
    assert say("judge", log, *only)[0] == 3
    status, out, _ = say("judge", log, "--rig", str(rig), *only)
    assert status == 0
    assert out.splitlines()[-1].endswith("sound, as far as it could be judged: 2 held")


def test_fd_frames_of_a_known_drive_are_judged(say):
    with golden("moteus") as path:
        status, _, err = say("judge", str(path))
    assert (status, err) == (0, "")
