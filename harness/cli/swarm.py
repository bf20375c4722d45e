"""The verb `swarm`: runs a program in many disturbed worlds, and keeps what breaks it."""

import argparse
import json
import os
import sys
import time
from base64 import b64decode
from collections import Counter
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import Executor
from contextlib import ExitStack, contextmanager, nullcontext, redirect_stdout
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Final, final

from motorhil.harness.cli.main import FAILED, INTERRUPTED, NOT_JUDGED, PASSED, WRONG_USAGE
from motorhil.harness.cli.options import add_only, add_seed, real, whole
from motorhil.harness.cli.printable import teller
from motorhil.harness.cli.progress import StatusLine
from motorhil.harness.cli.viewing import Beside, add_view
from motorhil.harness.cli.viewing import page_of as served_page
from motorhil.harness.rig.config.toml import SEED_MAX, RigError
from motorhil.harness.rig.reading import describe
from motorhil.harness.swarm.campaign import Campaign, checked_part, seeds_of, with_profile
from motorhil.harness.swarm.engine import Cluster, dask, end_workers, local, run_chunk
from motorhil.harness.swarm.kept import Kept, keep, kept_in, record_of
from motorhil.harness.swarm.lanes import lane_of
from motorhil.harness.swarm.plan import (
    FUNCTION,
    PROGRAMS,
    PYTEST,
    SCRIPT,
    WALL_S,
    Plan,
    Program,
    plan_of,
)
from motorhil.harness.swarm.report.coverage import coverage_of
from motorhil.harness.swarm.report.page import page_of, write_page
from motorhil.harness.swarm.report.processes import KEEPS, processes_of
from motorhil.harness.swarm.report.progress import Progress, Times, progress_in
from motorhil.harness.swarm.report.sentences import failed
from motorhil.harness.swarm.report.texts import as_table, counted, lines_of, progress_line
from motorhil.harness.swarm.results import Results, create, open_results, require_new
from motorhil.harness.swarm.row import CANARY, Result, Row, row_from
from motorhil.harness.swarm.summary import Summary, summary_of
from motorhil.harness.swarm.worlds.disturbance import World
from motorhil.harness.swarm.worlds.shrinking import cause_of, shrunk

