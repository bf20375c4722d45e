"""The verb `conform`: checks an adaptation against the motor interface, or a drive against CiA 402.

Each clause of the kit is checked on a bench of its own, in another process, so that an adaptation
cannot end the run. A clause that fails is checked again with the same seed, and that run is
recorded.
"""

import argparse
import json
import os
import sys
import time
from collections.abc import Callable, Generator, Sequence
from contextlib import ExitStack, closing, nullcontext, redirect_stdout
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Final

from motorhil.harness.cli.main import FAILED, NOT_JUDGED, PASSED, WRONG_USAGE
from motorhil.harness.cli.options import add_color, add_seed, whole
from motorhil.harness.cli.printable import coloured, has_colours
from motorhil.harness.cli.progress import StatusLine
from motorhil.harness.rig.config.toml import RigError, one_line
from motorhil.settings import listed, nearest

if TYPE_CHECKING:
    from motorhil.harness.conformance.examination import Finding
    from motorhil.harness.conformance.job import Job, Loaded, Promise
    from motorhil.harness.conformance.supervisor import Supervisor
    from motorhil.harness.conformance.verdicts.results import Outcome

_MORE: Final = """\
Without --rig the adaptation is checked on the rig that comes with it. Exit status: 0 all claims
are kept, 1 one is not, 2 wrong usage, 3 no clause was applicable.
"""
_STDOUT: Final = Path("-")
_SOME, _ALL, _OWN, _PAIRS = "some", "all", "own", "pairs"
_NAMED: Final = 6
_RECORDS: Final = Path("out", "conform")
_SHARE: Final = 25
"""The least number of clauses for which a further worker is worth its start."""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the arguments of `conform`."""
    parser.epilog = _MORE
    parser.add_argument(
        "--adaptation",
        metavar="NAME",
        help="from `motorhil list adaptations`, or package.module:function",
    )
    parser.add_argument(
        "--controller",
        metavar="NAME",
        help="check a drive of the rig against CiA 402; without --rig: `drive`, an emulated one",
    )
    parser.add_argument("--rig", metavar="RIG", help="a rig file with motors of this adaptation")
    parser.add_argument("--level", type=level_of, metavar="L3", help="all clauses up to this level")
    parser.add_argument(
        "--clause", action="append", metavar="ID", help="only this clause; repeatable"
    )
    parser.add_argument(
        "--on",
        action="append",
        metavar="[BUS=]WHERE",
        help="the rig's motors are on real buses: a SocketCAN interface, the socket of `motorhil "
        "serve`, interface:channel of python-can; a Modbus line: a device, or host:port",
    )
    _add_benches(parser)
    add_seed(parser)
    _add_results(parser)
    parser.add_argument(
        "--fail-fast", action="store_true", help="end after the first clause that is not fulfilled"
    )
    parser.add_argument(
        "--workers",
        type=whole(1, 256),
        metavar="N",
        help="processes that check clauses at the same time; by default one for each core, but 1 "
        "for few clauses, with --on, and with --fail-fast",
    )
    parser.add_argument("--list", action="store_true", help="print the clauses, and check none")
    add_color(parser)


def _add_results(parser: argparse.ArgumentParser) -> None:
    parser.add_argument(
        "-o",
        "--output",
        type=Path,
        default=_RECORDS,
        metavar="DIR",
        help=f"folder for the records of failed clauses (default {_RECORDS})",
    )
    parser.add_argument(
        "--json",
        type=Path,
        nargs="?",
        const=_STDOUT,
        metavar="FILE",
        help="print JSON, or write it to FILE",
    )
    parser.add_argument("--junit", type=Path, metavar="FILE", help="write the results as JUnit XML")
    parser.add_argument("--html", type=Path, metavar="FILE", help="write the results as HTML")


def _add_benches(parser: argparse.ArgumentParser) -> None:
    """Add the arguments about the benches that clauses meet."""
    parser.add_argument(
        "--benches",
        metavar="WHICH",
        default=_SOME,
        help='"some": most clauses run on variations of the kit\'s rig, chosen by the seed '
        '(default); "pairs": on pairs of them; "own": all on the rig as it is; "all": all on every '
        "variation; or a name",
    )
    parser.add_argument(
        "--swarm",
        type=whole(1, 1_000_000, "worlds"),
        metavar="N",
        help="instead: each clause in N gentle worlds of the rig, in which clocks, plants, errors "
        "of the bus and turns differ",
    )


def level_of(text: str) -> int:
    """Parse a level of the kit, for argparse."""
    from motorhil.harness.conformance.clause import Level

    found = {one.name: one for one in Level}.get(f"L{text.upper().removeprefix('L')}")
    if found is None:
        raise argparse.ArgumentTypeError(f"invalid level {text!r}; use L0 to {max(Level).name}")
    return found


def run(options: argparse.Namespace) -> int:
    """Check the clauses; return 0 if all claims are kept, 1 if not, 3 if none is applicable.

    Raises:
        RigError: a file or an option cannot be used, or a result cannot be written.
    """
    from motorhil.harness.conformance.job import Job
    from motorhil.harness.conformance.supervisor import CannotTestError, Supervisor, WrongJobError
    from motorhil.harness.virtual_time.interrupts import ends_by_signal

    if options.list:
        return _list(options)
    wrong = _wrong_target(options)
    if wrong:
        print(f"motorhil conform: {wrong}", file=sys.stderr)
        return WRONG_USAGE
    for file in (options.json, options.junit, options.html):
        if file is not None and file != _STDOUT:
            _require_writable(file)
    if os.getcwd() not in sys.path:
        sys.path.insert(0, os.getcwd())  # finds modules that are not installed yet
    job = Job(
        options.adaptation or "",
        options.rig or "",
        options.seed,
        tuple(options.on or ()),
        options.controller or "",
    )
    words = redirect_stdout(sys.stderr) if options.json == _STDOUT else nullcontext()
    try:
        with ends_by_signal(), Supervisor(job) as supervisor, words:
            outcome = _outcome(options, job, supervisor)
    except WrongJobError as error:
        print(error, file=sys.stderr)
        return WRONG_USAGE
    except CannotTestError as error:
        print(f"motorhil conform: {error}", file=sys.stderr)
        return FAILED
    _write(options, outcome)
    if options.json != _STDOUT:
        _print_summary(outcome)
    if outcome.is_empty:
        print("motorhil conform: no clause was applicable, so nothing was tested", file=sys.stderr)
        return NOT_JUDGED
    return PASSED if outcome.passed else FAILED


def _wrong_target(options: argparse.Namespace) -> str:
    """Return the error in the choice of what is tested, and how; "" if there is none."""
    if options.controller is not None and options.adaptation is not None:
        return "--controller checks a drive, --adaptation a host; leave one of them out"
    if options.workers not in (None, 1) and (options.on or options.fail_fast):
        return "--on and --fail-fast check one clause after another; leave --workers out"
    if options.swarm is not None and (options.on or options.controller is not None):
        return "--swarm disturbs emulated drives of an adaptation; leave --on and --controller out"
    if options.controller is None and options.adaptation is None and options.rig is None:
        return (
            "no adaptation named; use --adaptation NAME, --rig RIG, or both; or --controller NAME"
        )
    return ""


def _require_writable(file: Path) -> None:
    """Raise RigError if a file cannot be written, before any clause is checked."""
    if file.is_dir():
        raise RigError(file, "is a folder", "name a file in it")
    if not file.parent.is_dir():
        raise RigError(file, f"folder {file.parent} does not exist", "create it, or name another")
    if not os.access(file if file.exists() else file.parent, os.W_OK):
        raise RigError(file, "cannot be written", "name another file")


def _chosen(options: argparse.Namespace, known: "Sequence[Promise]") -> "list[Promise]":
    """Return the selected clauses in the order of the kit.

    Raises:
        RigError: an option names a clause that does not exist, or one above the level.
    """
    by_id = {one.id: one for one in known}
    for name in options.clause or ():
        if name not in by_id:
            remedy = nearest(name, list(by_id))
            if not remedy.startswith("did"):
                remedy = f"one of {listed(by_id)}"
            raise RigError(f"--clause {name}", "there is no such clause", remedy)
        level = by_id[name].level
        if options.level is not None and level > options.level:
            problem = f"is of level L{level}, above --level L{options.level}"
            raise RigError(f"--clause {name}", problem, "leave --level out")
    return [
        one
        for one in known
        if (options.level is None or one.level <= options.level)
        and (options.clause is None or one.id in options.clause)
    ]


def _list(options: argparse.Namespace) -> int:
    from motorhil.harness.cli.options import print_table
    from motorhil.harness.conformance.drives.kit import drive_clauses
    from motorhil.harness.conformance.job import Promise
    from motorhil.harness.conformance.kit import all_clauses

    clauses = drive_clauses() if options.controller is not None else all_clauses()
    known = [Promise(one.id, one.level, one.promise, one.source) for one in clauses.values()]
    rows = [(one.id, f"L{one.level}", one.promise, one.source) for one in _chosen(options, known)]
    head = ("clause", "level", "promise", "source")
    if options.json is not None:
        print(json.dumps([dict(zip(head, row, strict=True)) for row in rows]))
        return PASSED
    print_table(head, rows, words=(0, 1, 2, 3))
    return PASSED


def _outcome(options: argparse.Namespace, job: "Job", supervisor: "Supervisor") -> "Outcome":
    """Check the clauses, print each result as it comes, and return the outcome."""
    from motorhil.harness.conformance.benches.variations import not_met
    from motorhil.harness.conformance.supervisor import CannotTestError
    from motorhil.harness.conformance.verdicts.results import Outcome

    chosen = _chosen(options, supervisor.loaded.clauses)
    findings: list[Finding] = []
    first_of: dict[tuple[str, str, str], str] = {}
    first_s = 0.0
    line = StatusLine()
    if options.swarm is not None:
        pairs = _in_worlds(options.swarm, chosen, supervisor.loaded)
    else:
        pairs = _pairs(options.benches, chosen, supervisor.loaded)
    with closing(_findings(options, job, supervisor, pairs)) as found:
        for number, (promise, _) in enumerate(pairs, 1):
            line.show(f"{promise.id} ({number} of {len(pairs)})")
            finding = next(found)
            first_s = first_s or _running_s()
            line.clear()
            _print_finding(finding, first_of, has_colours(options.color, sys.stdout))
            findings.append(finding)
            if options.fail_fast and not finding.verdict.result.is_good:
                break
    try:
        claims = supervisor.claims()
    except CannotTestError as error:
        print(f"motorhil conform: {error}", file=sys.stderr)
        claims = None
    loaded = supervisor.loaded
    conditions = [*loaded.variations, *(_paired(loaded) if options.benches == _PAIRS else ())]
    missing = not_met(conditions, {one.variation for one in findings})
    return Outcome(loaded, findings, claims, first_s, _running_s(), tuple(missing))


def _findings(
    options: argparse.Namespace,
    job: "Job",
    supervisor: "Supervisor",
    pairs: "Sequence[tuple[Promise, str]]",
) -> "Generator[Finding, None, None]":
    """Yield the findings on the clauses in their order, by several workers if there are many."""
    from motorhil.harness.conformance.examination import Examiner, examine_all
    from motorhil.harness.conformance.supervisor import Supervisor

    words, is_live = _command(options), bool(options.on)
    is_required = options.swarm is None and options.benches not in (_SOME, _PAIRS)
    with ExitStack() as held:
        supervisors = [supervisor]
        for _ in range(1, _workers(options, len(pairs))):
            supervisors.append(Supervisor(job))
            held.push(supervisors[-1])
        examiners = [Examiner(one, words, options.output, is_live=is_live) for one in supervisors]
        with closing(examine_all(examiners, pairs, is_required=is_required)) as found:
            yield from found


def _workers(options: argparse.Namespace, count: int) -> int:
    """Return the number of processes that check `count` clauses."""
    if options.on or options.fail_fast:
        return 1
    if options.workers is not None:
        return int(options.workers)
    return max(1, min(len(os.sched_getaffinity(0)), count // _SHARE))


def _in_worlds(
    count: int, chosen: "Sequence[Promise]", loaded: "Loaded"
) -> "list[tuple[Promise, str]]":
    """Return the clauses to check, each in so many worlds, from that of the seed on."""
    from motorhil.harness.conformance.benches.worlds import world_name

    worlds = [world_name(loaded.seed + number) for number in range(count)]
    return [(promise, world) for world in worlds for promise in chosen]


def _pairs(
    which: str, chosen: "Sequence[Promise]", loaded: "Loaded"
) -> "list[tuple[Promise, str]]":
    """Return the clauses to check, each with the variation of the rig.

    Raises:
        RigError: there is no such variation.
    """
    from motorhil.harness.conformance.benches.variations import OWN, assigned
    from motorhil.harness.conformance.benches.worlds import is_world

    names = loaded.variations
    if which == _ALL:
        return [(promise, name) for promise in chosen for name in (OWN, *names)]
    if which == _OWN:
        return [(promise, OWN) for promise in chosen]
    if which in (_SOME, _PAIRS):
        if which == _PAIRS:
            names = tuple(_paired(loaded))
        by_clause = assigned([one.id for one in loaded.clauses], names, loaded.seed)
        return [(promise, by_clause[promise.id]) for promise in chosen]
    if which not in names and not is_world(which) and which not in _paired(loaded):
        known = (_SOME, _PAIRS, _ALL, _OWN, *names)
        remedy = nearest(which, list(known))
        if not remedy.startswith("did"):
            remedy = f"one of {listed(known)}"
        raise RigError(f"--benches {which}", "this rig has no such variation", remedy)
    return [(promise, which) for promise in chosen]


def _paired(loaded: "Loaded") -> list[str]:
    """Return the pairs of variations that the rig can have."""
    from motorhil.harness.conformance.benches.variations import pairs_of

    return pairs_of(Path(loaded.rig).read_text(), loaded.variations) if loaded.variations else []


def _command(options: argparse.Namespace) -> list[str]:
    words = ["motorhil", "conform"]
    if options.adaptation is not None:
        words += ["--adaptation", options.adaptation]
    if options.controller is not None:
        words += ["--controller", options.controller]
    if options.rig is not None:
        words += ["--rig", options.rig]
    for where in options.on or ():
        words += ["--on", where]
    return words


def _running_s() -> float:
    """Return the age of this process [s]."""
    fields = Path("/proc/self/stat").read_text().rpartition(")")[2].split()
    born_s = int(fields[19]) / os.sysconf("SC_CLK_TCK")
    return time.clock_gettime(time.CLOCK_BOOTTIME) - born_s


# --- output ------------------------------------------------------------------------------------


def _print_finding(
    one: "Finding", first_of: dict[tuple[str, str, str], str], in_colours: bool
) -> None:
    """Print a finding; of one that was seen before, at the same place, only where.

    Args:
        one: the finding.
        first_of: the first clause of each bad finding so far, which this one is added to.
        in_colours: the result has its colour.
    """
    verdict = one.verdict
    text = verdict.seen or one.promise.promise
    first = one.promise.id
    result = f"{verdict.result.value:<15}"
    if in_colours:
        result = coloured(verdict.result.value, result)
    if not verdict.result.is_good:
        key = (verdict.result.value, verdict.seen, verdict.place)
        first = first_of.setdefault(key, first)
    if first != one.promise.id:
        print(f"{one.promise.id:<10}{result}{'':>10}  the same as {first}")
        sys.stdout.flush()
        return
    print(f"{one.promise.id:<10}{result}{verdict.time_ns / 1e9:8.3f} s  {one_line(text)}")
    sys.stdout.flush()


def _print_summary(outcome: "Outcome") -> None:
    from motorhil.harness.conformance.clause import Result
    from motorhil.harness.conformance.verdicts.causes import groups_of, summary_of

    groups = groups_of(outcome.findings)
    if groups:
        print("\nTo mend, the first one first:")
    for line in summary_of(groups):
        print(line[: len(line) - len(line.lstrip())] + one_line(line.strip()))
    counts = [(outcome.count(result), result) for result in Result]
    results = ", ".join(f"{count} {result.value}" for count, result in counts if count)
    took = f"first verdict after {outcome.first_verdict_s:.2f} s, the last {outcome.took_s:.2f} s"
    clauses = "1 clause" if len(outcome.findings) == 1 else f"{len(outcome.findings)} clauses"
    print(f"\n{clauses}: {results or 'none'}; {took}")
    if outcome.loaded.variations:
        more = len(outcome.not_met) - _NAMED
        tail = f" and {more} more" if more > 0 else ""
        print(f"not met: {', '.join(outcome.not_met[:_NAMED])}{tail}")
    else:
        print("benches: the rig as it is, not varied")
    if outcome.claims is not None:
        print(f"claimed: {listed(outcome.claimed)}")
        if outcome.assumed:
            print(f"assumed, unless [conformance.without] denies it: {listed(outcome.assumed)}")
    reasons: dict[str, list[str]] = {}
    for one in outcome.findings:
        if one.verdict.result is Result.NOT_APPLICABLE:
            reasons.setdefault(one.verdict.seen, []).append(one.promise.id)
    for reason, names in reasons.items():
        print(f"not applicable: {', '.join(names)}: {one_line(reason)}")


def _write(options: argparse.Namespace, outcome: "Outcome") -> None:
    """Write the requested result files.

    Raises:
        RigError: a file cannot be written.
    """
    from motorhil.harness.conformance.verdicts.results import as_json, as_junit, as_page

    texts: tuple[tuple[Path | None, Callable[[Outcome], str]], ...] = (
        (options.json, as_json),
        (options.junit, as_junit),
        (options.html, partial(as_page, folder=options.html and options.html.parent)),
    )
    for file, text in texts:
        if file is None:
            continue
        if file == _STDOUT:
            print(text(outcome).rstrip())
            continue
        try:
            file.write_text(text(outcome), encoding="utf-8")
        except OSError as error:
            raise RigError(file, f"cannot be written: {error.strerror}") from None
