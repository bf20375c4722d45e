"""Error messages to a node, in the format of SocketCAN.

An error message is a 16-byte can_frame with ERR_FLAG. The identifier's bits are classes of errors,
8 bytes of data give details. Error messages are never on the bus. The medium makes them for the
node that detected an error, and for the record. Lost arbitration is not reported: few common
controllers do (SJA1000, CTU CAN FD), and on a busy bus each frame would cost a message per waiting
node.

Source: Linux include/uapi/linux/can/error.h.
"""

from typing import Final

from emulators.media.can_frame import ERR_FLAG, pack

# classes: bits of the identifier
TX_TIMEOUT: Final = 0x001
ARBITRATION_LOST: Final = 0x002  # data[0]: in which bit
CONTROLLER: Final = 0x004  # data[1]
PROTOCOL: Final = 0x008  # data[2], data[3]
TRANSCEIVER: Final = 0x010  # data[4]
NO_ACKNOWLEDGE: Final = 0x020
BUS_OFF: Final = 0x040
BUS_ERROR: Final = 0x080
RESTARTED: Final = 0x100
COUNTERS: Final = 0x200  # data[6]: TEC, data[7]: REC

# data[1]: the controller's state
RX_OVERFLOW: Final = 0x01
TX_OVERFLOW: Final = 0x02
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
ACTIVE_ANNOUNCED: Final = 0x40
TRANSMITTING: Final = 0x80  # the node was sending

# data[3]: place
UNSPECIFIED: Final = 0x00
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
PASSIVE_FLAG: Final = 0x16
DELIMITER: Final = 0x17  # of an error or overload frame
OVERLOAD_FLAG: Final = 0x1C

_COUNTER_MAX: Final = 0xFF


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
