"""Desk: requests of pages for the rig beside which they are served, and its answers.

The rig is another process. It reads requests when it comes to them, and tells its state unasked.
"""

import json
import threading
from collections.abc import Callable
from typing import Any, Final, final

WAITING_MAX: Final = 16
"""Limit of requests that the rig has not answered; a pipe holds as many of BODY_MAX bytes."""
BODY_MAX: Final = 2_048
"""Longest request [bytes]."""
_PATIENCE_S: Final = 5.0
_OPENING_S: Final = 20.0
ANSWERED, REFUSED, LATER, BUSY = 200, 400, 202, 503  # HTTP
_OVER: Final = "rig: the run is over"


@final
class Desk:
    """The requests of one server.

    Attributes:
        revision: increases with every state that the rig tells.
    """

    def __init__(self, send: Callable[[bytes], object], changed: Callable[[], None]) -> None:
        """Send requests by `send`; `changed` is called after a new state."""
        self.revision: int = 0
        self._send = send
        self._changed = changed
        self._answers: dict[int, str | None] = {}  # None: not answered yet
        self._count = 0
        self._waiting = 0
        self._elements: dict[str, Any] | None = None
        self._state: dict[str, Any] = {}
        self._condition = threading.Condition()

    @property
    def is_open(self) -> bool:
        """True if there is a rig with hands."""
        return self._elements is not None

    def opens(self, patience_s: float = _OPENING_S) -> bool:
        """Wait until a rig has told its elements; return False if there is none."""
        with self._condition:
            return self._condition.wait_for(lambda: self.is_open, patience_s)

    def has_news(self, seen: int) -> bool:
        """Return True if there is a state after this revision."""
        return self.is_open and self.revision != seen

    def elements(self) -> str:
        """Return what a hand can act on, as JSON."""
        return json.dumps(self._elements)

    def state(self) -> str:
        """Return the latest state, as JSON."""
        return json.dumps(self._state)

    def post(self, body: bytes, patience_s: float = _PATIENCE_S) -> tuple[int, str]:
        """Pass a request on, and wait for its answer; return an HTTP status and a text."""
        try:
            act = json.loads(body)
        except (ValueError, RecursionError):
            return REFUSED, "request: is not JSON"
        with self._condition:
            if self._state.get("over"):
                return REFUSED, _OVER
            if self._waiting >= WAITING_MAX:
                return BUSY, f"rig: {WAITING_MAX} requests wait; the program computes: try later"
            self._count += 1
            self._waiting += 1
            number = self._count
            self._answers[number] = None
            told = json.dumps({"id": number, "act": act}, ensure_ascii=False)
            self._send(told.encode("utf-8", "replace") + b"\n")
            self._condition.wait_for(lambda: self._answers[number] is not None, patience_s)
            problem = self._answers.pop(number)
        if problem is None:
            return LATER, "sent; the rig takes it when its program waits"
        return (REFUSED, problem) if problem else (ANSWERED, "done")

    def hear(self, line: bytes) -> None:
        """Take a line from the rig: its elements, its state, or an answer."""
        told = json.loads(line)
        with self._condition:
            if "id" in told:
                self._waiting -= 1
                if told["id"] in self._answers:
                    self._answers[told["id"]] = told["problem"]
            elif "elements" in told:
                self._elements = told["elements"]
            else:
                self._state = told["state"]
                self.revision += 1
                if self._state.get("over"):
                    self._refuse_all()  # the rig reads no more of them
            self._condition.notify_all()
        self._changed()

    def close(self) -> None:
        """End: the rig's process has ended."""
        with self._condition:
            self._state = {**self._state, "over": True}
            self.revision += 1
            self._refuse_all()
            self._condition.notify_all()
        self._changed()

    def _refuse_all(self) -> None:
        """Refuse the requests that are not answered."""
        self._answers = {
            number: _OVER if answer is None else answer for number, answer in self._answers.items()
        }
