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


def disturbed(level: int, by: Sequence[Disturbance], bit: int) -> int:
    """The level sampled in this bit by who is struck by these."""
    for one in by:
        if one.strikes(bit):
            if one.effect is Effect.FLIP:
                level = 1 - level
            else:
                level = DOMINANT if one.effect is Effect.DOMINANT else RECESSIVE
    return level
