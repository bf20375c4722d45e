"""Programs at one lock, as threads that stop before any system call on its file."""

import fcntl
import os
import threading
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path
from typing import Any
from unittest.mock import patch

from motorhil.motorapi.errors import MotorBusyError
from motorhil.motorapi.locking.directory import LockDirectory
from motorhil.motorapi.locking.process_lock import LockHandle, ProcessLock

PATIENCE_S = 60.0
CALLS = ((fcntl, "fcntl"), (os, "pread"), (os, "pwrite"))


class Killed(BaseException):
    """The end of a program in the middle of a step."""


class Turns:
    """A runtime without time: a wait looks twice, and other programs run meanwhile."""

    def now_ns(self) -> int:
        """Return 0."""
        return 0

    def wait_until(self, done: Callable[[], bool], timeout_s: float | None = None) -> bool:
        """Look twice."""
        return done() or done()


class Program(threading.Thread):
    """A program that stops before each system call until `advance` permits it.

    It acquires the lock, or does what `action` does.
    """

    def __init__(self, path: Path, action: Callable[[], object] | None = None, **how: Any) -> None:
        super().__init__(daemon=True)
        self.lock = ProcessLock("pan", "the pan", LockDirectory(path))
        self.action, self.how = action, how
        self.hold: LockHandle | None = None
        self.is_over, self.is_killed, self.left = False, False, 0
        self.may_run, self.has_stopped = threading.Semaphore(0), threading.Semaphore(0)
        self.error: Exception | None = None
        self.start()

    def run(self) -> None:
        """Carry out the action; keep its error."""
        self.may_run.acquire()
        try:
            if self.is_killed:
                pass
            elif self.action is not None:
                self.action()
            else:
                self.hold = self.lock.acquire(Turns(), "test", 1.0, **self.how)
        except (MotorBusyError, Killed):
            pass
        except Exception as error:
            self.error = error
        finally:
            self.is_over = True
            self.has_stopped.release()

    def step(self) -> None:
        """Stop here if no step is left."""
        if self.left == 0 and not self.is_over:
            self.has_stopped.release()
            self.may_run.acquire()
            if self.is_killed and self.left == 0:
                self.left = -1
                raise Killed
        self.left -= 1

    def give_way(self) -> None:
        """Give up the steps that are left, unless the program runs to its end."""
        self.left = min(self.left, 0)

    def advance(self, steps: int = -1) -> bool:
        """Run a number of system calls; -1: run to the end. Return False if it has ended."""
        if steps and not self.is_over:
            self.left = steps
            self.may_run.release()
            assert self.has_stopped.acquire(timeout=PATIENCE_S)
            if self.error is not None:
                raise self.error
        return not self.is_over

    def kill(self) -> None:
        """Kill it before its next system call; the kernel then releases its locks."""
        if not self.is_over:
            self.is_killed = True
            self.may_run.release()
            assert self.has_stopped.acquire(timeout=PATIENCE_S)
            self.hold = None
            self.lock.begin_anew()  # closes its files


@contextmanager
def stopped_at_calls() -> Iterator[None]:
    """Let each `Program` stop before a system call on the lock file."""

    def stopping(call: Callable[..., object]) -> Callable[..., object]:
        def stop_first(*args: object) -> object:
            program = threading.current_thread()
            if isinstance(program, Program):
                program.step()
            return call(*args)

        return stop_first

    with ExitStack() as stack:
        for module, name in CALLS:
            stack.enter_context(patch.object(module, name, stopping(getattr(module, name))))
        yield
