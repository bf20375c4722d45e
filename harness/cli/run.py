"""The verb `run`: runs a script, the programs of a rig, or a prompt, with a rig around it."""

import argparse
import builtins
import code
import linecache
import os
import shlex
import sys
import threading
import traceback
from collections.abc import Iterator, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from pathlib import Path
from types import CodeType, ModuleType
from typing import TYPE_CHECKING, Final, Self, final

from motorhil.harness.cli.main import PASSED
from motorhil.harness.cli.options import add_seed, time_ns
from motorhil.harness.cli.printable import teller
from motorhil.harness.python_can.hardware_names import bus_settings
from motorhil.harness.rig.config.toml import RigError
from motorhil.harness.rig.rig import NoSuchName
from motorhil.harness.virtual_time.interrupts import exit_handlers
from motorhil.harness.virtual_time.standstill import Standstill, line_in, watched
from motorhil.harness.virtual_time.stdlib.install import in_virtual_time
from motorhil.harness.virtual_time.stdlib.threads import join_executors
from motorhil.traces.errors import TraceError

if TYPE_CHECKING:
    from motorhil.harness.rig.rig import Rig

STDIN: Final = "-"
_STDIN_NAME: Final = "<stdin>"
_PATIENCE_S: Final = 1.0
_OWN_FOLDER: Final = str(Path(__file__).parents[3]) + os.sep
_OWN_PACKAGES: Final = tuple(
    folder + "motorhil" + os.sep
    for folder in (_OWN_FOLDER, "")  # compiled modules do not know their path
)
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
        "motorhil run [-h] [--realtime] [--seed N] [--until S] [-o FILE] RIG [SCRIPT [ARGS ...]] "
        "[-- ARGS ...]"
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
    add_seed(parser)
    parser.add_argument(
        "--until",
        type=time_ns,
        metavar="S",
        help="end the script at S seconds of the rig's time, as Ctrl-C would; exit status 0",
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
    rig = Rig.open(options.rig, seed=options.seed, realtime=options.realtime, record=options.output)
    for note in rig.notes:
        print(note, file=sys.stderr)
    end = _End(rig, options.until)
    try:
        if script is None and rig.description.programs:
            return _run_programs(rig)
        status = run_judged(rig, script, words, "run")
    except KeyboardInterrupt:
        if not end.is_reached:
            raise
        status = PASSED
    if status != PASSED and script is not None:
        print(f"again: {_repeat_command(options, rig, words)}", file=sys.stderr)
    return status


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
    command = ["motorhil", "run", str(options.rig), options.script, "--seed", str(rig.seed)]
    if options.realtime:
        command.append("--realtime")
    if options.until is not None:
        command += ["--until", f"{options.until / 1e9:.9g}"]
    if options.output is not None:
        command += ["-o", str(options.output)]
    if words:
        command += ["--", *words]
    return shlex.join(command)


@final
@dataclass(frozen=True, slots=True)
class Script:
    """A Python program: its name in tracebacks, its source and its folder."""

    name: str
    source: bytes
    folder: str


def read_script(name: str) -> Script:
    """Read the program in a file, or from standard input if the name is "-".

    Raises:
        RigError: the file does not exist, or is not readable.
    """
    if name == STDIN:
        return Script(_STDIN_NAME, sys.stdin.buffer.read(), "")
    path = Path(name)
    try:
        return Script(name, path.read_bytes(), str(path.resolve().parent))
    except FileNotFoundError:
        raise RigError(path, "no such file", "name a Python program") from None
    except (OSError, ValueError) as error:
        reason = getattr(error, "strerror", None) or error
        raise RigError(path, f"cannot be read: {reason}", "name a Python program") from None


def run_script(rig: "Rig", script: Script, words: Sequence[str]) -> int:
    """Run the program as `__main__`; return its exit status, or 1 if it raised.

    Exceptions, also those of its threads, are printed on stderr, starting at its own first line.
    KeyboardInterrupt propagates. As with Python itself, the program ends when its threads have
    ended.
    """
    main = ModuleType("__main__")
    main.__dict__.update(__file__=script.name, __builtins__=builtins)
    if script.name == _STDIN_NAME:  # lets tracebacks quote its lines
        lines = script.source.decode("utf-8", "replace").splitlines(keepends=True)
        linecache.cache[_STDIN_NAME] = (len(script.source), None, lines, _STDIN_NAME)
    with (
        _as_main(main, script, words),
        bus_settings(rig.description.buses),
        _Threads(rig, script.name) as threads,
        in_virtual_time(rig),
        exit_handlers() as handlers,
    ):
        try:
            status = _run(rig, script, main)
            threads.join()
            rig.send_queued()
        finally:
            handlers.run(lambda error: print_error(error, script.name))
    return status or int(threads.failed)


def _run(rig: "Rig", script: Script, main: ModuleType) -> int:
    """Run the program's own lines; return its exit status."""
    try:
        program: CodeType = compile(script.source, script.name, "exec", dont_inherit=True)
        exec(program, main.__dict__)
    except SystemExit as leaving:
        return _status(leaving)
    except BrokenPipeError:
        raise  # the reader of its output has left: as with any command
    except Exception as error:
        if rig.recording is not None and error is rig.recording.error:
            raise  # the record failed, not the program
        print_error(error, script.name)
        return 1
    return 0


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


@final
class _Threads:
    """The threads that a program starts; an exception in them is the program's failure.

    Attributes:
        failed: True if a thread raised an exception.
    """

    def __init__(self, rig: "Rig", script: str) -> None:
        self.failed = False
        self._rig = rig
        self._script = script
        self._before = threading.enumerate()
        self._hook = threading.excepthook

    def __enter__(self) -> Self:
        threading.excepthook = self._report
        return self

    def __exit__(self, *_: object) -> None:
        threading.excepthook = self._hook

    def _report(self, raised: threading.ExceptHookArgs) -> None:
        recording = self._rig.recording
        if recording is not None and raised.exc_value is recording.error:
            return  # the record failed, not the program; `run_judged` reports it
        if raised.exc_value is not None and not isinstance(raised.exc_value, SystemExit):
            self.failed = True
            print_error(raised.exc_value, self._script)

    def join(self) -> None:
        """Wait for all threads except daemons; report a thread that runs for more than a second."""
        join_executors()
        for thread in threading.enumerate():
            if thread in self._before or thread.daemon:
                continue
            thread.join(_PATIENCE_S)
            if thread.is_alive():
                print(
                    f"{self._script} has ended, but its thread {thread.name!r} still runs; "
                    "Ctrl-C ends it",
                    file=sys.stderr,
                )
                thread.join()


def run_prompt(rig: "Rig") -> int:
    """Run a Python prompt in which `rig` is the rig, until the user leaves it."""
    with suppress(ImportError):  # without readline the prompt lacks line editing
        import readline  # noqa: F401 -- importing is all it takes
    names = {"rig": rig, "__name__": "__console__", "__doc__": None}
    with bus_settings(rig.description.buses), in_virtual_time(rig):
        try:
            _Prompt(names).interact(_banner(rig), exitmsg="")
        except SystemExit as leaving:
            return _status(leaving)
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


@contextmanager
def _as_main(main: ModuleType, script: Script, words: Sequence[str]) -> Iterator[None]:
    before = (sys.argv, sys.path.copy(), sys.modules["__main__"])
    sys.argv = [script.name, *words]
    sys.path.insert(0, script.folder)
    sys.modules["__main__"] = main
    try:
        yield
    finally:
        sys.argv, sys.path[:], sys.modules["__main__"] = before


def _status(leaving: SystemExit) -> int:
    """Return the exit status that Python itself would give for sys.exit(...)."""
    if leaving.code is None:
        return 0
    if isinstance(leaving.code, int):
        return leaving.code & 0xFF
    print(leaving.code, file=sys.stderr)
    return 1


def print_error(error: BaseException, script: str) -> None:
    """Print the traceback on stderr, reduced to the lines that the script's author needs.

    It begins in the script and omits frames between the script's lines. It also omits frames after
    the last of them if the motor interface or python-can raised the error deliberately. An
    unexpected error from inside is printed in full.
    """
    on_purpose = is_on_purpose(error)
    report = traceback.TracebackException.from_exception(error)
    if on_purpose:
        report.__cause__ = report.__context__ = None
    links = [report]
    for link in links:
        link.stack = _frames_of(link.stack, script, on_purpose)
        links += [other for other in (link.__cause__, link.__context__) if other is not None]
    in_script = any(frame.filename == script for frame in report.stack)
    is_no_python = isinstance(error, SyntaxError) and not in_script
    lines = report.format_exception_only() if is_no_python else report.format()
    print("".join(lines), end="", file=sys.stderr)


def is_on_purpose(error: BaseException) -> bool:
    """Return True if the motor interface, python-can or a rig raised it for its caller."""
    kinds = [f"{kind.__module__}.{kind.__name__}" for kind in type(error).__mro__]
    return (
        "motorhil.motorapi.errors.MotorError" in kinds
        or "can.exceptions.CanError" in kinds
        or isinstance(error, RigError | NoSuchName)
    )


def _frames_of(
    stack: traceback.StackSummary, script: str, on_purpose: bool
) -> traceback.StackSummary:
    frames = list(stack)
    places = [number for number, frame in enumerate(frames) if frame.filename == script]
    if places:
        frames = frames[places[0] :]
    folder = str(Path(script).resolve().parent) + os.sep
    users: list[traceback.FrameSummary] = []
    inside: list[traceback.FrameSummary] = []  # from one of our frames up to the user's next one
    for frame in frames:
        own = frame.filename != script and is_own_file(frame.filename)
        is_users = frame.filename == script or (frame.filename.startswith(folder) and not own)
        if is_users or not (own or inside):
            users.append(frame)
            inside = []
        else:
            inside.append(frame)
    in_full = bool(inside) and not on_purpose
    return traceback.StackSummary.from_list(frames if in_full else users)


def is_own_file(filename: str) -> bool:
    """Return True if a code file belongs to these packages."""
    return filename.startswith(_OWN_PACKAGES)
