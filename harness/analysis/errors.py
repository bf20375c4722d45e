"""Error model of the bus: a burst, then a minimum distance.

Each error costs the longest error frame and one retransmission, of the longest frame that can
interfere. Source: Tindell, Burns & Wellings, Calculating Controller Area Network (CAN) message
response times (1995), section 5: (n + ceil(t / T) - 1) (31 bits + C). The 31 bits are two
consecutive flags of six bits, a delimiter of eight, and an intermission of three. The last eight
are the suspended transmission of an error passive sender.
"""

from dataclasses import dataclass
from math import exp, expm1, lgamma, log, log1p
from typing import Final, final

RECOVERY_BITS: Final = 31


@final
@dataclass(frozen=True, slots=True)
class ErrorModel:
    """Bound on the number of errors.

    Attributes:
        burst: number of simultaneous errors.
        interval_ns: minimum distance between later errors [ns]; None: no errors after the burst.
    """

    burst: int = 1
    interval_ns: int | None = None

    def count(self, window_ns: int) -> int:
        """Return the maximum number of errors in a window of this length."""
        if self.interval_ns is None:
            return self.burst
        return self.burst + max(0, -(-window_ns // self.interval_ns) - 1)


NO_ERRORS: Final = ErrorModel(burst=0)


def more_errors_probability(errors: int, bits: int, bit_error_rate: float) -> float:
    """Bound the probability of more than `errors` independent bit errors in `bits` bits.

    The number of errors is binomial. A Poisson variable of mean -bits ln(1 - rate) is
    stochastically at least as large, and its tail is returned. Source: Broster, Burns &
    Rodriguez-Navas, Probabilistic analysis of CAN with faults (2002), for the idea.
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
