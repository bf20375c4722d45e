"""Child processes that answer in lines of JSON, and end when they hang."""

import json
import os
import resource
import signal
import sys
import traceback
from collections.abc import Callable, Iterator
from contextlib import suppress
from typing import Any, Final

_MEMORY: Final = 1 << 30
"""Memory that a child may use beyond its parent's [bytes]."""

Tell = Callable[[Any], None]


def answers(work: Callable[[Tell], None]) -> Iterator[Any]:
    """Yield what `work` tells in a child process; then None, if it was ended by a signal."""
    reader, writer = os.pipe()
    sys.stdout.flush()
    pid = os.fork()
    if pid == 0:
        os.close(reader)
        _child(work, writer)
    os.close(writer)
    try:
        with os.fdopen(reader) as lines:
            yield from map(json.loads, lines)
        _, status = os.waitpid(pid, 0)
        if os.WIFSIGNALED(status):
            yield None
    finally:
        with suppress(ProcessLookupError):
            os.killpg(pid, signal.SIGKILL)
        with suppress(ChildProcessError):
            os.waitpid(pid, 0)


def _child(work: Callable[[Tell], None], writer: int) -> None:
    """Do the work, and end this process."""
    os.setsid()
    os.set_inheritable(writer, False)
    null = os.open(os.devnull, os.O_RDWR)
    for descriptor in (0, 1, 2):
        os.dup2(null, descriptor)
    with open("/proc/self/statm") as sizes:
        used = int(sizes.read().split()[0]) * resource.getpagesize()
    resource.setrlimit(resource.RLIMIT_AS, (used + _MEMORY, used + _MEMORY))

    def tell(answer: Any) -> None:
        os.write(writer, json.dumps(answer).encode() + b"\n")

    try:
        work(tell)
    except BaseException as error:
        last = traceback.extract_tb(error.__traceback__)[-1]
        tell({"raised": f"{type(error).__name__}: {error}", "at": f"{last.filename}:{last.lineno}"})
    finally:
        os._exit(0)


def limit(cpu_s: float, wall_s: float) -> None:
    """End this process by a signal, unless this is called again before."""
    signal.setitimer(signal.ITIMER_PROF, cpu_s)
    signal.setitimer(signal.ITIMER_REAL, wall_s)


def cpu_s() -> float:
    """Return the processor time of this process [s]."""
    used = resource.getrusage(resource.RUSAGE_SELF)
    return used.ru_utime + used.ru_stime
