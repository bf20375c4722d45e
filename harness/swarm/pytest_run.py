"""Run of pytest as the program of one world: its rigs and its failures are told to a watcher.

Each rig that a test opens is watched from its opening to the end of its record. Tests of one world
share nothing with those of another: no cache of pytest, no examples of Hypothesis.
"""

import os
from collections.abc import Generator, Sequence
from pathlib import Path
from typing import Final, Protocol, final

import pytest

from motorhil.harness.rig.config.toml import RigError
from motorhil.harness.rig.rig import Rig

WATCHER: Final = "motorhil-world"
"""Name under which pytest finds the watcher, if its session runs in a world of a swarm."""
_QUIET: Final = (
    *("-q", "--no-header", "--no-summary", "-p", "no:cacheprovider"),
    *("-W", "ignore:Module already imported:pytest.PytestAssertRewriteWarning"),
)
_TEXT_MAX: Final = 200


class Watcher(Protocol):
    """Watcher of a world's rigs and tests."""

    def opened(self, rig: Rig) -> None:
        """Take a rig that is open at time 0."""

    def refused(self, error: RigError) -> None:
        """Take the reason why a rig could not be opened."""

    def closed(self, rig: Rig, record: Path) -> None:
        """Take a rig that is closed, and its complete record, which is deleted afterwards."""

    def raised(self, error: BaseException) -> None:
        """Take an exception that failed a test, or a fixture."""


def run_pytest(
    node: str,
    words: Sequence[str],
    rig: str,
    seed: int,
    world: Path | None,
    passing: Path,
    watcher: Watcher,
) -> str:
    """Run the tests of a node; return why none could run, or "".

    Args:
        node: the node id.
        words: more arguments of pytest.
        rig: the rig file.
        seed: the seed of all rigs.
        world: the fragment of the world, or None.
        passing: a folder for records and what else passes.
        watcher: told of rigs and failures.
    """
    options = ["--motorhil-rig", rig, "--motorhil-seed", str(seed)]
    options += ["--motorhil-record-dir", str(passing)]
    if world is not None:
        options += ["--motorhil-world", str(world)]
    told = _Told(watcher, seed, passing)
    status = pytest.main([node, *_QUIET, *options, *words], [told])
    if status == pytest.ExitCode.NO_TESTS_COLLECTED:
        return f"pytest collects no test of {node}"
    if told.problem:
        return f"pytest cannot collect {node}: {told.problem}"[:_TEXT_MAX]
    if status in (pytest.ExitCode.USAGE_ERROR, pytest.ExitCode.INTERNAL_ERROR):
        return f"pytest does not find {node}, or refuses its options"
    return ""


def warm_pytest(passing: Path) -> None:
    """Import pytest and its plugins, by a session without any test."""
    words = ("-c", os.devnull, "--rootdir", str(passing), "--noconftest", "--collect-only")
    pytest.main([str(passing), *_QUIET, *words])


@final
class _Told:
    """A plugin of pytest that tells what its session does."""

    def __init__(self, watcher: Watcher, seed: int, passing: Path) -> None:
        self.problem = ""
        self._watcher = watcher
        self._seed = seed
        self._passing = passing

    @pytest.hookimpl(tryfirst=True)
    def pytest_configure(self, config: pytest.Config) -> None:
        """Watch the rigs of the session; all of it runs here, and by one seed."""
        config.pluginmanager.register(self._watcher, WATCHER)
        if hasattr(config.option, "dist"):  # of pytest-xdist
            config.option.dist, config.option.tx = "no", []
        if hasattr(config.option, "hypothesis_seed"):
            from hypothesis.configuration import set_hypothesis_home_dir

            set_hypothesis_home_dir(self._passing)
            config.option.hypothesis_seed = str(self._seed)

    def pytest_collectreport(self, report: pytest.CollectReport) -> None:
        """Keep the reason why tests cannot be collected."""
        if report.failed and not self.problem:
            lines = [line for line in report.longreprtext.splitlines() if line.strip()]
            self.problem = lines[-1].removeprefix("E").strip() if lines else "an error"

    @pytest.hookimpl(wrapper=True)
    def pytest_runtest_makereport(
        self, item: pytest.Item, call: pytest.CallInfo[None]
    ) -> Generator[None, pytest.TestReport, pytest.TestReport]:
        """Tell of a failed phase of a test."""
        report = yield
        if report.failed:
            passed = AssertionError("passes, though it is marked as one that fails")
            self._watcher.raised(passed if call.excinfo is None else call.excinfo.value)
        return report
