"""`motorhil replay FILE --as device|host`: a recording stands in for one side of the bus."""

import argparse
from importlib import import_module
from pathlib import Path
from typing import Final

from harness.seed_option import add_seed

_MODES: Final = {
    "device": "harness.replay.device_verb",
    "host": "harness.replay.host_verb",
}


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """What `replay` can be told."""
    parser.add_argument("file", type=Path, metavar="FILE", help="a recording (MCAP)")
    parser.add_argument(
        *("--as",),
        required=True,
        choices=list(_MODES),
        dest="mode",
        help="device: its devices answer SCRIPT as they did; host: its host drives a rig, and what "
        "the devices tell is compared",
    )
    parser.add_argument("script", nargs="?", metavar="SCRIPT", help="a Python program, or -")
    parser.add_argument("args", nargs="*", default=[], metavar="ARGS", help="of the script")
    parser.add_argument(
        "--rig", type=Path, metavar="RIG", help="a rig file (default: the recording's own rig)"
    )
    parser.add_argument(
        "--set-points",
        choices=("exact", "any"),
        default="exact",
        help="any: values of set-points in PDOs may be others than recorded (device)",
    )
    parser.add_argument("--realtime", action="store_true", help="no faster than the wall clock")
    add_seed(parser)
    parser.add_argument("-o", "--output", type=Path, metavar="FILE", help="record to FILE (MCAP)")
    parser.add_argument(
        "--speed", type=float, metavar="X", help="pauses of the host X times faster"
    )
    parser.add_argument(
        "--patience",
        type=float,
        default=2.0,
        metavar="S",
        help="how long the host waits for what was told in the recording (default 2)",
    )
    parser.add_argument(
        "--tolerance",
        type=float,
        default=0.01,
        metavar="X",
        help="how far a motor may be off, rad or m (default 0.01)",
    )
    parser.add_argument("--all", action="store_true", help="tell all differences, not 20")
    parser.add_argument("--json", action="store_true", help="answer for a machine")


def run(options: argparse.Namespace) -> int:
    """Exit status: 0 passed, 1 it went otherwise than recorded.

    Raises:
        RigError, TraceError: a file cannot be used.
    """
    status: int = import_module(_MODES[options.mode]).run(options)
    return status
