"""`motorhil replay FILE --as device SCRIPT`: an application against recorded devices."""

import argparse
import shlex
import sys
from typing import TYPE_CHECKING

from harness.exit_status import PASSED

if TYPE_CHECKING:
    from harness.rig import Rig
    from harness.rig_file import RigDescription


def run(options: argparse.Namespace) -> int:
    """Return the script's exit status; 1 if it raised or sent an unanswerable command.

    Raises:
        RigError: the recording, the rig or the script cannot be used.
    """
    from harness.rig import Rig
    from harness.script import read_script, run_judged

    words = [*options.args, *(options.rest or ())]
    script = None if options.script is None else read_script(options.script)
    rig = Rig(
        _described(options), seed=options.seed, realtime=options.realtime, record=options.output
    )
    status = run_judged(rig, script, words, "replay")
    if status != PASSED and script is not None:
        print(f"again: {_again(options, rig, words)}", file=sys.stderr)
    return status


def _described(options: argparse.Namespace) -> "RigDescription":
    from harness.replay.recorded_rig import with_recorded
    from harness.rig import describe

    rig = describe(options.file if options.rig is None else options.rig)
    return with_recorded(rig, options.file, options.set_points)


def _again(options: argparse.Namespace, rig: "Rig", words: list[str]) -> str:
    command = ["motorhil", "replay", str(options.file), "--as", "device", options.script]
    command += ["--seed", str(rig.seed)]
    if options.rig is not None:
        command += ["--rig", str(options.rig)]
    if options.set_points != "exact":
        command += ["--set-points", options.set_points]
    if options.realtime:
        command.append("--realtime")
    if options.output is not None:
        command += ["-o", str(options.output)]
    return shlex.join([*command, "--", *words] if words else command)
