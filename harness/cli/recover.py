"""The verb `recover`: recovers messages of a cut or damaged recording."""

import argparse
import json
import os
import sys
from typing import Final

from motorhil.harness.cli.main import PASSED
from motorhil.harness.cli.options import add_max_memory

_NS: Final = 1_000_000_000


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the arguments of `recover`."""
    parser.add_argument("file", metavar="FILE", help="a recording (MCAP), cut or damaged")
    parser.add_argument("-o", "--output", required=True, metavar="WHOLE", help="file to write")
    parser.add_argument("--force", action="store_true", help="overwrite an existing file")
    add_max_memory(parser)
    parser.add_argument("--json", action="store_true", help="print JSON")


def run(options: argparse.Namespace) -> int:
    """Write the recovered recording, and print what was left out; return 0.

    Raises:
        TraceError: the file is not a recording, or the new one cannot be written.
    """
    from motorhil.harness.cli.progress import following
    from motorhil.traces.mcap.recovery import recover

    size = os.path.getsize(options.file) if os.path.isfile(options.file) else None
    with following("recover", [options.output], size):  # it maps the file, and writes as it reads
        done = recover(options.file, options.output, options.force, options.max_memory)
    span_ns = (done.last_ns or 0) - (done.first_ns or 0)
    if options.json:
        losses = [
            {
                "offset": loss.offset,
                "bytes": loss.size,
                "what": loss.what,
                "first_ns": loss.first_ns,
                "last_ns": loss.last_ns,
                "messages": loss.messages,
            }
            for loss in done.losses
        ]
        facts = {
            "target": options.output,
            "messages": done.messages,
            "expected": done.expected,
            "salvaged": done.salvaged,
            "span_ns": span_ns,
            "lost_bytes": done.lost_bytes,
            "lost_ns": done.lost_ns,
            "losses": losses,
            "nameless": done.nameless,
        }
        print(json.dumps(facts))
        return PASSED
    for loss in done.losses:
        print(f"{options.file}: {loss}", file=sys.stderr)
    for number in dict.fromkeys(done.nameless):
        text = f"channel {number} has no description; its messages are in /channel/{number}"
        print(f"{options.file}: {text}", file=sys.stderr)
    lost = "nothing is lost"
    if done.losses:
        lost = f"{done.lost_bytes} bytes and {done.lost_ns / _NS:.3f} s are lost"
    if done.expected is not None and done.expected > done.messages:
        lost += f", {done.expected - done.messages} messages"
    print(f"{options.output}: {done.messages} messages in {span_ns / _NS:.3f} s; {lost}")
    return PASSED
