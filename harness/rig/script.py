"""Program of a user, run as `__main__` in the time of an open rig."""

import builtins
import linecache
import os
import sys
import threading
import traceback
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from types import CodeType, ModuleType
from typing import TYPE_CHECKING, Final, Self, final

from motorhil.frozen import frozen
from motorhil.harness.python_can.hardware_names import bus_settings
from motorhil.harness.rig.config.toml import RigError
from motorhil.harness.rig.names import NoSuchName
from motorhil.harness.virtual_time.interrupts import exit_handlers
from motorhil.harness.virtual_time.stdlib.install import in_virtual_time
from motorhil.harness.virtual_time.stdlib.threads import join_executors

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
OnError = Callable[[BaseException, str], None]
"""Called with an exception that ended the program or one of its threads, and the program's name."""


@final
@frozen
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


def run_script(
    rig: "Rig", script: Script, words: Sequence[str], on_error: "OnError | None" = None
) -> int:
    """Run the program as `__main__`; return its exit status, or 1 if it raised.

    Exceptions, also those of its threads, go to `on_error`. By default they are printed on stderr,
    starting at its own first line. KeyboardInterrupt propagates. As with Python itself, the program
    ends when its threads have ended.
    """
    report = on_error or print_error
    main = ModuleType("__main__")
    main.__dict__.update(__file__=script.name, __builtins__=builtins)
    if script.name == _STDIN_NAME:  # lets tracebacks quote its lines
        lines = script.source.decode("utf-8", "replace").splitlines(keepends=True)
        linecache.cache[_STDIN_NAME] = (len(script.source), None, lines, _STDIN_NAME)
    with (
        _as_main(main, script, words),
        bus_settings(rig.description.buses),
        _Threads(rig, script.name, report) as threads,
        in_virtual_time(rig),
        exit_handlers() as handlers,
    ):
        try:
            status = _run(rig, script, main, report)
            threads.join()
            rig.send_queued()
        finally:
            handlers.run(lambda error: report(error, script.name))
    return status or int(threads.failed)


def _run(rig: "Rig", script: Script, main: ModuleType, report: OnError) -> int:
    """Run the program's own lines; return its exit status."""
    try:
        program: CodeType = compile(script.source, script.name, "exec", dont_inherit=True)
        exec(program, main.__dict__)
    except SystemExit as leaving:
        return exit_status(leaving)
    except BrokenPipeError:
        raise  # the reader of its output has left: as with any command
    except Exception as error:
        if rig.recording is not None and error is rig.recording.error:
            raise  # the record failed, not the program
        report(error, script.name)
        return 1
    return 0


@final
class _Threads:
    """The threads that a program starts; an exception in them is the program's failure.

    Attributes:
        failed: True if a thread raised an exception.
    """

    def __init__(self, rig: "Rig", script: str, report: OnError) -> None:
        self.failed = False
        self._rig = rig
        self._script = script
        self._on_error = report
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
            self._on_error(raised.exc_value, self._script)

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


def exit_status(leaving: SystemExit) -> int:
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
