"""Disturbances: nodes sample other levels than those on the wire."""

from collections.abc import Sequence
from dataclasses import dataclass
from enum import Enum
from typing import Final, final

from emulators.media.can_wire import DOMINANT, RECESSIVE

ALL_PORTS: Final = -1  # as a mask of 1 << port


class Effect(Enum):
    """The effect of a disturbance on a level."""

    FLIP = "flip"
    DOMINANT = "dominant"
    RECESSIVE = "recessive"


@final
@dataclass(frozen=True, slots=True)
class Disturbance:
    """A disturbance that makes ports sample another level than the nodes put on the wire.

    Attributes:
        first: the bit in which it begins.
        effect: its effect; of two in one bit the one named later prevails.
        bits: its duration in bits; None: for ever.
        ports: the ports that sample it (1 << port, or'ed); ALL_PORTS: it is on the wire.
    """

    first: int
    effect: Effect = Effect.FLIP
    bits: int | None = 1
    ports: int = ALL_PORTS

    def strikes(self, bit: int) -> bool:
        """Return whether it is active in this bit."""
        return self.first <= bit and (self.bits is None or bit < self.first + self.bits)


@final
class Strikes:
    """Disturbances, and those active in the current bit. Bits are visited in order.

    Args:
        all_of_them: in the order in which they are applied.
    """

    def __init__(self, all_of_them: Sequence[Disturbance]) -> None:
        self._to_come = sorted(enumerate(all_of_them), key=_first, reverse=True)
        self._lasting: list[tuple[int, Disturbance]] = []

    def look_at(self, bit: int) -> bool:
        """Visit this bit and return whether any disturbance is active in it."""
        lasting = [one for one in self._lasting if one[1].strikes(bit)]
        while self._to_come and self._to_come[-1][1].first <= bit:
            begun = self._to_come.pop()
            if begun[1].strikes(bit):
                lasting.append(begun)
        lasting.sort(key=_turn)
        self._lasting = lasting
        return bool(lasting)

    def disturbed(self, level: int) -> int:
        """Return the level sampled in the current bit under these disturbances."""
        for _, one in self._lasting:
            if one.effect is Effect.FLIP:
                level = 1 - level
            else:
                level = DOMINANT if one.effect is Effect.DOMINANT else RECESSIVE
        return level


def _first(numbered: tuple[int, Disturbance]) -> int:
    return numbered[1].first


def _turn(numbered: tuple[int, Disturbance]) -> int:
    return numbered[0]
