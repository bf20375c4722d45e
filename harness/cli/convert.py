"""The verb `convert`: converts recorded traffic between formats."""

import argparse
import json
import sys
from typing import TYPE_CHECKING, Final

from motorhil.harness.cli.main import FAILED, PASSED, WRONG_USAGE
from motorhil.harness.cli.options import add_eds, add_max_memory, attachments_of

if TYPE_CHECKING:
    from motorhil.harness.recording.conversion import Conversion

_SHOWN: Final = 20


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the arguments of `convert`."""
    from motorhil.harness.recording.conversion import MODBUS_PCAPNG
    from motorhil.traces.formats.registry import WRITABLE

    names = ["mcap", *(known.name for known in WRITABLE), MODBUS_PCAPNG]
    parser.add_argument("source", metavar="SOURCE", help="a recording of any format")
    parser.add_argument("-o", "--output", required=True, metavar="TARGET", help="file to write")
    parser.add_argument("--to", choices=names, help="format to write (default: from the ending)")
    add_eds(parser)
    parser.add_argument("--force", action="store_true", help="overwrite an existing file")
    parser.add_argument(
        "--strict", action="store_true", help="exit 1 if anything was not readable or is lost"
    )
    parser.add_argument("--all", action="store_true", help=f"print all problems, not only {_SHOWN}")
    parser.add_argument("--json", action="store_true", help="print JSON")
    add_max_memory(parser)


def run(options: argparse.Namespace) -> int:
    """Write the target, and print which records were not readable and which facts are lost.

    Raises:
        TraceError: the source cannot be read, or the target cannot be written.
    """
    from motorhil.harness.recording.conversion import convert, format_of_ending

    name = options.to or format_of_ending(options.output)
    if name is None:
        print(
            f"motorhil convert: {options.output}: no format for this ending; use --to FORMAT",
            file=sys.stderr,
        )
        return WRONG_USAGE
    attachments = attachments_of(options.eds)
    if attachments and name != "mcap":
        print(f"motorhil convert: --eds: {name} holds no EDS; write mcap", file=sys.stderr)
        return WRONG_USAGE
    source, target, memory_max = options.source, options.output, options.max_memory
    done = convert(source, target, name, options.force, attachments, memory_max)
    found = done.findings
    if options.json:
        facts = {
            "source": done.source.path,
            "read_as": done.source.format,
            "target": done.target,
            "written_as": done.format,
            "frames": found.frames,
            "buses": done.buses,
            "unstamped": found.unstamped,
            "stamped_backward": found.backward,
            "largest_step_back_ns": found.largest_step_back_ns,
            "comments": found.comments,
            "notes": found.notes,
            "problems": [{"line": p.line, "text": p.text} for p in found.problems],
            "lost": {str(what.name).lower(): count for what, count in done.lost.items()},
        }
        print(json.dumps(facts))
    else:
        shown = found.problems if options.all else found.problems[:_SHOWN]
        for line, text in shown:
            print(f"{done.source.path}:{line}: {text}", file=sys.stderr)
        if len(shown) < len(found.problems):
            more = len(found.problems) - len(shown)
            print(f"{done.source.path}: {more} more problems: --all", file=sys.stderr)
        for note in _notes(done):
            print(f"{done.source.path}: {note}", file=sys.stderr)
        unread = f", {len(found.problems)} not readable" if found.problems else ""
        print(
            f"{done.target}: {found.frames} {_unit_of(done)} of {', '.join(done.buses)}, "
            f"from {done.source.format} to {done.format}{unread}"
        )
    return FAILED if options.strict and (found.problems or done.lost) else PASSED


def _notes(done: "Conversion") -> list[str]:
    found = done.findings
    notes = list(found.notes)
    if found.unstamped:
        notes.append(f"{found.unstamped} frames have no time stamp: their time is 0")
    if found.backward:
        back_s = found.largest_step_back_ns / 1e9
        notes.append(
            f"{found.backward} frames have an earlier time stamp than the one before, by up to "
            f"{back_s:.6f} s: order and time stamps are kept"
        )
    for what, count in done.lost.items():
        feature = str(what.name).lower().replace("_", " ")
        notes.append(f"lost, {done.format} cannot hold it: {feature} of {count} {_unit_of(done)}")
    return notes


def _unit_of(done: "Conversion") -> str:
    return "ADUs" if done.is_modbus else "frames"
