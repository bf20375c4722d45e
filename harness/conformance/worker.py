"""The worker process that checks clauses for a supervisor.

The worker receives a job, then requests, each as a line of JSON on one pipe. Each answer is a line
on another pipe. Output of the adaptation goes elsewhere. The supervisor's first signal makes Python
dump the stacks of all threads. The second signal ends the check, if possible.

    {"job": {...}}                          -> {"ready": {...}}, or {"wrong": "why"}
    {"check": {"clause": "STOP-04", "record": null, "variation": ""}}
                                            -> {"verdict": {...}}, or {"wrong": "why"}
    {"claims": true}                        -> {"claims": {"homing": "why not, or nothing"}}

Each request has a number, and its answer is [number, answer].
"""

import faulthandler
import gc
import json
import os
import signal
import sys
from collections.abc import Callable, Mapping
from pathlib import Path
from types import FrameType
from typing import TYPE_CHECKING, Any, Final, NoReturn, TextIO, final

from motorhil.harness.conformance.benches.rig_bench import TimeIsUp
from motorhil.harness.conformance.benches.variations import changes_claims
from motorhil.harness.conformance.child import DUMP_STACKS, END_CHECK
from motorhil.harness.conformance.claims import Claims
from motorhil.harness.conformance.clause import Result, Verdict, packed
from motorhil.harness.conformance.job import Job
from motorhil.harness.conformance.places import raised_at
from motorhil.harness.conformance.run import run_clause
from motorhil.harness.conformance.target import Target
from motorhil.harness.rig.config.conformance import Capability
from motorhil.harness.rig.config.toml import RigError

if TYPE_CHECKING:
    from motorhil.harness.conformance.drives.target import DriveTarget

_GC_OBJECTS: Final = 500_000
"""Number of new objects after which Python looks for garbage, also within a check."""
_GARBAGE_PAGES: Final = (128 << 20) // os.sysconf("SC_PAGE_SIZE")
"""Growth of the process after which it looks for garbage between checks.

To free all benches that a run closes takes a sixth of its time; the end of the process is free.
"""
_MARGIN_S: Final = 30.0
"""Time after the deadline at which a worker without a supervisor ends by itself."""


@final
class _Worker:
    """Answers the requests for one job."""

    def __init__(self, job: Mapping[str, Any]) -> None:
        self._target = _target_of(Job.unpacked(job))
        self._clauses = self._target.clauses()
        self._claims = Claims(self._target.opener())
        self._fewer: dict[str, Claims] = {}

    def ready(self) -> dict[str, object]:
        """Return the description of the job."""
        rig = self._target.rig
        return {
            "adaptation": self._target.adaptation,
            "rig": str(rig.source.path),
            "bench": rig.name,
            "motors": list(rig.conformance.motors),
            "seed": self._target.seed,
            "deadline_s": self._target.deadline_s,
            "home": self._target.home,
            "variations": list(self._target.variations),
            "clauses": [
                {"id": one.id, "level": one.level, "promise": one.promise, "source": one.source}
                for one in self._clauses.values()
            ],
        }

    def check(self, clause: str, record: str | None, variation: str) -> dict[str, object]:
        """Check a clause and return its verdict."""
        opener = self._target.opener(Path(record) if record else None, variation)
        claims = self._claims
        if variation and changes_claims(variation):
            unrecorded = self._target.opener(None, variation)
            claims = self._fewer.setdefault(variation, Claims(unrecorded))
        try:
            verdict = run_clause(self._clauses[clause], opener, claims, self._target.home)
        except KeyboardInterrupt as error:  # of the code under test: Ctrl-C does not come here
            place = raised_at(error, self._target.home)
            verdict = Verdict(clause, Result.CRASHED, "KeyboardInterrupt", place)
        return packed(verdict)

    def claims(self) -> dict[str, str]:
        """Return why each capability is not claimed; "" if it is claimed.

        Raises:
            RigError: the adaptation's claims cannot be read.
        """
        try:
            if not isinstance(self._target, Target):
                return self._target.claims()
            return {one.key: self._claims.why_not(one) for one in Capability}
        except RigError:
            raise
        except (Exception, SystemExit) as error:
            place = raised_at(error, self._target.home)
            raise RigError(
                place, f"{type(error).__name__}: {error}", "correct the adaptation"
            ) from error


def _target_of(job: Job) -> "Target | DriveTarget":
    """Return the target of a job; load what drives need for drives only."""
    if not job.controller:
        return Target(job)
    from motorhil.harness.conformance.drives.target import DriveTarget

    return DriveTarget(job)


def main(words: list[str]) -> None:
    """Answer requests until there are no more.

    Args:
        words: the descriptors for requests and answers, and of the file for stack dumps.
    """
    leave = os._exit

    def dump_and_leave(status: int) -> NoReturn:
        """Dump the stacks to show the caller, then exit as `os._exit`."""
        faulthandler.dump_traceback(dump)
        leave(status)

    reader, writer, stacks = (int(word) for word in words)
    for descriptor in (reader, writer, stacks):
        os.set_inheritable(descriptor, False)
    with open(stacks, "w", closefd=False) as dump:
        faulthandler.enable(dump)
        faulthandler.register(DUMP_STACKS, dump)
        signal.signal(END_CHECK, _end_check)
        os._exit = dump_and_leave
        with open(reader) as requests:
            _answer(requests, lambda reply: _write(writer, reply), dump)
    sys.stdout.flush()
    sys.stderr.flush()
    leave(0)  # even if the adaptation has left threads running


def _answer(requests: TextIO, reply: Callable[[object], None], dump: TextIO) -> None:
    worker: _Worker | None = None
    begun_pages = 0
    for line in requests:
        request = json.loads(line)
        answer: dict[str, object]
        try:
            if worker is None:
                sys.path[:] = request["path"]
                gc.disable()  # loading modules makes no garbage
                worker = _Worker(request["job"])
                gc.freeze()  # the collections after each clause need not scan the modules
                gc.set_threshold(_GC_OBJECTS)
                gc.enable()
                begun_pages = _pages()
                answer = {"ready": worker.ready()}
            elif "claims" in request:
                answer = {"claims": worker.claims()}
            else:
                left_s = request["deadline_s"] + _MARGIN_S
                faulthandler.dump_traceback_later(left_s, exit=True, file=dump)
                answer = {"verdict": worker.check(**request["check"])}
                faulthandler.cancel_dump_traceback_later()
        except RigError as error:
            answer = {"wrong": f"{error}"}
        reply([request["number"], answer])
        if worker is not None and _pages() - begun_pages > _GARBAGE_PAGES:
            gc.collect()
            begun_pages = _pages()


def _pages() -> int:
    """Return the size of this process in memory [pages]."""
    return int(Path("/proc/self/statm").read_text().split()[1])


def _write(descriptor: int, reply: object) -> None:
    data = json.dumps(reply).encode() + b"\n"
    while data:
        data = data[os.write(descriptor, data) :]


def _end_check(number: int, frame: FrameType | None) -> None:
    raise TimeIsUp("the deadline has passed")
