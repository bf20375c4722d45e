"""The verb `replay`: a recording stands in for devices, host, or both."""

import argparse
import math
import sys
from importlib import import_module
from pathlib import Path
from typing import Final

from harness.exit_status import WRONG_USAGE
from harness.number_options import identifier, real, time_ns, whole
from harness.seed_option import add_seed

_MODES: Final = {
    "device": "harness.replay.device_verb",
    "host": "harness.replay.host_verb",
    "traffic": "harness.replay.traffic_verb",
}


_OF_MODES: Final = {
    "SCRIPT": ("script", ("device",)),
    "--on": ("on", ("host", "traffic")),
    "--bitrate": ("bitrate", ("host", "traffic")),
    "--speed": ("speed", ("host", "traffic")),
    "--json": ("json", ("host", "traffic")),
    "--reset": ("reset", ("host",)),
    "--all": ("all", ("host",)),
    "--bus": ("bus", ("traffic",)),
    "--id": ("id", ("traffic",)),
    "--node": ("node", ("traffic",)),
    "--from": ("from_ns", ("traffic",)),
    "--to": ("to_ns", ("traffic",)),
    "--fd": ("fd", ("traffic",)),
}
"""Options that apply only to some modes: their attribute and these modes."""
_FACTOR: Final = real(1e-3, 1e6)


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the arguments of `replay`."""
    parser.add_argument("file", type=Path, metavar="FILE", help="a recording (MCAP)")
    parser.add_argument(
        *("--as",),
        required=True,
        choices=list(_MODES),
        dest="mode",
        help="device: its devices answer SCRIPT as recorded; host: its host drives a rig, and the "
        "answers are compared; traffic: its frames are sent again at their times",
    )
    parser.add_argument("script", nargs="?", metavar="SCRIPT", help="a Python program, or -")
    parser.add_argument(
        "args", nargs="*", default=[], metavar="ARGS", help="arguments of the script"
    )
    parser.add_argument(
        "--rig", type=Path, metavar="RIG", help="a rig file (default: the recording's own rig)"
    )
    parser.add_argument(
        "--set-points",
        choices=("exact", "any"),
        default="exact",
        help="any: set-points in PDOs may differ (device)",
    )
    parser.add_argument(
        "--realtime", action="store_true", help="run at most as fast as the wall clock"
    )
    add_seed(parser)
    parser.add_argument("-o", "--output", type=Path, metavar="FILE", help="record to FILE (MCAP)")
    parser.add_argument(
        "--speed",
        type=_speed,
        metavar="X",
        help="pauses of the host, or all traffic, X times faster; max: traffic without pauses",
    )
    parser.add_argument(
        "--patience",
        type=real(0.0, 1e6, "s"),
        default=2.0,
        metavar="S",
        help="how much longer than recorded the host waits for an answer (default 2)",
    )
    parser.add_argument(
        "--tolerance",
        type=real(0.0, 1e9),
        default=0.01,
        metavar="X",
        help="tolerance of a quantity, as a share of its range (host; default 0.01)",
    )
    parser.add_argument("--reset", action="store_true", help="reset all nodes first (host)")
    parser.add_argument("--all", action="store_true", help="print all differences, not only 20")
    _add_traffic(parser)
    parser.add_argument("--json", action="store_true", help="print JSON")


def _add_traffic(parser: argparse.ArgumentParser) -> None:
    traffic = parser.add_argument_group("for --as traffic; --on and --bitrate also for --as host")
    traffic.add_argument(
        "--on",
        action="append",
        default=[],
        metavar="[BUS=]WHERE",
        help="target of a recorded bus: as in `motorhil record`, or a bus of --rig",
    )
    traffic.add_argument("--bus", action="append", metavar="NAME", help="only this bus")
    traffic.add_argument(
        "--id", action="append", type=identifier, metavar="HEX", help="only this identifier"
    )
    traffic.add_argument(
        "--node",
        action="append",
        type=whole(1, 127),
        metavar="N",
        help="only this node",
    )
    traffic.add_argument("--from", type=time_ns, dest="from_ns", metavar="S", help="from this time")
    traffic.add_argument("--to", type=time_ns, dest="to_ns", metavar="S", help="before this time")
    traffic.add_argument(
        "--bitrate", type=whole(1, 10**8, "bit/s"), metavar="N", help="bit rate, for python-can"
    )
    traffic.add_argument("--fd", action="store_true", help="CAN FD, for python-can")


def _speed(text: str) -> float:
    try:
        return math.inf if text == "max" else _FACTOR(text)
    except argparse.ArgumentTypeError as error:
        raise argparse.ArgumentTypeError(f"{error}, nor max") from None


def run(options: argparse.Namespace) -> int:
    """Replay a recording; return 0 if it passed, 1 if it differs from the recording.

    Raises:
        RigError, TraceError: a file cannot be used.
    """
    from harness.settings import refuse_source

    if options.mode != "traffic" and options.speed == math.inf:
        print("motorhil replay: --speed max is for --as traffic; give a number", file=sys.stderr)
        return WRONG_USAGE
    idle = [
        word
        for word, (name, modes) in _OF_MODES.items()
        if options.mode not in modes and getattr(options, name)
    ]
    if idle:
        told = f"{', '.join(idle)}: not for --as {options.mode}"
        print(f"motorhil replay: {told}; leave out these options", file=sys.stderr)
        return WRONG_USAGE
    if options.output is not None:
        refuse_source(options.file, options.output)
    status: int = import_module(_MODES[options.mode]).run(options)
    return status
