"""Worker process: runs worlds of one plan in forked children.

Requests and answers are lines of JSON. The first request is the plan; the answer is the reason why
this worker refuses it, or "". The plan may come again with its profile. A request for a chunk is
answered by its rows and "done".

A batch of short worlds shares a child, until one of them does not pass or leaves anything in the
process. A world that fails, hangs or dies there runs again alone, and its row is that of the second
run. Some worlds that pass run alone as well. If a row depends on the worlds before, the answer
tells it, and the campaign begins anew with one world in each child.

    python -m motorhil.harness.swarm.worker
"""

import fcntl
import gc
import json
import os
import shutil
import signal
import sys
import time
from base64 import b64encode
from collections.abc import Callable, Generator, Iterable, Iterator
from contextlib import closing, contextmanager
from dataclasses import replace
from itertools import groupby
from pathlib import Path
from tempfile import gettempdir, mkdtemp
from typing import Any, Final, TextIO, final

from motorhil.harness.rig.config.toml import RigError
from motorhil.harness.rig.reading import describe
from motorhil.harness.swarm.child import (
    CLOSED,
    adopt_orphans,
    call_forked,
    end_orphans,
    forget_modules,
    forked,
    holdings,
    orphans,
    silence,
)
from motorhil.harness.swarm.lanes import Lane, batch_of, is_checked
from motorhil.harness.swarm.plan import FUNCTION, Plan, build, contents_of, plan_from
from motorhil.harness.swarm.row import CANARY, Result, Row, row_from
from motorhil.harness.swarm.trial import NoRecord, profiled, tried, warm
from motorhil.harness.swarm.worlds.disturbance import World, from_table
from motorhil.harness.swarm.worlds.drawing import parent_from

_TRIES: Final = 2
"""A world that something outside killed runs once more."""
_SENT_MAX: Final = 1 << 24
"""Length of a record that is sent, at most [bytes]."""
_LEFT: Final = "left"
_PASSING: Final = "motorhil-swarm-"
_WORLD: Final = "world"
_SENT: Final = "sent.mcap"
_NEW_S: Final = 60.0
_TOLD: Final = (Result.PASSED, Result.FAILED, Result.TIMEOUT)
"""Results that are the program's."""
_OUTSIDE: Final = (signal.SIGKILL, signal.SIGTERM)


def main() -> int:
    """Serve requests from standard input until it ends."""
    answers = os.fdopen(os.dup(1), "w")
    requests = os.fdopen(os.dup(0))
    silence()
    adopt_orphans()
    signal.signal(signal.SIGTERM, lambda *_: sys.exit(1))  # ends the child of the moment as well
    with _passing() as folder:
        _serve(requests, answers, folder)
    return 0


def _serve(requests: Iterable[str], answers: TextIO, folder: Path) -> None:
    worker: Worker | None = None
    for line in requests:
        request: dict[str, Any] = json.loads(line)
        if "plan" in request:
            plan = plan_from(request["plan"])
            refused = refusal(plan)
            if not refused and (worker is None or not worker.goes_on(plan)):
                worker = Worker(plan, folder)
            answer: Iterable[str] = [json.dumps({"refused": refused}) + "\n"]
        else:
            assert worker is not None, "a plan comes first"
            answer = worker.answer(request)
        for text in answer:
            answers.write(text)
            answers.flush()


@contextmanager
def _passing() -> Iterator[Path]:
    """Yield a folder for files that pass; also remove those that killed workers have left."""
    for one in Path(gettempdir()).glob(f"{_PASSING}*"):
        if _is_left(one):
            shutil.rmtree(one, ignore_errors=True)
    folder = Path(mkdtemp(prefix=_PASSING))
    lock = os.open(folder, os.O_RDONLY)
    try:
        fcntl.flock(lock, fcntl.LOCK_EX)  # until this process ends
        yield folder
    finally:
        shutil.rmtree(folder, ignore_errors=True)
        os.close(lock)


def _is_left(folder: Path) -> bool:
    """Return True if it is a worker's folder, and no worker has it any more."""
    try:
        if time.time() - folder.stat().st_mtime < _NEW_S:  # perhaps not locked yet
            return False
        if not {one.name for one in folder.iterdir()} <= {_WORLD, _SENT}:
            return False  # a user's own folder
        lock = os.open(folder, os.O_RDONLY)
    except OSError:
        return False
    try:
        fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except OSError:
        return False
    finally:
        os.close(lock)
    return True


