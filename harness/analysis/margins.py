"""Margins of a bus: tolerated errors, and helpful bit rates and queues."""

from dataclasses import dataclass, replace
from typing import Final, final

from harness.analysis.errors import NO_ERRORS, ErrorModel, more_errors_probability
from harness.analysis.message import BusLoad, Message
from harness.analysis.response_time import are_in_time, response_times

USUAL_BIT_S: Final = (
    *(10_000, 20_000, 50_000, 100_000, 125_000, 250_000, 500_000, 800_000, 1_000_000),
)
_INTERVAL_MAX_NS: Final = 100_000_000_000
_STEP_NS: Final = 1_000
ERRORS_MAX: Final = 99  # upper limit of the search


def shortest_error_interval_ns(load: BusLoad, burst: int = 1) -> int | None:
    """Return the shortest error interval, after a burst, that makes no message late [ns].

    The result is accurate to 1 us or 1/1000, whichever is more, and never too short. None: the
    burst alone makes a message late.
    """
    if not are_in_time(load, ErrorModel(burst)):
        return None
    low, high = 0, _INTERVAL_MAX_NS // _STEP_NS  # not tolerated, tolerated
    if not are_in_time(load, ErrorModel(burst, high * _STEP_NS)):
        return None
    while high - low > max(1, low // 1_000):
        middle = (low + high) // 2
        if are_in_time(load, ErrorModel(burst, middle * _STEP_NS)):
            high = middle
        else:
            low = middle
    return high * _STEP_NS


@final
@dataclass(frozen=True, slots=True)
class Tolerance:
    """The number of errors that a message tolerates.

    Attributes:
        message: a message with a deadline.
        errors: the largest tolerated number of errors in a busy period, up to ERRORS_MAX; None: the
            message is late even without errors.
        window_bits: the longest busy period with that many errors [bit].
    """

    message: Message
    errors: int | None
    window_bits: int

    def late_probability(self, bit_error_rate: float) -> float:
        """Bound the probability that a frame is late at this bit error rate.

        A late frame has seen more errors in its busy period than it tolerates.
        """
        if self.errors is None:
            return 1.0
        return more_errors_probability(self.errors, self.window_bits, bit_error_rate)


def tolerances(load: BusLoad) -> tuple[Tolerance, ...]:
    """Return the tolerance of every message with a deadline, the most urgent first."""
    found: dict[int, Tolerance] = {}
    timed = [one for one in load.messages if one.deadline_ns is not None]
    low: dict[int, int] = {one.rank: -1 for one in timed}  # tolerated
    high: dict[int, int] = {one.rank: ERRORS_MAX + 1 for one in timed}  # not tolerated
    asked: set[int] = set()
    while True:
        open_ranks = [rank for rank in low if high[rank] - low[rank] > 1]
        if not open_ranks:
            break
        errors = _next_burst(low[open_ranks[0]], high[open_ranks[0]])
        assert errors not in asked
        asked.add(errors)
        for one in response_times(load, ErrorModel(errors)):
            rank = one.message.rank
            if one.is_in_time and errors > low.get(rank, errors):
                low[rank] = errors
                assert one.busy_ns is not None
                bits = -(-one.busy_ns * load.bitrate_bit_s // 1_000_000_000)
                found[rank] = Tolerance(one.message, errors, bits)
            elif one.is_in_time is False and errors < high[rank]:
                high[rank] = errors
    return tuple(
        found.get(one.rank, Tolerance(one, None, 0))
        for one in sorted(timed, key=lambda one: one.rank)
    )


def _next_burst(low: int, high: int) -> int:
    """Return the next burst to try; small numbers first, since few buses tolerate many."""
    if low < 0:
        return 0
    return min(max(1, 2 * low), (low + high) // 2) if 2 * low < high else (low + high) // 2


def rate_that_helps(load: BusLoad, errors: ErrorModel = NO_ERRORS) -> int | None:
    """Return the lowest usual bit rate above the present one that brings all in time, or None."""
    for rate in USUAL_BIT_S:
        if rate > load.bitrate_bit_s and are_in_time(at_rate(load, rate), errors):
            return rate
    return None


def at_rate(load: BusLoad, bitrate_bit_s: int) -> BusLoad:
    """Return the load at another nominal bit rate; a lower data rate rises to it."""
    data = load.data_bitrate_bit_s
    return replace(
        load,
        bitrate_bit_s=bitrate_bit_s,
        data_bitrate_bit_s=None if data is None else max(data, bitrate_bit_s),
    )


def queues_that_help(load: BusLoad, errors: ErrorModel = NO_ERRORS) -> tuple[str, ...] | None:
    """Return the senders that must send by priority to bring all in time; None: no help.

    A single sender is returned if one is sufficient, otherwise all of them.
    """
    for sender in sorted(load.fifo):
        if are_in_time(replace(load, fifo=load.fifo - {sender}), errors):
            return (sender,)
    if load.fifo and are_in_time(replace(load, fifo=frozenset()), errors):
        return tuple(sorted(load.fifo))
    return None
