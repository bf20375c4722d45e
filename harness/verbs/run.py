"""The verb `run`: runs a script, or a prompt, with a rig."""

import argparse
import shlex
import sys
from pathlib import Path
from typing import TYPE_CHECKING

from harness.exit_status import PASSED
from harness.seed_option import add_seed
from harness.settings import RigError

if TYPE_CHECKING:
    from harness.rig import Rig

_MORE = """\
SCRIPT opens its bus with can.Bus(), as on real hardware: CAN_INTERFACE and CAN_CHANNEL name a bus
of the rig. Time passes while the script waits: time.sleep, clocks, threads, locks and queues use
the rig's clock; operations that cannot use it raise UsageError. Without SCRIPT, a prompt opens, in
which `rig` is the rig. With "-", the script is read from standard input. Arguments after -- go to
the script.
"""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the arguments of `run`."""
    parser.usage = (
        "motorhil run [-h] [--realtime] [--seed N] [-o FILE] RIG [SCRIPT [ARGS ...]] [-- ARGS ...]"
    )
    parser.epilog = _MORE
    parser.add_argument(
        *("rig",),
        type=Path,
        metavar="RIG",
        help="a rig file (TOML), or a recording in place of its devices",
    )
    parser.add_argument("script", nargs="?", metavar="SCRIPT", help="a Python program, or -")
    parser.add_argument(
        "args", nargs="*", default=[], metavar="ARGS", help="the script's own arguments"
    )
    parser.add_argument(
        "--realtime", action="store_true", help="run at most as fast as the wall clock"
    )
    add_seed(parser)
    parser.add_argument("-o", "--output", type=Path, metavar="FILE", help="record to FILE (MCAP)")


def run(options: argparse.Namespace) -> int:
    """Run the script; return its exit status, or 1 if it raised an exception.

    Raises:
        RigError: the rig, the script or the output file cannot be used; nothing was run.
    """
    from harness.rig import Rig
    from harness.script import read_script, run_judged

    words = [*options.args, *(options.rest or ())]
    script = None if options.script is None else read_script(options.script)
    if script is None and words:
        raise RigError(options.rig, "arguments, but no script to take them", "name a script")
    rig = Rig.open(options.rig, seed=options.seed, realtime=options.realtime, record=options.output)
    for note in rig.notes:
        print(note, file=sys.stderr)
    status = run_judged(rig, script, words, "run")
    if status != PASSED and script is not None:
        print(f"again: {_again(options, rig, words)}", file=sys.stderr)
    return status


def _again(options: argparse.Namespace, rig: "Rig", words: list[str]) -> str:
    command = ["motorhil", "run", str(options.rig), options.script, "--seed", str(rig.seed)]
    if options.realtime:
        command.append("--realtime")
    if options.output is not None:
        command += ["-o", str(options.output)]
    if words:
        command += ["--", *words]
    return shlex.join(command)
