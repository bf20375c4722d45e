"""A clause is checked, and if that does not end well once more, with everything recorded.

On a bench of the wall's world it is recorded the first time.
"""

import shlex
import time
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Final, final

from harness.conformance.job import Promise
from harness.conformance.supervision import Supervisor
from harness.conformance.verdict import Verdict
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
        is_live: whether the bench is of the wall's world, where no run is like another, so that
            the first one has to be recorded.
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

    def examine(self, promise: Promise) -> Finding:
        """What there is to be known of this clause.

        Raises:
            WrongJobError, CannotTestError: see `Supervisor.loaded`.
            RigError: the folder for records cannot be made.
        """
        record = self._record_of(promise) if self._is_live else None
        begin_s = time.monotonic()
        verdict = self._supervisor.check(promise.id, record=record)
        wall_s = time.monotonic() - begin_s
        said = self._supervisor.said
        if verdict.result.is_good:
            if record is not None:
                record.unlink(missing_ok=True)
            return Finding(promise, verdict, wall_s)
        loaded = self._supervisor.loaded
        again = [*self._command, "--clause", promise.id, "--seed", str(loaded.seed)]
        second = None
        if record is None:
            record = self._record_of(promise)
            second = self._again(verdict, wall_s >= loaded.deadline_s, record)
        return Finding(
            promise,
            verdict,
            wall_s,
            said,
            shlex.join(again),
            record if record.exists() else None,
            _digest(record),
            second,
        )

    def _again(self, first: Verdict, was_slow: bool, record: Path) -> Verdict | None:
        """Its verdict when it is checked again and recorded, if that is another one."""
        deadline_s = None
        if was_slow:
            deadline_s = max(1.0, _HANGS_SOONER * self._supervisor.loaded.deadline_s)
        second = self._supervisor.check(first.clause, record=record, deadline_s=deadline_s)
        if was_slow and first.result is second.result:
            return None
        return None if second == first else second

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
