"""A clause is checked, and if that does not end well once more, with everything recorded."""

import shlex
import time
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Final, final

from harness.conformance.job import Promise
from harness.conformance.supervision import Supervisor
from harness.conformance.verdict import Result, Verdict
from harness.settings import RigError

_HANGS_SOONER: Final = 0.1
"""Of the deadline, for a check that is known to hang."""


@final
@dataclass(frozen=True, slots=True)
class Finding:
    """What was found out about one clause.

    Attributes:
        promise: the clause.
        verdict: of the run without a record.
        wall_s: how long that took [s].
        said: the last lines that were printed meanwhile.
        again: the command that checks this clause alone; "" where nothing is to be mended.
        record: of the second run, an MCAP file; None where there is none.
        digest: of the record's messages; "" where there is none, or it was cut off.
        second: the verdict of the second run, where it ended in another way than the first.
    """

    promise: Promise
    verdict: Verdict
    wall_s: float
    said: tuple[str, ...] = ()
    again: str = ""
    record: Path | None = None
    digest: str = ""
    second: Verdict | None = None


@final
class Examiner:
    """Finds out about clauses.

    Args:
        supervisor: checks them.
        command: `motorhil conform` with what it was told of adaptation and rig.
        folder: where records go.
    """

    def __init__(self, supervisor: Supervisor, command: Sequence[str], folder: Path) -> None:
        self._supervisor = supervisor
        self._command = tuple(command)
        self._folder = folder

    def examine(self, promise: Promise) -> Finding:
        """What there is to be known of this clause.

        Raises:
            WrongJobError, CannotTestError: see `Supervisor.loaded`.
            RigError: the folder for records cannot be made.
        """
        begin_s = time.monotonic()
        verdict = self._supervisor.check(promise.id)
        wall_s = time.monotonic() - begin_s
        if verdict.result.is_good:
            return Finding(promise, verdict, wall_s)
        said = self._supervisor.said
        loaded = self._supervisor.loaded
        again = [*self._command, "--clause", promise.id, "--seed", str(loaded.seed)]
        record = self._record_of(promise)
        is_slow = verdict.result is Result.HUNG and wall_s >= loaded.deadline_s
        limit_s = max(1.0, _HANGS_SOONER * loaded.deadline_s) if is_slow else None
        second = self._supervisor.check(promise.id, record=record, deadline_s=limit_s)
        return Finding(
            promise,
            verdict,
            wall_s,
            said,
            shlex.join(again),
            record if record.exists() else None,
            _digest(record),
            None if (is_slow and second.result is verdict.result) or second == verdict else second,
        )

    def _record_of(self, promise: Promise) -> Path:
        try:
            self._folder.mkdir(parents=True, exist_ok=True)
        except OSError as error:
            reason = f"cannot be made: {error.strerror}"
            raise RigError(self._folder, reason, "name another folder with -o") from None
        record = self._folder / f"{promise.id}.mcap"
        with suppress(FileNotFoundError):
            record.unlink()  # of a run before this one
        return record


def _digest(record: Path) -> str:
    from traces.digest import digest
    from traces.errors import TraceError

    try:
        return digest(record)
    except (TraceError, OSError):
        return ""
