"""How much a bus stands: errors, bit errors, and what another bit rate or queue would change."""

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
ERRORS_MAX: Final = 99  # counted so far


def shortest_error_interval_ns(load: BusLoad, burst: int = 1) -> int | None:
    """Errors no closer than this, after a burst of so many, make no message late.

    To the microsecond or a thousandth, whichever is more, and never too short; None: not even the
    burst alone is stood.
    """
    if not are_in_time(load, ErrorModel(burst)):
        return None
    low, high = 0, _INTERVAL_MAX_NS // _STEP_NS  # not stood, stood
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
    """How many errors a message stands.

    Attributes:
        message: of the bus; it has a deadline.
        errors: so many at any time in a busy period leave it in time, counted to ERRORS_MAX;
            None: not even without.
        window_bits: the longest busy period with so many.
    """

    message: Message
    errors: int | None
    window_bits: int

    def late_probability(self, bit_error_rate: float) -> float:
        """That a frame of it is late where each bit is destroyed with this chance, at most.

        Who is late has seen more errors in a busy period than it stands.
        """
        if self.errors is None:
            return 1.0
        return more_errors_probability(self.errors, self.window_bits, bit_error_rate)


def tolerances(load: BusLoad) -> tuple[Tolerance, ...]:
    """Of every message with a deadline, the most urgent first."""
    found: dict[int, Tolerance] = {}
    timed = [one for one in load.messages if one.deadline_ns is not None]
    low: dict[int, int] = {one.rank: -1 for one in timed}  # stood
    high: dict[int, int] = {one.rank: ERRORS_MAX + 1 for one in timed}  # not stood
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
    """Small numbers first: few buses stand many."""
    if low < 0:
        return 0
    return min(max(1, 2 * low), (low + high) // 2) if 2 * low < high else (low + high) // 2


def rate_that_helps(load: BusLoad, errors: ErrorModel = NO_ERRORS) -> int | None:
    """The lowest usual bit rate, above today's, with which all are in time; None: there is none."""
    for rate in USUAL_BIT_S:
        if rate > load.bitrate_bit_s and are_in_time(at_rate(load, rate), errors):
            return rate
    return None


def at_rate(load: BusLoad, bitrate_bit_s: int) -> BusLoad:
    """The same messages at another nominal bit rate; a lower data rate rises to it."""
    data = load.data_bitrate_bit_s
    return replace(
        load,
        bitrate_bit_s=bitrate_bit_s,
        data_bitrate_bit_s=None if data is None else max(data, bitrate_bit_s),
    )


def queues_that_help(load: BusLoad, errors: ErrorModel = NO_ERRORS) -> tuple[str, ...] | None:
    """Senders that must send their most urgent frame first for all to be in time; None: no help.

    One that is enough, if there is such; else all of them.
    """
    for sender in sorted(load.fifo):
        if are_in_time(replace(load, fifo=load.fifo - {sender}), errors):
            return (sender,)
    if load.fifo and are_in_time(replace(load, fifo=frozenset()), errors):
        return tuple(sorted(load.fifo))
    return None
