"""Programs beside a rig in real time: child processes, and signals that stop the loop."""

import os
import signal
import subprocess
import sys
from collections.abc import Mapping, Sequence
from contextlib import suppress
from pathlib import Path
from types import FrameType
from typing import Final, Protocol, Self, final

import motorhil

STOPPING: Final = (signal.SIGINT, signal.SIGTERM)
_LINE_MAX: Final = 65_536


class Wakeable(Protocol):
    """A loop that descriptors can wake."""

    def wake_on(self, descriptor: int) -> None:
        """Wake the loop also when this descriptor becomes readable."""

    def forget(self, descriptor: int) -> None:
        """Stop waking the loop for this descriptor."""


@final
class StopSignals:
    """A context in which a terminating signal wakes the loop instead, and is kept.

    Attributes:
        number: the first signal received, or None.
    """

    def __init__(self, loop: Wakeable, numbers: Sequence[signal.Signals] = STOPPING) -> None:
        self.number: int | None = None
        self._loop = loop
        self._reader, self._writer = os.pipe()
        os.set_blocking(self._writer, False)
        loop.wake_on(self._reader)
        self._old_wakeup = signal.set_wakeup_fd(self._writer, warn_on_full_buffer=False)
        self._old_handlers = {
            number: signal.signal(number, self._keep)
            for number in numbers
            if number != signal.SIGHUP or signal.getsignal(number) != signal.SIG_IGN  # nohup
        }

    def _keep(self, number: int, frame: FrameType | None) -> None:
        if self.number is None:
            self.number = number

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        """Restore the former signal handlers."""
        for number, handler in self._old_handlers.items():
            signal.signal(number, handler)
        signal.set_wakeup_fd(self._old_wakeup)
        self._loop.forget(self._reader)
        os.close(self._writer)
        os.close(self._reader)


@final
class Program:
    """A Python program in a process of its own, until it ends or the context does.

    It has a process group of its own: Ctrl-C reaches only this process, which then ends it.

    Attributes:
        name: name in messages.
        file: name of its file.
        pid: its process id.
    """

    def __init__(self, path: Path, environment: Mapping[str, str], loop: Wakeable) -> None:
        """Start the program; `lines` returns its output of both streams."""
        self.name: Final = path.stem.removesuffix("_program")
        self.file: Final = path.name
        root = str(Path(motorhil.__file__).parent.parent)  # lets it import the same packages
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
        self._is_reading = False
        try:
            os.set_blocking(self._output, False)
            loop.wake_on(self._output)
            self._is_reading = True
            self._watch = os.pidfd_open(self.pid)
            loop.wake_on(self._watch)
        except BaseException:
            self.__exit__()
            raise

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        """Kill the program if it still runs, and wait for its end."""
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
        """The exit status, -n if signal n ended it, or None while it runs."""
        status = self._process.poll()
        if status is not None:
            self._forget_process()
        return status

    def kill(self) -> None:
        """Kill the program at once, by its process id; no effect if it has ended."""
        self._process.kill()

    def lines(self) -> list[str]:
        """Return the lines printed since the last call."""
        if self._is_reading:
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
            with suppress(KeyError):  # it was never registered
                self._loop.forget(watch)
            os.close(watch)

    def _forget_output(self) -> None:
        if self._is_reading:
            self._is_reading = False
            self._loop.forget(self._output)
