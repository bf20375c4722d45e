"""The verb `judge`: checks a recording against the oracles."""

import argparse
import json
import sys
import textwrap
from collections.abc import Sequence
from dataclasses import asdict, replace
from pathlib import Path
from typing import Final

from motorhil.harness.cli.main import FAILED, NOT_JUDGED, PASSED, WRONG_USAGE
from motorhil.harness.cli.options import (
    add_color,
    add_descriptions,
    add_eds,
    add_max_memory,
    add_only,
    attachments_of,
    print_table,
)
from motorhil.harness.cli.printable import has_colours, teller
from motorhil.harness.cli.times import add_span, span_in, span_of
from motorhil.harness.oracles.base import Finding, Verdict
from motorhil.harness.oracles.facts import Facts, read_limits, read_rig
from motorhil.harness.oracles.judge import CATALOGUE, is_sound, judge
from motorhil.harness.oracles.seen import Seen
from motorhil.harness.recording.decoders import description_for, messages_at
from motorhil.traces.decoding.narrative import Describe
from motorhil.traces.formats.registry import Source, open_source
from motorhil.traces.mcap.reader import read_trace
from motorhil.traces.mcap.records import Attachment

_WIDTH: Final = 100
_SHOWN: Final = 20


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the arguments of `judge`."""
    parser.add_argument(
        "file", nargs="?", metavar="FILE", help="a recording: MCAP, candump, TRC, ASC, BLF, CSV ..."
    )
    parser.add_argument(
        "--list", action="store_true", help="print the promises of the oracles, and their sources"
    )
    add_only(parser)
    parser.add_argument(
        "--limits",
        type=Path,
        metavar="TOML",
        help="limits of measured values, by motor",
    )
    parser.add_argument(
        "--rig", type=Path, metavar="RIG", help="the rig, if the recording does not contain it"
    )
    add_eds(parser)
    add_descriptions(parser)
    parser.add_argument(
        "--complete",
        action="store_true",
        help="the recording has every frame of its buses: missing frames count",
    )
    add_span(parser)
    add_max_memory(parser)
    add_color(parser)
    parser.add_argument("--json", action="store_true", help="print one JSON object")


def run(options: argparse.Namespace) -> int:
    """Judge a recording; return 0 if it is sound, 1 if not, 3 if nothing could be judged.

    Raises:
        RigError: the rig or the file of limits is wrong.
        TraceError: the recording cannot be read, or is damaged.
    """
    if options.list:
        _list(options.only, options.json)
        return PASSED
    if options.file is None:
        print("motorhil judge: name a recording, or use --list", file=sys.stderr)
        return WRONG_USAGE
    facts = Facts(is_complete=options.complete, attachments=attachments_of(options.eds))
    if options.limits is not None:
        facts = facts.with_more(read_limits(options.limits))
    if options.rig is not None:
        rig = read_rig(options.rig)
        facts = facts.with_more(rig.motors)
        facts = replace(facts, attachments=(*facts.attachments, *rig.attachments))
    tell = teller("judge")
    source = open_source(options.file, options.max_memory)
    attachments = _note_truncation(source)
    describe = description_for(attachments, options.dbc, options.decoder, tell)
    from_ns, to_ns = span_of(
        options, options.file, span_in(options.file, options, options.max_memory), tell
    )
    seen = Seen()
    findings = judge(
        source,
        facts,
        only=options.only,
        from_ns=from_ns,
        to_ns=to_ns,
        note=lambda text: tell(f"{options.file}: {text}"),
        seen=seen,
    )
    if describe is not None:
        findings = _described(findings, source, describe)
    for given in options.eds:
        if not any(given.stands_for(*place) for place in seen.places):
            heard = ", ".join(f"{bus}:{node}" for bus, node in sorted(seen.places)) or "none"
            what = f"nothing of node {given.node} is in the recording; heard: {heard}"
            print(f"motorhil judge: --eds {given}: {what}", file=sys.stderr)
            return WRONG_USAGE
    if options.limits is not None and (strangers := _strangers(facts, seen)):
        print(f"{options.limits}: {strangers}", file=sys.stderr)
        return WRONG_USAGE
    verdict, status = _sum(findings)
    if options.json:
        tables = [finding.as_table() for finding in findings]
        incidents = [asdict(one) for one in seen.incidents]
        told = {"file": options.file, "verdict": verdict, "seen": incidents, "findings": tables}
        print(json.dumps(told))
    else:
        _print(findings, has_colours(options.color, sys.stdout))
        for incident in seen.incidents[:_SHOWN]:
            print(f"seen: {incident}")
        if len(seen.incidents) > _SHOWN:
            print(f"seen: {len(seen.incidents) - _SHOWN} more; --json has all")
        print(f"{options.file}: {verdict}: {_counts(findings)}{_count_of(seen)}")
    return status


def _strangers(facts: Facts, seen: Seen) -> str:
    """Return an error about motors with limits that the recording does not have, or ""."""
    known = ", ".join(sorted(seen.motors)) or "none"
    for name, motor in facts.motors.items():
        if motor.place is not None:
            bus, node = motor.place[:2]
            if motor.limits and (bus, node) not in seen.places:
                return f"motor.{name}: nothing of {bus} node {node} is in the recording"
        elif motor.limits and motor.controller is None and name not in seen.motors:
            return (
                f"motor.{name}: the recording has no such motor (it has: {known}); name one of"
                " them, or give its bus and node_id"
            )
    return ""


def _count_of(seen: Seen) -> str:
    """Return the number of faults, limits and alarms, for the last line."""
    count = sum(one.times for one in seen.incidents)
    return f"; {count} incident{'s' if count != 1 else ''} seen" if count else ""


def _sum(findings: Sequence[Finding]) -> tuple[str, int]:
    if is_sound(findings):
        return "sound, as far as it could be judged", PASSED
    if any(finding.verdict is Verdict.BROKEN for finding in findings):
        return "broken", FAILED
    return "not judged", NOT_JUDGED


def _counts(findings: Sequence[Finding]) -> str:
    verdicts = [finding.verdict for finding in findings]
    counts = [(verdicts.count(verdict), verdict.value) for verdict in Verdict]
    return ", ".join(f"{count} {word}" for count, word in counts if count)


def _print(findings: Sequence[Finding], in_colours: bool) -> None:
    rows = [(one.oracle, one.verdict.value, str(one.looked)) for one in findings]
    print_table(("oracle", "verdict", "looked at"), rows, (0, 1), in_colours)
    for one in findings:
        if one.first is not None:
            more = f"; {one.further} more" if one.further else ""
            doubt = "" if one.verdict is Verdict.BROKEN else "perhaps: "
            print(f"{one.oracle}: {doubt}{one.first}{more}")
        for message in one.messages:
            print(f"{one.oracle}: in this frame: {message}")
        if one.reason:
            print(f"{one.oracle}: {one.reason}")


def _list(only: Sequence[str], as_json: bool) -> None:
    chosen = [one for one in CATALOGUE if not only or one[0] in only]
    if as_json:
        head = ("oracle", "promise", "source", "cannot_judge")
        print(json.dumps([dict(zip(head, one, strict=True)) for one in chosen]))
        return
    for name, promise, source, needs in chosen:
        print(name)
        for text in (promise, f"source: {source}", f"cannot judge: {needs}"):
            print(textwrap.indent(textwrap.fill(text, _WIDTH), "    "))


def _note_truncation(source: Source) -> Sequence[Attachment]:
    """Print where a recording is cut, for it is judged up to there; return its attachments."""
    if source.format != "mcap":
        return ()
    with read_trace(source.path, source.memory_max) as trace:
        if trace.cut is not None:
            print(f"motorhil judge: {source.path}: {trace.cut}", file=sys.stderr)
        return trace.attachments


def _described(findings: Sequence[Finding], source: Source, describe: Describe) -> list[Finding]:
    """Return the findings with the messages in their frames."""
    moments = {(one.first.bus, one.first.time_ns) for one in findings if one.first is not None}
    told = messages_at(source, moments, describe)
    described: list[Finding] = []
    for one in findings:
        if one.first is not None:
            node = one.first.node
            messages = tuple(
                message
                for message in told.get((one.first.bus, one.first.time_ns), ())
                if not node or message.node in (None, node)
            )
            one = replace(one, messages=messages)
        described.append(one)
    return described
