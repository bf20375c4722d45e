"""The worker process, which checks clauses on request of its supervisor.

The worker receives a job, then requests, each as a line of JSON on one pipe. Each answer is a line
on another pipe. Output of the adaptation goes elsewhere. The supervisor's first signal makes Python
dump the stacks of all threads. The second signal ends the check, if possible.

    {"job": {...}}                          -> {"ready": {...}}, or {"wrong": "why"}
    {"check": "STOP-04", "record": null}    -> {"verdict": {...}}, or {"wrong": "why"}
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
from typing import Any, Final, NoReturn, TextIO, final

from harness.conformance.verdict import TELL_WHERE, TIME_IS_UP, packed

_MARGIN_S: Final = 30.0
"""Time after the deadline at which a worker without a supervisor ends by itself."""


@final
class _Worker:
    """Answers the requests for one job."""

    def __init__(self, job: Mapping[str, Any]) -> None:
        from harness.conformance.claims import Claims
        from harness.conformance.job import Job
        from harness.conformance.kit import all_clauses
        from harness.conformance.target import Target

        self._target = Target(Job.unpacked(job))
        self._clauses = all_clauses()
        self._claims = Claims(self._target.opener())

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
            "clauses": [
                {"id": one.id, "level": one.level, "promise": one.promise, "source": one.source}
                for one in self._clauses.values()
            ],
        }

    def check(self, clause: str, record: str | None) -> dict[str, object]:
        """Check a clause and return its verdict."""
        from harness.conformance.code_places import raised_at
        from harness.conformance.run import run_clause
        from harness.conformance.verdict import Result, Verdict

        opener = self._target.opener(Path(record) if record else None)
        try:
            verdict = run_clause(self._clauses[clause], opener, self._claims, self._target.home)
        except (
            KeyboardInterrupt
        ) as error:  # from the code under test: this process does not receive Ctrl-C
            place = raised_at(error, self._target.home)
            verdict = Verdict(clause, Result.CRASHED, "KeyboardInterrupt", place)
        return packed(verdict)

    def claims(self) -> dict[str, str]:
        """Return why each capability is not claimed; "" if it is claimed.

        Raises:
            RigError: the adaptation's claims cannot be read.
        """
        from harness.conformance.capability import Capability
        from harness.conformance.code_places import raised_at
        from harness.settings import RigError

        try:
            return {one.key: self._claims.why_not(one) for one in Capability}
        except RigError:
            raise
        except (Exception, SystemExit) as error:
            place = raised_at(error, self._target.home)
            raise RigError(
                place, f"{type(error).__name__}: {error}", "correct the adaptation"
            ) from error


def main(words: list[str]) -> None:
    """Answer requests until there are no more.

    Args:
        words: the descriptors for requests and answers, and of the file for stack dumps.
    """
    leave = os._exit

    def leave_and_tell(status: int) -> NoReturn:
        """Dump the stacks to show the caller, then exit as `os._exit`."""
        faulthandler.dump_traceback(told)
        leave(status)

    reader, writer, stacks = (int(word) for word in words)
    for descriptor in (reader, writer, stacks):
        os.set_inheritable(descriptor, False)
    with open(stacks, "w", closefd=False) as told:
        faulthandler.enable(told)
        faulthandler.register(TELL_WHERE, told)
        signal.signal(TIME_IS_UP, _time_is_up)
        os._exit = leave_and_tell
        with open(reader) as requests:
            _answer(requests, lambda reply: _write(writer, reply), told)
    sys.stdout.flush()
    sys.stderr.flush()
    leave(0)  # even if the adaptation has left threads running


def _answer(requests: TextIO, reply: Callable[[object], None], told: TextIO) -> None:
    from harness.settings import RigError

    worker: _Worker | None = None
    for line in requests:
        request = json.loads(line)
        answer: dict[str, object]
        try:
            if worker is None:
                sys.path[:] = request["path"]
                gc.disable()  # loading modules makes no garbage
                worker = _Worker(request["job"])
                gc.freeze()  # the collections after each clause need not scan the modules (`leaks`)
                gc.enable()
                answer = {"ready": worker.ready()}
            elif "claims" in request:
                answer = {"claims": worker.claims()}
            else:
                left_s = request["deadline_s"] + _MARGIN_S
                faulthandler.dump_traceback_later(left_s, exit=True, file=told)
                answer = {"verdict": worker.check(request["check"], request["record"])}
                faulthandler.cancel_dump_traceback_later()
        except RigError as error:
            answer = {"wrong": f"{error}"}
        reply([request["number"], answer])


def _write(descriptor: int, reply: object) -> None:
    data = json.dumps(reply).encode() + b"\n"
    while data:
        data = data[os.write(descriptor, data) :]


def _time_is_up(number: int, frame: FrameType | None) -> None:
    from harness.conformance.rig_bench import TimeIsUp

    raise TimeIsUp("the deadline has passed")
