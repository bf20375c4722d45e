"""How late things were, of however many: kept in a table that does not grow with them."""

from typing import Final, final

_BITS: Final = 6  # a figure is kept to 1 part in 32


@final
class Lateness:
    """Delays [ns], counted by their size; quantiles are at most 1/32 too large.

    Attributes: count; worst_ns and last_ns, exactly (0: there was none).
    """

    def __init__(self) -> None:
        self.count = 0
        self.worst_ns = 0
        self.last_ns = 0
        self._counts: dict[tuple[int, int], int] = {}

    def add(self, late_ns: int) -> None:
        """One more; what was early counts as in time."""
        late_ns = max(0, late_ns)
        self.count += 1
        self.last_ns = late_ns
        self.worst_ns = max(self.worst_ns, late_ns)
        shift = max(0, late_ns.bit_length() - _BITS)
        key = shift, late_ns >> shift
        self._counts[key] = self._counts.get(key, 0) + 1

    def quantile_ns(self, share: float) -> int:
        """What this share of them (0 to 1) did not exceed; 0 if there were none."""
        left = share * self.count
        for (shift, high), count in sorted(self._counts.items()):
            left -= count
            if left <= 0:
                return min(self.worst_ns, ((high + 1) << shift) - 1)
        return self.worst_ns
