"""Bus condition from the host's CAN controller: error active, passive or bus-off.

Error messages have the SocketCAN format: a can_frame of 8 bytes with ERR_FLAG in its identifier,
whose other bits are error classes. All listeners (`Runtime.listen`) receive them. They are not bus
traffic: no node has sent them. An adaptation has one `BusStatus` per bus. The adaptation passes
error messages to `hear`, and checks the status before it sends and while it waits:

- In bus-off (256 transmit errors) nothing is sent or received: `check` raises LinkError.
- Operations that were waiting when the bus went off fail at once with `failure`, even if the bus
  recovers a moment later: `offs` counts the transitions.
- A controller that stays error passive because of its transmissions gets no ACK: no other node is
  active.

Source: Linux include/uapi/linux/can/error.h.
"""

from enum import Enum
from typing import TYPE_CHECKING, Final, final

from motorapi.errors import LinkError

if TYPE_CHECKING:
    import can

ERROR_FLAG: Final = 0x2000_0000
ERROR_BYTE: Final = 0x20  # in the last byte of an identifier

_CONTROLLER: Final = 0x004
_NO_ACKNOWLEDGE: Final = 0x020
_BUS_OFF: Final = 0x040
_RESTARTED: Final = 0x100
_COUNTERS: Final = 0x200
_RX_WARNING: Final = 0x04
_TX_WARNING: Final = 0x08
_RX_PASSIVE: Final = 0x10
_TX_PASSIVE: Final = 0x20
_ACTIVE: Final = 0x40


@final
class BusCondition(Enum):
    """Fault confinement state of a CAN controller (ISO 11898-1)."""

    ACTIVE = "error active"
    WARNING = "at the error warning limit"
    PASSIVE = "error passive"
    OFF = "bus-off"


@final
class BusStatus:
    """Known state of one bus.

    Attributes:
        name: name of the bus ("can0").
        condition: last reported condition; ACTIVE before the first report.
        since_ns: time of the last change of condition [ns]; None before the first report.
        counters: last reported transmit and receive error counters, or None.
        is_off: True while the bus is off.
        offs: number of transitions to bus-off.
        unacknowledged_ns: time since which frames get no ACK [ns], or None.
    """

    def __init__(self, name: str, remedy: str) -> None:
        """Create the status of a bus without any report.

        Args:
            name: name of the bus.
            remedy: advice for the user if the bus is off.
        """
        self.name: Final = name
        self.condition = BusCondition.ACTIVE
        self.since_ns: int | None = None
        self.counters: tuple[int, int] | None = None
        self.is_off = False
        self.offs = 0
        self.unacknowledged_ns: int | None = None
        self._off_ns: int | None = None
        self._remedy: Final = remedy

    def __repr__(self) -> str:
        return f"<{self}>"

    def __str__(self) -> str:
        text = f"{self.name} is {self.condition.value}"
        if self.since_ns is not None:
            text += f" since {self.since_ns / 1e9:.6f} s"
        if self.counters is not None:
            text += " (TEC {}, REC {})".format(*self.counters)
        return text

    def hear(self, message: bytes, time_ns: int) -> None:
        """Process an error message of the CAN controller, received at `time_ns` [ns]."""
        classes = int.from_bytes(message[:4], "little")
        if classes & _COUNTERS:
            self.counters = (message[14], message[15])
        if classes & _NO_ACKNOWLEDGE and self.unacknowledged_ns is None:
            self.unacknowledged_ns = time_ns
        found = _condition_in(classes, message[9])
        if found is None or found is self.condition:
            return
        self.condition = found
        self.since_ns = time_ns
        if not classes & _COUNTERS:
            self.counters = None
        if found is BusCondition.PASSIVE and message[9] & _TX_PASSIVE:
            if self.unacknowledged_ns is None:
                self.unacknowledged_ns = time_ns
        elif found in (BusCondition.ACTIVE, BusCondition.OFF):
            self.unacknowledged_ns = None
        self.is_off = found is BusCondition.OFF
        if self.is_off:
            self.offs += 1
            self._off_ns = time_ns

    def sent(self) -> None:
        """Record that an own frame was transmitted, and so acknowledged."""
        self.unacknowledged_ns = None

    def check(self) -> None:
        """Raise LinkError while the bus is off."""
        if self.is_off:
            raise self.failure()

    def failure(self) -> LinkError:
        """Return the error for a bus that is, or was, off."""
        if self.is_off:
            reason = "bus-off: nothing is sent or received"
            since_ns, remedy = self._off_ns, self._remedy
            return LinkError(link=self.name, reason=reason, since_ns=since_ns, remedy=remedy)
        at = "once" if self._off_ns is None else f"at {self._off_ns / 1e9:.6f} s"
        reason = f"the bus was off {at} and has recovered; operations waiting at that time failed"
        return LinkError(link=self.name, reason=reason)

    def trouble(self) -> str:
        """Return the problem of the bus for the message of a timeout; "" if none is known."""
        if self.unacknowledged_ns is not None and not self.is_off:
            text = f"{self.name}: no ACK since t = {self.unacknowledged_ns / 1e9:.6f} s"
            return f"{text}, controller {self.condition.value}"
        return "" if self.condition is BusCondition.ACTIVE else str(self)


def _condition_in(classes: int, status: int) -> BusCondition | None:
    """Return the condition that an error message reports, or None."""
    if classes & _BUS_OFF:
        return BusCondition.OFF
    if classes & _CONTROLLER:
        if status & (_RX_PASSIVE | _TX_PASSIVE):
            return BusCondition.PASSIVE
        if status & (_RX_WARNING | _TX_WARNING):
            return BusCondition.WARNING
        if status & _ACTIVE:
            return BusCondition.ACTIVE
    return BusCondition.ACTIVE if classes & _RESTARTED else None


def status_of(bus: "can.BusABC", name: str) -> BusStatus:
    """Return a new status for this bus object, called `name` in messages.

    A bus other than SocketCAN may offer its own remedy in an attribute `bus_off_remedy`.
    """
    remedy = getattr(bus, "bus_off_remedy", "")
    usual = f"ip link set {name} type can restart; or set restart-ms 100 for automatic restart"
    return BusStatus(name, remedy or usual)
