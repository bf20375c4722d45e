import signal

import pytest

from motorhil.harness.cli.main import main
from tests.support.plugin_rigs import GOOD, SCRIPT, WHEEL

ENTRY_POINTS = """\
[motorhil.controllers]
echo = tests.support.plugin:controller
broken = tests.unit.harness.no_such_module:controller
[motorhil.adaptations]
bare = tests.support.plugin:adaptation
"""


@pytest.fixture(scope="session")
def demo(tmp_path_factory):
    """Return the demo's recording, made once."""
    path = tmp_path_factory.mktemp("demo") / "demo.mcap"
    assert main(["demo", "-o", str(path)]) == 0
    return path


@pytest.fixture
def bench(tmp_path, monkeypatch):
    """Return a folder for rigs, with the plugins of bench.py installed."""
    info = tmp_path / "site" / "bench-1.0.dist-info"
    info.mkdir(parents=True)
    (info / "METADATA").write_text("Metadata-Version: 2.1\nName: bench\nVersion: 1.0\n")
    (info / "entry_points.txt").write_text(ENTRY_POINTS)
    monkeypatch.syspath_prepend(tmp_path / "site")
    folder = tmp_path / "bench"
    folder.mkdir()
    monkeypatch.chdir(folder)
    return folder


@pytest.fixture
def rig(bench):
    (bench / "rig.toml").write_text(GOOD)
    (bench / "wheel.toml").write_text(WHEEL)
    (bench / "script.py").write_text(SCRIPT)
    return bench


@pytest.fixture
def say(capsys):
    """Return a function that runs a command line and returns (exit status, stdout, stderr)."""

    def run(*words):
        status = main(words)
        said = capsys.readouterr()
        return status, said.out, said.err

    return run


@pytest.fixture
def interruptible():
    """Enable Ctrl-C even if the tests run in the background and ignore it."""
    before = signal.signal(signal.SIGINT, signal.default_int_handler)
    yield
    signal.signal(signal.SIGINT, before)
