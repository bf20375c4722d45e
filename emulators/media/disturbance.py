"""What makes the nodes of a bus sample other levels than they put on the wire."""

from collections.abc import Sequence
from dataclasses import dataclass
from enum import Enum
from typing import Final, final

from emulators.media.can_wire import DOMINANT, RECESSIVE

ALL_PORTS: Final = -1  # as a mask of 1 << port


class Effect(Enum):
    """What a disturbance does to a level."""

    FLIP = "flip"
    DOMINANT = "dominant"
    RECESSIVE = "recessive"


@final
@dataclass(frozen=True, slots=True)
class Disturbance:
    """Something that makes ports sample another level than the nodes put on the wire.

    Attributes:
        first: the bit in which it begins.
        effect: what it does; of two in one bit the one named later has the last word.
        bits: for how many bits; None: for ever.
        ports: who samples it (1 << port, or'ed); ALL_PORTS: it is on the wire.
    """

    first: int
    effect: Effect = Effect.FLIP
    bits: int | None = 1
    ports: int = ALL_PORTS

    def strikes(self, bit: int) -> bool:
        """Whether it lasts in this bit."""
        return self.first <= bit and (self.bits is None or bit < self.first + self.bits)


@final
class Strikes:
    """Disturbances, and which of them last in the bit looked at; bits are looked at in order.

    Args:
        all_of_them: in the order in which they have their say.
    """

    def __init__(self, all_of_them: Sequence[Disturbance]) -> None:
        self._to_come = sorted(enumerate(all_of_them), key=_first, reverse=True)
        self._lasting: list[tuple[int, Disturbance]] = []

    def look_at(self, bit: int) -> bool:
        """Whether any of them lasts in this bit."""
        lasting = [one for one in self._lasting if one[1].strikes(bit)]
        while self._to_come and self._to_come[-1][1].first <= bit:
            begun = self._to_come.pop()
            if begun[1].strikes(bit):
                lasting.append(begun)
        lasting.sort(key=_turn)
        self._lasting = lasting
        return bool(lasting)

    def disturbed(self, level: int) -> int:
        """The level sampled in the bit looked at by who is struck by these."""
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
