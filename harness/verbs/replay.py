"""`motorhil replay FILE --as device|host|traffic`: a recording stands in for a side, or both."""

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
"""Where an option is kept, and which modes do anything with it; others all do."""
_FACTOR: Final = real(1e-3, 1e6)


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """What `replay` can be told."""
    parser.add_argument("file", type=Path, metavar="FILE", help="a recording (MCAP)")
    parser.add_argument(
        *("--as",),
        required=True,
        choices=list(_MODES),
        dest="mode",
        help="device: its devices answer SCRIPT as they did; host: its host drives a rig, and what "
        "the devices tell is compared; traffic: its frames are sent again, at their times",
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
        "--speed",
        type=_speed,
        metavar="X",
        help="pauses of the host, or all traffic, X times faster; max: traffic as fast as it goes",
    )
    parser.add_argument(
        "--patience",
        type=real(0.0, 1e6, "s"),
        default=2.0,
        metavar="S",
        help="how much longer than recorded the host waits for what was told (default 2)",
    )
    parser.add_argument(
        "--tolerance",
        type=real(0.0, 1e9),
        default=0.01,
        metavar="X",
        help="how far a quantity may be off, as a share of its own range (host; default 0.01)",
    )
    parser.add_argument(
        "--reset", action="store_true", help="reset all nodes first: they boot again (host)"
    )
    parser.add_argument("--all", action="store_true", help="tell all differences, not 20")
    _add_traffic(parser)
    parser.add_argument("--json", action="store_true", help="answer for a machine")


def _add_traffic(parser: argparse.ArgumentParser) -> None:
    traffic = parser.add_argument_group("of --as traffic; --on and --bitrate also of --as host")
    traffic.add_argument(
        "--on",
        action="append",
        default=[],
        metavar="[BUS=]WHERE",
        help="where a recorded bus is sent: as of `motorhil record`, or a bus of --rig",
    )
    traffic.add_argument("--bus", action="append", metavar="NAME", help="only this bus")
    traffic.add_argument(
        "--id", action="append", type=identifier, metavar="HEX", help="only this one"
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
        "--bitrate", type=whole(1, 10**8, "bit/s"), metavar="N", help="bit/s, of python-can's"
    )
    traffic.add_argument("--fd", action="store_true", help="CAN FD, of python-can's")


def _speed(text: str) -> float:
    try:
        return math.inf if text == "max" else _FACTOR(text)
    except argparse.ArgumentTypeError as error:
        raise argparse.ArgumentTypeError(f"{error}, nor max") from None


def run(options: argparse.Namespace) -> int:
    """Exit status: 0 passed, 1 it went otherwise than recorded.

    Raises:
        RigError, TraceError: a file cannot be used.
    """
    from harness.settings import refuse_source

    if options.mode != "traffic" and options.speed == math.inf:
        print("motorhil replay: --speed max is for --as traffic; say a number", file=sys.stderr)
        return WRONG_USAGE
    idle = [
        word
        for word, (name, modes) in _OF_MODES.items()
        if options.mode not in modes and getattr(options, name)
    ]
    if idle:
        told = f"{', '.join(idle)}: not of --as {options.mode}"
        print(f"motorhil replay: {told}; leave out what it does not do", file=sys.stderr)
        return WRONG_USAGE
    if options.output is not None:
        refuse_source(options.file, options.output)
    status: int = import_module(_MODES[options.mode]).run(options)
    return status
