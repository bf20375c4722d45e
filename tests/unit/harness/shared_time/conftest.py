"""Runs of programs that share a rig's time."""

import pytest

from motorhil.harness.rig.rig import Rig
from motorhil.harness.shared_time.programs import run_programs
from motorhil.traces.digest import digest

SILENT = """
[bus.can0]
bitrate_bit_s = 500_000
node = { listener = { silent = true } }
"""


@pytest.fixture
def run(tmp_path):
    """Return a function that runs programs, by name, and returns (output, failures, digest)."""

    def run(base=SILENT, *, stall_s=10, lines=None, **commands):
        text = base
        for name, command in commands.items():
            words = ", ".join(f"'{word}'" for word in command)
            text += f"\n[program.{name}]\ncommand = [{words}]\nstall_s = {stall_s}\n"
        (tmp_path / "rig.toml").write_text(text)
        lines = [] if lines is None else lines
        with Rig.open(tmp_path / "rig.toml", record=tmp_path / "run.mcap") as rig:
            wrong = run_programs(rig, lines.append)
        return lines, wrong, digest(tmp_path / "run.mcap")

    return run


@pytest.fixture
def twice(run):
    """Return a function that runs programs twice, to the same bytes; it returns the output."""

    def twice(*facts, **commands):
        lines, wrong, record = run(*facts, **commands)
        assert wrong == {}, lines[-3:]
        assert run(*facts, **commands) == (lines, wrong, record)
        return lines

    return twice
