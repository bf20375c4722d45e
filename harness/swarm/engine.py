"""Engine: where chunks of a campaign run.

An engine is an executor of `concurrent.futures`: threads on this machine, or a cluster of dask.
Each of its threads keeps one worker process. Results are the rows; an engine that loses some loses
time, never rows that were written.
"""

import json
import subprocess
import sys
import threading
from concurrent.futures import Executor, ThreadPoolExecutor
from typing import Any, Final, final

from motorhil.harness.rig.config.toml import RigError
from motorhil.harness.swarm.row import Row, row_from

_COMMAND: Final = (sys.executable, "-m", "motorhil.harness.swarm.worker")


class WorkerDied(Exception):  # noqa: N818 -- it says what happened, as the errors of motorapi
    """A worker process ended before its answer; the chunk may run again."""


class WorkerRefused(Exception):  # noqa: N818 -- likewise
    """A worker has another version or other files than the campaign."""


@final
class Worker:
    """A worker process with one plan."""

    def __init__(self, plan: dict[str, Any]) -> None:
        self._process = subprocess.Popen(
            _COMMAND,
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            text=True,
            start_new_session=True,  # Ctrl-C reaches the campaign, which ends it
        )
        answer = self._ask({"plan": plan})
        refused = json.loads(answer)["refused"]
        if refused:
            self.close()
            raise WorkerRefused(refused)

    @property
    def pid(self) -> int:
        """The process id."""
        return self._process.pid

    def rows(self, request: dict[str, Any]) -> list[Row]:
        """Return the rows of a request.

        Raises:
            WorkerDied: the worker ended before.
        """
        rows = []
        answer = self._ask(request)
        while answer != '{"done": true}\n':
            rows.append(row_from(answer))
            answer = self._answer()
        return rows

    def close(self) -> None:
        """End the process, also in the middle of a world."""
        self._process.kill()
        self._process.wait()

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
_ALL: Final[list[Worker]] = []


def run_chunk(plan: dict[str, Any], request: dict[str, Any]) -> list[str]:
    """Return the rows of a request as lines, from this thread's worker process.

    Raises:
        WorkerDied: the worker ended before.
        WorkerRefused: this machine has another version or other files.
    """
    key = json.dumps(plan)
    if getattr(_OWN, "key", None) != key:
        worker = Worker(plan)
        _OWN.worker, _OWN.key = worker, key
        _ALL.append(worker)
    try:
        return [row.as_line() for row in _OWN.worker.rows(request)]
    except WorkerDied:
        _OWN.key = None
        _OWN.worker.close()
        raise


def end_workers() -> None:
    """End all worker processes of this process."""
    while _ALL:
        _ALL.pop().close()


def local(workers: int) -> Executor:
    """Return the engine of this machine."""
    return ThreadPoolExecutor(workers, thread_name_prefix="swarm")


def dask(address: str) -> Executor:
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
        client = Client(f"tcp://{address}", timeout="10s", set_as_default=False)
    except OSError as error:
        remedy = "start `dask scheduler`, and name its HOST:PORT"
        raise RigError(f"dask={address}", f"no scheduler answers: {error}", remedy) from None
    executor: Executor = client.get_executor(pure=False, retries=2)
    return executor
