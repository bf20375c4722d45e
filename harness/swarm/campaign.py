"""Campaign: runs the seeds of a plan on an engine, lane by lane, and keeps the rows.

If a row depends on the worlds that its process ran before, the program keeps state. All worlds then
run anew, each in a process of its own.
"""

import json
import time
from collections.abc import Callable, Iterable
from concurrent.futures import FIRST_COMPLETED, Executor, Future, wait
from dataclasses import replace
from typing import Any, Final, final

from motorhil.harness.rig.config.toml import RigError
from motorhil.harness.swarm.engine import (
    Cluster,
    WorkerDied,
    WorkerRefused,
    profile_of,
    run_chunk,
)
from motorhil.harness.swarm.lanes import LANES, batch_of, lane_of
from motorhil.harness.swarm.plan import PYTEST, Plan
from motorhil.harness.swarm.results import Results
from motorhil.harness.swarm.row import CANARY, Result, Row, row_from

_CHUNK_S: Final = 2.0
"""Wall time that a chunk should take [s]."""
_CHUNK_MAX: Final = 200
_DEATHS_MAX: Final = 5
_LOOK_S: Final = 2.0
"""Wall time between looks at a cluster from which nothing comes [s]."""
_AGAIN: Final = "resume with --resume"
_KEEPS: Final = '{"keeps": '
OnRows = Callable[[list[Row]], None]


class _KeepsState(Exception):  # noqa: N818 -- it says what happened, as the errors of motorapi
    """A row depends on the worlds that its process ran before."""

    def __init__(self, row: Row) -> None:
        super().__init__(row.seed)
        self.row = row


