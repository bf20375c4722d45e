"""Supervision of the worker that checks clauses.

    with Supervisor(Job("my_drive", "bench.toml")) as supervisor:
        verdict = supervisor.check("STOP-04")

An adaptation cannot end the kit. One worker checks all clauses as long as it lives. A check that
misses its deadline is interrupted, and the verdict has the line where it hangs. If the worker then
ends or has died, a new worker checks the remaining clauses.
"""

import os
import re
import sys
import threading
from contextlib import suppress
from pathlib import Path
from typing import Any, Final, Self, final

from motorhil.harness.conformance.benches.variations import OWN
from motorhil.harness.conformance.child import DUMP_STACKS, END_CHECK, Child, ChildEndedError
from motorhil.harness.conformance.clause import Result, Verdict, unpacked
from motorhil.harness.conformance.job import Job, Loaded, Promise
from motorhil.harness.conformance.places import Line, place_in

START_S: Final = 30.0
"""Time limit for loading the adaptation and reading its rig."""
_DUMPING_S: Final = 0.1
_GRACE_S: Final = 1.0
_OUTPUT_LINES: Final = 5
_THREAD: Final = re.compile(r"^(?:Current thread|Thread) .*$", re.MULTILINE)
_FRAME: Final = re.compile(r'^  File "(.*)", line (\d+) in ', re.MULTILINE)
_WAITS: Final = os.path.join("virtual_time", "runtime.py")


class WrongJobError(Exception):
    """The adaptation or the rig cannot be used as given; the text says why."""


class CannotTestError(Exception):
    """Loading the adaptation ends the process, or never ends; the text says where."""


class AbandonedError(Exception):
    """The worker was ended by `Supervisor.abandon`."""


