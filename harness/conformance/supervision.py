"""Clauses are checked in a process of its own, so that nothing an adaptation does ends the kit.

    with Supervisor(Job("my_drive", "bench.toml")) as supervisor:
        verdict = supervisor.check("STOP-04")

One worker checks everything, as long as it lives. Whoever does not end in time is told to, with the
line at which it hangs; then, or when the worker has died, another worker does the rest.
"""

import os
import re
import sys
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final, Self, final

from harness.conformance.child import Child, ChildEndedError
from harness.conformance.code_places import Line, place_in
from harness.conformance.job import Job, Promise
from harness.conformance.verdict import TELL_WHERE, TIME_IS_UP, Result, Verdict, unpacked

START_S: Final = 30.0
"""Within which an adaptation has to be loaded, and its rig to be read."""
_TELLING_S: Final = 0.1
_GRACE_S: Final = 1.0
_SAID_LINES: Final = 5
_THREAD: Final = re.compile(r"^(?:Current thread|Thread) .*$", re.MULTILINE)
_FRAME: Final = re.compile(r'^  File "(.*)", line (\d+) in ', re.MULTILINE)
_WAITS: Final = os.path.join("harness", "virtual_time.py")


class WrongJobError(Exception):
    """The adaptation or the rig cannot be used as they are given; the text says why."""


class CannotTestError(Exception):
    """Loading the adaptation ends the process, or never ends; the text says where."""


@final
@dataclass(frozen=True, slots=True)
class Loaded:
    """What a worker says of its job, once it has read it.

    Attributes: adaptation, rig (its file), bench (what the rig is called), motors (under test),
    seed, deadline_s (for one clause), home (where the adaptation's code is), clauses (the kit's).
    """

    adaptation: str
    rig: str
    bench: str
    motors: tuple[str, ...]
    seed: int
    deadline_s: float
    home: str
    clauses: tuple[Promise, ...]


@final
class Supervisor:
    """Checks clauses of one job; a context manager, after which nothing is left of it.

    Attributes:
        said: the last lines that were printed during the last check.
    """

    def __init__(self, job: Job) -> None:
        self.said: tuple[str, ...] = ()
        self._job = job
        self._child: Child | None = None
        self._loaded: Loaded | None = None
        self._has_loaded = False

    def __enter__(self) -> Self:
        self._start()
        return self

    def __exit__(self, *_: object) -> None:
        self._retire()

    @property
    def loaded(self) -> Loaded:
        """What the job is about.

        Raises:
            WrongJobError: the adaptation or the rig cannot be used.
            CannotTestError: loading them ends the process, or never ends.
        """
        child = self._start()
        if self._loaded is None:
            child.said = b""
            try:
                answer = child.answer(START_S)
            except ChildEndedError as ended:
                self._note(child)
                said = "".join(f"\n  {line}" for line in self.said)
                raise CannotTestError(f"loading it: {ended}{said}") from None
            if answer is None:
                place = _where(child, "")
                raise CannotTestError(f"loading it has not ended after {START_S:g} s, at {place}")
            ready = _right(answer)["ready"]
            clauses = tuple(Promise(**one) for one in ready["clauses"])
            self._loaded = Loaded(**{**ready, "motors": tuple(ready["motors"]), "clauses": clauses})
            self._has_loaded = True
        return self._loaded

    def check(
        self, clause: str, *, record: Path | None = None, deadline_s: float | None = None
    ) -> Verdict:
        """The verdict of a clause, in any case.

        Args:
            clause: its id.
            record: an MCAP file for everything that happens.
            deadline_s: instead of the rig's [s].

        Raises:
            WrongJobError, CannotTestError: as of `loaded`.
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
        child.ask({"check": clause, "record": file, "deadline_s": limit_s})
        try:
            answer = child.answer(limit_s)
            if answer is not None:
                return unpacked(_right(answer)["verdict"])
            answer = _interrupt(child)
            result, seen = Result.HUNG, f"it has not ended after {limit_s:g} s of the wall's time"
            if answer is None:
                seen += ", nor when it was interrupted"
        except ChildEndedError as ended:
            result, seen, answer = Result.CRASHED, f"{ended}", None
        finally:
            self._note(child)
        self._retire()
        time_ns = unpacked(answer["verdict"]).time_ns if answer else 0
        return Verdict(clause, result, seen, _place(child.told, loaded.home), time_ns)

    def claims(self) -> dict[str, str]:
        """By capability's key, why the motors do not claim it; "" of what they claim.

        Raises:
            WrongJobError, CannotTestError: as of `loaded`; or asking ends the process.
        """
        loaded = self.loaded
        child = self._start()
        child.forget()
        child.ask({"claims": True, "deadline_s": loaded.deadline_s})
        try:
            answer = child.answer(loaded.deadline_s)
        except ChildEndedError as ended:
            raise CannotTestError(f"asking what it claims: {ended}") from None
        if answer is None:
            place = _where(child, loaded.home)
            limit_s = f"{loaded.deadline_s:g} s"
            raise CannotTestError(
                f"asking what it claims has not ended after {limit_s}, at {place}"
            )
        if "wrong" in answer:
            raise CannotTestError(f"asking what it claims: {answer['wrong']}")
        claims: dict[str, str] = answer["claims"]
        return claims

    def _start(self) -> Child:
        """The worker, at work on the job."""
        if self._child is None:
            self._child = Child()
            self._child.ask({"job": self._job.packed(), "path": sys.path})
            self._loaded = None
        return self._child

    def _retire(self) -> None:
        child, self._child = self._child, None
        if child is not None:
            child.close()

    def _note(self, child: Child) -> None:
        lines = child.said.decode(errors="replace").splitlines()
        self.said = tuple(lines[-_SAID_LINES:])


def _interrupt(child: Child) -> dict[str, Any] | None:
    """What it answers when it was told to end; None if it does not end even so."""
    child.signal(TELL_WHERE)
    answer = child.answer(_TELLING_S)  # two signals at once could interrupt a wait as one
    if answer is None:
        child.signal(TIME_IS_UP)
        answer = child.answer(_GRACE_S)
    return answer


def _where(child: Child, home: str) -> str:
    """Where it hangs; it was told to end."""
    with suppress(ChildEndedError):
        _interrupt(child)
    return _place(child.stacks(), home)


def _right(answer: dict[str, Any]) -> dict[str, Any]:
    if "wrong" in answer:
        raise WrongJobError(answer["wrong"])
    return answer


def _place(stacks: str, home: str) -> str:
    """Where it hangs, or died, by what faulthandler wrote of all threads; the last is the main one.

    In virtual time one thread runs, and it may be another than that.
    """
    threads = [
        [(file, int(number)) for file, number in reversed(_FRAME.findall(text))]
        for text in _THREAD.split(stacks)[1:]
    ]
    running = [lines for lines in threads if lines and not lines[-1][0].endswith(_WAITS)]
    own = [lines for lines in running if home and any(file.startswith(home) for file, _ in lines)]
    chosen: list[Line] = next(reversed(own or running or threads), [])
    return place_in(chosen, home)
