"""The state of a CAN controller as python-can has it, from its error messages.

python-can has three: ACTIVE (error active, the warning level included), PASSIVE (error passive) and
ERROR (bus-off). Its own SocketCAN interface asks nobody and always says ACTIVE.

Source: Linux include/uapi/linux/can/error.h; python-can 4.6.1, can/bus.py and interfaces.
"""

from typing import Final

from can import BusState

from emulators.media.can_frame import ERR_FLAG, can_id_of
from emulators.media.error_message import (
    BUS_OFF,
    CONTROLLER,
    ERROR_ACTIVE,
    RESTARTED,
    RX_PASSIVE,
    RX_WARNING,
    TX_PASSIVE,
    TX_WARNING,
)

_STATE_AT: Final = 9  # data[1] of the message
_PASSIVE: Final = RX_PASSIVE | TX_PASSIVE
_ACTIVE: Final = RX_WARNING | TX_WARNING | ERROR_ACTIVE


def is_error(frame: bytes) -> bool:
    """Whether it is no frame of the bus, but what a CAN controller tells."""
    return bool(can_id_of(frame) & ERR_FLAG)


def state_after(message: bytes, before: BusState) -> BusState:
    """The state once this error message was told; most of them change nothing."""
    classes = can_id_of(message)
    if classes & BUS_OFF:
        return BusState.ERROR
    if classes & CONTROLLER and message[_STATE_AT] & _PASSIVE:
        return BusState.PASSIVE
    if classes & RESTARTED or (classes & CONTROLLER and message[_STATE_AT] & _ACTIVE):
        return BusState.ACTIVE
    return before
