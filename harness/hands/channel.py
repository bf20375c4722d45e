"""Channel between a rig and the server of its page: lines of JSON on two pipes.

The rig alone decides when it reads, and never waits to write. A server that does not read loses old
states; one that has ended leaves the rig alone.
"""

import json
import os
import select
from collections import deque
from collections.abc import Mapping
from contextlib import suppress
from typing import Any, Final, final

_CHUNK: Final = 65_536
_LINE_MAX: Final = 16_384  # bytes of a request
_INBOX_MAX: Final = 64
_UNSENT_MAX: Final = 4_000_000  # bytes that a server has not read
_LOOKS: Final = 10  # at the end


@final
class Channel:
    """The rig's end.

    Attributes:
        inbox: requests in order, each with its number under "id".
        is_open: False after the server has ended.
    """

    def __init__(self, requests: int, answers: int) -> None:
        """Use these file descriptors, which the caller closes."""
        self.inbox: deque[dict[str, Any]] = deque()
        self.is_open: bool = True
        self._requests = requests
        self._answers = answers
        self._line = b""
        self._unsent = b""
        self._state: bytes = b""
        os.set_blocking(requests, False)
        os.set_blocking(answers, False)
        self._poll = select.poll()
        self._poll.register(requests, select.POLLIN)

    def wait(self, timeout_s: float) -> None:
        """Wait up to `timeout_s` [s] for a request, unless there is one."""
        self._send()
        if not self.is_open:
            if timeout_s > 0.0 and not self.inbox:
                select.select((), (), (), timeout_s)
            return
        is_full = len(self.inbox) >= _INBOX_MAX
        timeout_ms = 0.0 if self.inbox else timeout_s * 1e3
        if not is_full and self._poll.poll(timeout_ms):
            self._read()

    def answer(self, number: object, problem: str = "") -> None:
        """Answer a request; `problem`: why it was refused."""
        self._append({"id": number, "problem": problem})

    def tell_elements(self, elements: Mapping[str, Any]) -> None:
        """Tell what a hand can act on."""
        self._append({"elements": elements})

    def tell_state(self, state: Mapping[str, Any]) -> None:
        """Tell the present state; an older one that is not sent yet is dropped."""
        self._state = json.dumps({"state": state}).encode() + b"\n"
        self._send()

    def finish(self) -> None:
        """Wait a second at most until a server that reads slowly has everything."""
        for _ in range(_LOOKS):
            self._send()
            if not self.is_open or not (self._unsent or self._state):
                return
            select.select((), (self._answers,), (), 1.0 / _LOOKS)

    def _append(self, message: Mapping[str, Any]) -> None:
        if len(self._unsent) < _UNSENT_MAX:
            self._unsent += json.dumps(message).encode() + b"\n"
        self._send()

    def _send(self) -> None:
        """Write as much as the pipe takes."""
        while self.is_open and (self._unsent or self._state):
            if not self._unsent:
                self._unsent, self._state = self._state, b""
            try:
                sent = os.write(self._answers, self._unsent)
            except BlockingIOError:
                return
            except OSError:
                self.is_open = False
                return
            self._unsent = self._unsent[sent:]

    def _read(self) -> None:
        try:
            data = os.read(self._requests, _CHUNK)
        except BlockingIOError:
            return
        except OSError:
            data = b""
        *lines, self._line = (self._line + data).split(b"\n")
        self.is_open = bool(data) and len(self._line) <= _LINE_MAX
        for line in lines:
            with suppress(ValueError, RecursionError):
                found = json.loads(line)
                if isinstance(found, dict):
                    self.inbox.append(found)
