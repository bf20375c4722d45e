"""CAN controller states of python-can, derived from error messages.

python-can has three: ACTIVE (error active, including the warning level), PASSIVE (error passive)
and ERROR (bus-off). Its own SocketCAN interface never queries the controller and always reports
ACTIVE.

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
    """Return True for an error message of a CAN controller, False for a frame of the bus."""
    return bool(can_id_of(frame) & ERR_FLAG)


def state_after(message: bytes, before: BusState) -> BusState:
    """Return the state after this error message; most messages do not change it."""
    classes = can_id_of(message)
    if classes & BUS_OFF:
        return BusState.ERROR
    if classes & CONTROLLER and message[_STATE_AT] & _PASSIVE:
        return BusState.PASSIVE
    if classes & RESTARTED or (classes & CONTROLLER and message[_STATE_AT] & _ACTIVE):
        return BusState.ACTIVE
    return before
