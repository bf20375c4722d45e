"""The verb `swarm`: runs a program in many disturbed worlds, and keeps what breaks it."""

import argparse
import json
import os
import time
from collections.abc import Callable, Iterator
from concurrent.futures import Executor
from contextlib import contextmanager
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Final, final

from motorhil.harness.cli.main import FAILED, INTERRUPTED, NOT_JUDGED, PASSED
from motorhil.harness.cli.options import add_seed, real, whole
from motorhil.harness.cli.printable import teller
from motorhil.harness.cli.progress import StatusLine
from motorhil.harness.oracles.judge import IDS
from motorhil.harness.rig.config.toml import SEED_MAX, RigError
from motorhil.harness.rig.rig import describe
from motorhil.harness.swarm.campaign import Campaign, checked_part, seeds_of, with_profile
from motorhil.harness.swarm.engine import dask, end_workers, local, run_chunk
from motorhil.harness.swarm.kept import Kept, command, keep, story
from motorhil.harness.swarm.page import write_page
from motorhil.harness.swarm.plan import FUNCTION, PYTEST, SCRIPT, WALL_S, Plan, Program, plan_of
from motorhil.harness.swarm.results import Results, create, open_results
from motorhil.harness.swarm.row import Result, Row, row_from
from motorhil.harness.swarm.summary import Summary, summary_of
from motorhil.harness.swarm.worlds.disturbance import World
from motorhil.harness.swarm.worlds.shrinking import cause_of, shrunk

