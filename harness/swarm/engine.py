"""Engine: where chunks of a campaign run.

An engine is an executor of `concurrent.futures`: threads on this machine, or a cluster of dask.
Each of its threads keeps one worker process. Results are the rows; an engine that loses some loses
time, never rows that were written. The worker that ran the undisturbed world is not started again:
the first chunk of its campaign in this process takes it over.
"""

import json
import subprocess
import sys
import threading
from collections.abc import Callable
from concurrent.futures import Executor, Future, ThreadPoolExecutor
from contextlib import suppress
from typing import Any, Final, ParamSpec, TypeVar, final

from motorhil.harness.rig.config.toml import RigError
from motorhil.harness.swarm.row import Row, row_from
from motorhil.harness.swarm.worlds.profile import Profile, profile_from

P = ParamSpec("P")
T = TypeVar("T")
_COMMAND: Final = (sys.executable, "-P", "-m", "motorhil.harness.swarm.worker")
_DONE: Final = '{"done": true}\n'
_FAILED: Final = '{"failed": '
_PATIENCE_S: Final = 2.0


class WorkerDied(Exception):  # noqa: N818 -- it says what happened, as the errors of motorapi
    """A worker process ended before its answer; the chunk may run again."""


class WorkerRefused(Exception):  # noqa: N818 -- likewise
    """A worker has another version or other files than the campaign."""


@final
class WorkerProcess:
    """A worker process with one plan.

    Raises:
        WorkerRefused: it has another version or other files.
    """

    def __init__(self, plan: dict[str, Any]) -> None:
        self._process = subprocess.Popen(
            _COMMAND,
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            text=True,
            start_new_session=True,  # Ctrl-C reaches the campaign, which ends it
        )
        try:
            self.begin(plan)
        except BaseException:
            self.close()
            raise

    def begin(self, plan: dict[str, Any]) -> None:
        """Go on with another plan; little is done anew if only its profile differs.

        Raises:
            WorkerDied: the worker has ended.
            WorkerRefused: it has another version or other files.
        """
        refused = json.loads(self._ask({"plan": plan}))["refused"]
        if refused:
            raise WorkerRefused(refused)

    @property
    def pid(self) -> int:
        """The process id."""
        return self._process.pid

    def lines(self, request: dict[str, Any]) -> list[str]:
        """Return the lines of the answer to a request, such as rows.

        Raises:
            WorkerDied: the worker ended before.
            WorkerRefused: it cannot write records.
        """
        lines = []
        answer = self._ask(request)
        while answer != _DONE:
            if answer.startswith(_FAILED):
                raise WorkerRefused(json.loads(answer)["failed"])
            lines.append(answer.rstrip("\n"))
            answer = self._answer()
        return lines

    def profile(self) -> tuple[Row, Profile | None]:
        """Run the undisturbed world; return its row, and what it looks like unless it failed.

        Raises:
            WorkerDied: the worker ended before.
            WorkerRefused: it cannot write records.
        """
        (line,) = self.lines({"profile": True})
        table = json.loads(line)
        seen = table["profile"]
        return row_from(table["row"]), None if seen is None else profile_from(seen)

    def close(self) -> None:
        """End the process and its children, also in the middle of a world."""
        self._process.terminate()
        try:
            self._process.wait(_PATIENCE_S)
        except subprocess.TimeoutExpired:
            self._process.kill()
            self._process.wait()
        for pipe in (self._process.stdin, self._process.stdout):
            assert pipe is not None
            with suppress(OSError):  # what it has not read any more
                pipe.close()

    def _ask(self, request: dict[str, Any]) -> str:
        assert self._process.stdin is not None
        try:
            self._process.stdin.write(json.dumps(request) + "\n")
            self._process.stdin.flush()
        except OSError:
            raise WorkerDied(f"worker {self.pid} has ended") from None
        return self._answer()

    def _answer(self) -> str:
        assert self._process.stdout is not None
        line = self._process.stdout.readline()
        if not line.endswith("\n"):
            raise WorkerDied(f"worker {self.pid} has ended")
        return line


_OWN = threading.local()
_ALL: Final[list[WorkerProcess]] = []
_SPARE: Final[list[tuple[dict[str, Any], WorkerProcess]]] = []
"""The worker of the last undisturbed run, and its plan; its operations are atomic."""


