"""One node's error confinement: its two error counters, and what they make of it.

The rules are those of ISO 11898-1, fault confinement, by their letters (Bosch CAN 2.0 numbers them
1 to 12). When one applies is seen on the wire, by `can_station`; here stands what it does:

a  a receiver detects an error: REC + 1, but not for a bit error in its active error flag or its
   overload flag, which is e
b  a receiver samples a dominant bit as the first after its error flag: REC + 8
c  a transmitter sends an error flag: TEC + 8, with two exceptions: an error passive one that misses
   its acknowledgement and sees no dominant bit while it sends its flag; a stuff error in
   arbitration, where the stuff bit was sent recessive, before RTR, and sampled dominant
d  a transmitter samples a bit error in its active error flag or overload flag: TEC + 8
e  a receiver does: REC + 8
f  eight dominant bits follow an error or overload flag, and each further eight: TEC + 8 for a
   transmitter, REC + 8 for a receiver
g  a frame was sent: TEC - 1, not below 0
h  a frame was received up to its ACK slot, and acknowledged: REC - 1, not below 0; from above 127
   to between 119 and 127
i  at 128 or more in either a node is error passive, at a TEC above 255 bus-off

Left open by the standard, decided here: h leads to 127. REC counts to 255 and stays there, as in an
8-bit register; so does what is told of TEC.
"""

from enum import IntEnum
from typing import Final, final

WARNING: Final = 96
PASSIVE: Final = 128
BUS_OFF: Final = 256
TEC_MAX: Final = 255  # that a register holds: what one that is bus-off shows
REC_MAX: Final = 255

_ERROR: Final = 8  # what an error costs that cannot be somebody else's
_REC_RECOVERED: Final = 127


class ErrorState(IntEnum):
    """What a node's counters make of it; the higher the worse."""

    ACTIVE = 0
    WARNING = 1  # error active; a host would want to know
    PASSIVE = 2
    BUS_OFF = 3


def state_of(counter: int) -> ErrorState:
    """What this counter alone makes of a node; REC does not reach what would be bus-off."""
    if counter >= BUS_OFF:
        return ErrorState.BUS_OFF
    if counter >= PASSIVE:
        return ErrorState.PASSIVE
    return ErrorState.WARNING if counter >= WARNING else ErrorState.ACTIVE


@final
class Confinement:
    """A node's TEC and REC. Rules a to h, each a method; i is what they are compared with.

    Attributes: tec (0 to 263), rec (0 to 255). Read them; the rules alone change them.

    Raises:
        ValueError: tec is not 0 to 255, or rec is not.
    """

    def __init__(self, tec: int = 0, rec: int = 0) -> None:
        if not 0 <= tec < BUS_OFF or not 0 <= rec <= REC_MAX:
            raise ValueError(f"TEC {tec}, REC {rec}: a node on the bus has 0 to 255 of each")
        self.tec = tec
        self.rec = rec

    def __str__(self) -> str:
        return f"TEC {self.tec}, REC {self.rec}"

    def is_passive(self) -> bool:
        """Whether its error flags are passive."""
        return self.tec >= PASSIVE or self.rec >= PASSIVE

    def is_off(self) -> bool:
        """Whether it has left the bus."""
        return self.tec >= BUS_OFF

    def state(self) -> ErrorState:
        """Rule i."""
        return state_of(self.tec if self.tec > self.rec else self.rec)

    def receiver_error(self) -> None:
        """Rule a."""
        self._add_rec(1)

    def dominant_after_flag(self) -> None:
        """Rule b."""
        self._add_rec(_ERROR)

    def transmitter_error(self) -> None:
        """Rule c; whether it is an exception, the wire tells."""
        self.tec += _ERROR

    def flag_destroyed(self, transmitter: bool) -> None:
        """Rules d and e."""
        self._add(transmitter)

    def dominant_eight(self, transmitter: bool) -> None:
        """Rule f."""
        self._add(transmitter)

    def sent(self) -> None:
        """Rule g."""
        if self.tec:
            self.tec -= 1

    def received(self) -> None:
        """Rule h."""
        if self.rec >= PASSIVE:
            self.rec = _REC_RECOVERED
        elif self.rec:
            self.rec -= 1

    def _add(self, transmitter: bool) -> None:
        if transmitter:
            self.tec += _ERROR
        else:
            self._add_rec(_ERROR)

    def _add_rec(self, amount: int) -> None:
        self.rec = self.rec + amount if self.rec + amount < REC_MAX else REC_MAX
