"""Published sets of messages for the tests of the analysis."""

from motorhil.harness.analysis.message import BusLoad, Message
from tests.support.can.published import MS, SAE


def sae(rate: int) -> BusLoad:
    """Return the benchmark; each message has its own node, and its period as deadline."""
    messages = tuple(
        Message(0x78 + place, row[1], row[0] * MS, deadline_ns=(5 if place == 0 else row[0]) * MS)
        for place, row in enumerate(SAE)
    )
    return BusLoad("can0", rate, messages)


def davis() -> BusLoad:
    """Return the counter-example of Davis, Burns, Bril & Lukkien 2007: A, B and C of 1 ms each."""
    times = ((1, 2.5, 2.5), (2, 3.5, 3.25), (3, 3.5, 3.25))
    messages = tuple(
        Message(number, 7, int(period_ms * MS), deadline_ns=int(deadline_ms * MS))
        for number, period_ms, deadline_ms in times
    )
    return BusLoad("can0", 125_000, messages)
