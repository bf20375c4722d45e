"""How errors on the bus are bounded: so many at once, and then no more often than so.

Each costs the longest error frame and the frame that is sent again, the longest of those that can
be in the way. Source: Tindell, Burns & Wellings, Calculating Controller Area Network (CAN) message
response times (1995), section 5: (n + ceil(t / T) - 1) (31 bits + C). 31 bits are two flags of six,
one behind the other, eight bits of delimiter, three of intermission and eight in which a sender
that is error passive suspends transmission.
"""

from dataclasses import dataclass
from math import exp, expm1, lgamma, log, log1p
from typing import Final, final

RECOVERY_BITS: Final = 31


@final
@dataclass(frozen=True, slots=True)
class ErrorModel:
    """Errors that may strike.

    Attributes:
        burst: so many at once.
        interval_ns: and from then on never two closer than this; None: no more than the burst.
    """

    burst: int = 1
    interval_ns: int | None = None

    def count(self, window_ns: int) -> int:
        """How many in a window of this length, at most."""
        if self.interval_ns is None:
            return self.burst
        return self.burst + max(0, -(-window_ns // self.interval_ns) - 1)


NO_ERRORS: Final = ErrorModel(burst=0)


def more_errors_probability(errors: int, bits: int, bit_error_rate: float) -> float:
    """That more than so many errors strike so many bits, each on its own with that chance; at most.

    The number is binomial; a Poisson number of mean -bits ln(1 - rate) is at least as large in
    every sense, and its tail is what is told. Source: Broster, Burns & Rodriguez-Navas,
    Probabilistic analysis of CAN with faults (2002), for the idea.
    """
    mean = -bits * log1p(-bit_error_rate)
    if mean == 0.0:
        return 0.0
    if errors == 0:
        return -expm1(-mean)
    total = 0.0
    count = errors + 1
    while True:
        part = exp(count * log(mean) - mean - lgamma(count + 1))
        total += part
        if count > mean and part <= total * 1e-12:
            return min(1.0, total)
        count += 1
