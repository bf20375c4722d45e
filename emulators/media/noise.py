"""Random inversion of bits: the distances between inverted bits."""

from collections.abc import Callable
from typing import Final, final

from emulators.media.fault_rule import FaultRule

_DOUBLINGS: Final = 48  # distances up to 2**48 bits, beyond the life of a bus


@final
class NoiseSource:
    """A stream of inverted bits, with one draw per inverted bit.

    The computation uses products alone, so that all machines get equal results.

    Attributes (read only):
        rule: its NOISE rule.
        ports: mask of the ports that see its bits; ALL_PORTS: the wire.
        left: bits of frames before the next inverted one.
    """

    def __init__(self, rule: FaultRule, ports: int, draw: Callable[[], float]) -> None:
        self.rule = rule
        self.ports = ports
        self._draw = draw
        self._spared = [1.0 - rule.bit_error_rate]  # probability that 1, 2, 4, ... bits are spared
        for _ in range(_DOUBLINGS - 1):
            self._spared.append(self._spared[-1] * self._spared[-1])
        self._gaps: list[int] = []  # between inverted bits that were looked at already
        self.left = self._distance()

    def pass_by(self, bits: int) -> None:
        """Advance by this many bits."""
        while self.left < bits:
            self.left += 1 + (self._gaps.pop(0) if self._gaps else self._distance())
        self.left -= bits

    def within(self, bits: int) -> list[int]:
        """Return the numbers of the inverted bits among the next bits."""
        places: list[int] = []
        place = self.left
        while place < bits:
            if len(places) == len(self._gaps):
                self._gaps.append(self._distance())
            places.append(place)
            place += 1 + self._gaps[len(places) - 1]
        return places

    def _distance(self) -> int:
        """Draw the number of spared bits: at least n with probability (1 - rate) ** n."""
        chance = self._draw()
        bits = 0
        spared = 1.0
        for doubling in range(_DOUBLINGS - 1, -1, -1):
            if spared * self._spared[doubling] > chance:
                spared *= self._spared[doubling]
                bits += 1 << doubling
        return bits
