"""Programs in processes of their own beside a world in wall time, and the signals that stop us."""

import os
import signal
import subprocess
import sys
from collections.abc import Mapping, Sequence
from contextlib import suppress
from pathlib import Path
from types import FrameType
from typing import Final, Protocol, Self, final

import harness
from emulators.serve import WallLoop

STOPPING: Final = (signal.SIGINT, signal.SIGTERM)
_LINE_MAX: Final = 65_536


class Wakeable(Protocol):
    """A loop that descriptors can wake."""

    def wake_on(self, descriptor: int) -> None:
        """It also wakes when this one becomes readable."""

    def forget(self, descriptor: int) -> None:
        """It no longer does."""


@final
class StopSignals:
    """In the block, a signal that would end us wakes the loop instead, and is kept.

    Attributes: number, the first one that came; None: none.
    """

    def __init__(self, loop: Wakeable, numbers: Sequence[signal.Signals] = STOPPING) -> None:
        self.number: int | None = None
        self._loop = loop
        self._reader, self._writer = os.pipe()
        os.set_blocking(self._writer, False)
        loop.wake_on(self._reader)
        self._old_wakeup = signal.set_wakeup_fd(self._writer, warn_on_full_buffer=False)
        self._old_handlers = {
            number: signal.signal(number, self._come)
            for number in numbers
            if number != signal.SIGHUP or signal.getsignal(number) != signal.SIG_IGN  # nohup
        }

    def _come(self, number: int, frame: FrameType | None) -> None:
        if self.number is None:
            self.number = number

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        """Signals mean what they meant before."""
        for number, handler in self._old_handlers.items():
            signal.signal(number, handler)
        signal.set_wakeup_fd(self._old_wakeup)
        self._loop.forget(self._reader)
        os.close(self._writer)
        os.close(self._reader)


@final
class Program:
    """A Python program that runs in a process of its own, until it ends, or the block does.

    It is in a process group of its own: Ctrl-C is ours alone to hear, and we end it.

    Attributes: name; pid.
    """

    def __init__(self, path: Path, environment: Mapping[str, str], loop: WallLoop) -> None:
        """It has begun. What it prints, on either stream, is in `lines`."""
        self.name: Final = path.stem.removesuffix("_program")
        self.file: Final = path.name
        root = str(Path(harness.__file__).parent.parent)  # it finds the packages that we are of
        others = [path for path in (environment.get("PYTHONPATH"),) if path]
        self._loop = loop
        self._process = subprocess.Popen(
            [sys.executable, str(path)],
            env={**environment, "PYTHONPATH": os.pathsep.join([root, *others])},
            stdin=subprocess.DEVNULL,
            stdout=subprocess.PIPE,
            stderr=subprocess.STDOUT,
            process_group=0,
        )
        self.pid: Final = self._process.pid
        assert self._process.stdout is not None
        self._output = self._process.stdout.fileno()
        self._text = b""
        self._watch: int | None = None
        self._hears = False
        try:
            os.set_blocking(self._output, False)
            loop.wake_on(self._output)
            self._hears = True
            self._watch = os.pidfd_open(self.pid)
            loop.wake_on(self._watch)
        except BaseException:
            self.__exit__()
            raise

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        """It has ended; if need be, it was killed."""
        try:
            self.kill()
        finally:
            self._process.wait()
            self._forget_process()
            self._forget_output()
            assert self._process.stdout is not None
            self._process.stdout.close()

    @property
    def status(self) -> int | None:
        """Its exit status, -n if signal n ended it; None while it runs."""
        status = self._process.poll()
        if status is not None:
            self._forget_process()
        return status

    def kill(self) -> None:
        """It is killed at once, by its id; nothing if it has ended."""
        self._process.kill()

    def lines(self) -> list[str]:
        """The lines it has printed since this was asked last."""
        if self._hears:
            try:
                data = os.read(self._output, _LINE_MAX)
            except BlockingIOError:
                return []
            if not data:
                self._forget_output()
                data = b"\n" if self._text else b""
            *whole, self._text = (self._text + data).split(b"\n")
            return [line.decode("utf-8", "replace") for line in whole]
        return []

    def _forget_process(self) -> None:
        watch, self._watch = self._watch, None
        if watch is not None:
            with suppress(KeyError):  # it was never woken by it
                self._loop.forget(watch)
            os.close(watch)

    def _forget_output(self) -> None:
        if self._hears:
            self._hears = False
            self._loop.forget(self._output)
