"""The worker process that checks clauses, and its supervisor.

    with Supervisor(Job("my_drive", "bench.toml")) as supervisor:
        verdict = supervisor.check("STOP-04")

An adaptation cannot end the kit. One worker checks all clauses as long as it lives. A check that
misses its deadline is interrupted, and the verdict has the line where it hangs. If the worker then
ends or has died, a new worker checks the remaining clauses.

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
import re
import select
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Container, Mapping
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from types import FrameType
from typing import Any, Final, NoReturn, Self, TextIO, final

import motorhil
from motorhil.harness.conformance.clause import Result, Verdict, packed, unpacked
from motorhil.harness.conformance.drives.target import DriveTarget
from motorhil.harness.conformance.rig_bench import TimeIsUp
from motorhil.harness.conformance.run import Claims, Line, place_in, raised_at, run_clause
from motorhil.harness.conformance.target import Job, Target
from motorhil.harness.conformance.variations import OWN, changes_claims
from motorhil.harness.rig.config.conformance import Capability
from motorhil.harness.rig.config.toml import RigError

DUMP_STACKS: Final = signal.SIGUSR1
"""Signal to a worker: dump the stacks of all threads."""
END_CHECK: Final = signal.SIGUSR2
"""Signal to a worker: end the check."""
_MARGIN_S: Final = 30.0
"""Time after the deadline at which a worker without a supervisor ends by itself."""
START_S: Final = 30.0
"""Time limit for loading the adaptation and reading its rig."""
_DUMPING_S: Final = 0.1
_GRACE_S: Final = 1.0
_OUTPUT_LINES: Final = 5
_THREAD: Final = re.compile(r"^(?:Current thread|Thread) .*$", re.MULTILINE)
_FRAME: Final = re.compile(r'^  File "(.*)", line (\d+) in ', re.MULTILINE)
_WAITS: Final = os.path.join("virtual_time", "runtime.py")
_READ_MAX: Final = 65_536
_OUTPUT_MAX: Final = 8_192
_END_S: Final = 2.0
_PROGRAM: Final = (
    "import sys; from motorhil.harness.conformance.worker import main; main(sys.argv[1:])"
)


@final
class _Worker:
    """Answers the requests for one job."""

    def __init__(self, job: Mapping[str, Any]) -> None:
        wanted = Job.unpacked(job)
        self._target: Target | DriveTarget
        self._target = DriveTarget(wanted) if wanted.controller else Target(wanted)
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
            if isinstance(self._target, DriveTarget):
                return self._target.claims()
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
    for line in requests:
        request = json.loads(line)
        answer: dict[str, object]
        try:
            if worker is None:
                sys.path[:] = request["path"]
                gc.disable()  # loading modules makes no garbage
                worker = _Worker(request["job"])
                gc.freeze()  # the collections after each clause need not scan the modules
                gc.enable()
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


def _write(descriptor: int, reply: object) -> None:
    data = json.dumps(reply).encode() + b"\n"
    while data:
        data = data[os.write(descriptor, data) :]


def _end_check(number: int, frame: FrameType | None) -> None:
    raise TimeIsUp("the deadline has passed")


class ChildEndedError(Exception):
    """The worker is no longer usable; the text says how it ended, or why."""


@final
class Child:
    """A running worker; `close` ends it and all processes that it has started.

    The worker has its own process group, so that only the supervisor receives Ctrl-C.

    Attributes:
        output: the last output of the worker since this was emptied.
        last_stacks: the stack dumps at the end; "" before `close`.
    """

    def __init__(self) -> None:
        self.output: bytes = b""
        self.last_stacks: str = ""
        self._stacks = tempfile.TemporaryFile()  # noqa: SIM115 -- closed with the child
        requests, self._requests = os.pipe()
        self._replies, replies = os.pipe()
        root = str(Path(motorhil.__file__).parent.parent)
        others = [path for path in (os.environ.get("PYTHONPATH"),) if path]
        options = [f"-W{one}" for one in sys.warnoptions] + ["-O"] * sys.flags.optimize
        arguments = [str(one) for one in (requests, replies, self._stacks.fileno())]
        self._process = subprocess.Popen(
            [sys.executable, "-P", *options, "-c", _PROGRAM, *arguments],
            env={**os.environ, "PYTHONPATH": os.pathsep.join([root, *others])},
            stdin=subprocess.DEVNULL,
            stdout=subprocess.PIPE,
            stderr=subprocess.STDOUT,
            pass_fds=(requests, replies, self._stacks.fileno()),
            process_group=0,
        )
        os.close(requests)
        os.close(replies)
        assert self._process.stdout is not None
        self._pipe = self._process.stdout
        self._ended = os.pidfd_open(self._process.pid)
        self._received = b""
        self._number = 0
        self._is_idle = True
        self._poll = select.poll()
        for descriptor in (self._replies, self._pipe.fileno()):
            os.set_blocking(descriptor, False)
            self._poll.register(descriptor, select.POLLIN)
        self._poll.register(self._ended, select.POLLIN)

    def ask(self, request: Mapping[str, Any]) -> None:
        """Send a request to the worker; `answer` returns its result."""
        self._is_idle = False
        self._number += 1
        line = json.dumps({**request, "number": self._number}).encode() + b"\n"
        with suppress(BrokenPipeError):  # the worker has ended; `answer` reports this
            os.write(self._requests, line)

    def answer(self, timeout_s: float) -> dict[str, Any] | None:
        """Return the next answer of the worker, or None if none comes within `timeout_s` [s].

        Raises:
            ChildEndedError: the worker has ended, or its answer cannot be decoded.
        """
        end_s = time.monotonic() + timeout_s
        while b"\n" not in self._received:
            left_s = end_s - time.monotonic()
            if left_s <= 0.0:
                return None
            ready = {descriptor for descriptor, _ in self._poll.poll(left_s * 1e3)}
            self.output = (self.output + self._read(self._pipe.fileno(), ready))[-_OUTPUT_MAX:]
            self._received += self._read(self._replies, ready)
            if self._ended in ready and b"\n" not in self._received:
                raise ChildEndedError(self._end_status())
        line, _, self._received = self._received.partition(b"\n")
        answer = self._decode(line)
        self._is_idle = True
        return answer

    def _decode(self, line: bytes) -> dict[str, Any]:
        """Decode an answer line.

        Raises:
            ChildEndedError: the line is not an answer to the last request; code under test wrote
                it.
        """
        try:
            number, answer = json.loads(line)
            if number == self._number and isinstance(answer, dict):
                return answer
        except (ValueError, TypeError):
            pass
        text = line[:40].decode(errors="replace")
        raise ChildEndedError(f"worker: wrote {text!r} to the pipe reserved for the kit's answers")

    def forget(self) -> None:
        """Discard the output and the stack dumps received so far."""
        self.output = b""
        os.ftruncate(self._stacks.fileno(), 0)
        # The worker inherited the file, and thus shares its position.
        os.lseek(self._stacks.fileno(), 0, os.SEEK_SET)

    def signal(self, number: signal.Signals) -> None:
        """Send a signal to the worker."""
        with suppress(ProcessLookupError):
            self._process.send_signal(number)

    def stacks(self) -> str:
        """Return the stack dumps that the worker has written."""
        size = os.fstat(self._stacks.fileno()).st_size
        return os.pread(self._stacks.fileno(), min(size, _READ_MAX), 0).decode(errors="replace")

    def _read(self, descriptor: int, ready: Container[int]) -> bytes:
        """Read available data from a descriptor; unregister the descriptor at its end."""
        data = b""
        if descriptor in ready:
            with suppress(BlockingIOError):
                data = os.read(descriptor, _READ_MAX)
                if not data:
                    self._poll.unregister(descriptor)
        return data

    def _end_status(self) -> str:
        facts = os.waitid(os.P_PID, self._process.pid, os.WEXITED | os.WNOWAIT)
        assert facts is not None
        if facts.si_code == os.CLD_EXITED:
            return f"worker process ended with exit status {facts.si_status}"
        return f"worker process ended by {signal.Signals(facts.si_status).name}"

    def close(self) -> None:
        """Wait for an idle worker to end, or kill it, and release its resources."""
        os.close(self._requests)
        poll = select.poll()
        poll.register(self._ended, select.POLLIN)
        if self._is_idle:
            poll.poll(_END_S * 1e3)
        with suppress(ProcessLookupError):  # not reaped yet, so the group is still its own
            os.killpg(self._process.pid, signal.SIGKILL)
        self._process.wait()
        self.last_stacks = self.stacks()
        self._pipe.close()
        self._stacks.close()
        os.close(self._replies)
        os.close(self._ended)


@final
@dataclass(frozen=True, slots=True)
class Promise:
    """A clause without its check; see `clause.Clause`."""

    id: str
    level: int
    promise: str
    source: str


class WrongJobError(Exception):
    """The adaptation or the rig cannot be used as given; the text says why."""


class CannotTestError(Exception):
    """Loading the adaptation ends the process, or never ends; the text says where."""


@final
@dataclass(frozen=True, slots=True)
class Loaded:
    """The worker's description of its job after loading.

    Attributes: adaptation (or the drive under test), rig (its file), bench (the rig's name), motors
    (under test), seed, deadline_s (for one clause), home (the folder of the adaptation's code),
    clauses (of the kit), variations (that the rig can have).
    """

    adaptation: str
    rig: str
    bench: str
    motors: tuple[str, ...]
    seed: int
    deadline_s: float
    home: str
    clauses: tuple[Promise, ...]
    variations: tuple[str, ...] = ()


@final
class Supervisor:
    """Checks the clauses of one job; a context manager that ends its worker.

    Attributes:
        output: the last lines printed during the last check.
    """

    def __init__(self, job: Job) -> None:
        self.output: tuple[str, ...] = ()
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

    def _start(self) -> Child:
        """Return the worker; start it if needed."""
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
