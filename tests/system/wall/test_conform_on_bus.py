"""`motorhil conform --on`: the clauses on drives of another process."""

import json

import pytest

from motorhil.harness.conformance.drives.target import OWN_RIG
from motorhil.harness.conformance.job import Job
from motorhil.harness.conformance.target import Target
from motorhil.harness.rig.config.toml import RigError
from motorhil.traces.mcap.reader import read_trace
from tests.support.kit_benches import RIGS
from tests.system.wall.test_serve import MOTORHIL, motorhil

pytestmark = pytest.mark.wall


@pytest.fixture
def strict_rig(tmp_path):
    """Return a drive that no motor can bring to rest near enough to its start."""
    rig = tmp_path / "strict.toml"
    text = (RIGS / "cia402.toml").read_text()
    rig.write_text(text.replace("window_rad = 0.001", "window_rad = 1e-12"))
    return str(rig)


def test_conform_checks_foreign_drives_and_records_failures(tmp_path, strict_rig):
    hub, found = tmp_path / "hub", tmp_path / "found.json"
    clauses = [word for one in ("STATE-01", "MOVE-02", "UNIT-01") for word in ("--clause", one)]
    words = ("--rig", strict_rig, "--on", f"can0={hub}", "--json", str(found), *clauses)
    done = motorhil(
        *("serve", str(RIGS / "cia402.toml"), "--socket", str(hub), "--"),
        *(*MOTORHIL, "conform", *words, "-o", str(tmp_path / "records")),
    )
    assert done.returncode == 1, done.stdout + done.stderr
    clauses = {one["id"]: one for one in json.loads(found.read_text())["clauses"]}
    assert {name: one["result"] for name, one in clauses.items()} == {
        "STATE-01": "passed",
        "MOVE-02": "failed",
        "UNIT-01": "not applicable",
    }
    assert clauses["UNIT-01"]["seen"] == "the bench cannot see the true position of the motor"
    assert sorted(path.name for path in (tmp_path / "records").iterdir()) == ["MOVE-02.mcap"]
    with read_trace(clauses["MOVE-02"]["record"]) as trace:
        topics = {channel.topic for channel, _, _ in trace.messages()}
    assert topics == {"/can/can0"}
    assert f"--on can0={hub} --clause MOVE-02 --seed 1" in clauses["MOVE-02"]["again"]


@pytest.mark.parametrize(
    ("on", "told"),
    [
        ("can0=/nowhere/hub", "--on can0=/nowhere/hub: "),
        ("can0=nosuch:1", "python-can has no interface 'nosuch'"),
        ("can1=vcan0", "is not a free bus of the motors under test (can0)"),
        ("=vcan0", "is not a free bus of the motors under test"),
    ],
)
def test_unreachable_bus_is_a_one_line_error(on, told):
    with pytest.raises(RigError) as refused:
        Target(Job("cia402", on=(on,))).opener()()
    assert told in str(refused.value)


def test_missing_bus_of_a_motor_is_refused(tmp_path):
    rig = tmp_path / "rig.toml"
    text = (RIGS / "cia402.toml").read_text()
    second = '[bus.can1]\nbitrate_bit_s = 1_000_000\n\n[controller.right]\nkind = "cia402"\n'
    rig.write_text(
        text.replace('[controller.right]\nkind = "cia402"\nbus = "can0"', f'{second}bus = "can1"')
    )
    with pytest.raises(RigError, match="no place is given for bus can1; add --on can1=WHERE"):
        Target(Job("cia402", str(rig), on=("can0=vcan0",)))


def test_conform_checks_a_foreign_drive_through_its_bus(tmp_path):
    hub, found = tmp_path / "hub", tmp_path / "found.json"
    names = ("PDS-01", "PP-02", "PDS-04")
    clauses = [word for one in names for word in ("--clause", one)]
    words = ("--controller", "drive", "--on", f"can0={hub}", "--json", str(found), *clauses)
    done = motorhil(
        *("serve", str(OWN_RIG), "--socket", str(hub), "--"),
        *(*MOTORHIL, "conform", *words, "-o", str(tmp_path / "records")),
    )
    assert done.returncode == 0, done.stdout + done.stderr
    document = json.loads(found.read_text())
    results = {one["id"]: one["result"] for one in document["clauses"]}
    assert results == dict.fromkeys(names, "passed")
    assert document["claims"]["csp"] == ""
    assert document["claims"]["vl"] == "6502h bit 1 is 0"
