"""Page of a campaign: one HTML file, written while it runs, readable from disk without a network.

The style sheet is that of `motorhil report`. There is no script. A content security policy forbids
every request. While the campaign runs, the page loads itself again every few seconds.
"""

import base64
import hashlib
import os
from collections.abc import Callable, Iterable, Sequence
from datetime import UTC, datetime
from html import escape
from importlib.resources import files
from pathlib import Path
from typing import Final
from urllib.parse import quote

from motorhil.harness.report import picture
from motorhil.harness.rig.config.toml import RigError, one_line
from motorhil.harness.swarm.kept import Kept, command
from motorhil.harness.swarm.plan import Plan
from motorhil.harness.swarm.report.coverage import Coverage, coverage_of
from motorhil.harness.swarm.report.moment import moment_of
from motorhil.harness.swarm.report.processes import Processes
from motorhil.harness.swarm.report.progress import Progress
from motorhil.harness.swarm.report.sentences import story
from motorhil.harness.swarm.report.texts import counted, span
from motorhil.harness.swarm.row import Result
from motorhil.harness.swarm.summary import Cause, Summary

NAME: Final = "index.html"
RELOAD_S: Final = 5
_POINTS: Final = 400
_CAUSES: Final = 200
_SEEDS: Final = 1000
_STYLE: Final = """
main { padding: 0 16px 30px; max-width: 1200px; overflow-wrap: anywhere }
section { padding-top: 18px } section > h2 { display: block; margin-bottom: 4px }
.wide { overflow-x: auto } table { border-collapse: collapse }
td, th { text-align: left; padding: 2px 16px 2px 0; vertical-align: top;
  border-bottom: 1px solid var(--grid); overflow-wrap: anywhere }
td.n, th.n { text-align: right; font-variant-numeric: tabular-nums; overflow-wrap: normal }
article { border-top: 1px solid var(--rule); margin-top: 14px; padding-top: 8px }
pre { background: var(--off); padding: 6px 10px; overflow-x: auto; margin: 6px 0 }
a { color: var(--accent) } .wide svg { min-width: 560px; width: 100% } figure { margin: 6px 0 }
figcaption { color: var(--soft) } .bad { color: var(--fault); font-weight: 600 }
@media (max-width: 800px) { main { padding: 0 8px 30px } td, th { padding-right: 8px } }
"""


def write_page(folder: Path, text: str) -> Path:
    """Write the page of a campaign, and return its file; a reader never sees half of it.

    Raises:
        RigError: it cannot be written.
    """
    passing, path = folder / f"{NAME}.{os.getpid()}.new", folder / NAME
    try:
        passing.write_text(text, encoding="utf-8")
        passing.replace(path)
    except OSError as error:
        raise RigError(path, f"cannot be written: {error.strerror}", "free some space") from None
    return path


def page_of(
    folder: Path,
    plan: Plan,
    summary: Summary,
    kept: Sequence[Kept],
    progress: Progress,
    processes: Processes,
    now_s: float,
    *,
    is_running: bool = False,
) -> str:
    """Return the page of a campaign.

    Args:
        folder: the folder of the campaign.
        plan: its plan.
        summary: its findings.
        kept: its kept failures, so far.
        progress: its times.
        processes: which of its worlds ran alone.
        now_s: now [s of the Unix epoch].
        is_running: whether the page will be written again.
    """
    coverage = coverage_of(plan, summary)
    style = (files("motorhil.harness.report") / "template" / "page.css").read_text("utf-8")
    style += picture.STYLE + _STYLE
    title = f"swarm: {plan.program.name} on {plan.rig}"
    reload = f'<meta http-equiv="refresh" content="{RELOAD_S}">\n' if is_running else ""
    digest = base64.b64encode(hashlib.sha256(style.encode()).digest()).decode()
    sections = (
        _results(summary),
        _processes(processes),
        _causes(summary, progress, {one.cause for one in kept}),
        _kept(folder, plan, kept),
        _curves(summary, progress),
        _disturbances(summary),
        _reached(summary, coverage),
        _never(coverage),
    )
    return f"""<!doctype html>
<html lang="en"><head><meta charset="utf-8">
<meta http-equiv="Content-Security-Policy" content="default-src 'none'; img-src data:; \
style-src 'sha256-{digest}'; base-uri 'none'; form-action 'none'">
<meta name="viewport" content="width=device-width, initial-scale=1">
<meta name="color-scheme" content="light dark"><meta name="referrer" content="no-referrer">
{reload}<link rel="icon" href="data:,">
<title>{_text(title)}</title>
<style>{style}</style></head><body>
<header id="head"><h1>{_text(title)}</h1>
{_facts(plan, summary, progress, now_s)}
{_notes(summary, progress, is_running)}</header>
<main>
{"".join(sections)}</main>
</body></html>
"""


# --- the head ------------------------------------------------------------------------------------


