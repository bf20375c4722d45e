"""Whose turn it is to talk to a device: one exchange after another, in the order of asking."""

from collections import deque
from collections.abc import Iterator
from contextlib import contextmanager
from typing import final

from motorapi.errors import DeadlineExceeded
from motorapi.runtime import Runtime


@final
class TurnLock:
    """One party at a time, first come first served; those who wait let time pass."""

    def __init__(self, runtime: Runtime) -> None:
        self._runtime = runtime
        self._tickets: deque[object] = deque()

    def take(self, timeout_s: float, awaited: str) -> object:
        """It is the caller's turn, until `give_back` of what this returns.

        Raises:
            DeadlineExceeded: others kept it for `timeout_s` [s]; `awaited` says what for.
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
        """The turn is the next one's."""
        self._tickets.remove(ticket)

    @contextmanager
    def turn(self, timeout_s: float, awaited: str) -> Iterator[None]:
        """The block is run alone. Raises as `take`."""
        ticket = self.take(timeout_s, awaited)
        try:
            yield
        finally:
            self.give_back(ticket)
