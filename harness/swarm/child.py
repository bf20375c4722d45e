"""Child process: one call in a forked process, whatever becomes of it there.

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
import time
from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Final, NoReturn, final

CLOSED: Final = 121
"""Exit status of a child whose answer could not be sent: its file descriptors were closed."""
_SET_PDEATHSIG, _SET_CHILD_SUBREAPER = 1, 36  # prctl(2)
_BYTES: Final = 1 << 16
_LOOK_S: Final = 0.005
_GARBAGE: Final = 100_000
"""Objects until garbage is looked for: a short world ends before."""
_prctl = ctypes.CDLL(None).prctl if sys.platform == "linux" else None


@final
@dataclass(frozen=True, slots=True)
class Ended:
    """The end of a child.

    Attributes:
        text: its answer, one line; None if it sent none.
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
    reading, writing = os.pipe()
    child = os.fork()
    if child == 0:
        os.close(reading)
        _answer(call, writing)
    try:
        os.close(writing)
        end_s = time.monotonic() + wall_s
        text, is_late = _read(reading, end_s)
        if text is None and not is_late:  # closed without an answer: how it ends tells more
            is_late = not _has_ended(child, end_s)
    finally:
        os.close(reading)
        with suppress(ProcessLookupError):
            os.killpg(child, signal.SIGKILL)  # and processes that it has left
        with suppress(ProcessLookupError):
            os.kill(child, signal.SIGKILL)  # had it no group yet
        _, status = os.waitpid(child, 0)
    return Ended(text, status, is_late)


def _answer(call: Callable[[], str], writing: int) -> NoReturn:
    """Make the call in the child, and send its answer."""
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
        line = call().encode() + b"\n"
        if os.getpid() != own:  # a copy that the call has forked
            os._exit(0)
        while line:
            line = line[os.write(writing, line) :]
        status = 0
    finally:
        os._exit(status)


def silence() -> None:
    """Drop what programs print, and let them read nothing."""
    nothing = os.open(os.devnull, os.O_RDWR)
    for number in range(3):
        os.dup2(nothing, number)
    os.close(nothing)
    sys.stdin = open(0, closefd=False)  # noqa: SIM115 -- without what its parent has read ahead


def _read(reading: int, end_s: float) -> tuple[bytes | None, bool]:
    """Return the line that the child sent, or None; and whether it took too long."""
    parts: list[bytes] = []
    while True:
        ready, _, _ = select.select([reading], [], [], max(0.0, end_s - time.monotonic()))
        if not ready:
            return None, True
        part = os.read(reading, _BYTES)
        if not part:
            return None, False
        parts.append(part)
        if part.endswith(b"\n"):
            return b"".join(parts)[:-1], False


def _has_ended(child: int, end_s: float) -> bool:
    """Wait for the end of a child without reaping it; return False if it takes too long."""
    while os.waitid(os.P_PID, child, os.WEXITED | os.WNOHANG | os.WNOWAIT) is None:
        if time.monotonic() >= end_s:
            return False
        select.select([], [], [], _LOOK_S)
    return True


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
