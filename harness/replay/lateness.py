"""Statistics of delays, in a table of bounded size."""

from typing import Final, final

_BITS: Final = 6  # values are kept to 1 part in 32


@final
class Lateness:
    """Histogram of delays [ns]; quantiles are at most 1/32 too large.

    Attributes:
        count: the number of delays.
        worst_ns, last_ns: the exact largest and last delay [ns]; 0 if there is none.
    """

    def __init__(self) -> None:
        self.count = 0
        self.worst_ns = 0
        self.last_ns = 0
        self._counts: dict[tuple[int, int], int] = {}

    def add(self, late_ns: int) -> None:
        """Add one delay; negative values count as 0."""
        late_ns = max(0, late_ns)
        self.count += 1
        self.last_ns = late_ns
        self.worst_ns = max(self.worst_ns, late_ns)
        shift = max(0, late_ns.bit_length() - _BITS)
        key = shift, late_ns >> shift
        self._counts[key] = self._counts.get(key, 0) + 1

    def quantile_ns(self, share: float) -> int:
        """Return the delay that this share of all delays (0 to 1) does not exceed; 0 if none."""
        left = share * self.count
        for (shift, high), count in sorted(self._counts.items()):
            left -= count
            if left <= 0:
                return min(self.worst_ns, ((high + 1) << shift) - 1)
        return self.worst_ns
