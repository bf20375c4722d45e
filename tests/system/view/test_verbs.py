"""Option --view of verbs that record, and `view` of rigs and buses."""

import os
import subprocess
import sys

import pytest

from motorhil.harness.cli.main import main
from motorhil.harness.view.stream import Event
from motorhil.traces.digest import digest
from tests.support.checkout import CHECKOUT
from tests.support.view.growing import Events
from tests.support.view.page_model import Page
from tests.support.view.watched import Watched

pytestmark = pytest.mark.wall

ROOT = str(CHECKOUT)


@pytest.mark.parametrize(
    "words",
    [
        ("run", "wheels/rig.toml", "wheels/drive.py", "--view", "-o", "watched.mcap"),
        ("view", "wheels/rig.toml", "wheels/drive.py", "--pace", "20", "-o", "watched.mcap"),
    ],
)
def test_watched_run_shows_and_records_what_it_would_without(wheels, words):
    assert main(["run", "wheels/rig.toml", "wheels/drive.py", "-o", "plain.mcap"]) == 0
    with Watched(*words) as watched:
        watched.line("the run is over")
        page = watched.page()
        status, out = watched.interrupted()
    assert status == 0
    assert "right is at 3.1416 rad" in out
    assert digest("watched.mcap") == digest("plain.mcap")
    assert {"left", "right"} <= page.presence.keys()
    final = page.lines["right", "position", "true (plant)"][-1][1]
    assert final == pytest.approx(3.1416, abs=1e-3)


def test_page_without_an_output_leaves_no_file(wheels, tmp_path):
    before = sorted(path.name for path in tmp_path.iterdir())
    with Watched("run", "wheels/rig.toml", "wheels/drive.py", "--view") as watched:
        watched.line("the run is over")
        assert watched.page().messages > 500
        assert watched.interrupted()[0] == 0
    assert sorted(path.name for path in tmp_path.iterdir()) == before


def test_status_of_a_failed_program_is_kept(wheels, tmp_path):
    (tmp_path / "bad.py").write_text("raise SystemExit(7)\n")
    with Watched("run", "wheels/rig.toml", "bad.py", "--view") as watched:
        watched.line("the run is over")
        assert watched.interrupted()[0] == 7


def test_missing_recording_is_named_as_a_file(capsys):
    assert main(["view", "nothing.mcap"]) == 2
    told = "nothing.mcap: cannot be read: no such file or directory; check the name\n"
    assert capsys.readouterr().err == told


def test_live_bus_is_watched_while_it_is_recorded(wheels):
    code = "from motorhil.harness.cli.main import main; main(['serve', 'wheels/rig.toml'"
    serve = subprocess.Popen(
        [sys.executable, "-c", f"{code}, '--socket', './hub'])"], stdout=subprocess.PIPE, text=True
    )
    try:
        serve.stdout.readline()
        with Watched("view", "./hub") as watched:
            page = Page()
            hub = {"CAN_INTERFACE": "emulated", "CAN_CHANNEL": "./hub"}
            drive = subprocess.Popen(
                [sys.executable, "wheels/drive.py"],
                env={**os.environ, **hub},
                stdout=subprocess.DEVNULL,
            )
            with Events(watched.port, token=watched.token) as events:
                while page.messages < 200:
                    told = events.next()
                    page.take(Event(told["id"], told["event"], told["data"]))
            assert drive.wait(timeout=60) == 0
            status, out = watched.interrupted()
        assert status == 0
        assert "frames of" in out
        assert any(bus.startswith("can") for bus, _ in page.loads)
    finally:
        serve.terminate()
        serve.communicate()
