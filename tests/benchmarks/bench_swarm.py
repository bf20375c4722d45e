"""Swarm: worlds per core and hour, and what it costs beside the same runs without it.

Each world is drawn, run, recorded, judged and digested. The peer is a loop in one process that does
the same with the same worlds. CPU time of all processes is compared, in turns, because other load
moves wall time. Two workers against one are wall time. Beside it stand the same worlds in two
processes without a swarm, for the machine itself may give less, and the share of time in which
workers wait for the next chunk.
"""

import os
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import Executor, Future
from functools import partial
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import TypeVar

from motorhil.harness import examples
from motorhil.harness.oracles.judge import judge
from motorhil.harness.rig.reading import describe
from motorhil.harness.rig.rig import Rig
from motorhil.harness.swarm.campaign import Campaign, with_profile
from motorhil.harness.swarm.engine import dask, end_workers, local, worker_pids
from motorhil.harness.swarm.lanes import LANES, Lane
from motorhil.harness.swarm.plan import FUNCTION, Plan, Program, plan_of
from motorhil.harness.swarm.results import create
from motorhil.harness.swarm.worlds.disturbance import World, fragment
from motorhil.harness.swarm.worlds.fairness import fair
from motorhil.traces.digest import digest
from tests.benchmarks import swarm_programs
from tests.benchmarks.bench_system import COMPILED
from tests.support.swarm.clusters import cluster

_EXAMPLES = Path(examples.__file__).parent
_RIGS = {
    "two wheels": (_EXAMPLES / "two_wheels.toml", "turn", 64, 3),
    "rover": (_EXAMPLES / "rover.toml", "drive", 4, 3),
}
_WARM = 2
_MOTOR_ERROR = ("LinkError", "DeadlineExceeded", "DeviceFault", "MotionInterrupted", "LimitError")
"""The last one: a load has moved a motor beyond the limits of its model."""

T = TypeVar("T")
Figures = Iterator[tuple[str, float, str]]


def run() -> Figures:
    """Yield (name, figure, unit) with pure cores and, after `make compiled`, compiled ones."""
    for python, cores in ((sys.executable, "pure"), (str(COMPILED), "compiled")):
        if not Path(python).exists():
            continue
        environment = {**os.environ, "MOTORHIL_PURE": "1"} if cores == "pure" else dict(os.environ)
        command = [python, "-P", "-m", "tests.benchmarks.bench_swarm"]
        environment["PYTHONPATH"] = str(Path(__file__).parents[2]) if cores == "pure" else _tests()
        done = subprocess.run(command, check=True, capture_output=True, text=True, env=environment)
        for line in done.stdout.splitlines():
            what, figure, unit = line.split("\t")
            yield f"{cores}: {what}", float(figure), unit


def _tests() -> str:
    """Return a folder from which `tests` can be imported, and none of the sources beside it."""
    folder = Path(__file__).parents[2] / "build" / "tests"
    folder.mkdir(parents=True, exist_ok=True)
    link = folder / "tests"
    if not link.exists():
        link.symlink_to(Path(__file__).parents[1], target_is_directory=True)
    return str(folder)


def main() -> None:
    """Print the figures of the cores of this process."""
    for name, (rig, function, worlds, rounds) in _RIGS.items():
        program = Program(FUNCTION, f"{swarm_programs.__name__}:{function}")
        plan = with_profile(plan_of(rig, program, (), 60.0))
        for what, figure, unit in _figures(plan, worlds, rounds):
            print(f"{name}: {what}", figure, unit, sep="\t")