def profile_of(plan: dict[str, Any]) -> tuple[Row, Profile | None]:
    """Run the undisturbed world, as `WorkerProcess.profile`, in a worker for its campaign.

    Raises:
        WorkerDied: the worker ended before.
        WorkerRefused: it has another version or other files, or cannot write records.
    """
    _end_spare()
    worker = WorkerProcess(plan)
    try:
        found = worker.profile()
    except BaseException:
        worker.close()
        raise
    _SPARE.append((plan, worker))
    return found


def _spare_of(plan: dict[str, Any]) -> WorkerProcess | None:
    """Return the worker that ran the undisturbed world of this plan, if there is one."""
    try:
        known, worker = _SPARE.pop()
    except IndexError:
        return None
    try:
        if known == plan | {"profile": None}:
            worker.begin(plan)
            return worker
    except (WorkerDied, WorkerRefused):  # a new one tells why
        pass
    worker.close()
    return None


def _end_spare() -> None:
    with suppress(IndexError):
        _SPARE.pop()[1].close()


def run_chunk(plan: dict[str, Any], request: dict[str, Any]) -> list[str]:
    """Return the rows of a request as lines, from this thread's worker process.

    One world is tried again by another process if the first one dies.

    Raises:
        WorkerDied: the worker ended before.
        WorkerRefused: this machine has another version or other files, or its disk is full.
    """
    try:
        return _worker_of(plan).lines(request)
    except WorkerDied:
        _forget()
        if "try" not in request:
            raise
    return _worker_of(plan).lines(request)


def _worker_of(plan: dict[str, Any]) -> WorkerProcess:
    """Return this thread's worker process, a new one for a new plan."""
    if getattr(_OWN, "plan", None) != plan:
        _forget()
        _OWN.worker, _OWN.plan = _spare_of(plan) or WorkerProcess(plan), plan
        _ALL.append(_OWN.worker)
    worker: WorkerProcess = _OWN.worker
    return worker


def _forget() -> None:
    """End the worker process of this thread."""
    worker = getattr(_OWN, "worker", None)
    _OWN.worker = _OWN.plan = None
    if worker is not None:
        worker.close()
        if worker in _ALL:
            _ALL.remove(worker)


def worker_pids() -> list[int]:
    """Return the process ids of all worker processes of this process."""
    return [worker.pid for worker in _ALL]


def end_workers() -> None:
    """End all worker processes of this process."""
    _end_spare()
    while _ALL:
        _ALL.pop().close()


def local(workers: int) -> Executor:
    """Return the engine of this machine."""
    return ThreadPoolExecutor(workers, thread_name_prefix="swarm")


@final
class Cluster(Executor):
    """The engine of a dask scheduler."""

    def __init__(self, client: Any) -> None:
        self._client = client
        self._executor = client.get_executor(pure=False, retries=2)

    @property
    def is_gone(self) -> bool:
        """True once the scheduler is lost; what runs there then never ends."""
        return self._client.status in ("closing", "closed")

    def submit(self, call: Callable[P, T], /, *args: P.args, **options: P.kwargs) -> "Future[T]":
        """Run a call on the cluster.

        Raises:
            RuntimeError: the scheduler is lost.
        """
        if self.is_gone:
            raise RuntimeError("its scheduler is lost")
        future: Future[T] = self._executor.submit(call, *args, **options)
        return future

    def shutdown(self, wait: bool = True, *, cancel_futures: bool = False) -> None:
        """Leave the cluster; what still runs there is dropped."""
        self._client.close(timeout=_PATIENCE_S)


def dask(address: str) -> Cluster:
    """Return the engine of a dask scheduler at HOST:PORT.

    Raises:
        RigError: dask is not installed, or the scheduler cannot be reached.
    """
    try:
        from distributed import Client  # type: ignore[import-not-found,unused-ignore] # an extra
    except ImportError:
        remedy = "install motorhil[dask]"
        raise RigError(f"dask={address}", "dask.distributed is not installed", remedy) from None
    try:
        client = Client(  # type: ignore[no-untyped-call,unused-ignore]
            f"tcp://{address}", timeout="10s", set_as_default=False
        )
    except OSError as error:
        remedy = "start `dask scheduler`, and name its HOST:PORT"
        raise RigError(f"dask={address}", f"no scheduler answers: {error}", remedy) from None
    return Cluster(client)
