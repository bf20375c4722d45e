"""Recordings in third-party readers: @mcap/core, which Foxglove uses, and Rerun.

The first needs node and npm, and is installed into pytest's cache by its lock file, hashes checked.
The second needs `rerun` of rerun-sdk (800 MB) in PATH. The tests of mcap for Python are in
tests/unit/traces/formats.
"""

import json
import os
import re
import shutil
import subprocess
from collections import Counter
from pathlib import Path

import pytest
from mcap.reader import make_reader

from motorhil.harness.rig.config.scaffold import EXAMPLES
from motorhil.harness.rig.rig import Rig
from motorhil.motorapi import ControlMode
from motorhil.traces.digest import digest
from tests.support.recordings.written import write

HERE = Path(__file__).parent / "mcap_core"


@pytest.fixture(scope="module")
def recording(tmp_path_factory):
    """Return a recorded run: frames, states, locks, truth, attachments, metadata."""
    path = tmp_path_factory.mktemp("readers") / "run.mcap"
    with Rig.open(EXAMPLES / "two_wheels.toml", record=path) as rig:
        motor = rig.motors["left"]
        motor.enable()
        motor.set_control_mode(ControlMode.SETPOINT)
        motor.set_setpoint(0.5)
        motor.start()
        motor.wait_until_done(5)
    return path


@pytest.fixture(scope="module")
def mcap_core(request):
    """Return a folder with the reader, or skip with a reason."""
    if shutil.which("npm") is None or shutil.which("node") is None:
        pytest.skip("@mcap/core needs node and npm")
    folder = request.config.cache.mkdir("mcap-core")
    lock = (HERE / "package-lock.json").read_bytes()
    for name in ("package.json", "package-lock.json", "read.mjs"):
        shutil.copyfile(HERE / name, folder / name)
    done = folder / "installed.json"
    if not done.is_file() or done.read_bytes() != lock:
        done.unlink(missing_ok=True)
        command = ["npm", "ci", "--ignore-scripts", "--no-audit", "--no-fund", "--fetch-retries=0"]
        try:
            npm = subprocess.run(command, cwd=folder, capture_output=True, text=True, timeout=120)
        except subprocess.TimeoutExpired:
            pytest.skip("@mcap/core cannot be installed: npm took longer than 120 s")
        if "EINTEGRITY" in npm.stderr:
            pytest.fail(f"a package is not what its hash says: {npm.stderr}")
        if npm.returncode:
            pytest.skip(f"@mcap/core cannot be installed: {npm.stderr.strip()[-200:]}")
        done.write_bytes(lock)
    return folder


def read(folder, path):
    command = ["node", "read.mjs", str(path)]
    return subprocess.run(command, cwd=folder, capture_output=True, text=True, timeout=120)


def python_counts(path):
    """Return the number of messages by topic, counted by mcap for Python."""
    with path.open("rb") as file:
        reader = make_reader(file, validate_crcs=True)
        return dict(Counter(channel.topic for _, channel, _ in reader.iter_messages()))


def test_mcap_core_reads_every_message_with_valid_crcs(mcap_core, recording):
    done = read(mcap_core, recording)
    assert done.returncode == 0, done.stderr
    told = json.loads(done.stdout)
    stream, indexed = told["stream"], told["indexed"]
    counts = python_counts(recording)
    assert len(counts) >= 5
    assert stream["messages"] == indexed["messages"] == counts
    assert stream["digest"] == digest(recording)
    assert (stream["done"], indexed["backward"]) == (True, 0)
    assert indexed["counted"] == sum(counts.values())
    assert stream["kinds"]["ChunkIndex"] == indexed["chunks"] > 0
    assert {"run", "versions"} <= set(stream["metadata"])
    assert "two_wheels.toml" in stream["attachments"]


def test_mcap_core_detects_flipped_bit(mcap_core, recording, tmp_path):
    data = bytearray(recording.read_bytes())
    data[len(data) // 2] ^= 0x10
    (tmp_path / "hurt.mcap").write_bytes(data)
    done = read(mcap_core, tmp_path / "hurt.mcap")
    assert done.returncode != 0
    assert done.stdout == ""


def test_mcap_core_reads_file_written_in_small_pieces(mcap_core, tmp_path):
    write(tmp_path / "a.mcap", 500)
    done = read(mcap_core, tmp_path / "a.mcap")
    assert done.returncode == 0, done.stderr
    told = json.loads(done.stdout)
    assert told["stream"]["digest"] == digest(tmp_path / "a.mcap")
    assert told["indexed"]["chunks"] == 25


@pytest.fixture
def rerun(tmp_path):
    """Run `rerun` with its telemetry off."""
    if shutil.which("rerun") is None:
        pytest.skip("Rerun is not installed: pip install rerun-sdk (800 MB)")

    def run(*words):
        told = os.environ | {"HOME": str(tmp_path), "NO_COLOR": "1"}
        return subprocess.run(
            ["rerun", *words], capture_output=True, text=True, timeout=120, env=told
        )

    run("analytics", "disable")
    return run


def test_rerun_verifies_and_converts_recording(rerun, recording, tmp_path):
    counts = python_counts(recording)
    info = rerun("mcap", "info", str(recording))
    assert info.returncode == 0, info.stderr
    assert re.search(rf"Messages +{sum(counts.values())}\b", info.stdout)
    check = rerun("mcap", "check", "--full", str(recording))
    assert check.returncode == 0, check.stderr
    judged = re.findall(r"^(\w+) +\d+ +\d+ +/", check.stdout, re.MULTILINE)
    assert judged == ["ok"] * len(counts), check.stdout
    done = rerun("mcap", "convert", str(recording), "-o", str(tmp_path / "run.rrd"))
    assert done.returncode == 0, done.stderr
    assert (tmp_path / "run.rrd").stat().st_size > 10_000


def test_rerun_detects_damage(rerun, recording, tmp_path):
    (tmp_path / "cut.mcap").write_bytes(recording.read_bytes()[:-100])
    assert rerun("mcap", "check", str(tmp_path / "cut.mcap")).returncode != 0
