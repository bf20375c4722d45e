"""Fault confinement of a CAN node: error counters, state and messages.

The rules are those of ISO 11898-1, fault confinement, by their letters (Bosch CAN 2.0 numbers them
1 to 12). `CanStation` detects on the wire when a rule applies. This module implements its effect:

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
8-bit register. The reported TEC is limited in the same way.

The module also has the error messages to a node, in the format of SocketCAN. An error message is a
16-byte can_frame with ERR_FLAG. The identifier's bits are classes of errors, 8 bytes of data give
details. Error messages are never on the bus. The medium makes them for the node that detected an
error, and for the record. Lost arbitration is not reported: few common controllers do (SJA1000, CTU
CAN FD), and on a busy bus each frame would cost a message per waiting node.

Source: Linux include/uapi/linux/can/error.h.
"""

from enum import IntEnum
from typing import Final, final

from motorhil.emulators.can.frame import ERR_FLAG, pack

WARNING: Final = 96
PASSIVE: Final = 128
BUS_OFF: Final = 256
TEC_MAX: Final = 255  # maximum of a register; shown by a bus-off node
REC_MAX: Final = 255

_ERROR: Final = 8  # increment for an error that is the node's own fault
_REC_RECOVERED: Final = 127

# classes: bits of the identifier
CONTROLLER: Final = 0x004  # data[1]
PROTOCOL: Final = 0x008  # data[2], data[3]
NO_ACKNOWLEDGE: Final = 0x020
MESSAGE_BUS_OFF: Final = 0x040
BUS_ERROR: Final = 0x080
RESTARTED: Final = 0x100
COUNTERS: Final = 0x200  # data[6]: TEC, data[7]: REC

# data[1]: the controller's state
RX_WARNING: Final = 0x04
TX_WARNING: Final = 0x08
RX_PASSIVE: Final = 0x10
TX_PASSIVE: Final = 0x20
ERROR_ACTIVE: Final = 0x40

# data[2]: type of the error
BIT_ERROR: Final = 0x01  # not distinguishable
FORM_ERROR: Final = 0x02
STUFF_ERROR: Final = 0x04
BIT0_ERROR: Final = 0x08  # a dominant bit could not be sent
BIT1_ERROR: Final = 0x10  # a recessive bit could not be sent
OVERLOAD: Final = 0x20
TRANSMITTING: Final = 0x80  # the node was sending

# data[3]: place
START_OF_FRAME: Final = 0x03
ID_28_21: Final = 0x02
ID_20_18: Final = 0x06
SRTR: Final = 0x04
IDE: Final = 0x05
ID_17_13: Final = 0x07
ID_12_5: Final = 0x0F
ID_4_0: Final = 0x0E
RTR: Final = 0x0C
RESERVED_1: Final = 0x0D
RESERVED_0: Final = 0x09
DLC: Final = 0x0B
DATA: Final = 0x0A
CRC_SEQUENCE: Final = 0x08
CRC_DELIMITER: Final = 0x18
ACK_SLOT: Final = 0x19
ACK_DELIMITER: Final = 0x1B
END_OF_FRAME: Final = 0x1A
INTERMISSION: Final = 0x12
# Linux has no names for these; its driver hands on the chip's value (SJA1000, error code capture).
ACTIVE_FLAG: Final = 0x11
TOLERATED: Final = 0x13  # dominant bits after a flag
DELIMITER: Final = 0x17  # of an error or overload frame
OVERLOAD_FLAG: Final = 0x1C

_COUNTER_MAX: Final = 0xFF


class ErrorState(IntEnum):
    """The error state of a node; a higher value is worse."""

    ACTIVE = 0
    WARNING = 1  # error active, above the warning limit
    PASSIVE = 2
    BUS_OFF = 3


def state_of(counter: int) -> ErrorState:
    """Return the error state for one counter alone; REC never reaches bus-off."""
    if counter >= BUS_OFF:
        return ErrorState.BUS_OFF
    if counter >= PASSIVE:
        return ErrorState.PASSIVE
    return ErrorState.WARNING if counter >= WARNING else ErrorState.ACTIVE


@final
class Confinement:
    """The TEC and REC of a node. Rules a to h are methods; `state` applies rule i.

    Attributes: tec (0 to 263), rec (0 to 255). Read only; the rules alone change them.

    Raises:
        ValueError: tec or rec is not 0 to 255.
    """

    def __init__(self, tec: int = 0, rec: int = 0) -> None:
        if not 0 <= tec < BUS_OFF or not 0 <= rec <= REC_MAX:
            raise ValueError(f"TEC {tec}, REC {rec}: invalid counters; expected 0 to 255 each")
        self.tec: int = tec
        self.rec: int = rec

    def __str__(self) -> str:
        return f"TEC {self.tec}, REC {self.rec}"

    def is_passive(self) -> bool:
        """Return whether the node is error passive and its error flags are passive."""
        return self.tec >= PASSIVE or self.rec >= PASSIVE

    def is_off(self) -> bool:
        """Return whether the node is bus-off."""
        return self.tec >= BUS_OFF

    def state(self) -> ErrorState:
        """Return the error state by rule i."""
        return state_of(self.tec if self.tec > self.rec else self.rec)

    def receiver_error(self) -> None:
        """Apply rule a."""
        self._add_rec(1)

    def dominant_after_flag(self) -> None:
        """Apply rule b."""
        self._add_rec(_ERROR)

    def transmitter_error(self) -> None:
        """Apply rule c; the caller checks the exceptions."""
        self.tec += _ERROR

    def flag_destroyed(self, transmitter: bool) -> None:
        """Apply rule d or e."""
        self._add(transmitter)

    def dominant_eight(self, transmitter: bool) -> None:
        """Apply rule f."""
        self._add(transmitter)

    def sent(self) -> None:
        """Apply rule g."""
        if self.tec:
            self.tec -= 1

    def received(self) -> None:
        """Apply rule h."""
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


def pack_error(
    classes: int,
    *,
    controller: int = 0,
    protocol: int = 0,
    location: int = 0,
    counters: tuple[int, int] | None = None,
) -> bytes:
    """Return the error message (16 bytes).

    Args:
        classes: of errors, or'ed.
        controller: data[1].
        protocol: data[2].
        location: data[3].
        counters: TEC and REC to report, or None; values above 255 are reported as 255.
    """
    data = bytearray(8)
    data[1] = controller
    data[2] = protocol
    data[3] = location
    if counters is not None:
        classes |= COUNTERS
        data[6] = min(counters[0], _COUNTER_MAX)
        data[7] = min(counters[1], _COUNTER_MAX)
    return pack(ERR_FLAG | classes, bytes(data))
