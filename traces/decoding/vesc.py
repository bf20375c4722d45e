"""Frames of a VESC in words: commands, status frames, packets.

The names are those of the firmware. Packets of several frames are shown frame by frame.

Source: vedderb/bldc b9d287b3 (firmware 7.01), documentation/comm_can.md.
"""

from collections.abc import Callable
from typing import Final

from motorhil.traces.can_frame import EFF, ERR, RTR, fields
from motorhil.traces.decoding.narrative import BusMessage
from motorhil.traces.layout import Layout, Signal, layouts

_COMMANDS: Final = layouts(
    """
0 SET_DUTY: duty i32/1e5
1 SET_CURRENT: current i32/1e3 A
2 SET_CURRENT_BRAKE: current i32/1e3 A
3 SET_RPM: erpm i32
4 SET_POS: position i32/1e6 deg
5 FILL_RX_BUFFER: offset u8
6 FILL_RX_BUFFER_LONG: offset u16
7 PROCESS_RX_BUFFER: from u8; mode u8; length u16; crc u16
8 PROCESS_SHORT_BUFFER: from u8; mode u8
9 STATUS: erpm i32; current i16/10 A; duty i16/1e3
10 SET_CURRENT_REL: share i32/1e5
11 SET_CURRENT_BRAKE_REL: share i32/1e5
12 SET_CURRENT_HANDBRAKE: current i32/1e3 A
13 SET_CURRENT_HANDBRAKE_REL: share i32/1e5
14 STATUS_2: used i32/1e4 Ah; charged i32/1e4 Ah
15 STATUS_3: used i32/1e4 Wh; charged i32/1e4 Wh
16 STATUS_4: MOSFET temperature i16/10 C; motor temperature i16/10 C; input current i16/10 A;
  position i16/50 deg
17 PING: from u8
18 PONG: from u8; hardware type u8
21 CONF_CURRENT_LIMITS: min i32/1e3 A; max i32/1e3 A
22 CONF_STORE_CURRENT_LIMITS: min i32/1e3 A; max i32/1e3 A
27 STATUS_5: tachometer i32; input voltage i16/10 V
31 SHUTDOWN:
55 UPDATE_PID_POS_OFFSET: angle i32/1e4 deg; store u8
56 POLL_ROTOR_POS:
57 NOTIFY_BOOT:
58 STATUS_6: ADC1 i16/1e3 V; ADC2 i16/1e3 V; ADC3 i16/1e3 V; PPM i16/1e3 V
""",
    "big",
)
_POSITION: Final = Layout("position i32/1e5 deg", "big")
_PACKETS: Final = {
    **{0: "FW_VERSION", 4: "GET_VALUES", 5: "SET_DUTY", 6: "SET_CURRENT", 7: "SET_CURRENT_BRAKE"},
    **{8: "SET_RPM", 9: "SET_POS", 10: "SET_HANDBRAKE", 29: "REBOOT", 30: "ALIVE"},
    **{34: "FORWARD_CAN", 50: "GET_VALUES_SELECTIVE", 62: "PING_CAN", 84: "SET_CURRENT_REL"},
    **{159: "MOTOR_ESTOP"},
}
_TO_SENDER: Final = (7, 8, 18)  # the controller names itself in the first byte
_EVERYBODY: Final = 255
_ONLY_FAULT: Final = bytes((0, 0, 0x80, 0))
_FAULTS: Final = (
    *("none", "over voltage", "under voltage", "DRV", "abs over current", "over temp FET"),
    *("over temp motor", "gate driver over voltage", "gate driver under voltage"),
    *("MCU under voltage", "booting from watchdog reset", "encoder SPI", "sin/cos below minimum"),
    *("sin/cos above maximum", "flash corruption", "offset current sensor 1"),
    *("offset current sensor 2", "offset current sensor 3", "unbalanced currents", "BRK"),
    *("resolver LOT", "resolver DOS", "resolver LOS", "flash corruption app"),
    *("flash corruption motor configuration", "encoder no magnet", "encoder magnet too strong"),
    *("phase filter", "encoder fault", "LV output", "encoder slip", "overspeed", "underspeed"),
    "absolute overspeed",
)


def build(node_id: int) -> Callable[[bytes], BusMessage | None]:
    """Return the decoder of one controller's frames."""

    def decode(frame: bytes) -> BusMessage | None:
        told = fields(frame)
        if told.fd or told.can_id & (EFF | RTR | ERR) != EFF or told.identifier > 0xFFFF:
            return None
        command, number = divmod(told.identifier, 256)
        is_own = number in (node_id, _EVERYBODY)
        is_answer = command in _TO_SENDER and told.data[:1] == bytes((node_id,))
        if command not in _COMMANDS or not (is_own or is_answer):
            return None
        name, (layout,) = _COMMANDS[command]
        if number != node_id:
            name += " to all" if number == _EVERYBODY else f" to {number}"
        if len(told.data) < layout.size:
            return BusMessage(name, problem=f"{len(told.data)} bytes; expected {layout.size}")
        if command == 56 and len(told.data) >= 4:  # an answer; the request is empty
            layout = _POSITION
        signals = [*layout.signals(told.data)]
        if command == 8:
            signals += _packet(told.data[2:])
        elif command == 57:
            signals.append(Signal("hardware", told.data.decode("ascii", "replace"), ""))
        return BusMessage(name, tuple(signals))

    return decode


def _packet(packet: bytes) -> list[Signal]:
    """Return the name of a packet, and its fault."""
    if not packet:
        return []
    signals = [Signal("packet", _PACKETS.get(packet[0], str(packet[0])), "")]
    if packet[0] == 50 and packet[1:5] == _ONLY_FAULT and len(packet) == 6:
        code = packet[5]
        signals.append(Signal("fault", _FAULTS[code] if code < len(_FAULTS) else str(code), ""))
    return signals
