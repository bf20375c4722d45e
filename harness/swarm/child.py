"""Child process: calls in a forked process, whatever becomes of it there.

A program under test may hang, crash, leave its process, fork, close all file descriptors, or leave
processes behind. The child has a process group of its own, nothing to read and nobody to print to.
On Linux the kernel ends it when its parent ends, and its orphans become children of the parent.
"""

import ctypes
import gc
import os
import select
import signal
import sys
import sysconfig
import threading
import time
from collections.abc import Callable, Generator, Iterable, Set
from contextlib import suppress
from pathlib import Path
from typing import Final, NoReturn, final

from motorhil.frozen import frozen

CLOSED: Final = 121
"""Exit status of a child whose answer could not be sent: its file descriptors were closed."""
_SET_PDEATHSIG, _SET_CHILD_SUBREAPER = 1, 36  # prctl(2)
_BYTES: Final = 1 << 16
_END: Final = b"\x04"
"""The line after the last one."""
_LOOK_S: Final = 0.005
_GARBAGE: Final = 100_000
"""Objects until garbage is looked for: a short world ends before."""
_FILES: Final = "/proc/self/fd" if sys.platform == "linux" else "/dev/fd"
_LIBRARIES: Final = tuple(
    sysconfig.get_path(name) + os.sep for name in ("stdlib", "platstdlib", "purelib", "platlib")
)
_prctl = ctypes.CDLL(None).prctl if sys.platform == "linux" else None


@final
@frozen
class Ended:
    """The end of a child.

    Attributes:
        text: its last line; None if it ended before.
        status: its status, as of waitpid.
        is_late: True if it took too long.
    """

    text: bytes | None
    status: int
    is_late: bool


def adopt_orphans() -> None:
    """Let processes whose parents end become children of this one, where the system can."""
    if _prctl is not None:
        _prctl(_SET_CHILD_SUBREAPER, 1)


def call_forked(call: Callable[[], str], wall_s: float) -> Ended:
    """Call a function in a forked process; return its answer, once its process group is ended.

    Args:
        call: the function; its answer has no line ends.
        wall_s: time on the wall clock that it may take [s].
    """
    lines = forked(lambda: (call(),), wall_s)
    while True:
        try:
            next(lines)
        except StopIteration as end:
            ended: Ended = end.value
            return ended


def forked(lines: Callable[[], Iterable[str]], wall_s: float) -> Generator[bytes, None, Ended]:
    """Make lines in a forked process; yield each of them, and return the end of the process.

    Its process group is ended then, and also when the generator is closed.

    Args:
        lines: called there; no line has a line end.
        wall_s: time on the wall clock that each line may take [s].
    """
    reading, writing = os.pipe()
    child = os.fork()
    if child == 0:
        os.close(reading)
        _answer(lines, writing)
    last: bytes | None = None
    is_late = False
    try:
        os.close(writing)
        rest = b""
        while True:
            end_s = time.monotonic() + wall_s
            text, rest, is_late = _read(reading, rest, end_s)
            if text is None or text == _END:
                break
            last = text
            yield text
        if text is None:
            last = None
            if not is_late:  # closed before the end: how it ends tells more
                is_late = not _has_ended(child, end_s)
    finally:
        os.close(reading)
        with suppress(ProcessLookupError):
            os.killpg(child, signal.SIGKILL)  # and processes that it has left
        with suppress(ProcessLookupError):
            os.kill(child, signal.SIGKILL)  # had it no group yet
        _, status = os.waitpid(child, 0)
    return Ended(last, status, is_late)


