"""A worker process as its supervisor holds it: its pipes, its output, and its end."""

import json
import os
import select
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Container, Mapping
from contextlib import suppress
from pathlib import Path
from typing import Any, Final, final

import motorhil

DUMP_STACKS: Final = signal.SIGUSR1
"""Signal to a worker: dump the stacks of all threads."""
END_CHECK: Final = signal.SIGUSR2
"""Signal to a worker: end the check."""
_READ_MAX: Final = 65_536
_OUTPUT_MAX: Final = 8_192
_END_S: Final = 2.0
_PROGRAM: Final = (
    "import sys; from motorhil.harness.conformance.worker import main; main(sys.argv[1:])"
)


class ChildEndedError(Exception):
    """The worker is no longer usable; the text says how it ended, or why."""


@final
class Child:
    """A running worker; `close` ends it and all processes that it has started.

    The worker has its own process group, so that only the supervisor receives Ctrl-C.

    Attributes:
        output: the last output of the worker since this was emptied.
        last_stacks: the stack dumps at the end; "" before `close`.
    """

    def __init__(self) -> None:
        self.output: bytes = b""
        self.last_stacks: str = ""
        self._stacks = tempfile.TemporaryFile()  # noqa: SIM115 -- closed with the child
        requests, self._requests = os.pipe()
        self._replies, replies = os.pipe()
        root = str(Path(motorhil.__file__).parent.parent)
        others = [path for path in (os.environ.get("PYTHONPATH"),) if path]
        options = [f"-W{one}" for one in sys.warnoptions] + ["-O"] * sys.flags.optimize
        arguments = [str(one) for one in (requests, replies, self._stacks.fileno())]
        self._process = subprocess.Popen(
            [sys.executable, "-P", *options, "-c", _PROGRAM, *arguments],
            env={**os.environ, "PYTHONPATH": os.pathsep.join([root, *others])},
            stdin=subprocess.DEVNULL,
            stdout=subprocess.PIPE,
            stderr=subprocess.STDOUT,
            pass_fds=(requests, replies, self._stacks.fileno()),
            process_group=0,
        )
        os.close(requests)
        os.close(replies)
        assert self._process.stdout is not None
        self._pipe = self._process.stdout
        self._ended = os.pidfd_open(self._process.pid)
        self._received = b""
        self._number = 0
        self._is_idle = True
        self._poll = select.poll()
        for descriptor in (self._replies, self._pipe.fileno()):
            os.set_blocking(descriptor, False)
            self._poll.register(descriptor, select.POLLIN)
        self._poll.register(self._ended, select.POLLIN)

    def ask(self, request: Mapping[str, Any]) -> None:
        """Send a request to the worker; `answer` returns its result."""
        self._is_idle = False
        self._number += 1
        line = json.dumps({**request, "number": self._number}).encode() + b"\n"
        with suppress(BrokenPipeError):  # the worker has ended; `answer` reports this
            os.write(self._requests, line)

    def answer(self, timeout_s: float) -> dict[str, Any] | None:
        """Return the next answer of the worker, or None if none comes within `timeout_s` [s].

        Raises:
            ChildEndedError: the worker has ended, or its answer cannot be decoded.
        """
        end_s = time.monotonic() + timeout_s
        while b"\n" not in self._received:
            left_s = end_s - time.monotonic()
            if left_s <= 0.0:
                return None
            ready = {descriptor for descriptor, _ in self._poll.poll(left_s * 1e3)}
            self.output = (self.output + self._read(self._pipe.fileno(), ready))[-_OUTPUT_MAX:]
            self._received += self._read(self._replies, ready)
            if self._ended in ready and b"\n" not in self._received:
                raise ChildEndedError(self._end_status())
        line, _, self._received = self._received.partition(b"\n")
        answer = self._decode(line)
        self._is_idle = True
        return answer

    def _decode(self, line: bytes) -> dict[str, Any]:
        """Decode an answer line.

        Raises:
            ChildEndedError: the line is not an answer to the last request; code under test wrote
                it.
        """
        try:
            number, answer = json.loads(line)
            if number == self._number and isinstance(answer, dict):
                return answer
        except (ValueError, TypeError):
            pass
        text = line[:40].decode(errors="replace")
        raise ChildEndedError(f"worker: wrote {text!r} to the pipe reserved for the kit's answers")

    def forget(self) -> None:
        """Discard the output and the stack dumps received so far."""
        self.output = b""
        os.ftruncate(self._stacks.fileno(), 0)
        # The worker inherited the file, and thus shares its position.
        os.lseek(self._stacks.fileno(), 0, os.SEEK_SET)

    def kill(self) -> None:
        """Kill the worker, from any thread; `answer` then reports its end."""
        with suppress(ProcessLookupError):
            os.kill(self._process.pid, signal.SIGKILL)

    def signal(self, number: signal.Signals) -> None:
        """Send a signal to the worker."""
        with suppress(ProcessLookupError):
            self._process.send_signal(number)

    def stacks(self) -> str:
        """Return the stack dumps that the worker has written."""
        size = os.fstat(self._stacks.fileno()).st_size
        return os.pread(self._stacks.fileno(), min(size, _READ_MAX), 0).decode(errors="replace")

    def _read(self, descriptor: int, ready: Container[int]) -> bytes:
        """Read available data from a descriptor; unregister the descriptor at its end."""
        data = b""
        if descriptor in ready:
            with suppress(BlockingIOError):
                data = os.read(descriptor, _READ_MAX)
                if not data:
                    self._poll.unregister(descriptor)
        return data

    def _end_status(self) -> str:
        facts = os.waitid(os.P_PID, self._process.pid, os.WEXITED | os.WNOWAIT)
        assert facts is not None
        if facts.si_code == os.CLD_EXITED:
            return f"worker process ended with exit status {facts.si_status}"
        return f"worker process ended by {signal.Signals(facts.si_status).name}"

    def close(self) -> None:
        """Wait for an idle worker to end, or kill it, and release its resources."""
        os.close(self._requests)
        poll = select.poll()
        poll.register(self._ended, select.POLLIN)
        if self._is_idle:
            poll.poll(_END_S * 1e3)
        with suppress(ProcessLookupError):  # not reaped yet, so the group is still its own
            os.killpg(self._process.pid, signal.SIGKILL)
        self._process.wait()
        self.last_stacks = self.stacks()
        self._pipe.close()
        self._stacks.close()
        os.close(self._replies)
        os.close(self._ended)
