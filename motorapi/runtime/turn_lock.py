"""FIFO lock for exchanges with a device.

Waiting callers let time pass in their runtime.
"""

from collections import deque
from collections.abc import Iterator
from contextlib import contextmanager
from typing import final

from motorhil.motorapi.errors import DeadlineExceeded
from motorhil.motorapi.runtime.api import Runtime


@final
class TurnLock:
    """A lock that serves callers in order of arrival; waiting callers let time pass."""

    def __init__(self, runtime: Runtime) -> None:
        self._runtime = runtime
        self._tickets: deque[object] = deque()

    def take(self, timeout_s: float, awaited: str) -> object:
        """Wait for the caller's turn, and return the ticket for `give_back`.

        Raises:
            DeadlineExceeded: others kept it for `timeout_s` [s]; `awaited` names the purpose.
        """
        ticket = object()
        tickets = self._tickets
        tickets.append(ticket)
        if tickets[0] is ticket:
            return ticket
        try:
            if self._runtime.wait_until(lambda: tickets[0] is ticket, timeout_s):
                return ticket
        except BaseException:
            tickets.remove(ticket)
            raise
        tickets.remove(ticket)
        raise DeadlineExceeded(
            awaited=awaited, timeout_s=timeout_s, last_heard=f"{len(tickets)} others before it"
        )

    def give_back(self, ticket: object) -> None:
        """Pass the turn to the next caller."""
        self._tickets.remove(ticket)

    @contextmanager
    def turn(self, timeout_s: float, awaited: str) -> Iterator[None]:
        """Run the block alone; raises as `take`."""
        ticket = self.take(timeout_s, awaited)
        try:
            yield
        finally:
            self.give_back(ticket)
