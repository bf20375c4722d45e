"""Event log of a node, and its CAN controller's error messages.

Error messages are those of a driver that reports each error: its type, its place, whether the node
was sending, and the counters after it. A change of the node's error state is reported as Linux's
`can_change_state` does. A bus-off node reports no counters: they would not fit.

Source: Linux drivers/net/can/dev/dev.c; "can: do not report txerr and rxerr during bus-off" (2022)
in its drivers.
"""

from typing import Final, final

from emulators.media import error_message as told
from emulators.media.confinement import Confinement, ErrorState, state_of

# kinds of notes
NOTE_ACCEPTED: Final = 0
NOTE_SENT: Final = 1
NOTE_FAILED: Final = 2
NOTE_LOST: Final = 3
NOTE_ERROR: Final = 4
NOTE_STATE: Final = 5

_TX: Final = (told.ERROR_ACTIVE, told.TX_WARNING, told.TX_PASSIVE)
_RX: Final = (told.ERROR_ACTIVE, told.RX_WARNING, told.RX_PASSIVE)


@final
class ErrorJournal:
    """The log of events at the node with these counters.

    Attributes:
        bit: the bit of the next entry.
        notes: (bit, kind, frame or error message).
    """

    def __init__(self, confinement: Confinement) -> None:
        self.bit = 0
        self.notes: list[tuple[int, int, bytes]] = []
        self._confinement = confinement
        self._state = confinement.state()

    def note(self, kind: int, frame: bytes) -> None:
        """Log an event of this kind for this frame."""
        self.notes.append((self.bit, kind, frame))

    def note_error(self, kind: int, place: int, transmitter: bool) -> None:
        """Log an error of this kind, at this place (data[2] and data[3] of the message)."""
        classes = told.PROTOCOL | told.BUS_ERROR
        if place == told.ACK_SLOT and not kind:
            classes |= told.NO_ACKNOWLEDGE
        confinement = self._confinement
        message = told.pack_error(
            classes,
            protocol=kind | told.TRANSMITTING if transmitter else kind,
            location=place,
            counters=None if confinement.is_off() else (confinement.tec, confinement.rec),
        )
        self.note(NOTE_ERROR, message)

    def note_state(self) -> bool:
        """Log a change of the error state and return whether the node became bus-off."""
        state = self._confinement.state()
        if state == self._state:
            return False
        self._state = state
        self.note(NOTE_STATE, state_message(self._confinement))
        return state == ErrorState.BUS_OFF


def state_message(confinement: Confinement) -> bytes:
    """Return the error message that reports the current error state."""
    if confinement.is_off():
        return told.pack_error(told.BUS_OFF)
    tx, rx = state_of(confinement.tec), state_of(confinement.rec)
    controller = _TX[tx] if tx >= rx else 0
    if rx >= tx:
        controller |= _RX[rx]
    counters = (confinement.tec, confinement.rec)
    return told.pack_error(told.CONTROLLER, controller=controller, counters=counters)