@final
class Campaign:
    """A campaign on an engine.

    Args:
        plan: its plan, with the profile.
        results: where rows are kept.
        engine: where chunks run.
        workers: number of chunks at a time.
        guided: whether every second world mutates an earlier one.
        part: (K, N): only lanes K - 1, K - 1 + N, ...
    """

    def __init__(
        self,
        plan: Plan,
        results: Results,
        engine: Executor,
        workers: int,
        *,
        guided: bool = True,
        part: tuple[int, int] = (1, 1),
    ) -> None:
        self._plan = plan
        self._table = plan.as_table()
        self._results = results
        self._engine = engine
        self._workers = workers
        self._guided = guided
        self._part = part
        self._chunk = 4
        self._batch = plan.batch()
        self._deaths = 0
        self._running: dict[Future[list[str]], tuple[int, list[int], float]] = {}

    def run(self, seeds: Iterable[int], on_rows: OnRows, until: float | None = None) -> None:
        """Run all seeds that have no row; call `on_rows` with the new rows of each chunk.

        Args:
            seeds: the seeds, ascending.
            on_rows: called after rows were written.
            until: a time of time.monotonic() after which no chunk begins.

        Raises:
            RigError: rows cannot be written, or workers die or refuse.
        """
        asked = list(seeds)
        try:
            self._run(asked, on_rows, until)
        except _KeepsState as found:
            for future in self._running:  # their rows are dropped
                future.cancel()
            self._running.clear()
            self._results.begin_alone(found.row, self._part)
            self._run(asked, on_rows, until)

    def _run(self, seeds: list[int], on_rows: OnRows, until: float | None) -> None:
        number, count = self._part
        waiting: dict[int, list[int]] = {}
        for seed in self._results.missing(seeds):
            if lane_of(seed) % count == number - 1:
                waiting.setdefault(lane_of(seed), []).append(seed)
        idle = sorted(waiting)
        while idle or self._running:
            is_over = until is not None and time.monotonic() >= until
            while idle and len(self._running) < self._workers and not is_over:
                self._begin(idle.pop(0), waiting)
            if not self._running:
                break
            done, _ = wait(self._running, _LOOK_S, return_when=FIRST_COMPLETED)
            if not done and isinstance(self._engine, Cluster) and self._engine.is_gone:
                what = "the engine is gone: its scheduler is lost"
                raise RigError(self._plan.rig, what, _AGAIN)
            for future in done:
                lane, rows = self._taken(future, waiting)
                if rows:
                    on_rows(rows)
                if waiting[lane]:
                    idle.append(lane)

    def _begin(self, lane: int, waiting: dict[int, list[int]]) -> None:
        seeds = self._next(waiting[lane])
        del waiting[lane][: len(seeds)]
        state = self._results.lane(lane, seeds[0])
        request: dict[str, Any] = {
            "seeds": seeds,
            "seen": list(state.seen),
            "corpus": [one.as_table() for one in state.corpus],
            "guided": self._guided,
            "alone": self._results.is_alone,
        }
        try:
            future = self._engine.submit(run_chunk, self._table, request)
        except Exception as error:  # of a cluster that is gone
            raise RigError(self._plan.rig, f"the engine is gone: {_told(error)}", _AGAIN) from None
        self._running[future] = lane, seeds, time.monotonic()

    def _next(self, seeds: list[int]) -> list[int]:
        """Return the next chunk of a lane, in whole batches."""
        count = min(self._chunk, len(seeds))
        if not self._results.is_alone:
            last = batch_of(seeds[count - 1], self._batch)
            while count < len(seeds) and batch_of(seeds[count], self._batch) == last:
                count += 1
        return seeds[:count]

    def _taken(
        self, future: "Future[list[str]]", waiting: dict[int, list[int]]
    ) -> tuple[int, list[Row]]:
        """Return the lane and the rows of a chunk; a chunk whose worker died waits again."""
        lane, seeds, begun = self._running.pop(future)
        try:
            lines = future.result()
        except WorkerRefused as error:
            raise RigError(self._plan.rig, f"a worker refuses: {error}", _AGAIN) from None
        except Exception as error:  # a worker has died, or a cluster has lost the chunk
            self._deaths += 1
            if self._deaths > _DEATHS_MAX:
                what = f"{self._deaths} workers have died, the last one: {_told(error)}"
                raise RigError(self._plan.rig, what, f"is memory short? {_AGAIN}") from None
            waiting[lane][:0] = seeds
            return lane, []
        self._deaths = 0
        told = [line for line in lines if line.startswith(_KEEPS)]
        if told:
            raise _KeepsState(row_from(json.loads(told[0])["keeps"]))
        rows = [row_from(line) for line in lines]
        took_s = max(1e-3, time.monotonic() - begun)
        self._chunk = max(1, min(_CHUNK_MAX, round(len(seeds) * _CHUNK_S / took_s)))
        self._results.append(rows, self._part)
        return lane, rows


def _told(error: Exception) -> str:
    return f"{type(error).__name__}: {error}" if str(error) else type(error).__name__


def seeds_of(first: int, count: int) -> list[int]:
    """Return the seeds of a campaign, with the canary's."""
    return [CANARY, *range(first, first + count)]


def checked_part(text: str) -> tuple[int, int]:
    """Return (K, N) of "K/N".

    Raises:
        ValueError: it is no part.
    """
    number, _, count = text.partition("/")
    part = int(number), int(count)
    if not 1 <= part[0] <= part[1] <= LANES:
        raise ValueError(f"part {text}: expected K/N with 1 <= K <= N <= {LANES}")
    return part


def with_profile(plan: Plan) -> Plan:
    """Return the plan with the profile of the undisturbed run.

    Raises:
        RigError: the program fails without any disturbance.
    """
    try:
        row, profile = profile_of(plan.as_table())
    except (WorkerDied, WorkerRefused) as error:
        raise RigError(plan.rig, f"the undisturbed run: {error}") from None
    if row.is_bad or profile is None:
        first = "pytest" if plan.program.kind == PYTEST else "motorhil run"
        what = f"the program fails without any disturbance: {row.text or row.result.value}"
        if row.result is Result.CANCELLED:
            what = f"the program cannot run: {row.text}"
        raise RigError(plan.rig, what, f"make it pass `{first}` first")
    return replace(plan, profile=profile)