_FOLDER: Final = Path("out/swarm")
_SEEDS: Final = 1000
_SHOWN: Final = 20
_PAGE_S: Final = 5.0
_EPILOG: Final = """\
PROGRAM is a script, or "package.module:function", which is called with the open rig. Each seed
makes a world of the rig: faults, loads, clocks, plants and turns differ. Oracles judge each run; so
do the program's exceptions, asserts, and motorhil.always(...). Results are files in DIR: rows, a
page, and for each cause of failures a fragment, a test and the command that repeats it. With
--world, one world runs alone.
"""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the arguments of `swarm`."""
    parser.epilog = _EPILOG
    parser.usage = (
        "motorhil swarm [options] RIG PROGRAM [-- ARGS ...]\n"
        "       motorhil swarm [options] RIG --pytest NODEID [-- ARGS ...]"
    )
    parser.add_argument("rig", type=Path, metavar="RIG", help="a rig file (TOML)")
    parser.add_argument("program", nargs="?", metavar="PROGRAM", help="a script or a function")
    parser.add_argument("--pytest", metavar="NODEID", help="a test or a file of tests instead")
    _add_seeds(parser)
    _add_engine(parser)
    parser.add_argument(
        "--only",
        action="append",
        choices=IDS,
        default=[],
        metavar="ID",
        help="only this oracle; may be repeated",
    )
    parser.add_argument("--world", type=Path, metavar="FILE", help="run only this fragment")
    add_seed(parser)
    parser.add_argument("--json", action="store_true", help="print one JSON object")


def _add_seeds(parser: argparse.ArgumentParser) -> None:
    """Add the arguments about which worlds run."""
    parser.add_argument(
        "--seeds",
        type=whole(1, SEED_MAX, "seeds"),
        default=_SEEDS,
        metavar="N",
        help=f"number of worlds (default {_SEEDS})",
    )
    parser.add_argument(
        "--first",
        type=whole(0, SEED_MAX, ""),
        default=0,
        metavar="SEED",
        help="first seed (default 0)",
    )
    parser.add_argument(
        *("--for",),
        dest="for_s",
        type=real(1e-3, 1e9, "s"),
        metavar="S",
        help="begin no world after S seconds of wall time",
    )
    parser.add_argument(
        "--no-guidance", action="store_true", help="draw each world anew; mutate none"
    )
    parser.add_argument("--no-shrink", action="store_true", help="keep failures as found")


def _add_engine(parser: argparse.ArgumentParser) -> None:
    """Add the arguments about where worlds run, and where results go."""
    parser.add_argument(
        "--engine",
        default="local",
        metavar="ENGINE",
        help="local (default); index=K/N: every Nth part of the seeds, for machines without a "
        "network; dask=HOST:PORT: a cluster",
    )
    parser.add_argument(
        "--workers",
        type=whole(1, 4096, ""),
        default=os.cpu_count() or 1,
        metavar="N",
        help="worlds at a time (default: one per processor)",
    )
    parser.add_argument(
        "--timeout",
        type=real(0.1, 86_400.0, "s"),
        default=WALL_S,
        metavar="S",
        help=f"wall time of one world (default {WALL_S:g} s)",
    )
    parser.add_argument(
        "-o",
        "--output",
        type=Path,
        default=_FOLDER,
        metavar="DIR",
        help=f"folder of the results (default {_FOLDER})",
    )
    parser.add_argument(
        "--resume", action="store_true", help="go on with the seeds that DIR has no result of"
    )


def run(options: argparse.Namespace) -> int:
    """Run a campaign; return 0 if nothing failed, 1 if something did, 3 if the canary was missed.

    Raises:
        RigError: the rig, the program, the folder or the engine cannot be used.
    """
    program = _program(options)
    if options.world is not None:
        return _run_one(options, program)
    plan, results = _begun(options, program)
    engine, part = _engine(options)
    tell = teller("swarm")
    try:
        with _ending(engine):
            campaign = Campaign(
                plan,
                results,
                engine,
                options.workers,
                guided=not options.no_guidance,
                part=part,
            )
            watch = _Watch(plan, results, options.seeds)
            until = None if options.for_s is None else time.monotonic() + options.for_s
            try:
                campaign.run(seeds_of(options.first, options.seeds), watch.take, until)
            finally:
                watch.end()
            kept = _kept(plan, results, engine, shrinks=not options.no_shrink)
    except KeyboardInterrupt:
        summary = summary_of(results.rows.values())
        write_page(results.folder, plan, summary, [])
        _print(summary, [], plan, options)
        tell(f"interrupted; go on with --resume -o {results.folder}")
        return INTERRUPTED
    summary = summary_of(results.rows.values())
    write_page(results.folder, plan, summary, kept)
    _print(summary, kept, plan, options)
    return _status(summary, tell)


def _status(summary: Summary, tell: Callable[[str], None]) -> int:
    if summary.failures:
        return FAILED
    if summary.canary is not None and "always" not in summary.canary:
        tell("the canary was not found: the campaign proves nothing; is every oracle switched off?")
        return NOT_JUDGED
    if not summary.worlds:
        tell("no world has run; give more time with --for, or more seeds")
        return NOT_JUDGED
    return PASSED


# --- the campaign --------------------------------------------------------------------------------


def _program(options: argparse.Namespace) -> Program:
    words = tuple(options.rest or ())
    if options.pytest is not None:
        if options.program is not None:
            raise RigError(options.rig, "both PROGRAM and --pytest", "give one of them")
        return Program(PYTEST, options.pytest, words)
    if options.program is None:
        if programs := describe(options.rig).programs:
            what = f"its programs ({', '.join(programs)}) cannot share the time of a swarm's worlds"
            raise RigError(options.rig, what, "name one program, or a function with their parts")
        raise RigError(options.rig, "no program to run", "name a script, or --pytest NODEID")
    name = options.program
    if Path(name).is_file():
        return Program(SCRIPT, name, words)
    if ":" in name and not name.endswith(".py"):
        return Program(FUNCTION, name, words)
    raise RigError(name, "no such file", "name a Python program, or package.module:function")


def _begun(options: argparse.Namespace, program: Program) -> tuple[Plan, Results]:
    """Return the plan and its results, new or resumed."""
    plan = plan_of(options.rig, program, tuple(options.only), options.timeout)
    if not options.resume:
        folder = options.output
        plan = with_profile(plan)
        return plan, create(folder, plan)
    earlier, results = open_results(options.output)
    for key in ("build", "contents", "oracles", "program"):
        if getattr(earlier, key) != getattr(plan, key):
            what = f"was begun with another {key}"
            raise RigError(options.output, what, "begin anew in another folder: -o")
    return replace(earlier, rig=plan.rig), results


def _engine(options: argparse.Namespace) -> tuple[Executor, tuple[int, int]]:
    name, _, value = options.engine.partition("=")
    if name == "local" and not value:
        return local(options.workers), (1, 1)
    if name == "dask" and value:
        return dask(value), (1, 1)
    if name == "index":
        try:
            return local(options.workers), checked_part(value)
        except ValueError as error:
            raise RigError("--engine", str(error), "write index=1/4") from None
    what = f"no engine {options.engine!r}"
    raise RigError("--engine", what, "write local, index=K/N or dask=HOST:PORT")


@contextmanager
def _ending(engine: Executor) -> Iterator[None]:
    """End the engine, whatever happens; worlds that still run are not counted."""
    try:
        yield
    finally:
        end_workers()
        engine.shutdown(wait=True, cancel_futures=True)


@final
class _Watch:
    """Progress of a campaign, on the terminal and on its page."""

    def __init__(self, plan: Plan, results: Results, seeds: int) -> None:
        self._plan = plan
        self._results = results
        self._seeds = seeds
        self._line = StatusLine()
        self._begun = self._page = time.monotonic()
        self._ran = 0

    def take(self, rows: list[Row]) -> None:
        """Take the rows of a chunk."""
        self._ran += len(rows)
        now = time.monotonic()
        rate = self._ran / max(1e-3, now - self._begun)
        bad = sum(row.is_bad and row.seed >= 0 for row in self._results.rows.values())
        count = len(self._results.rows)
        self._line.show(f"{count} of {self._seeds} worlds, {rate:.1f}/s, {bad} failures")
        if now - self._page >= _PAGE_S:
            self._page = now
            write_page(
                self._results.folder, self._plan, summary_of(self._results.rows.values()), []
            )

    def end(self) -> None:
        """Clear the line."""
        self._line.clear()


def _kept(plan: Plan, results: Results, engine: Executor, shrinks: bool) -> list[Kept]:
    """Shrink a failure of each cause, and write it to files."""
    found: list[Kept] = []
    line = StatusLine()
    causes = summary_of(results.rows.values()).causes
    for number, cause in enumerate(causes, 1):
        line.show(f"shrinking {number} of {len(causes)}: {cause.name}")
        row = cause.first
        if shrinks and row.world:
            row = shrunk(row, partial(_again, plan, engine, row.seed))
        found.append(keep(row, plan, results.folder))
    line.clear()
    return found


def _again(plan: Plan, engine: Executor, seed: int, world: World) -> Row:
    request: dict[str, object] = {"try": seed, "world": [one.as_table() for one in world]}
    (line,) = engine.submit(run_chunk, plan.as_table(), request).result()
    return row_from(line)


def _run_one(options: argparse.Namespace, program: Program) -> int:
    """Run one fragment, and print its result."""
    from motorhil.harness.swarm.trial import tried_in

    plan = plan_of(options.rig, program, tuple(options.only), options.timeout)
    row = tried_in(plan, options.seed or 0, options.world)
    if options.json:
        print(row.as_line())
    else:
        print(story(row) if row.is_bad else f"passes; {row.end_ns / 1e9:g} s simulated")
    return FAILED if row.is_bad else PASSED


# --- what it says --------------------------------------------------------------------------------


def _print(summary: Summary, kept: list[Kept], plan: Plan, options: argparse.Namespace) -> None:
    if options.json:
        print(json.dumps(_as_table(summary, kept, plan), indent=1))
        return
    counts = ", ".join(f"{count} {result.value}" for result, count in summary.counts.items())
    print(f"{summary.worlds} worlds: {counts or 'none'}; {summary.pairs} pairs of state and event")
    for number, cause in enumerate(summary.causes[:_SHOWN], 1):
        print(f"{number}. {cause.name}: {len(cause.rows)} worlds, first seed {cause.first.seed}")
        one = next((one for one in kept if _is_of(one, cause.name)), None)
        if one is not None:
            print(f"   {story(one.row)}")
            print(f"   again: {command(one.row, plan, one.fragment)}")
    for name, count in summary.reached.items():
        print(f"sometimes {name!r}: {'never' if not count else f'in {count} worlds'}")
    if summary.ended_by:
        ends = ", ".join(f"{name} {count}" for name, count in summary.ended_by.items())
        print(f"ended by errors that are allowed: {ends}")
    print(f"page: {options.output / 'index.html'}")


def _is_of(kept: Kept, cause: str) -> bool:
    return cause_of(kept.row) == cause


def _as_table(summary: Summary, kept: list[Kept], plan: Plan) -> dict[str, object]:
    return {
        "worlds": summary.worlds,
        "results": {one.value: summary.counts.get(one, 0) for one in Result},
        "pairs": summary.pairs,
        "canary": summary.canary,
        "sometimes": summary.reached,
        "ended_by": summary.ended_by,
        "causes": [
            {
                "cause": cause.name,
                "worlds": len(cause.rows),
                "first_seed": min(row.seed for row in cause.rows),
                "text": cause.first.text,
                "signatures": dict(cause.signatures),
            }
            for cause in summary.causes
        ],
        "kept": [
            {
                "seed": one.row.seed,
                "signature": one.row.signature,
                "fragment": str(one.fragment),
                "again": command(one.row, plan, one.fragment),
            }
            for one in kept
        ],
    }
