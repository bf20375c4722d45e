"""`make rule-mutants`: samples mutants made by rule, and tells which ones no clause kills.

The exit status is 1 if a mutant survives, or no clause executes it, and `equivalent.toml` does not
say why that is right.
"""

import argparse
import json
import os
import sys
from collections import Counter
from collections.abc import Iterator, Sequence
from dataclasses import asdict
from pathlib import Path

from tests.conformance.mutants.by_rule.classified import Reason, known, read, reason_of
from tests.conformance.mutants.by_rule.execution import (
    Execution,
    Run,
    before_benches,
    measured,
    of_clauses,
)
from tests.conformance.mutants.by_rule.sources import Mutant, mutant_of, sample
from tests.conformance.mutants.by_rule.trial import Outcome, Trial, prepare, tried

_DEAR_S = 1.0  # cost of a known verdict's check, at most [s]
Reasons = dict[tuple[str, str], Reason]


def table(trials: Sequence[Trial], reasons: Reasons) -> Iterator[str]:
    """Yield the table of outcomes by room, in Markdown."""
    names = [one.value for one in Outcome]
    yield f"| room | sampled | {' | '.join(names)} | of these explained |"
    yield "| --- " * (len(names) + 3) + "|"
    rooms = sorted({one.mutant.room for one in trials})
    for room in (*rooms, "all"):
        some = [one for one in trials if room in (one.mutant.room, "all")]
        counts = Counter(one.outcome for one in some)
        closed = sum(is_closed(one, reasons) for one in some)
        cells = [len(some), *(counts[outcome] for outcome in Outcome), closed]
        yield f"| {room} | {' | '.join(map(str, cells))} |"


def is_closed(trial: Trial, reasons: Reasons) -> bool:
    """Return whether no clause should find this mutant, and none does."""
    reason = reason_of(trial.mutant, reasons)
    return not trial.outcome.is_found and reason is not None and reason.is_closed


def share(trials: Sequence[Trial], reasons: Reasons) -> str:
    """Return the share of the mutants that matter which clauses have found, and can find."""
    judged = [(one, reason_of(one.mutant, reasons)) for one in trials]
    wrong = [one for one, why in judged if one.outcome.is_found or not (why and why.is_harmless)]
    near = [one for one in wrong if not is_closed(one, reasons)]
    found = sum(one.outcome.is_found for one in trials)
    parts = [f"{found} of {len(some)} ({found / max(1, len(some)):.0%})" for some in (wrong, near)]
    return f"found: {parts[0]} that are not harmless; {parts[1]} that no other test has to see"


def told(trial: Trial, reasons: Reasons) -> Iterator[str]:
    """Yield the lines about a mutant that was not found."""
    one = trial.mutant
    yield f"{one.file}:{one.line} {one.scope}: {trial.outcome.value} [{one.rule}]"
    yield f"    {one.change}"
    if trial.seen:
        yield f"    {trial.clause} on {trial.bench}: {trial.seen}"
    clauses = dict.fromkeys(name.partition(" on ")[0] for name in trial.ran)
    if clauses:
        yield f"    {len(trial.ran)} checks passed: {', '.join(clauses)}"
    reason = reason_of(one, reasons)
    if reason is not None:
        yield f"    {reason.kind}: {reason.reason}"


def mutants_of(options: argparse.Namespace) -> Iterator[Mutant]:
    """Yield the sampled mutants, or those that were not found in an earlier run."""
    if not options.again:
        yield from sample(options.seed, options.count, options.only)
        return
    for line in Path(options.again).read_text().splitlines():
        values = json.loads(line)
        one = Mutant(**values["mutant"])
        if not Outcome(values["outcome"]).is_found and options.only in one.function:
            try:
                yield mutant_of(one.function, one.change)
            except LookupError as error:
                print(error, file=sys.stderr)


def trials_of(options: argparse.Namespace) -> Iterator[Trial]:
    """Yield the trial of each mutant; show the progress on stderr."""
    prepare()
    runs = of_clauses(options.clause, options.bench) if options.clause else []
    if options.clause:
        execution = Execution(runs, before_benches(options.bench), [])
    else:
        execution = measured(options.bench)
    prepare(execution.modules)
    for number, mutant in enumerate(mutants_of(options), 1):
        plan = runs or execution.plan(mutant, options.seconds)
        trial = tried(mutant, plan, afresh=execution.is_early(mutant))
        by = f" {trial.clause} on {trial.bench}" if trial.outcome.is_found else ""
        line = f"{number:4} {mutant.function}: {trial.outcome.value}{by}, {trial.cpu_s:.1f} s"
        print(line, file=sys.stderr, flush=True)
        yield trial


def known_verdicts(stride: int) -> int:
    """Try each `stride`-th mutant of `known.toml`; return the exit status."""
    prepare()
    wrong = 0
    for one in known()[::stride]:
        mutant = one.mutant()
        run = Run(one.bench, one.clause, _DEAR_S, "passed", {})
        trial = tried(mutant, [run], afresh=one.is_early or not mutant.is_in_function)
        if trial.outcome.value != one.outcome:
            wrong += 1
            print(f"known.toml: expected {one.outcome} by {one.clause}", file=sys.stderr)
            print(*told(trial, {}), sep="\n", file=sys.stderr)
    return int(bool(wrong))


def main(words: Sequence[str]) -> int:
    """Run the command and return its exit status."""
    parser = argparse.ArgumentParser(prog="python -m tests.conformance.mutants.by_rule")
    parser.add_argument("--seed", type=int, default=1, metavar="N", help="default 1")
    parser.add_argument("--count", type=int, default=200, metavar="N", help="default 200")
    parser.add_argument("--only", default="", metavar="TEXT", help="in functions of such names")
    parser.add_argument("--bench", default="", metavar="TEXT", help="on benches of such names")
    parser.add_argument(
        "--seconds", type=float, default=10.0, metavar="S", help="cost of a mutant's checks"
    )
    parser.add_argument(
        "--clause", action="append", metavar="ID", help="try these alone, without measuring"
    )
    parser.add_argument(
        "--again", metavar="FILE", help="those of a --json file that were not found, no sample"
    )
    parser.add_argument("--json", metavar="FILE", help="write each trial as a line")
    parser.add_argument("--all", action="store_true", help="also tell the explained survivors")
    parser.add_argument(
        "--known", type=int, nargs="?", const=1, metavar="N", help="each N-th of known.toml alone"
    )
    options = parser.parse_args(words)
    if options.known:
        return known_verdicts(options.known)
    reasons = read()
    trials = []
    with open(options.json or os.devnull, "w") as file:
        for one in trials_of(options):
            trials.append(one)
            values = {**asdict(one), "outcome": one.outcome.value}
            print(json.dumps(values), file=file, flush=True)
            if not one.outcome.is_found and (options.all or not is_closed(one, reasons)):
                print(*told(one, reasons), sep="\n", flush=True)
    unexplained = [one for one in trials if not one.outcome.is_found]
    unexplained = [one for one in unexplained if not is_closed(one, reasons)]
    print(*table(trials, reasons), sep="\n")
    print(share(trials, reasons))
    for reason in reasons.values():
        if reason.is_outdated:
            print(f"equivalent.toml: {reason.function}: {reason.change}: not in the sources; drop")
    cost_s = sum(one.cpu_s for one in trials)
    print(f"{len(trials)} mutants cost {cost_s:.0f} s of processor time")
    return int(bool(unexplained))


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