_FOLDER: Final = Path("out/swarm")
_SEEDS: Final = 1000
_PAGE_S: Final = 5.0
_PAGE_SHARE: Final = 20.0
"""Times as long as writing a page takes, until the next one is written."""
_EPILOG: Final = """\
PROGRAM is a script, or "package.module:function", which is called with the open rig; without one,
the programs of the rig run, and some worlds kill one of them. Each seed
makes a world of the rig: faults, loads, clocks, plants and turns differ. Oracles judge each run; so
do the program's exceptions, asserts, and motorhil.always(...). Results are files in DIR: rows, a
page, and for each cause of failures a fragment, a test and the command that repeats it. With
--world, one world runs alone.
"""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the arguments of `swarm`."""
    parser.epilog = _EPILOG
    parser.usage = (
        "motorhil swarm [options] RIG [PROGRAM [-- ARGS ...]]\n"
        "       motorhil swarm [options] RIG --pytest NODEID [-- ARGS ...]\n"
        "       motorhil swarm [--json] --show DIR"
    )
    parser.add_argument("rig", nargs="?", type=Path, metavar="RIG", help="a rig file (TOML)")
    parser.add_argument("program", nargs="?", metavar="PROGRAM", help="a script or a function")
    parser.add_argument("--pytest", metavar="NODEID", help="a test or a file of tests instead")
    _add_seeds(parser)
    _add_engine(parser)
    add_only(parser)
    parser.add_argument("--world", type=Path, metavar="FILE", help="run only this fragment")
    add_seed(parser)
    parser.add_argument(
        "--show",
        type=Path,
        metavar="DIR",
        help="print the findings of a folder and write its page; run nothing",
    )
    parser.add_argument("--json", action="store_true", help="print one JSON object")
    add_view(parser)


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
    if options.show is not None:
        return _show(options)
    program = _program(options)
    if options.world is not None:
        return _run_one(options, program)
    return _run_campaign(options, program)


def _run_campaign(options: argparse.Namespace, program: Program) -> int:
    engine, part = _engine(options)
    tell = teller("swarm")
    kept: list[Kept] = []
    with ExitStack() as cleanup:
        page: Beside | None = None
        with _ending(engine):
            plan, results = _begun(options, program)
            guided = not options.no_guidance
            campaign = Campaign(plan, results, engine, options.workers, guided=guided, part=part)
            watch = _Watch(plan, results, options, part)
            if options.view:
                page = cleanup.enter_context(
                    served_page(results.folder, "swarm", options.view_port, stays=False)
                )
            until = None if options.for_s is None else time.monotonic() + options.for_s
            try:
                campaign.run(seeds_of(options.first, options.seeds), watch.take, until)
                kept = _kept(plan, results, engine, watch, shrinks=not options.no_shrink)
            except KeyboardInterrupt:
                watch.end()
                _tell(plan, results, kept_in(results.folder), options)
                tell(f"interrupted; go on with --resume -o {results.folder}")
                return INTERRUPTED
            except RigError:
                watch.end()
                _page(plan, results, kept_in(results.folder))
                raise
            finally:
                watch.end()
        status = _status(_tell(plan, results, kept, options), tell)
        if page is not None:
            sys.stdout.flush()
            page.stay()
    return status


def _status(summary: Summary, tell: Callable[[str], None]) -> int:
    if summary.failures:
        return FAILED
    if not summary.found_canary:
        tell("the canary was not found: the campaign proves nothing; is every oracle switched off?")
        return NOT_JUDGED
    if not summary.worlds:
        tell("no world has run; give more time with --for, or more seeds")
        return NOT_JUDGED
    return PASSED


# --- the campaign --------------------------------------------------------------------------------


def _program(options: argparse.Namespace) -> Program:
    words = tuple(options.rest or ())
    if options.rig is None:
        raise RigError("motorhil swarm", "no rig file", "name RIG and PROGRAM, or --show DIR")
    if options.pytest is not None:
        if options.program is not None:
            raise RigError(options.rig, "both PROGRAM and --pytest", "give one of them")
        return Program(PYTEST, options.pytest, words)
    if options.program is None:
        if describe(options.rig).programs:
            return Program(PROGRAMS, str(options.rig))
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
        require_new(options.output)
        plan = with_profile(plan)
        return plan, create(options.output, plan)
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
    """Progress of a campaign, on the terminal, in its file of times and on its page."""

    def __init__(
        self, plan: Plan, results: Results, options: argparse.Namespace, part: tuple[int, int]
    ) -> None:
        self._plan = plan
        self._results = results
        number, count = part
        seeds = range(options.first, options.first + options.seeds)
        self._asked = sum(lane_of(seed) % count == number - 1 for seed in seeds)
        self._line = StatusLine()
        self._begun = self._page = time.monotonic()
        self._ran = 0
        self._is_over = False
        self._is_alone = results.is_alone
        self._failures = _failures(results.rows.values())
        self._times = Times(results.folder, part, options.first, options.seeds, time.time())
        self._kept = kept_in(results.folder)
        self.draw(self._kept)

    def take(self, rows: list[Row]) -> None:
        """Take the rows of a chunk."""
        self._times.take(rows, time.time())
        self._ran += len(rows)
        if self._is_alone != self._results.is_alone:  # earlier rows count no more
            self._is_alone = True
            self._failures.clear()
        self._failures.update(_failures(rows))
        now = time.monotonic()
        rate = self._ran / max(1e-3, now - self._begun)
        done = len(self._results.rows) - (CANARY in self._results.rows)
        failures = ""
        if self._failures:
            causes = counted(len(self._failures), "cause")
            failures = f"{counted(self._failures.total(), 'failure')} of {causes}"
        self._line.show(progress_line(failures, done, self._asked, rate))
        if now >= self._page:
            self.draw(self._kept)

    def say(self, text: str) -> None:
        """Show another line."""
        self._line.show(text)

    def draw(self, kept: list[Kept]) -> None:
        """Write the page; the next one only after much more time than this one took."""
        begun = time.monotonic()
        _page(self._plan, self._results, kept, is_running=True)
        self._page = time.monotonic() + max(_PAGE_S, _PAGE_SHARE * (time.monotonic() - begun))

    def end(self) -> None:
        """Clear the line, and note the end, once."""
        self._line.clear()
        if not self._is_over:
            self._times.end(time.time())
        self._is_over = True


def _failures(rows: Iterable[Row]) -> Counter[str]:
    return Counter(cause_of(row) for row in rows if row.is_bad and row.seed != CANARY)


def _kept(
    plan: Plan, results: Results, engine: Executor, watch: _Watch, shrinks: bool
) -> list[Kept]:
    """Shrink a failure of each cause, record it, and write it to files, unless they are there."""
    found: list[Kept] = []
    earlier = {one.cause: one for one in kept_in(results.folder)}
    causes = summary_of(results.rows.values()).causes
    for number, cause in enumerate(causes, 1):
        watch.say(f"shrinking {number} of {len(causes)}: {cause.name}")
        row, known = cause.first, earlier.get(cause.name)
        is_small = known is not None and (not shrinks or known.row.world != row.world)
        if known is not None and is_small and known.row.seed == row.seed:
            found.append(known)
            continue
        if shrinks and row.world:
            row = shrunk(row, partial(_again, plan, engine, row.seed))
        record = record_of(row, results.folder)
        _again(plan, engine, row.seed, row.world, record.resolve())
        found.append(keep(row, plan, results.folder))
        watch.draw(found)
    return found


def _again(
    plan: Plan, engine: Executor, seed: int, world: World, record: Path | None = None
) -> Row:
    request: dict[str, object] = {"try": seed, "world": [one.as_table() for one in world]}
    if record is not None and isinstance(engine, Cluster):
        request["sends"] = True
    elif record is not None:
        request["record"] = str(record)
    line, *sent = engine.submit(run_chunk, plan.as_table(), request).result()
    if record is not None and sent:
        try:
            record.write_bytes(b64decode(json.loads(sent[0])["record"]))
        except OSError as error:
            what = f"cannot be written: {error.strerror}"
            raise RigError(record, what, "free some space") from None
    return row_from(line)


def _run_one(options: argparse.Namespace, program: Program) -> int:
    """Run one fragment, and print its result."""
    from motorhil.harness.swarm.trial import tried_in

    plan = plan_of(options.rig, program, tuple(options.only), options.timeout)
    with redirect_stdout(sys.stderr) if options.json else nullcontext():  # what programs print
        row = tried_in(plan, options.seed or 0, options.world)
    if row.result is Result.CANCELLED:
        print(row.text, file=sys.stderr)
        return WRONG_USAGE
    if options.json:
        print(row.as_line())
    else:
        what = failed(row) if row.is_bad else f"passes; {row.end_ns / 1e9:g} s simulated"
        print(f"{options.world}: {what}")
    return FAILED if row.is_bad else PASSED


# --- what it says --------------------------------------------------------------------------------


def _show(options: argparse.Namespace) -> int:
    """Write the page of a folder, and print its findings, without running anything."""
    if options.rig is not None:
        raise RigError(options.rig, "--show runs nothing", "leave out RIG and PROGRAM")
    plan, results = open_results(options.show, repairs=False)
    summary = _tell(plan, results, kept_in(options.show), options)
    return _status(summary, teller("swarm"))


def _tell(plan: Plan, results: Results, kept: list[Kept], options: argparse.Namespace) -> Summary:
    """Write the page, and print the findings; return them."""
    page, summary, progress = _page(plan, results, kept)
    processes = processes_of(plan, results)
    if results.is_alone:
        teller("swarm")(_alone(results.shown_by))
    found = summary, kept, plan, coverage_of(plan, summary), progress
    if options.json:
        alone = {
            "alone": results.is_alone,
            "shown_by": results.shown_by,
            "batch": processes.batch,
            "ran_alone": list(processes.alone),
        }
        print(json.dumps({**as_table(*found), **alone, "page": str(page)}, indent=1))
        return summary
    for line in lines_of(*found):
        print(line)
    print(f"page: {page}")
    return summary


def _alone(seed: int | None) -> str:
    """Return why each world ran in a process of its own."""
    shown = "" if seed is None else f"seed {seed}: its result depends on the worlds before it; "
    return f"{shown}{KEEPS}"


def _page(
    plan: Plan, results: Results, kept: list[Kept], *, is_running: bool = False
) -> tuple[Path, Summary, Progress]:
    """Write the page; return its file, and the findings in it."""
    folder = results.folder
    summary, progress = summary_of(results.rows.values()), progress_in(folder)
    found = summary, kept, progress, processes_of(plan, results)
    text = page_of(folder, plan, *found, time.time(), is_running=is_running)
    return write_page(folder, text), summary, progress
