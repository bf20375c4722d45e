"""SocketCAN error messages in words.

Source: Linux include/uapi/linux/can/error.h; kernels before 5.19 report no counters.
"""

from enum import Enum
from typing import Final, NamedTuple, final

_CLASSES: Final = 0x1FFF_FFFF
_TIMEOUT: Final = 0x001
_ARBITRATION: Final = 0x002
_CONTROLLER: Final = 0x004
_PROTOCOL: Final = 0x008
_TRANSCEIVER: Final = 0x010
_NO_ACKNOWLEDGE: Final = 0x020
_BUS_OFF: Final = 0x040
_BUS_ERROR: Final = 0x080
_RESTARTED: Final = 0x100
_COUNTERS: Final = 0x200
_KNOWN: Final = 0x3FF
_UNACKNOWLEDGED: Final = "no acknowledgement"

_TRANSMITTING: Final = 0x80
_VIOLATIONS: Final = (  # data[2]
    (0x01, "bit error"),
    (0x02, "form error"),
    (0x04, "stuff error"),
    (0x08, "no dominant bit could be sent"),
    (0x10, "no recessive bit could be sent"),
    (0x20, "overload"),
    (0x40, "active error announced"),
)
_LOCATIONS: Final = {  # data[3]
    0x03: "start of frame",
    0x02: "identifier bits 28 to 21",
    0x06: "identifier bits 20 to 18",
    0x04: "RTR or SRTR",
    0x05: "IDE",
    0x07: "identifier bits 17 to 13",
    0x0F: "identifier bits 12 to 5",
    0x0E: "identifier bits 4 to 0",
    0x0C: "RTR",
    0x0D: "reserved bit 1",
    0x09: "reserved bit 0",
    0x0B: "DLC",
    0x0A: "data",
    0x08: "CRC sequence",
    0x18: "CRC delimiter",
    0x19: "ACK slot",
    0x1B: "ACK delimiter",
    0x1A: "end of frame",
    0x12: "intermission",
    0x11: "active error flag",  # from here on: codes of the SJA1000, which drivers pass through
    0x13: "dominant bits tolerated",
    0x16: "passive error flag",
    0x17: "error delimiter",
    0x1C: "overload flag",
}
_WIRES: Final = {  # data[4]: four bits per wire
    0x4: "no wire",
    0x5: "short to battery",
    0x6: "short to supply",
    0x7: "short to ground",
    0x8: "short to CANH",
}


@final
class ControllerState(Enum):
    """Error state of a CAN controller, in SocketCAN's words."""

    ACTIVE = "error active again"
    WARNING = "error warning"
    PASSIVE = "error passive"
    BUS_OFF = "bus-off"
    RESTARTED = "restarted"


class BusError(NamedTuple):
    """A decoded error message.

    Attributes:
        state: the reported state; None: no state.
        way: "sending", "receiving" or both: the counter that caused the state.
        what: all other contents, in words.
        counters: TEC and REC, at most 255 each; None: not reported.
    """

    state: ControllerState | None
    way: str
    what: tuple[str, ...]
    counters: tuple[int, int] | None

    @property
    def text(self) -> str:
        """The message in words, without its counters."""
        parts = list(self.what)
        if self.state is not None:
            parts.insert(0, f"{self.state.value}{f' {self.way}' if self.way else ''}")
        return ", ".join(parts)

    @property
    def is_unacknowledged(self) -> bool:
        """True if no node acknowledged a frame."""
        return _UNACKNOWLEDGED in self.what

    @property
    def counted(self) -> str:
        """The counters in words, with a leading blank; empty if not reported."""
        return "" if self.counters is None else " (TEC {}, REC {})".format(*self.counters)


def bus_error(frame: bytes) -> BusError:
    """Decode an error message; missing data bytes count as 0."""
    classes = int.from_bytes(frame[:4], "little") & _CLASSES
    data = frame[8 : 8 + frame[4]].ljust(8, b"\0")
    state, way, what = _state(classes, data[1])
    if classes & _PROTOCOL:
        what.append(_violation(data[2], data[3]))
    elif classes & _BUS_ERROR:
        what.append("bus error")
    if classes & _NO_ACKNOWLEDGE:
        what.append(_UNACKNOWLEDGED)
    if classes & _ARBITRATION:
        bit = f" in bit {data[0]}" if data[0] else ""
        what.append(f"arbitration lost{bit}")
    if classes & _TIMEOUT:
        what.append("transmission timed out")
    if classes & _TRANSCEIVER:
        what.append(_transceiver(data[4]))
    unknown = classes & ~_KNOWN
    if unknown or not (what or state):
        what.append(f"class {unknown or classes:X}h")
    counters = (data[6], data[7]) if classes & _COUNTERS else None
    return BusError(state, way, tuple(what), counters)


def _state(classes: int, status: int) -> tuple[ControllerState | None, str, list[str]]:
    """Return state, cause of the state and other reports of the controller."""
    what: list[str] = []
    if classes & _CONTROLLER:
        what += [f"{side} buffer overflow" for bit, side in _BUFFERS if status & bit]
    if classes & _BUS_OFF:
        return ControllerState.BUS_OFF, "", what
    if classes & _CONTROLLER:
        for mask, sending, state in _STATES:
            if status & mask:
                ways = status & mask
                way = "" if ways == mask else "by sending" if ways == sending else "by receiving"
                return state, way if sending else "", what
        if not status:
            what.append("controller problem")
    if classes & _RESTARTED:
        return ControllerState.RESTARTED, "", what
    return None, "", what


_BUFFERS: Final = ((0x01, "receive"), (0x02, "transmit"))
_STATES: Final = (  # data[1]: both bits, the bit for sending
    (0x30, 0x20, ControllerState.PASSIVE),
    (0x0C, 0x08, ControllerState.WARNING),
    (0x40, 0, ControllerState.ACTIVE),
)


def _violation(kind: int, location: int) -> str:
    named = [name for bit, name in _VIOLATIONS if kind & bit] or ["bus error"]
    role = "sending" if kind & _TRANSMITTING else "receiving"
    place = _LOCATIONS.get(location, f"location {location:02X}h") if location else ""
    return f"{' and '.join(named)} while {role}" + (f", in the {place}" if place else "")


def _transceiver(status: int) -> str:
    sides = (("CANH", status & 0xF), ("CANL", status >> 4))
    told = [f"{side} {_WIRES.get(code, f'code {code:X}h')}" for side, code in sides if code]
    return "transceiver" + (f": {', '.join(told)}" if told else " problem")
