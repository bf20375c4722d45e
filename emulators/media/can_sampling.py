"""Whether a node whose clock is off still reads each bit of another's frame as it was sent.

A receiver begins its bit times with the edge of the start of frame, and from then on only corrects
them: at each edge from recessive to dominant by as much as it is off, but no more than the
synchronisation jump width. In between it drifts by the difference of the two clocks. It reads the
wrong bit once its sample point has left the one that it is looking for. Stuffing makes sure of an
edge to go by every ten bits, so there is a difference that no frame is misread at: `tolerance`.

The reckoning is in whole numbers, a bit time being ONE; that a real controller sees edges only in
steps of its time quantum, and cables' delays, are left out: a margin, not a figure.

Source: ISO 11898-1, synchronisation; Hartwich & Bassemir, The configuration of the CAN bit timing
(1999), oscillator tolerance.
"""

from dataclasses import dataclass
from typing import Final, final

ONE: Final = 10**12  # a bit time; also the rate of an ideal clock (emulators.plant.oscillator)
RECESSIVE: Final = 1

_EDGES_APART: Final = 10  # bits, at most, between edges to dominant: five of each level
_TO_ERROR_FLAG: Final = 13  # bits from such an edge to the one that tells an error flag's end


@final
@dataclass(frozen=True, slots=True)
class BitTiming:
    """How a bit time is divided, in time quanta.

    Attributes:
        quanta: in a bit time, 8..25 on most controllers.
        sample: after so many of them the bit is read; CiA 301 wants 87.5 %.
        jump: the synchronisation jump width.

    Raises:
        ValueError: the sample point is not inside the bit, or the jump is longer than what is
            left of the bit behind it.
    """

    quanta: int = 16
    sample: int = 14
    jump: int = 1

    def __post_init__(self) -> None:
        if not 1 < self.sample < self.quanta:
            raise ValueError(f"sample point {self.sample} of {self.quanta} quanta: 2 or more, less")
        if not 1 <= self.jump <= self.quanta - self.sample:
            raise ValueError(
                f"jump width {self.jump}: 1 to {self.quanta - self.sample}, the quanta behind the"
                " sample point"
            )

    def tolerance_1e12(self) -> int:
        """Two clocks that differ by no more than this [1e-12] read one another without fail.

        What drifts between two edges can be made good at one of them, and the thirteenth bit after
        an edge is still read inside itself (the bits of an error flag and behind it have none).
        """
        by_jump = self.jump * ONE // (_EDGES_APART * self.quanta)
        before, after = self.sample, self.quanta - self.sample
        by_sample = min(before, after) * ONE // (_TO_ERROR_FLAG * self.quanta - after)
        return min(by_jump, by_sample)


USUAL_TIMING: Final = BitTiming()


def first_misread(levels: bytes, drift_1e12: int, timing: BitTiming) -> int | None:
    """The first bit that the receiver reads as another level than was sent; None: it reads all.

    Args:
        levels: of the bits as sent, 0 dominant and 1 recessive, start of frame first.
        drift_1e12: how much longer its bit times are than the sender's [1e-12]; below 0: shorter.
        timing: of the receiver.
    """
    sample = timing.sample * ONE // timing.quanta
    jump = timing.jump * ONE // timing.quanta
    at_sample = sample + drift_1e12 * timing.sample // timing.quanta
    late = 0  # so much later than the sender's does a bit of the receiver begin
    before = RECESSIVE
    last = len(levels) - 1
    for number, level in enumerate(levels):
        if number and before == RECESSIVE != level:
            late -= min(late, jump) if late > 0 else max(late, -jump)
        looked_at = min(max(number + (late + at_sample) // ONE, 0), last)
        if levels[looked_at] != level:
            return number
        before = level
        late += drift_1e12
    return None
