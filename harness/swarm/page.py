"""Page of a campaign: one HTML file, written while it runs, readable from disk."""

from collections.abc import Sequence
from html import escape
from pathlib import Path
from typing import Final

from motorhil.harness.swarm.kept import Kept, command, story
from motorhil.harness.swarm.plan import Plan
from motorhil.harness.swarm.summary import Summary

NAME: Final = "index.html"


def write_page(folder: Path, plan: Plan, summary: Summary, kept: Sequence[Kept]) -> None:
    """Write the page; a reader never sees half of it."""
    text = _page(plan, summary, kept)
    passing = folder / f"{NAME}.new"
    passing.write_text(text)
    passing.replace(folder / NAME)


def _page(plan: Plan, summary: Summary, kept: Sequence[Kept]) -> str:
    rows = "".join(
        f"<tr><td>{escape(one.name)}</td><td>{len(one.rows)}</td><td>{one.first.seed}</td></tr>"
        for one in summary.causes
    )
    failures = "".join(
        f"<h2>{escape(one.row.signature)}</h2><p>{escape(story(one.row))}</p>"
        f"<pre>{escape(command(one.row, plan, one.fragment))}</pre>"
        for one in kept
    )
    return (
        f"<!doctype html><title>swarm of {escape(plan.rig)}</title>"
        f"<p>{summary.worlds} worlds, {summary.failures} failures, {summary.pairs} pairs</p>"
        f"<table>{rows}</table>{failures}"
    )
