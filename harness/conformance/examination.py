"""Examination of clauses: a failing check is repeated and recorded.

On a bench in wall time the first run is recorded.

Targets of a job: the loaded adaptation and its rig.
"""

import inspect
import os
import shlex
import time
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Final, final

from motorhil.harness.conformance.bench import Opener
from motorhil.harness.conformance.clause import NOTHING_DECLARED, Facts, Verdict
from motorhil.harness.conformance.rig_bench import RigBench, bench_description
from motorhil.harness.conformance.run import home_of
from motorhil.harness.conformance.worker import Job, Promise, Supervisor
from motorhil.harness.plugins import ADAPTATIONS, installed, is_target, named
from motorhil.harness.rig.config.rig_file import RigDescription, read_rig
from motorhil.harness.rig.config.toml import BrokenPluginError, RigError, a_kind_of, listed, nearest
from motorhil.harness.rig.rig import describe, installed_plugins

_HANGS_SOONER: Final = 0.1
"""Share of the deadline for a check that is known to hang."""


@final
@dataclass(frozen=True, slots=True)
class Finding:
    """The result of the examination of one clause.

    Attributes:
        promise: the clause.
        verdict: the verdict of the run without a record.
        wall_s: the duration of that run [s].
        said: the last lines printed during that run.
        again: the command that checks this clause alone; "" if the verdict is good.
        record: the MCAP file of the second run, or None.
        digest: the digest of the record's messages; "" if there is none, or the record is
            incomplete.
        second: the verdict of the second run, if it differs from the first.
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

    def examine(self, promise: Promise) -> Finding:
        """Check a clause and return the finding.

        Raises:
            WrongJobError, CannotTestError: see `Supervisor.loaded`.
            RigError: the folder for records cannot be created.
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
        """Check the clause again and record it; return the verdict if it differs."""
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
            reason = f"cannot be created: {error.strerror}"
            raise RigError(self._folder, reason, "name another folder with -o") from None
        record = self._folder / f"{promise.id}.mcap"
        with suppress(FileNotFoundError):
            record.unlink()  # from an earlier run
        return record


def _digest(record: Path) -> str:
    from motorhil.traces.digest import digest
    from motorhil.traces.errors import TraceError

    try:
        return digest(record)
    except (TraceError, OSError):
        return ""


_LIVE_DEADLINE_S: Final = 120.0
OWN_RIGS: Final = Path(__file__).parent / "rigs"


@final
class Target:
    """The loaded adaptation and the rig of a job.

    Attributes:
        rig: the description, with the motors under test.
        seed: the seed of all random numbers.
        deadline_s: for one clause, in wall time [s].
        home: the folder of the adaptation's code (`code_places.home_of`).

    Raises:
        RigError: the adaptation or the rig cannot be used.
    """

    def __init__(self, job: Job) -> None:
        build = _loaded(job.adaptation) if job.adaptation else None
        described = _described(Path(job.rig) if job.rig else _own_rig(job.adaptation, build))
        self.rig = bench_description(described, job.adaptation or None)
        self.seed = described.seed if job.seed is None else job.seed
        first = self.rig.motors[self.rig.conformance.motors[0]]
        self._places = _places(job, self.rig) if job.on else None
        self.deadline_s: Final = _deadline_s(self.rig.conformance, is_live=bool(job.on))
        self.adaptation: Final = first.adaptation
        self.home: Final = home_of(getattr(build or _loaded(self.adaptation), "__module__", ""))

    def opener(self, record: Path | None = None) -> Opener:
        """Return an opener for benches of this rig, which record everything to `record`."""
        if self._places is None:
            return lambda: RigBench(self.rig, self.seed, record=record)
        from motorhil.harness.conformance.wall_bench import WallBench

        places = self._places
        return lambda: WallBench(self.rig, places, self.seed, record=record)


def _described(path: Path) -> RigDescription:
    """Return the rig in a file; detecting a recording takes 0.1 s, so skip it for TOML files."""
    if path.suffix == ".toml":
        return read_rig(path, installed_plugins())
    return describe(path)


def _places(job: Job, rig: RigDescription) -> dict[str, str]:
    from motorhil.harness.conformance.wall_bench import places_in

    return places_in(job.on, rig)


def _deadline_s(facts: Facts, is_live: bool) -> float:
    """Return the declared deadline; a live bench's default allows for the motions themselves."""
    is_declared = facts.deadline_s != NOTHING_DECLARED.deadline_s
    return facts.deadline_s if is_declared or not is_live else _LIVE_DEADLINE_S


def _loaded(adaptation: str) -> object:
    """Return the function that builds the adaptation's motors."""
    where = f"adaptation {adaptation}"
    known = list(installed(ADAPTATIONS))
    if not is_target(adaptation) and adaptation not in known:
        message = f"is not installed (known: {listed(known)})"
        remedy = nearest(adaptation, known)
        if not remedy.startswith("did"):
            remedy = "name one of these, or a function as package.module:function"
        raise RigError(where, message, remedy)
    try:
        loaded = named(ADAPTATIONS, adaptation).load()
    except (Exception, SystemExit) as error:
        raise BrokenPluginError(
            where,
            f"cannot be loaded: {type(error).__name__}: {error}",
            "correct the adaptation or its name",
        ) from error
    if not callable(loaded):
        raise BrokenPluginError(where, f"is {a_kind_of(loaded)}", "name a function")
    return loaded


def _own_rig(adaptation: str, build: object) -> Path:
    """Return the rig that comes with the adaptation."""
    own = OWN_RIGS / f"{adaptation}.toml"
    if own.exists():
        return own
    told = getattr(build, "conformance_rig", None)
    if not isinstance(told, str | os.PathLike):
        raise RigError(f"adaptation {adaptation}", "has no rig of its own", "add --rig RIG")
    module = inspect.getmodule(build)
    folder = Path(getattr(module, "__file__", None) or ".").parent
    return folder / told