def _facts(plan: Plan, summary: Summary, progress: Progress, now_s: float) -> str:
    asked = f" of {progress.asked} asked for" if progress.asked else ""
    facts = [
        ("rig", plan.rig),
        ("program", " ".join((plan.program.name, *plan.program.words))),
        ("motorhil", plan.build),
        ("worlds", f"{summary.worlds}{asked}"),
        ("canary", _canary(summary)),
    ]
    if progress.begun_s is not None:
        facts.append(("began", _date(progress.begun_s)))
        facts.append(("took", span(progress.took_s)))
    if progress.mean is not None:
        facts.append(("rate", f"{progress.mean:.1f} worlds/s"))
    facts.append(("page written", _date(now_s)))
    rows = "".join(f"<div><dt>{name}</dt><dd>{_text(value)}</dd></div>" for name, value in facts)
    return f'<dl id="facts">{rows}</dl>'


def _canary(summary: Summary) -> str:
    if summary.canary is None:
        return "has not run yet"
    return f"found by {summary.canary}" if summary.found_canary else "not found"


def _notes(summary: Summary, progress: Progress, is_running: bool) -> str:
    notes = []
    if is_running:
        notes.append(
            f"The campaign runs: this page loads itself again every {RELOAD_S} s. Failures are "
            "shrunk and kept at its end."
        )
    elif not progress.is_over:
        notes.append("The campaign is not over: it still runs, or it was ended from outside.")
    if not is_running and progress.asked > summary.worlds:
        missing = counted(progress.asked - summary.worlds, "world")
        notes.append(f"The results of {missing} are missing; --resume runs them.")
    if not summary.found_canary:
        notes.append("The planted defect was not found: the campaign proves nothing.")
    killed = summary.counts.get(Result.KILLED, 0)
    if killed:
        notes.append(f"Something outside killed {counted(killed, 'world')}: neither pass nor fail.")
    items = "".join(f"<li>{_text(note)}</li>" for note in notes)
    return f'<ul id="notes">{items}</ul>'


# --- sections ------------------------------------------------------------------------------------


def _results(summary: Summary) -> str:
    rows = [(one.value, summary.counts.get(one, 0)) for one in Result]
    return _section("Results", _table(("result", "worlds"), rows))


def _processes(processes: Processes) -> str:
    """Return which worlds ran alone."""
    parts = f"<p>{processes.told()}</p>"
    if processes.batch > 1 and processes.alone:
        number = counted(len(processes.alone), "world")
        seeds = ", ".join(map(str, processes.alone[:_SEEDS]))
        more = len(processes.alone) - _SEEDS
        parts += (
            f"<details><summary>{number} alone</summary><p>Seeds {seeds}"
            f"{f', and {more} more: see --json' if more > 0 else ''}.</p></details>"
        )
    return _section("Processes", parts)


def _causes(summary: Summary, progress: Progress, kept: set[str]) -> str:
    if not summary.causes:
        return _section("Causes of failures", "<p>No world has failed.</p>")
    heads = ("cause", "worlds", "first seed", "seen after", "signatures")
    rows = "".join(_cause(one, progress, one.name in kept) for one in summary.causes[:_CAUSES])
    more = len(summary.causes) - _CAUSES
    left_out = f"<p>{counted(more, 'more cause')}: see --json.</p>" if more > 0 else ""
    head = "".join(
        f'<th class="{"" if n in (0, 4) else "n"}">{h}</th>' for n, h in enumerate(heads)
    )
    table = f'<div class="wide"><table><tr>{head}</tr>{rows}</table></div>{left_out}'
    return _section("Causes of failures", table)


def _cause(cause: Cause, progress: Progress, is_kept: bool) -> str:
    """Return the row of a cause, with a sentence unless it has an article of its own."""
    told = "" if is_kept else f"<br>{_text(story(cause.first))}"
    seen_s = progress.seen(cause.rows)
    signatures = "".join(
        f"<li>{_text(name)}: {count}</li>" for name, count in cause.signatures[:_CAUSES]
    )
    number = counted(len(cause.signatures), "signature")
    return (
        f"<tr><td>{_text(cause.name)}{told}</td>"
        f'<td class="n">{len(cause.rows)}</td><td class="n">{cause.lowest}</td>'
        f'<td class="n">{"" if seen_s is None else span(seen_s)}</td>'
        f"<td><details><summary>{number}</summary><ul>{signatures}</ul></details></td></tr>"
    )


def _kept(folder: Path, plan: Plan, kept: Sequence[Kept]) -> str:
    if not kept:
        return ""
    return _section("Kept failures", "".join(_article(folder, plan, one) for one in kept))


