"""Findings of a campaign as lines for a terminal, and as JSON."""

from collections.abc import Iterator, Sequence
from dataclasses import asdict
from typing import Final

from motorhil.harness.rig.config.toml import one_line
from motorhil.harness.swarm.kept import Kept, command
from motorhil.harness.swarm.plan import Plan
from motorhil.harness.swarm.report.coverage import Coverage
from motorhil.harness.swarm.report.progress import Progress
from motorhil.harness.swarm.report.sentences import story
from motorhil.harness.swarm.row import Result
from motorhil.harness.swarm.summary import Summary

SHOWN: Final = 20
"""Causes that are listed, at most."""


def progress_line(summary: str, done: int, asked: int, rate: float) -> str:
    """Return the line that a terminal shows while the campaign runs."""
    left_s = (asked - done) / rate if rate > 0.0 else 0.0
    ends = f", {span(left_s)} left" if 0.0 < left_s < 1e6 else ""
    return f"{done} of {asked} worlds, {rate:.1f}/s{ends}{f'; {summary}' if summary else ''}"


def span(time_s: float) -> str:
    """Return a time on the wall clock in a few characters."""
    seconds = round(time_s)
    if seconds < 100:
        return f"{seconds} s"
    if seconds < 6000:
        return f"{round(seconds / 60)} min"
    return f"{seconds / 3600:.1f} h"


def lines_of(
    summary: Summary, kept: Sequence[Kept], plan: Plan, coverage: Coverage, progress: Progress
) -> Iterator[str]:
    """Yield the findings: results, causes by their number of worlds, and what was not reached."""
    yield headline(summary, progress)
    for number, cause in enumerate(summary.causes[:SHOWN], 1):
        worlds = counted(len(cause.rows), "world")
        yield f"{number}. {one_line(cause.name)}: {worlds}, first seed {cause.lowest}"
        one = next((one for one in kept if one.cause == cause.name), None)
        if one is None:
            yield f"   {story(cause.first)}"
            continue
        yield f"   {story(one.row)}"
        yield f"   again: {one_line(command(one.row, plan, one.fragment))}"
        yield f"   test:  {one.test}"
    if len(summary.causes) > SHOWN:
        yield f"and {counted(len(summary.causes) - SHOWN, 'more cause')}; see the page, or --json"
    if summary.worlds and not summary.strikes and not coverage.undrawn:
        yield "no disturbance is possible on this rig, or its [swarm] switches all off"
    if coverage.unmet:
        yield f"never true: {', '.join(map(one_line, coverage.unmet))}"
    if coverage.undrawn:
        yield f"never drawn: {', '.join(coverage.undrawn)}"
    if coverage.unstruck:
        yield f"never struck: {', '.join(coverage.unstruck)}"
    if summary.ended_by:
        ends = ", ".join(f"{name} {count}" for name, count in summary.ended_by.items())
        yield f"ended by allowed errors: {one_line(ends)}"


def headline(summary: Summary, progress: Progress) -> str:
    """Return the results in one line."""
    counts = ", ".join(f"{count} {result.value}" for result, count in summary.counts.items())
    parts = [
        f"{counted(summary.worlds, 'world')}: {counts or 'none'}",
        counted(summary.pairs, "pair") + " of state and event",
    ]
    if summary.causes:
        parts.insert(1, counted(len(summary.causes), "cause"))
    if progress.mean is not None:
        parts.append(f"{progress.mean:.1f} worlds/s")
    return "; ".join(parts)


def counted(count: int, noun: str) -> str:
    """Return a number with its noun."""
    return f"{count} {noun}{'' if count == 1 else 's'}"


def as_table(
    summary: Summary, kept: Sequence[Kept], plan: Plan, coverage: Coverage, progress: Progress
) -> dict[str, object]:
    """Return all findings for JSON."""
    return {
        "rig": plan.rig,
        "program": asdict(plan.program),
        "build": plan.build,
        "worlds": summary.worlds,
        "asked": progress.asked or None,
        "is_over": progress.is_over,
        "worlds_per_s": progress.mean,
        "results": {one.value: summary.counts.get(one, 0) for one in Result},
        "pairs": summary.pairs,
        "growth": [list(one) for one in summary.growth],
        "states": list(coverage.states),
        "canary": summary.canary,
        "sometimes": summary.reached,
        "ended_by": summary.ended_by,
        "disturbances": {kind: asdict(one) for kind, one in summary.strikes.items()},
        "never": {
            "true": list(coverage.unmet),
            "drawn": list(coverage.undrawn),
            "struck": list(coverage.unstruck),
            "possible": list(coverage.impossible),
            "states": list(coverage.unmet_states),
        },
        "causes": [
            {
                "cause": cause.name,
                "worlds": len(cause.rows),
                "first_seed": cause.lowest,
                "seen_s": progress.seen(cause.rows),
                "text": cause.first.text,
                "signatures": dict(cause.signatures),
            }
            for cause in summary.causes
        ],
        "kept": [
            {
                "cause": one.cause,
                "seed": one.row.seed,
                "signature": one.row.signature,
                "story": story(one.row),
                "at_ns": one.row.at_ns,
                "fragment": str(one.fragment),
                "test": str(one.test),
                "record": None if one.record is None else str(one.record),
                "again": command(one.row, plan, one.fragment),
            }
            for one in kept
        ],
    }
