"""`motorhil run RIG [SCRIPT [ARGS]]`: a script, or a prompt, with a rig around it."""

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
SCRIPT opens its bus with can.Bus(), as it would on real hardware: CAN_INTERFACE and CAN_CHANNEL say
that it joins the rig. Time passes while the script waits: time.sleep, clocks, threads, locks and
queues go by the rig, each thread in its turn; what cannot is refused by name. Without SCRIPT, a
prompt in which `rig` is the rig; with "-", the script is read from standard input. What follows --
goes to the script.
"""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """What `run` can be told."""
    parser.usage = (
        "motorhil run [-h] [--realtime] [--seed N] [-o FILE] RIG [SCRIPT [ARGS ...]] [-- ARGS ...]"
    )
    parser.epilog = _MORE
    parser.add_argument(
        *("rig",),
        type=Path,
        metavar="RIG",
        help="a rig file (TOML); or a recording, which then stands in for its devices",
    )
    parser.add_argument("script", nargs="?", metavar="SCRIPT", help="a Python program, or -")
    parser.add_argument(
        "args", nargs="*", default=[], metavar="ARGS", help="the script's own arguments"
    )
    parser.add_argument("--realtime", action="store_true", help="no faster than the wall clock")
    add_seed(parser)
    parser.add_argument("-o", "--output", type=Path, metavar="FILE", help="record to FILE (MCAP)")


def run(options: argparse.Namespace) -> int:
    """The script's exit status; 1 if it raised.

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
