"""How a bus is, as its own CAN controller tells: error active, passive or off, and since when.

Error messages are those of SocketCAN: a can_frame of 8 bytes with ERR_FLAG in its identifier, whose
other bits are classes of errors. They come to whoever listens (`Runtime.listen`), and are no
traffic: nobody on the bus has sent them. An adaptation has one `BusStatus` for its bus, shows it
each of them, and asks it before it sends, and while it waits:

- Off the bus (256 failures to send) nothing is sent or heard: `check` raises LinkError.
- What was waited for when the bus went off fails at once, by `failure`, though it may be on again
  a moment later: `offs` counts.
- A controller that stays error passive by its sending is alone: nobody acknowledges.

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
    """How far a CAN controller takes part (ISO 11898-1, fault confinement)."""

    ACTIVE = "error active"
    WARNING = "at the error warning limit"
    PASSIVE = "error passive"
    OFF = "bus-off"


@final
class BusStatus:
    """What is known of one bus.

    Attributes:
        name: of the bus ("can0").
        condition: told last; ACTIVE before anything was told.
        since_ns: since when; None: nothing was told.
        counters: transmit and receive error counter, told last; None: they were not told.
        is_off: whether the bus is off now.
        offs: how often it went off.
        unacknowledged_ns: since when nobody acknowledges; None: somebody does, or nothing was told.
    """

    def __init__(self, name: str, remedy: str) -> None:
        """Nothing is known.

        Args:
            name: of the bus.
            remedy: what to do if it is off.
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
        """An error message of its CAN controller came."""
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
        """An own frame was on the wire: somebody has acknowledged it."""
        self.unacknowledged_ns = None

    def check(self) -> None:
        """Raises LinkError while the bus is off."""
        if self.is_off:
            raise self.failure()

    def failure(self) -> LinkError:
        """That the bus is off, or was, to be raised."""
        if self.is_off:
            reason = "bus-off: nothing is sent or heard"
            since_ns, remedy = self._off_ns, self._remedy
            return LinkError(link=self.name, reason=reason, since_ns=since_ns, remedy=remedy)
        at = "once" if self._off_ns is None else f"at {self._off_ns / 1e9:.6f} s"
        reason = f"it went off the bus {at}, and is on again; what waited then is lost"
        return LinkError(link=self.name, reason=reason)

    def trouble(self) -> str:
        """What is wrong with the bus, for who has waited in vain; "" if nothing is known."""
        if self.unacknowledged_ns is not None and not self.is_off:
            text = f"nobody acknowledges on {self.name} since {self.unacknowledged_ns / 1e9:.6f} s"
            return f"{text}, it is {self.condition.value}"
        return "" if self.condition is BusCondition.ACTIVE else str(self)


def _condition_in(classes: int, status: int) -> BusCondition | None:
    """The condition that an error message tells; None: it tells none."""
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
    """The status of this bus object, of which nothing is known yet; messages call it `name`.

    A bus that is not SocketCAN's may tell by an attribute `bus_off_remedy` what to do.
    """
    remedy = getattr(bus, "bus_off_remedy", "")
    usual = f"ip link set {name} type can restart, or restart-ms 100: it does so by itself"
    return BusStatus(name, remedy or usual)
