import pytest

ENTRY_POINTS = """\
[motorhil.controllers]
echo = tests.harness.bench:controller
broken = tests.harness.no_such_module:controller
[motorhil.adaptations]
bare = tests.harness.bench:adaptation
"""


@pytest.fixture
def bench(tmp_path, monkeypatch):
    """A folder to write rigs in, with the plugins of bench.py installed."""
    info = tmp_path / "site" / "bench-1.0.dist-info"
    info.mkdir(parents=True)
    (info / "METADATA").write_text("Metadata-Version: 2.1\nName: bench\nVersion: 1.0\n")
    (info / "entry_points.txt").write_text(ENTRY_POINTS)
    monkeypatch.syspath_prepend(tmp_path / "site")
    folder = tmp_path / "bench"
    folder.mkdir()
    monkeypatch.chdir(folder)
    return folder