@final
class Supervisor:
    """Checks the clauses of one job; a context manager that ends its worker.

    Use it in one thread at a time; `abandon` may be called in any thread.

    Attributes:
        output: the last lines printed during the last check.
    """

    def __init__(self, job: Job) -> None:
        self.output: tuple[str, ...] = ()
        self._job = job
        self._child: Child | None = None
        self._loaded: Loaded | None = None
        self._has_loaded = False
        self._is_abandoned = False
        self._mutex = threading.Lock()  # of `_child`

    def __enter__(self) -> Self:
        self._start()
        return self

    def __exit__(self, *_: object) -> None:
        self._retire()

    @property
    def loaded(self) -> Loaded:
        """The description of the job.

        Raises:
            WrongJobError: the adaptation or the rig cannot be used.
            CannotTestError: loading them ends the process, or never ends.
        """
        child = self._start()
        if self._loaded is None:
            child.output = b""
            try:
                answer = child.answer(START_S)
            except ChildEndedError as ended:
                self._note(child)
                output = "".join(f"\n  {line}" for line in self.output)
                raise CannotTestError(f"loading the adaptation: {ended}{output}") from None
            if answer is None:
                place = _where(child, "")
                raise CannotTestError(
                    f"loading the adaptation: not finished after {START_S:g} s, at {place}"
                )
            ready = _accepted(answer)["ready"]
            clauses = tuple(Promise(**one) for one in ready["clauses"])
            lists = {name: tuple(ready[name]) for name in ("motors", "variations")}
            self._loaded = Loaded(**{**ready, **lists, "clauses": clauses})
            self._has_loaded = True
        return self._loaded

    def check(
        self,
        clause: str,
        *,
        record: Path | None = None,
        deadline_s: float | None = None,
        variation: str = OWN,
    ) -> Verdict:
        """Check a clause and return its verdict, whatever the adaptation does.

        Args:
            clause: its id.
            record: an MCAP file for all events.
            deadline_s: replaces the rig's deadline [s].
            variation: of the rig.

        Raises:
            WrongJobError, CannotTestError: as `loaded`.
        """
        try:
            loaded = self.loaded
        except CannotTestError as error:
            if not self._has_loaded:
                raise
            return Verdict(clause, Result.CRASHED, f"{error}")
        child = self._start()
        child.forget()
        limit_s = loaded.deadline_s if deadline_s is None else deadline_s
        file = None if record is None else str(record)
        check = {"clause": clause, "record": file, "variation": variation}
        child.ask({"check": check, "deadline_s": limit_s})
        try:
            answer = child.answer(limit_s)
            if answer is not None:
                return unpacked(_accepted(answer)["verdict"])
            answer = _interrupt(child)
            result, seen = Result.HUNG, f"not finished after {limit_s:g} s of wall time"
            if answer is None:
                seen += ", nor when interrupted"
        except ChildEndedError as ended:
            result, seen, answer = Result.CRASHED, f"{ended}", None
        finally:
            self._note(child)
        self._retire()
        time_ns = unpacked(answer["verdict"]).time_ns if answer else 0
        return Verdict(clause, result, seen, _place(child.last_stacks, loaded.home), time_ns)

    def claims(self) -> dict[str, str]:
        """Return the reason why each capability is not claimed, by key; "" if it is claimed.

        Raises:
            WrongJobError, CannotTestError: as `loaded`; also if reading the claims ends the
                process.
        """
        loaded = self.loaded
        child = self._start()
        child.forget()
        child.ask({"claims": True, "deadline_s": loaded.deadline_s})
        try:
            answer = child.answer(loaded.deadline_s)
        except ChildEndedError as ended:
            raise CannotTestError(f"reading the claims: {ended}") from None
        if answer is None:
            place = _where(child, loaded.home)
            limit_s = f"{loaded.deadline_s:g} s"
            raise CannotTestError(f"reading the claims: not finished after {limit_s}, at {place}")
        if "wrong" in answer:
            raise CannotTestError(f"reading the claims: {answer['wrong']}")
        claims: dict[str, str] = answer["claims"]
        return claims

    def abandon(self) -> None:
        """End the worker; a check in another thread raises AbandonedError, as all later ones."""
        with self._mutex:
            self._is_abandoned = True
            if self._child is not None:
                self._child.kill()

    def _start(self) -> Child:
        """Return the worker; start it if needed."""
        with self._mutex:
            if self._is_abandoned:
                raise AbandonedError
            if self._child is None:
                self._child = Child()
                self._child.ask({"job": self._job.packed(), "path": sys.path})
                self._loaded = None
            return self._child

    def _retire(self) -> None:
        with self._mutex:
            child, self._child = self._child, None
        if child is not None:
            child.close()

    def _note(self, child: Child) -> None:
        lines = child.output.decode(errors="replace").splitlines()
        self.output = tuple(lines[-_OUTPUT_LINES:])


def _interrupt(child: Child) -> dict[str, Any] | None:
    """Interrupt the check; return its answer, or None if it does not end."""
    child.signal(DUMP_STACKS)
    answer = child.answer(_DUMPING_S)  # two signals at once could interrupt a wait only once
    if answer is None:
        child.signal(END_CHECK)
        answer = child.answer(_GRACE_S)
    return answer


def _where(child: Child, home: str) -> str:
    """Interrupt the worker and return the place where it hangs."""
    with suppress(ChildEndedError):
        _interrupt(child)
    return _place(child.stacks(), home)


def _accepted(answer: dict[str, Any]) -> dict[str, Any]:
    if "wrong" in answer:
        raise WrongJobError(answer["wrong"])
    return answer


def _place(stacks: str, home: str) -> str:
    """Return the place where a worker hangs or died, from faulthandler's dump of all threads.

    The last thread in the dump is the main thread. In virtual time another thread may be running.
    """
    threads = [
        [(file, int(number)) for file, number in reversed(_FRAME.findall(text))]
        for text in _THREAD.split(stacks)[1:]
    ]
    running = [lines for lines in threads if lines and not lines[-1][0].endswith(_WAITS)]
    own = [lines for lines in running if home and any(file.startswith(home) for file, _ in lines)]
    chosen: list[Line] = next(reversed(own or running or threads), [])
    return place_in(chosen, home)
