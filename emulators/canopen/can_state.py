"""What a node's CAN controller says of itself, and what CiA 301 makes of that.

Error passive is an error as long as it lasts (EMCY 8120h). Bus-off is an error of communication,
like a lost heartbeat: 1029h:1 says which NMT state it leads to, the device around the node what
else (6007h). Off the bus nobody can be told, so that the node was is told when it is not any more
(EMCY 8140h). The node does not boot by that: its configuration is as it was.

What waited for the bus when it went off is lost. What the node would send meanwhile waits as in the
mailboxes of a CAN controller, one for each identifier: newer data take the place of older ones.
Emergencies each have their own.

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
    """How far a CAN controller takes part (ISO 11898-1, error confinement)."""

    ACTIVE = 0
    PASSIVE = 1
    OFF = 2


def state_in(message: bytes) -> CanState | None:
    """The state that an error message tells; None: it tells none."""
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
    """The state of the CAN controller of one node, as it was told last.

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
        """An error message came; whether the node has just gone off the bus."""
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
        """CAN itself fails: it is told, and stands until `repair`."""
        self._emcy.find(BUS_KEY, code, b"", now_ns)

    def repair(self, now_ns: int) -> None:
        """CAN works."""
        self._emcy.repair(BUS_KEY, now_ns)

    def recover(self, now_ns: int) -> None:
        """The node is on the bus again, and tells that it was not."""
        self._outbox.events.append(("info", "recovered from bus-off"))
        self.find(BUS_OFF_RECOVERED, now_ns)
        self.repair(now_ns)

    def hold(self, frames: list[bytes]) -> None:
        """These wait until the node is on the bus again."""
        for frame in frames:
            function = int.from_bytes(frame[:2], "little") & 0x780
            self._mailboxes[frame if function == _EMCY_FUNCTION else frame[:4]] = frame


def _counters(message: bytes) -> str:
    classes = int.from_bytes(message[:4], "little")
    return f" (TEC {message[14]}, REC {message[15]})" if classes & e.COUNTERS else ""
