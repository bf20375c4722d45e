"""CAN controller state of a node, and its effects by CiA 301.

Error passive is an error as long as it lasts (EMCY 8120h). Bus-off is a communication error like a
lost heartbeat. 1029h:1 gives the NMT state that it leads to. The device around the node decides on
other effects (6007h). A bus-off node cannot send, so it reports the bus-off after recovery (EMCY
8140h). The node does not boot then: its configuration stays.

Frames that waited for the bus at bus-off are lost. New frames wait as in the mailboxes of a CAN
controller, one for each identifier: newer data replace older data. Emergencies are all kept.

Source: CiA 301, 7.2.7.1 (table 26) and 1029h; Linux include/uapi/linux/can/error.h.
"""

from enum import IntEnum, unique
from typing import Final, final

from emulators.canopen.emcy import BUS_KEY, EmcyProducer
from emulators.canopen.shared import Outbox
from emulators.media import error_message as e

ERROR_PASSIVE: Final = 0x8120
BUS_OFF_RECOVERED: Final = 0x8140

_EMCY_FUNCTION: Final = 0x080
_PASSIVE: Final = e.RX_PASSIVE | e.TX_PASSIVE
_ACTIVE: Final = e.ERROR_ACTIVE | e.RX_WARNING | e.TX_WARNING


@final
@unique
class CanState(IntEnum):
    """The participation of a CAN controller (ISO 11898-1, error confinement)."""

    ACTIVE = 0
    PASSIVE = 1
    OFF = 2


def state_in(message: bytes) -> CanState | None:
    """Return the state in an error message, or None if it contains none."""
    classes = int.from_bytes(message[:4], "little")
    if classes & e.BUS_OFF:
        return CanState.OFF
    if classes & e.CONTROLLER:
        status = message[9]
        if status & _PASSIVE:
            return CanState.PASSIVE
        if status & _ACTIVE:
            return CanState.ACTIVE
    return CanState.ACTIVE if classes & e.RESTARTED else None


@final
class CanWatch:
    """The last reported state of the CAN controller of a node.

    Attributes:
        is_off: the node is off the bus.
    """

    def __init__(self, emcy: EmcyProducer, outbox: Outbox) -> None:
        self.is_off: bool = False
        self._state: CanState = CanState.ACTIVE
        self._emcy = emcy
        self._outbox = outbox
        self._mailboxes: dict[bytes, bytes] = {}

    def hear(self, message: bytes, now_ns: int) -> bool:
        """Process an error message and return whether the node has just gone off the bus."""
        state = state_in(message)
        before = self._state
        if state is None or state is before:
            return False
        self._state = state
        self.is_off = state is CanState.OFF
        if state is CanState.OFF:
            self._outbox.events.append(("error", "bus-off" + _counters(message)))
            return True
        if before is CanState.OFF:
            self._outbox.frames = [*self._mailboxes.values(), *self._outbox.frames]
            self._mailboxes.clear()
            self.recover(now_ns)
        if state is CanState.PASSIVE:
            self._outbox.events.append(("warning", "CAN error passive" + _counters(message)))
            self.find(ERROR_PASSIVE, now_ns)
        elif before is CanState.PASSIVE:
            self._outbox.events.append(("info", "CAN error active again"))
            self.repair(now_ns)
        return False

    def find(self, code: int, now_ns: int) -> None:
        """Report a CAN error, which lasts until `repair`."""
        self._emcy.find(BUS_KEY, code, b"", now_ns)

    def repair(self, now_ns: int) -> None:
        """End the CAN error."""
        self._emcy.repair(BUS_KEY, now_ns)

    def recover(self, now_ns: int) -> None:
        """Report a past bus-off after the node is on the bus again."""
        self._outbox.events.append(("info", "recovered from bus-off"))
        self.find(BUS_OFF_RECOVERED, now_ns)
        self.repair(now_ns)

    def hold(self, frames: list[bytes]) -> None:
        """Keep these frames until the node is on the bus again."""
        for frame in frames:
            function = int.from_bytes(frame[:2], "little") & 0x780
            self._mailboxes[frame if function == _EMCY_FUNCTION else frame[:4]] = frame


def _counters(message: bytes) -> str:
    classes = int.from_bytes(message[:4], "little")
    return f" (TEC {message[14]}, REC {message[15]})" if classes & e.COUNTERS else ""
