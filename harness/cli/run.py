"""The verb `run`: runs a script, the programs of a rig, or a prompt, with a rig around it."""

import argparse
import code
import shlex
import sys
from collections.abc import Iterator, Sequence
from contextlib import ExitStack, contextmanager, suppress
from pathlib import Path
from typing import TYPE_CHECKING, Final, final

from motorhil.harness.cli.main import PASSED
from motorhil.harness.cli.options import add_seed, time_ns
from motorhil.harness.cli.printable import teller
from motorhil.harness.cli.viewing import (
    Beside,
    add_foxglove,
    add_pace,
    add_paused,
    add_view,
    chunk_ns,
    foxglove_words,
    page_of,
    record_for,
)
from motorhil.harness.python_can.hardware_names import bus_settings
from motorhil.harness.rig.config.toml import RigError
from motorhil.harness.rig.script import (
    Script,
    exit_status,
    print_error,
    read_script,
    run_script,
)
from motorhil.harness.virtual_time.standstill import Standstill, line_in, watched
from motorhil.harness.virtual_time.stdlib.install import in_virtual_time
from motorhil.traces.errors import TraceError

if TYPE_CHECKING:
    from motorhil.harness.hands.hands import Hands
    from motorhil.harness.rig.rig import Rig

_EPILOG: Final = """\
SCRIPT opens its bus with can.Bus(), as on real hardware: CAN_INTERFACE and CAN_CHANNEL name a bus
of the rig. Time passes while the script waits: time.sleep, clocks, threads, locks and queues use
the rig's clock; operations that cannot use it raise UsageError. Without SCRIPT, a prompt opens, in
which `rig` is the rig. With "-", the script is read from standard input. Arguments after -- go to
the script.
"""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the arguments of `run`."""
    parser.usage = (
        "motorhil run [-h] [--realtime] [--pace X] [--view] [--foxglove PORT] [--paused] "
        "[--seed N] [--until S] [--world FILE] [-o FILE] RIG [SCRIPT [ARGS ...]] [-- ARGS ...]"
    )
    parser.epilog = _EPILOG
    parser.add_argument(
        "rig",
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
    add_pace(parser)
    add_view(parser)
    add_foxglove(parser)
    add_paused(parser)
    add_seed(parser)
    parser.add_argument(
        "--until",
        type=time_ns,
        metavar="S",
        help="end the script at S seconds of the rig's time, as Ctrl-C would; exit status 0",
    )
    parser.add_argument(
        "--world",
        type=Path,
        metavar="FILE",
        help="disturb the rig: a fragment of `motorhil swarm`, or a recording with acts by hand",
    )
    parser.add_argument("-o", "--output", type=Path, metavar="FILE", help="record to FILE (MCAP)")


def run(options: argparse.Namespace) -> int:
    """Run the script; return its exit status, or 1 if it raised an exception.

    Raises:
        RigError: the rig, the script or the output file cannot be used; nothing was run.
    """
    from motorhil.harness.rig.rig import Rig

    if options.rig.suffix == ".py":
        raise RigError(
            options.rig, "is a Python program, not a rig", "name the rig first: run RIG SCRIPT"
        )
    words = [*options.args, *(options.rest or ())]
    script = None if options.script is None else read_script(options.script)
    if script is None and words:
        raise RigError(options.rig, "arguments, but no script to take them", "name a script")
    if options.paused and not options.view:
        raise RigError(options.rig, "--paused needs a page that lets time pass", "add --view")
    pace = 1.0 if options.realtime else options.pace
    hands = None
    with record_for(options.output, options.view) as target, ExitStack() as cleanup:
        rig = Rig.open(
            options.rig,
            seed=options.seed,
            record=target,
            world=options.world,
            pace=pace,
            chunk_ns=chunk_ns(pace, options.view),
        )
        if options.view and target is not None:
            cleanup.callback(rig.close)
            name = rig.description.name
            page = cleanup.enter_context(
                page_of(target, name, options.view_port, stays=True, more=foxglove_words(options))
            )
            hands = cleanup.enter_context(_hands_on(rig, page, pace, options.paused))
        status = _run(options, rig, script, words)
        if hands is not None and hands.count and (script or rig.description.programs):
            print(_handless(options, rig, words, hands.count), file=sys.stderr)
        if status != PASSED and script is not None:
            print(f"again: {_repeat_command(options, rig, words)}", file=sys.stderr)
    return status


@contextmanager
def _hands_on(rig: "Rig", page: Beside, pace: float | None, is_stopped: bool) -> "Iterator[Hands]":
    """Let the page act on the rig until the context ends."""
    from motorhil.harness.hands.brake import Brake
    from motorhil.harness.hands.channel import Channel
    from motorhil.harness.hands.hands import Hands

    hands = Hands(rig)
    brake = Brake(hands, Channel(page.requests, page.answers), pace, is_stopped)
    rig.runtime.follow(brake)
    try:
        yield hands
    finally:
        brake.end()


def _handless(options: argparse.Namespace, rig: "Rig", words: list[str], count: int) -> str:
    """Return how to repeat the run without hands."""
    acts = f"{count} act{'' if count == 1 else 's'} by hand"
    if options.output is None:
        return f"{acts}; -o FILE keeps them in a recording"
    again = argparse.Namespace(**{**vars(options), "world": options.output, "output": None})
    return f"{acts}; without hands: {_repeat_command(again, rig, words)}"


def _run(
    options: argparse.Namespace, rig: "Rig", script: Script | None, words: Sequence[str]
) -> int:
    """Run what was asked for, and close the rig; return the exit status."""
    for note in rig.notes:
        print(note, file=sys.stderr)
    end = _End(rig, options.until)
    try:
        if script is None and rig.description.programs:
            return _run_programs(rig)
        return run_judged(rig, script, words, "run")
    except KeyboardInterrupt:
        if not end.is_reached:
            raise
        return PASSED


def _run_programs(rig: "Rig") -> int:
    """Run the programs of the rig, each in its process; return 0 if none of them failed."""
    from motorhil.harness.shared_time.programs import run_programs

    try:
        with rig:
            wrong = run_programs(rig, lambda line: print(line, flush=True))
    except (RigError, TraceError, BrokenPipeError):
        raise
    except Exception as error:
        print_error(error, "<programs>")
        return 1
    for name, reason in wrong.items():
        print(f"motorhil run: program {name}: {reason}", file=sys.stderr)
    return 1 if wrong else PASSED


@final
class _End:
    """The end of a run at a time of the rig [ns], or none.

    Attributes:
        is_reached: True once it has ended the script.
    """

    def __init__(self, rig: "Rig", until_ns: int | None) -> None:
        self.is_reached = False
        self._runtime = rig.runtime
        self._alarm = rig.runtime.queue.alarm(self._expire)
        self._alarm.set(until_ns)

    def _expire(self, now_ns: int) -> None:
        self.is_reached = True
        self._runtime.interrupt()
        self._alarm.set(now_ns + 1_000_000_000)  # a script may go on after the first


def _repeat_command(options: argparse.Namespace, rig: "Rig", words: list[str]) -> str:
    script = [] if options.script is None else [options.script]
    command = ["motorhil", "run", str(options.rig), *script, "--seed", str(rig.seed)]
    if options.realtime:
        command.append("--realtime")
    if options.pace is not None:
        command += ["--pace", f"{options.pace:g}"]
    if options.until is not None:
        command += ["--until", f"{options.until / 1e9:.9g}"]
    if options.world is not None:
        command += ["--world", str(options.world)]
    if options.output is not None:
        command += ["-o", str(options.output)]
    if words:
        command += ["--", *words]
    return shlex.join(command)


def run_judged(
    rig: "Rig", script: Script | None, words: Sequence[str], verb: str, whole: bool = False
) -> int:
    """Run the program, or a prompt, with the rig open around it; then close the rig.

    Args:
        rig: the rig.
        script: the program; None: a prompt.
        words: its arguments.
        verb: the name of the verb on stderr.
        whole: True if it must send all commands that recorded controllers have.

    Returns:
        The program's exit status; 1 if it raised, or if recorded controllers could not answer its
        requests, or missed some. What was missed is told on stderr.

    Raises:
        RigError, TraceError, BrokenPipeError: errors of the rig, its record or the output.
    """
    from motorhil.harness.replay.verdict import never_came, summary, unanswered

    tell = teller(verb)
    try:
        with rig:
            if script is None:
                status = run_prompt(rig)
            else:
                watch = Standstill(rig.runtime, line_in(script.name), tell)
                with watched(watch):
                    status = run_script(rig, script, words)
            for line in (*rig.take_forgotten(), *summary(rig)):
                tell(line)
            status = status or int(bool(unanswered(rig) or (whole and never_came(rig))))
        if rig.recording is not None and rig.recording.error is not None:
            raise rig.recording.error  # the program may have handled it
        return status
    except (RigError, TraceError, BrokenPipeError):
        raise
    except Exception as error:  # of a party without a join, or while closing resources
        print_error(error, "<prompt>" if script is None else script.name)
        return 1


def run_prompt(rig: "Rig") -> int:
    """Run a Python prompt in which `rig` is the rig, until the user leaves it."""
    with suppress(ImportError):  # without readline the prompt lacks line editing
        import readline  # noqa: F401 -- importing is all it takes
    names = {"rig": rig, "__name__": "__console__", "__doc__": None}
    with bus_settings(rig.description.buses), in_virtual_time(rig):
        try:
            _Prompt(names).interact(_banner(rig), exitmsg="")
        except SystemExit as leaving:
            return exit_status(leaving)
    return 0


@final
class _Prompt(code.InteractiveConsole):
    """Python's console, but with errors printed as for scripts."""

    def showtraceback(self) -> None:
        error = sys.exc_info()[1]
        if error is not None:
            sys.last_value = error
            print_error(error, self.filename)


def _banner(rig: "Rig") -> str:
    return (
        f"{rig.description.name}: motors {', '.join(rig.motors) or 'none'}; "
        "time passes while you wait: rig.runtime.run_for(1.0). Leave with Ctrl-D."
    )