def _figures(plan: Plan, worlds: int, rounds: int) -> Figures:
    swarm_s: list[float] = []
    bare_s: list[float] = []
    with TemporaryDirectory() as name, local(1) as engine:
        results = create(Path(name), plan)
        campaign = Campaign(plan, results, engine, 1, guided=False)
        campaign.run(range(_WARM), lambda rows: None)
        _bare(plan, range(_WARM))
        for number in range(rounds):
            seeds = _seeds(number, worlds)
            begun = _cpu_s()
            campaign.run(seeds, lambda rows: None)
            swarm_s.append((_cpu_s() - begun) / worlds)
            begun = time.process_time()
            _bare(plan, seeds)
            bare_s.append((time.process_time() - begun) / worlds)
        size = (Path(name) / "rows.jsonl").stat().st_size / len(results.rows)
        end_workers()
    yield "worlds per core and hour", 3600.0 / min(swarm_s), "1/h"
    yield "the same runs without it", 3600.0 / min(bare_s), "1/h"
    overheads = sorted(one / other - 1.0 for one, other in zip(swarm_s, bare_s, strict=True))
    yield "CPU time beyond the same runs without it", 100.0 * overheads[len(overheads) // 2], "%"
    yield "a row of a seed", size, "bytes"
    yield from _two_against_one(plan, worlds, rounds)
    yield from _cluster_against_local(plan, worlds, rounds)


def _seeds(number: int, worlds: int) -> list[int]:
    """Return the seeds of a round: whole batches of two lanes."""
    rows = range((number + 1) * worlds // 2, (number + 2) * worlds // 2)
    return [row * LANES + lane for row in rows for lane in (1, 2)]


def _two_against_one(plan: Plan, worlds: int, rounds: int) -> Figures:
    """Yield what a second worker gives, in turns with what a second process gives."""
    swarm: list[float] = []
    bare: list[float] = []
    waits: list[float] = []
    for number in range(rounds):
        seeds = _seeds(number, worlds)
        one_s, _ = _took(plan, 1, seeds)
        two_s, wait = _took(plan, 2, seeds)
        swarm.append(one_s / two_s)
        waits.append(wait)
        bare.append(_took_bare(plan, [seeds]) / _took_bare(plan, [seeds[::2], seeds[1::2]]))
    middle = rounds // 2
    yield "two workers against one, wall time", sorted(swarm)[middle], "x"
    yield "two processes without it against one", sorted(bare)[middle], "x"
    yield "time in which two workers wait", 100.0 * sorted(waits)[middle], "%"


def _cpu_s() -> float:
    """Return the CPU time of this process, its workers and their ended children [s]."""
    ticks = 0
    for pid in worker_pids():
        fields = Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()
        ticks += sum(map(int, fields[11:15]))
    return time.process_time() + ticks / os.sysconf("SC_CLK_TCK")


def _cluster_against_local(plan: Plan, worlds: int, rounds: int) -> Figures:
    """Yield what a cluster of dask costs beyond the workers of this machine, in turns."""
    try:
        import psutil
    except ImportError:
        return

    def cpu_s() -> float:
        own = psutil.Process()
        tree = [own, *own.children(recursive=True)]
        return sum(sum(one.cpu_times()[:4]) for one in tree)

    ratios: dict[str, list[float]] = {"CPU time": [], "wall time": []}
    with cluster(2) as (address, _), TemporaryDirectory() as name, local(2) as threads:
        engines = threads, dask(address)
        campaigns = [
            Campaign(plan, create(Path(name) / str(number), plan), engine, 2, guided=False)
            for number, engine in enumerate(engines)
        ]
        for campaign in campaigns:
            campaign.run(range(4, 12), lambda rows: None)  # every worker begins
        for number in range(rounds):
            took: list[tuple[float, float]] = []
            for campaign in campaigns:
                begun = cpu_s(), time.monotonic()
                campaign.run(_seeds(number, worlds), lambda rows: None)
                took.append((cpu_s() - begun[0], time.monotonic() - begun[1]))
            for what, one, other in zip(ratios, *took, strict=True):
                ratios[what].append(other / one - 1.0)
        engines[1].shutdown()
        end_workers()
    for what, some in ratios.items():
        yield (
            f"{what} of a cluster of dask beyond two local workers",
            100.0 * sorted(some)[rounds // 2],
            "%",
        )


class _Timed(Executor):
    """An engine that counts how long its calls take."""

    def __init__(self, engine: Executor) -> None:
        self.busy_s = 0.0
        self._engine = engine
        self._lock = threading.Lock()

    def submit(self, call: Callable[..., T], /, *args: object, **options: object) -> "Future[T]":
        return self._engine.submit(partial(self._timed, call), *args, **options)

    def _timed(self, call: Callable[..., T], *args: object) -> T:
        begun = time.monotonic()
        try:
            return call(*args)
        finally:
            with self._lock:
                self.busy_s += time.monotonic() - begun


def _took(plan: Plan, workers: int, seeds: list[int]) -> tuple[float, float]:
    """Return the wall time of some worlds, and the share of it in which workers wait."""
    with TemporaryDirectory() as name, local(workers) as threads:
        engine = _Timed(threads)
        campaign = Campaign(plan, create(Path(name), plan), engine, workers, guided=False)
        campaign.run(range(4, 4 + 4 * workers), lambda rows: None)  # every worker begins
        engine.busy_s = 0.0
        begun = time.monotonic()
        campaign.run(seeds, lambda rows: None)
        took_s = time.monotonic() - begun
        end_workers()
    return took_s, 1.0 - engine.busy_s / (workers * took_s)


def _took_bare(plan: Plan, parts: list[list[int]]) -> float:
    """Return the wall time of some worlds, each part in a process of its own."""
    begun = time.monotonic()
    children = []
    for seeds in parts:
        child = os.fork()
        if child == 0:
            status = 1
            try:
                _bare(plan, seeds)
                status = 0
            finally:
                os._exit(status)
        children.append(child)
    assert all(os.waitpid(child, 0)[1] == 0 for child in children)
    return time.monotonic() - begun


# --- the peer ------------------------------------------------------------------------------------


def _bare(plan: Plan, seeds: Iterable[int]) -> None:
    """Run, record, judge and digest the worlds of some seeds in this process."""
    assert plan.profile is not None
    table = describe(Path(plan.rig)).world.swarm
    lane = Lane()
    for seed in seeds:
        _run_bare(plan, seed, lane.world(seed, plan.profile, table, guided=False))


def _run_bare(plan: Plan, seed: int, world: World) -> None:
    with TemporaryDirectory() as name:
        file, record = Path(name) / "world.toml", Path(name) / "run.mcap"
        file.write_text(fragment(world))
        function = getattr(swarm_programs, plan.program.name.partition(":")[2])
        try:
            with Rig.open(plan.rig, seed, record=record, world=file) as rig:
                rig.runtime.queue.alarm(partial(_interrupt, rig)).set(60_000_000_000)
                function(rig)
        except KeyboardInterrupt:
            pass
        except Exception as error:
            if not any(kind.__name__ in _MOTOR_ERROR for kind in type(error).__mro__):
                raise
        judge(record, only=fair({one.kind for one in world}))
        digest(record)


def _interrupt(rig: Rig, now_ns: int) -> None:
    rig.runtime.interrupt()


if __name__ == "__main__":
    main()