def _article(folder: Path, plan: Plan, one: Kept) -> str:
    row = one.row
    links = [_link(one.fragment, folder, "fragment"), _link(one.test, folder, "test")]
    figures = ""
    if one.record is not None:
        links.append(_link(one.record, folder, "recording"))
        moment = moment_of(one.record, row.at_ns, row.text)
        figures = "".join(
            f'<figure class="wide">{picture.picture_of(curves, row.at_ns / 1e9, about)}'
            f"<figcaption>{_text(about)}</figcaption></figure>"
            for about, curves in moment.motors
        )
        if moment.messages:
            lines = "\n".join(map(_text, moment.messages))
            figures += f"<details><summary>messages around it</summary><pre>{lines}</pre></details>"
    try:
        world = one.fragment.read_text(encoding="utf-8", errors="replace")
    except OSError:
        world = "(the fragment is not there)"
    lines = "\n".join(map(_text, world.splitlines()))
    return (
        f"<article><h3>{_text(one.cause)}</h3><p>{_text(story(row))}</p>"
        f"<p>Again:</p><pre>{_text(command(row, plan, one.fragment))}</pre>{figures}"
        f"<details><summary>fragment</summary><pre>{lines}</pre></details>"
        f"<p>{', '.join(links)}; signature: {_text(row.signature)}</p></article>\n"
    )


def _curves(summary: Summary, progress: Progress) -> str:
    growth = [(0.0, 0.0), *((float(n), float(pairs)) for n, pairs in summary.growth)]
    growth.append((float(max(summary.worlds, 1)), float(summary.pairs)))
    step = -(-len(growth) // _POINTS)
    growth = [*growth[::step], growth[-1]]
    about = "Pairs of state and event over worlds, in the order of seeds"
    figures = _figure({"pairs": growth}, about, lambda n: f"{n:.0f} worlds")
    if progress.rate:
        about = "Worlds per second over time"
        figures += _figure({"rate": progress.rate}, about, lambda s: f"{s:.0f} s")
    return _section("Coverage", f"<p>{counted(summary.pairs, 'pair')} met.</p>{figures}")


def _disturbances(summary: Summary) -> str:
    heads = ("kind", "worlds with it", "worlds in which it struck", "strikes")
    rows = [(kind, one.worlds, one.struck, one.times) for kind, one in summary.strikes.items()]
    return _section("Disturbances", _table(heads, rows) if rows else "<p>None was drawn.</p>")


def _reached(summary: Summary, coverage: Coverage) -> str:
    parts = ""
    if coverage.met:
        parts += _table(("condition that was true", "worlds"), coverage.met.items())
    if summary.ended_by:
        parts += _table(
            ("allowed error that ended the program", "worlds"), summary.ended_by.items()
        )
    if coverage.states:
        parts += f"<p>States in which something happened: {', '.join(coverage.states)}.</p>"
    return _section("Reached", parts) if parts else ""


def _never(coverage: Coverage) -> str:
    never = (
        ("condition that was never true", coverage.unmet),
        ("disturbance that was never drawn", coverage.undrawn),
        ("disturbance that never struck", coverage.unstruck),
        ("disturbance that this rig excludes", coverage.impossible),
        ("state in which nothing happened", coverage.unmet_states),
    )
    rows = "".join(
        f"<tr><th>{what}</th><td>{_text(', '.join(names))}</td></tr>"
        for what, names in never
        if names
    )
    table = f'<div class="wide"><table>{rows}</table></div>' if rows else ""
    return _section("Never reached", table or "<p>Nothing known is missing.</p>")


# --- parts ---------------------------------------------------------------------------------------


def _section(title: str, contents: str) -> str:
    return f"<section><h2>{title}</h2>{contents}</section>\n"


def _table(heads: Sequence[str], rows: Iterable[tuple[str | int, ...]]) -> str:
    """Return a table whose first column is text, and whose other columns are numbers."""
    head = "".join(f"<th{_numeric(place)}>{_text(name)}</th>" for place, name in enumerate(heads))
    body = "".join(
        "<tr>"
        + "".join(f"<td{_numeric(n)}>{_text(str(value))}</td>" for n, value in enumerate(row))
        + "</tr>"
        for row in rows
    )
    return f'<div class="wide"><table><tr>{head}</tr>{body}</table></div>'


def _numeric(place: int) -> str:
    return ' class="n"' if place else ""


def _figure(
    curves: dict[str, Sequence[tuple[float, float]]], about: str, shown: Callable[[float], str]
) -> str:
    drawn = picture.picture_of(curves, None, about, shown)
    return f'<figure class="wide">{drawn}<figcaption>{about}</figcaption></figure>' if drawn else ""


def _link(path: Path, folder: Path, name: str) -> str:
    target = quote(os.path.relpath(path, folder), errors="surrogateescape")
    return f'<a href="{escape(target)}">{name}</a>'


def _date(time_s: float) -> str:
    return f"{datetime.fromtimestamp(time_s, UTC):%Y-%m-%d %H:%M:%S} UTC"


def _text(text: str) -> str:
    return escape(one_line(text), quote=True)