def _answer(lines: Callable[[], Iterable[str]], writing: int) -> NoReturn:
    """Make the lines in the child, and send them."""
    status = CLOSED
    try:
        os.setpgid(0, 0)
        signal.signal(signal.SIGTERM, signal.SIG_DFL)
        if _prctl is not None:
            _prctl(_SET_PDEATHSIG, signal.SIGKILL)
        gc.set_threshold(_GARBAGE)
        silence()
        os.closerange(3, writing)
        os.closerange(writing + 1, os.sysconf("SC_OPEN_MAX"))
        own = os.getpid()
        for line in lines():
            if os.getpid() != own:  # a copy that the call has forked
                os._exit(0)
            _send(writing, line.encode() + b"\n")
        _send(writing, _END + b"\n")
        status = 0
    finally:
        os._exit(status)


def _send(writing: int, data: bytes) -> None:
    while data:
        data = data[os.write(writing, data) :]


def silence() -> None:
    """Drop what programs print, and let them read nothing."""
    nothing = os.open(os.devnull, os.O_RDWR)
    for number in range(3):
        os.dup2(nothing, number)
    os.close(nothing)
    sys.stdin = open(0, closefd=False)  # noqa: SIM115 -- without what its parent has read ahead


def _read(reading: int, rest: bytes, end_s: float) -> tuple[bytes | None, bytes, bool]:
    """Return the next line or None, what was read beyond it, and whether it took too long."""
    parts = [rest]
    while b"\n" not in parts[-1]:
        ready, _, _ = select.select([reading], [], [], max(0.0, end_s - time.monotonic()))
        if not ready:
            return None, b"", True
        part = os.read(reading, _BYTES)
        if not part:
            return None, b"", False
        parts.append(part)
    line, _, rest = b"".join(parts).partition(b"\n")
    return line, rest, False


def _has_ended(child: int, end_s: float) -> bool:
    """Wait for the end of a child without reaping it; return False if it takes too long."""
    while os.waitid(os.P_PID, child, os.WEXITED | os.WNOHANG | os.WNOWAIT) is None:
        if time.monotonic() >= end_s:
            return False
        select.select([], [], [], _LOOK_S)
    return True


# --- several worlds in one process ---------------------------------------------------------------


def holdings() -> tuple[object, ...]:
    """Return what a program can leave in its process, apart from objects.

    These are threads, processes, open files, handlers of signals, timers, the environment, the
    current folder and the paths of modules.
    """
    gc.collect()  # files of objects that only refer to each other
    try:
        files = sorted(os.listdir(_FILES))
    except OSError:
        files = []
    return (
        {thread.ident for thread in threading.enumerate()},
        _children(),
        files,
        [signal.getsignal(number) for number in signal.valid_signals()],
        signal.getitimer(signal.ITIMER_REAL),
        dict(os.environ),
        os.getcwd(),
        sys.path.copy(),
        sys.argv.copy(),
    )


def forget_modules(loaded: Set[str], package: str) -> None:
    """Forget the application's modules, so that they are executed again when it begins anew.

    Modules of Python, of installed packages and of motorhil stay.

    Args:
        loaded: names of modules that stay in any case.
        package: the package that stays nowhere, though it is installed.
    """
    for name in sys.modules.keys() - loaded:
        file = getattr(sys.modules[name], "__file__", None) or ""
        if not file.endswith(".py"):
            continue  # an extension keeps its state anyway
        root = name.partition(".")[0]
        if root == package or (root != "motorhil" and not file.startswith(_LIBRARIES)):
            del sys.modules[name]


# --- orphans -------------------------------------------------------------------------------------


def orphans() -> bool:
    """Return True if this process has adopted any: it has one child of its own."""
    return len(_children()) > 1


def end_orphans() -> None:
    """End all children of this process, also those that it has adopted."""
    while children := _children():
        for one in children:
            with suppress(ProcessLookupError):
                os.kill(one, signal.SIGKILL)
            with suppress(ChildProcessError):
                os.waitpid(one, 0)


def _children() -> list[int]:
    """Return the children of this process, where the system tells."""
    try:
        return [int(one) for one in Path("/proc/thread-self/children").read_text().split()]
    except OSError:
        return []