def refusal(plan: Plan) -> str:
    """Return why this installation cannot run the plan, or ""."""
    if build() != plan.build:
        return f"motorhil here is {build()}; the campaign's is {plan.build}; install the same"
    try:
        contents = contents_of(Path(plan.rig), plan.program)
    except RigError as error:
        return str(error)
    if contents != plan.contents:
        return f"{plan.rig} or the program differs from the campaign's; copy the same files"
    return ""


@final
class Worker:
    """The worlds of a plan in this process's children.

    Args:
        plan: the plan; the program's own modules are imported by children only.
        folder: for files that pass.
    """

    def __init__(self, plan: Plan, folder: Path) -> None:
        self._plan = plan
        self._folder = folder / _WORLD
        self._folder.mkdir(exist_ok=True)
        self._sent = folder / _SENT
        self._table = describe(Path(plan.rig)).world.swarm
        warm(plan, self._folder)
        self._tidy()
        gc.collect()
        gc.freeze()  # children share what they do not look at

    def goes_on(self, plan: Plan) -> bool:
        """Take a plan that differs from this one in its profile alone; return False for others."""
        if replace(plan, profile=self._plan.profile) != self._plan:
            return False
        self._plan = plan
        return True

    def answer(self, request: dict[str, Any]) -> Iterable[str]:
        """Yield the lines of the answer to a request."""
        try:
            if "profile" in request:
                yield self._profile() + "\n"
            elif "try" in request:
                yield from self._again(request)
            else:
                lane = Lane(request["seen"], map(parent_from, request["corpus"]))
                guided, size = request["guided"], 1 if request["alone"] else self._plan.batch()
                for _, seeds in groupby(request["seeds"], lambda seed: batch_of(seed, size)):
                    for line in self._batch(lane, list(seeds), guided, size):
                        yield line + "\n"
        except NoRecord as error:
            yield json.dumps({"failed": str(error)}) + "\n"
        else:
            yield '{"done": true}\n'

    def _again(self, request: dict[str, Any]) -> Iterator[str]:
        """Run one world; yield its row, and its record if that is sent and not too long."""
        world = tuple(from_table(one) for one in request["world"])
        sends = request.get("sends", False)
        record = self._sent if sends else request.get("record")
        try:
            yield self.run(request["try"], world, record and Path(record)).as_line() + "\n"
            if sends and self._sent.exists() and self._sent.stat().st_size <= _SENT_MAX:
                yield json.dumps({"record": b64encode(self._sent.read_bytes()).decode()}) + "\n"
        finally:
            self._sent.unlink(missing_ok=True)

    def _batch(self, lane: Lane, seeds: list[int], guided: bool, size: int) -> Iterator[str]:
        """Run worlds of a lane; yield their rows, and whether a row depends on worlds before."""
        while seeds:
            together = None
            if len(seeds) > 1:
                together = yield from self._together(lane, seeds, guided, size)
            if together != _LEFT and seeds:
                row = self._next(lane, seeds.pop(0), guided, self.run)
                lane.learn(row)
                line = row.as_line()
                yield line
                if together not in (None, line) and row.result in _TOLD:
                    yield json.dumps({"keeps": together})

    def _together(
        self, lane: Lane, seeds: list[int], guided: bool, size: int
    ) -> Generator[str, None, str | None]:
        """Run worlds in one child; drop seeds that have a row.

        Returns:
            the row of a world that must run alone as well; _LEFT if a world has left something in
            its process; None if the child has ended.
        """

        def lines() -> Iterator[str]:
            loaded, held = frozenset(sys.modules), holdings()
            for seed in tuple(seeds):
                row = self._next(lane, seed, guided, self._tried)
                yield row.as_line()
                forget_modules(loaded, package)
                if row.result is not Result.PASSED or is_checked(seed, size):
                    return
                if holdings() != held:
                    yield _LEFT
                    return
                self._tidy()
                lane.learn(row)

        program = self._plan.program
        package = program.name.partition(".")[0] if program.kind == FUNCTION else ""
        try:
            with closing(forked(lines, self._plan.wall_s)) as child:
                for text in map(bytes.decode, child):
                    if text == _LEFT:
                        return _LEFT
                    row = row_from(text)
                    if row.result is not Result.PASSED or is_checked(row.seed, size):
                        return text
                    lane.learn(row)
                    seeds.pop(0)
                    yield text
                    if orphans():
                        return _LEFT
        finally:
            end_orphans()
            self._tidy()
        return None

    def _next(self, lane: Lane, seed: int, guided: bool, run: Callable[[int, World], Row]) -> Row:
        """Run the next world of a lane; the row has only what is new in it."""
        assert self._plan.profile is not None
        world = lane.world(abs(seed), self._plan.profile, self._table, guided)
        row = run(seed, world)
        new = tuple(pair for pair in row.new if pair not in lane.seen)
        row = replace(row, new=new if seed != CANARY else ())
        if not row.new:
            row = replace(row, reactions=())
        return row if row.new or row.is_bad else replace(row, world=())

    def _tried(self, seed: int, world: World) -> Row:
        """Run a world in this process; return its row."""
        try:
            return tried(self._plan, seed, world, self._folder)
        except BaseException as error:  # it runs again alone, and is told then
            return Row(seed, Result.CANCELLED, text=type(error).__name__)

    def run(self, seed: int, world: World, record: Path | None = None) -> Row:
        """Run a world in a child process; return its row whatever becomes of the child.

        Raises:
            NoRecord: the record could not be written.
        """
        plan, folder = self._plan, self._folder
        row = Row(seed, Result.KILLED)
        for _ in range(_TRIES):
            answer = self._called(
                seed, world, lambda: tried(plan, seed, world, folder, record).as_line()
            )
            row = answer if isinstance(answer, Row) else row_from(answer)
            if row.result is not Result.KILLED:
                break
        return row

    def _profile(self) -> str:
        """Run the undisturbed world; return its row and its profile.

        Raises:
            NoRecord: the record could not be written.
        """

        def call() -> str:
            row, profile = profiled(self._plan, 0, self._folder)
            seen = None if profile is None else profile.as_table()
            return json.dumps({"row": row.as_line(), "profile": seen})

        answer = self._called(0, (), call)
        if isinstance(answer, Row):
            return json.dumps({"row": answer.as_line(), "profile": None})
        return answer

    def _called(self, seed: int, world: World, call: Callable[[], str]) -> str | Row:
        """Return the answer of a child, or the row of its end."""
        try:
            ended = call_forked(lambda: _told(call), self._plan.wall_s)
        finally:
            end_orphans()
            self._tidy()
        if ended.is_late:
            limit = f"{self._plan.wall_s:g} s of wall time"
            what = f"takes more than {limit}; expected an end; see --timeout"
            return Row(seed, Result.TIMEOUT, "end", "end | hangs | - | - | -", what, world=world)
        if ended.text is None:
            return _died(seed, world, ended.status)
        table: dict[str, str] = json.loads(ended.text)
        if "failed" in table:
            raise NoRecord(table["failed"])
        if "error" in table:
            return Row(seed, Result.CANCELLED, text=table["error"])
        return table["answer"]

    def _tidy(self) -> None:
        """Remove what a child has left in the folder."""
        for one in self._folder.iterdir():
            if one.is_dir():
                shutil.rmtree(one, ignore_errors=True)
            else:
                one.unlink(missing_ok=True)


def _told(call: Callable[[], str]) -> str:
    """Return the answer of a call in a child, or why there is none."""
    try:
        return json.dumps({"answer": call()})
    except NoRecord as error:
        return json.dumps({"failed": str(error)})
    except BaseException as error:
        return json.dumps({"error": f"{type(error).__name__}: {error}"})


def _died(seed: int, world: World, status: int) -> Row:
    """Return the row of a child that ended without one."""
    number = os.WTERMSIG(status) if os.WIFSIGNALED(status) else 0
    if number in _OUTSIDE:
        return Row(seed, Result.KILLED, text=f"killed by {signal.Signals(number).name}")
    if number:
        what = f"crashed by {signal.Signals(number).name}"
    elif os.WEXITSTATUS(status) == CLOSED:
        what = "closed file descriptors that it had not opened"
    else:
        what = f"left its process with status {os.WEXITSTATUS(status)}"
    signature = f"exit | {what} | - | - | -"
    return Row(seed, Result.FAILED, "exit", signature, f"the program {what}", world=world)


if __name__ == "__main__":
    sys.exit(main())
