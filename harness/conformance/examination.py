"""Examination of clauses: a failing check is repeated and recorded.

On a bench in wall time the first run is recorded.

Several examiners, each with a worker of its own, share the clauses of a run (`examine_all`).
"""

import shlex
import time
from collections.abc import Generator, Sequence
from contextlib import ExitStack, suppress
from dataclasses import replace
from pathlib import Path
from typing import Final, final

from motorhil.frozen import frozen
from motorhil.harness.conformance.benches.variations import OWN
from motorhil.harness.conformance.clause import Result, Verdict
from motorhil.harness.conformance.job import Promise
from motorhil.harness.conformance.supervisor import Supervisor
from motorhil.harness.rig.config.toml import RigError

_HANGS_SOONER: Final = 0.1
"""Share of the deadline for a check that is known to hang."""


@final
@frozen
class Finding:
    """The result of the examination of one clause.

    Attributes:
        promise: the clause.
        verdict: the verdict of the run without a record.
        wall_s: the duration of that run [s].
        output: the last lines printed during that run.
        again: the command that checks this clause alone; "" if the verdict is good.
        record: the MCAP file of the second run, or None.
        digest: the digest of the record's messages; "" if there is none, or the record is
            incomplete.
        second: the verdict of the second run, if it differs from the first.
        variation: of the rig; "" if it was checked on the rig as it is.
    """

    promise: Promise
    verdict: Verdict
    wall_s: float
    output: tuple[str, ...] = ()
    again: str = ""
    record: Path | None = None
    digest: str = ""
    second: Verdict | None = None
    variation: str = OWN


@final
class Examiner:
    """Examines clauses.

    Args:
        supervisor: checks the clauses.
        command: `motorhil conform` with the arguments for adaptation and rig.
        folder: the folder for records.
        is_live: whether the bench runs in wall time, where runs differ, so that the first run must
            be recorded.
    """

    def __init__(
        self,
        supervisor: Supervisor,
        command: Sequence[str],
        folder: Path,
        *,
        is_live: bool = False,
    ) -> None:
        self._supervisor = supervisor
        self._command = tuple(command)
        self._folder = folder
        self._is_live = is_live

    def examine(
        self, promise: Promise, variation: str = OWN, *, is_required: bool = False
    ) -> Finding:
        """Check a clause and return the finding.

        A clause that is not applicable with this variation of the rig is checked on the rig as it
        is, unless the variation is required.

        Raises:
            WrongJobError, CannotTestError: see `Supervisor.loaded`.
            RigError: the folder for records cannot be created.
        """
        record = self._record_of(promise) if self._is_live else None
        begin_s = time.monotonic()
        verdict = self._supervisor.check(promise.id, record=record, variation=variation)
        if variation and not is_required and verdict.result is Result.NOT_APPLICABLE:
            variation = OWN
            verdict = self._supervisor.check(promise.id, record=record)
        wall_s = time.monotonic() - begin_s
        output = self._supervisor.output
        if verdict.result.is_good:
            if record is not None:
                record.unlink(missing_ok=True)
            return Finding(promise, verdict, wall_s, variation=variation)
        loaded = self._supervisor.loaded
        again = [*self._command, "--clause", promise.id, "--seed", str(loaded.seed)]
        if loaded.variations or variation:
            again += ["--benches", variation or "own"]
        second = None
        if record is None:
            record = self._record_of(promise)
            again_seen = self._check_again(verdict, wall_s >= loaded.deadline_s, record, variation)
            if again_seen.diagnosis is not None and again_seen == verdict:
                verdict = replace(verdict, diagnosis=again_seen.diagnosis)  # this run was observed
            is_same = again_seen == verdict or (
                wall_s >= loaded.deadline_s and verdict.result is again_seen.result
            )
            second = None if is_same else again_seen
        return Finding(
            promise,
            verdict,
            wall_s,
            output,
            shlex.join(again),
            record if record.exists() else None,
            _digest(record),
            second,
            variation,
        )

    def abandon(self) -> None:
        """End an examination in another thread; see `Supervisor.abandon`."""
        self._supervisor.abandon()

    def _check_again(self, first: Verdict, was_slow: bool, record: Path, variation: str) -> Verdict:
        """Check the clause again, observed and recorded."""
        deadline_s = None
        if was_slow:
            deadline_s = max(1.0, _HANGS_SOONER * self._supervisor.loaded.deadline_s)
        return self._supervisor.check(
            first.clause, record=record, deadline_s=deadline_s, variation=variation
        )

    def _record_of(self, promise: Promise) -> Path:
        try:
            self._folder.mkdir(parents=True, exist_ok=True)
        except OSError as error:
            reason = f"cannot be created: {error.strerror}"
            raise RigError(self._folder, reason, "name another folder with -o") from None
        record = self._folder / f"{promise.id}.mcap"
        with suppress(FileNotFoundError):
            record.unlink()  # from an earlier run
        return record


def examine_all(
    examiners: Sequence[Examiner],
    pairs: Sequence[tuple[Promise, str]],
    *,
    is_required: bool = False,
) -> Generator[Finding, None, None]:
    """Yield the findings on clauses in their order, each with the variation of its bench.

    Each of n examiners has every n-th clause, so that code that keeps a state meets the same
    clauses in every run. The first verdict is awaited alone, as loading further workers would delay
    it. Close the generator. If clauses remain then, several examiners cannot be used any more.

    Raises:
        WrongJobError, CannotTestError, RigError: see `Examiner.examine`.
    """
    count = len(examiners)
    alone = pairs[:1] if count > 1 else pairs
    for promise, variation in alone:
        yield examiners[0].examine(promise, variation, is_required=is_required)
    if len(alone) == len(pairs):
        return
    from concurrent.futures import ThreadPoolExecutor

    with ExitStack() as held:
        pools = [ThreadPoolExecutor(1) for _ in examiners]
        for pool in pools:
            held.callback(pool.shutdown, cancel_futures=True)
        findings = [
            pools[number % count].submit(
                examiners[number % count].examine, promise, variation, is_required=is_required
            )
            for number, (promise, variation) in enumerate(pairs)
            if number >= len(alone)
        ]
        try:
            for finding in findings:
                yield finding.result()
        finally:
            if not all(finding.done() for finding in findings):
                for examiner in examiners:
                    examiner.abandon()


def _digest(record: Path) -> str:
    from motorhil.traces.digest import digest
    from motorhil.traces.errors import TraceError

    try:
        return digest(record)
    except (TraceError, OSError):
        return ""
