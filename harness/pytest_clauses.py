"""The conformance kit as tests: `pytest --adaptation NAME --rig RIG`, an item for each clause.

The rig's file is what pytest collects them from: `bench.toml::STOP-04` is one clause.
"""

import os
import sys
from collections.abc import Generator, Iterator
from pathlib import Path
from typing import Final, final

import pytest

from harness.conformance.examination import Examiner, Finding
from harness.conformance.job import Job, Promise
from harness.conformance.result_files import more_of
from harness.conformance.supervision import CannotTestError, Supervisor, WrongJobError
from harness.conformance.verdict import Result
from harness.pytest_plugin import option, record_folder, shortened
from harness.settings import RigError

_PROPERTY: Final = "motorhil clause"


def collect_clauses(config: pytest.Config) -> None:
    """The kit's clauses are tests of this session: the only ones, where no others are named.

    Raises:
        pytest.UsageError: adaptation or rig cannot be used as they are named.
    """
    name, rig = option(config, "adaptation"), option(config, "rig")
    if rig is None:
        raise pytest.UsageError(
            f"--adaptation {name}: on which rig? Say --rig=FILE; on the one that comes with it: "
            f"motorhil conform --adaptation {name}"
        )
    here = config.invocation_params.dir
    if str(here) not in sys.path:
        sys.path.insert(0, str(here))  # where what is not installed yet is looked for
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
    """What pytest asks of the kit: its items, and whether anything was shown."""

    def __init__(self, rig: Path, clauses: list[Promise], examiner: Examiner) -> None:
        self._rig = rig
        self._clauses = clauses
        self._examiner = examiner
        self._results: dict[str, int] = {}

    def pytest_collect_file(
        self, file_path: Path, parent: pytest.Collector
    ) -> "ClausesOfKit | None":
        """The rig's file holds the clauses."""
        if file_path != self._rig:
            return None
        return ClausesOfKit.of(parent, file_path, self._clauses, self._examiner)

    @pytest.hookimpl(wrapper=True)
    def pytest_runtest_makereport(
        self, item: pytest.Item, call: pytest.CallInfo[None]
    ) -> Generator[None, pytest.TestReport, pytest.TestReport]:
        """What is not applicable is told of the rig, not of a line in here."""
        report = yield
        if isinstance(item, ClauseOfKit) and report.skipped and call.excinfo is not None:
            report.longrepr = (str(item.path), 1, str(call.excinfo.value))
        return report

    def pytest_runtest_logreport(self, report: pytest.TestReport) -> None:
        """Counts, also of what other processes ran."""
        if report.when == "call" and any(name == _PROPERTY for name, _ in report.user_properties):
            self._results[report.outcome] = self._results.get(report.outcome, 0) + 1

    @pytest.hookimpl(tryfirst=True)
    def pytest_sessionfinish(self, session: pytest.Session) -> None:
        """Where nothing was applicable, nothing was shown: that is no success."""
        if list(self._results) == ["skipped"]:
            session.exitstatus = pytest.ExitCode.TESTS_FAILED

    def pytest_terminal_summary(self, terminalreporter: "pytest.TerminalReporter") -> None:
        """That is told."""
        if list(self._results) == ["skipped"]:
            terminalreporter.write_line("motorhil: nothing was applicable, so nothing was shown")


@final
class ClausesOfKit(pytest.File):
    """A rig's file, from which the clauses of the kit are collected."""

    clauses: list[Promise]
    examiner: Examiner

    @classmethod
    def of(
        cls, parent: pytest.Collector, path: Path, clauses: list[Promise], examiner: Examiner
    ) -> "ClausesOfKit":
        """The collector of these clauses."""
        made: ClausesOfKit = cls.from_parent(parent, path=path)
        made.clauses, made.examiner = clauses, examiner
        return made

    def collect(self) -> Iterator["ClauseOfKit"]:
        """Its clauses, in the order of the kit."""
        for promise in self.clauses:
            yield ClauseOfKit.of(self, promise)


class NotKept(Exception):  # noqa: N818 -- it says what happened, as the errors of motorapi
    """The check of a clause did not end well.

    Attributes: finding.
    """

    def __init__(self, finding: Finding) -> None:
        self.finding = finding
        super().__init__(f"{finding.verdict.result.value}: {finding.verdict.seen}")


@final
class ClauseOfKit(pytest.Item):
    """One clause."""

    promise: Promise
    examiner: Examiner

    @classmethod
    def of(cls, parent: ClausesOfKit, promise: Promise) -> "ClauseOfKit":
        """The item of this clause."""
        made: ClauseOfKit = cls.from_parent(parent, name=promise.id)
        made.promise, made.examiner = promise, parent.examiner
        made.user_properties.append((_PROPERTY, promise.id))
        return made

    def runtest(self) -> None:
        """It is kept.

        Raises:
            NotKept: it is not.
        """
        finding = self.examiner.examine(self.promise)
        if finding.verdict.result is Result.NOT_APPLICABLE:
            pytest.skip(finding.verdict.seen)
        if not finding.verdict.result.is_good:
            raise NotKept(finding)

    def repr_failure(  # type: ignore[override] # a text is allowed, as of any Item
        self, excinfo: pytest.ExceptionInfo[BaseException]
    ) -> object:
        """What was promised, where, what was seen, where its record is, how it is repeated."""
        error = excinfo.value
        if isinstance(error, WrongJobError | CannotTestError | RigError):
            return str(error)
        if not isinstance(error, NotKept):
            return super().repr_failure(excinfo)
        lines = [
            str(error),
            f"promise: {self.promise.promise}",
            f"source: {self.promise.source}",
            *more_of(error.finding),
        ]
        return shortened("\n".join(lines), self.config)

    def reportinfo(self) -> tuple[Path, None, str]:
        """Where it stands, and what is promised."""
        return self.path, None, f"{self.promise.id}: {self.promise.promise}"
