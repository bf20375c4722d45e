"""Conformance clauses as tests: `pytest --adaptation NAME --rig RIG`.

pytest collects them from the rig's file: `bench.toml::STOP-04` is one clause.
"""

import os
import sys
from collections.abc import Generator, Iterator
from pathlib import Path
from typing import Final, final

import pytest

from motorhil.harness.conformance.clause import Result
from motorhil.harness.conformance.examination import Examiner, Finding
from motorhil.harness.conformance.job import Job, Promise
from motorhil.harness.conformance.supervisor import (
    CannotTestError,
    Supervisor,
    WrongJobError,
)
from motorhil.harness.conformance.verdicts.causes import cause_of, told_in_full
from motorhil.harness.pytest_plugin.options import option, record_folder, shortened
from motorhil.harness.rig.config.toml import RigError

_PROPERTY: Final = "motorhil clause"


def collect_clauses(config: pytest.Config) -> None:
    """Add the kit's clauses to the session; they are its only tests if no others are named.

    Raises:
        pytest.UsageError: the adaptation or the rig cannot be used.
    """
    name, rig = option(config, "adaptation"), option(config, "rig")
    if rig is None:
        raise pytest.UsageError(
            f"--adaptation {name}: no rig given; say --rig=FILE, or use the adaptation's own "
            f"rig: motorhil conform --adaptation {name}"
        )
    here = config.invocation_params.dir
    if str(here) not in sys.path:
        sys.path.insert(0, str(here))  # finds adaptations that are not installed
    supervisor = Supervisor(Job(name, str(here / rig), option(config, "seed")))
    config.add_cleanup(lambda: supervisor.__exit__())
    try:
        clauses = supervisor.loaded.clauses
    except (WrongJobError, CannotTestError) as error:
        raise pytest.UsageError(shortened(str(error), config)) from None
    level = option(config, "level")
    chosen = [one for one in clauses if level is None or one.level <= level]
    file = Path(os.path.abspath(here / rig))
    named = [here / word.partition("::")[0] for word in config.args]
    if config.args_source is not pytest.Config.ArgsSource.ARGS:
        config.args = [str(file)]
    elif file not in named:
        config.args.append(str(file))
    words = ["motorhil", "conform", "--adaptation", name, "--rig", rig]
    kit = _Kit(file, chosen, Examiner(supervisor, words, record_folder(config)))
    config.pluginmanager.register(kit, "motorhil-clauses")


@final
class _Kit:
    """The kit as a pytest plugin: its items, and a check that any clause was applicable."""

    def __init__(self, rig: Path, clauses: list[Promise], examiner: Examiner) -> None:
        self._rig = rig
        self._clauses = clauses
        self._examiner = examiner
        self._results: dict[str, int] = {}

    def pytest_collect_file(
        self, file_path: Path, parent: pytest.Collector
    ) -> "ClausesOfKit | None":
        """Return the collector of the clauses for the rig's file."""
        if file_path != self._rig:
            return None
        return ClausesOfKit.of(parent, file_path, self._clauses, self._examiner)

    @pytest.hookimpl(wrapper=True)
    def pytest_runtest_makereport(
        self, item: pytest.Item, call: pytest.CallInfo[None]
    ) -> Generator[None, pytest.TestReport, pytest.TestReport]:
        """Report a skipped clause at the rig's file instead of a line of this module."""
        report = yield
        if isinstance(item, ClauseOfKit) and report.skipped and call.excinfo is not None:
            report.longrepr = (str(item.path), 1, str(call.excinfo.value))
        return report

    def pytest_runtest_logreport(self, report: pytest.TestReport) -> None:
        """Count results, including those of other pytest processes."""
        if report.when == "call" and any(name == _PROPERTY for name, _ in report.user_properties):
            self._results[report.outcome] = self._results.get(report.outcome, 0) + 1

    @pytest.hookimpl(tryfirst=True)
    def pytest_sessionfinish(self, session: pytest.Session) -> None:
        """Fail the session if no clause was applicable, because then nothing was shown."""
        if list(self._results) == ["skipped"]:
            session.exitstatus = pytest.ExitCode.TESTS_FAILED

    def pytest_terminal_summary(self, terminalreporter: "pytest.TerminalReporter") -> None:
        """Print that no clause was applicable."""
        if list(self._results) == ["skipped"]:
            terminalreporter.write_line("motorhil: no clause was applicable, so nothing was shown")


@final
class ClausesOfKit(pytest.File):
    """A rig's file, from which the clauses of the kit are collected."""

    clauses: list[Promise]
    examiner: Examiner

    @classmethod
    def of(
        cls, parent: pytest.Collector, path: Path, clauses: list[Promise], examiner: Examiner
    ) -> "ClausesOfKit":
        """Return the collector of these clauses."""
        made: ClausesOfKit = cls.from_parent(parent, path=path)
        made.clauses, made.examiner = clauses, examiner
        return made

    def collect(self) -> Iterator["ClauseOfKit"]:
        """Yield its clauses in the order of the kit."""
        for promise in self.clauses:
            yield ClauseOfKit.of(self, promise)


class NotKept(Exception):  # noqa: N818 -- it says what happened, as the errors of motorapi
    """The check of a clause did not pass.

    Attributes:
        finding: the result of the check.
    """

    def __init__(self, finding: Finding) -> None:
        self.finding = finding
        super().__init__(f"{finding.verdict.result.value}: {finding.verdict.seen}")


@final
class ClauseOfKit(pytest.Item):
    """One clause as a test item."""

    promise: Promise
    examiner: Examiner

    @classmethod
    def of(cls, parent: ClausesOfKit, promise: Promise) -> "ClauseOfKit":
        """Return the item of this clause."""
        made: ClauseOfKit = cls.from_parent(parent, name=promise.id)
        made.promise, made.examiner = promise, parent.examiner
        made.user_properties.append((_PROPERTY, promise.id))
        return made

    def runtest(self) -> None:
        """Check the clause.

        Raises:
            NotKept: the adaptation does not meet the clause.
        """
        finding = self.examiner.examine(self.promise)
        if finding.verdict.result is Result.NOT_APPLICABLE:
            pytest.skip(finding.verdict.seen)
        if not finding.verdict.result.is_good:
            raise NotKept(finding)

    def repr_failure(  # type: ignore[override] # a text is allowed, as of any Item
        self, excinfo: pytest.ExceptionInfo[BaseException]
    ) -> object:
        """Return promise, source, observation, record and the command that repeats the check."""
        error = excinfo.value
        if isinstance(error, WrongJobError | CannotTestError | RigError):
            return str(error)
        if not isinstance(error, NotKept):
            return super().repr_failure(excinfo)
        lines = [
            str(error),
            f"promise: {self.promise.promise}",
            f"source: {self.promise.source}",
            f"likely cause: {cause_of(error.finding)}",
            *told_in_full(error.finding)[1:],
        ]
        return shortened("\n".join(lines), self.config)

    def reportinfo(self) -> tuple[Path, None, str]:
        """Return the location and the promise of the clause."""
        return self.path, None, f"{self.promise.id}: {self.promise.promise}"
