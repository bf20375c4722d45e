"""Bits inverted at random: how many come before the next one."""

from collections.abc import Callable
from typing import Final, final

from emulators.media.fault_rule import FaultRule

_DOUBLINGS: Final = 48  # of a bit: distances up to 2**48, an age of the bus


@final
class NoiseSource:
    """One stream of inverted bits. It draws once per bit inverted.

    It computes by products alone, so that machines agree.

    Attributes (read only):
        rule: the noise that it is of.
        ports: who sees its bits, as a mask; ALL_PORTS: the wire.
        left: bits of frames still to come before the next one.
    """

    def __init__(self, rule: FaultRule, ports: int, draw: Callable[[], float]) -> None:
        self.rule = rule
        self.ports = ports
        self._draw = draw
        self._spared = [1.0 - rule.bit_error_rate]  # the chance that 1, 2, 4, ... bits are spared
        for _ in range(_DOUBLINGS - 1):
            self._spared.append(self._spared[-1] * self._spared[-1])
        self._gaps: list[int] = []  # between those that were looked at already
        self.left = self._distance()

    def pass_by(self, bits: int) -> None:
        """So many bits have gone by."""
        while self.left < bits:
            self.left += 1 + (self._gaps.pop(0) if self._gaps else self._distance())
        self.left -= bits

    def within(self, bits: int) -> list[int]:
        """The numbers of those inverted among the next bits."""
        places: list[int] = []
        place = self.left
        while place < bits:
            if len(places) == len(self._gaps):
                self._gaps.append(self._distance())
            places.append(place)
            place += 1 + self._gaps[len(places) - 1]
        return places

    def _distance(self) -> int:
        """How many bits are spared: at least n with a chance of (1 - rate) ** n."""
        chance = self._draw()
        bits = 0
        spared = 1.0
        for doubling in range(_DOUBLINGS - 1, -1, -1):
            if spared * self._spared[doubling] > chance:
                spared *= self._spared[doubling]
                bits += 1 << doubling
        return bits
